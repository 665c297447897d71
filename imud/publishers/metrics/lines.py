"""Metrics of the wires of a device besides its data."""

from collections.abc import Callable
from typing import Final

from imud.contracts.status import DeviceStatus, LinesStatus
from imud.publishers.metrics.family import DeviceReader, Family, Labelled, part, part_labelled
from imud.units import NS_PER_S


def _lines(read: Callable[[LinesStatus], float | None]) -> DeviceReader:
    return part(lambda device: device.lines, read)


def _by_line(read: Callable[[LinesStatus], Labelled]) -> DeviceReader:
    return part_labelled(lambda device: device.lines, read)


def _problems(lines: LinesStatus) -> Labelled:
    names = dict.fromkeys((*lines.edges, *(("sin",) if lines.sin else ()), *lines.problems))
    return (((name,), float(name in lines.problems)) for name in names)


def _with_alarm(device: DeviceStatus) -> LinesStatus | None:
    return device.lines if device.lines is not None and "alarm" in device.lines.edges else None


def _with_sin(device: DeviceStatus) -> LinesStatus | None:
    return device.lines if device.lines is not None and device.lines.sin else None


LINE_FAMILIES: Final = (
    Family(
        "imud_line_problem", "1 while a line cannot be used, or its level cannot be right.", ("line",),
        _by_line(_problems),
    ),
    Family(
        "imud_line_edges_total", "Edges seen on a line.", ("line",),
        _by_line(lambda lines: (((name,), count) for name, count in lines.edges.items())),
    ),
    Family(
        "imud_line_edges_lost_total", "Edges that the kernel dropped because they were not read in time.", ("line",),
        _by_line(lambda lines: (((name,), count) for name, count in lines.edges_lost.items())),
    ),
    Family(
        "imud_alarm_active", "1 while the ALARM line is active; absent while nobody knows.", (),
        _lines(lambda lines: None if lines.alarm is None else float(lines.alarm)),
    ),
    Family(
        "imud_alarms_total", "Times the ALARM line became active.", (), part(_with_alarm, lambda lines: lines.alarms)
    ),
    Family("imud_triggers_total", "Triggers made on SIN.", (), part(_with_sin, lambda lines: lines.triggers)),
    Family(
        "imud_triggers_missed_total", "Deadlines for which no trigger was made, the host being busy.", (),
        part(_with_sin, lambda lines: lines.triggers_missed),
    ),
    Family(
        "imud_trigger_delay_seconds_total", "Time from deadline to trigger, summed over all.", (),
        part(_with_sin, lambda lines: lines.trigger_late_sum_ns / NS_PER_S),
    ),
    Family(
        "imud_trigger_delay_worst_seconds", "Longest time from deadline to trigger since start.", (),
        part(_with_sin, lambda lines: lines.trigger_late_worst_ns / NS_PER_S),
    ),
)  # fmt: skip
