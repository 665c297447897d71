"""Status of a device as rows of name and text, for `imud status` and the page of `imud web`."""

from collections.abc import Iterator
from math import degrees

from imud.attitude.conventions import AttitudeSource, Heading
from imud.contracts.setting import SettingsState, SettingsStatus
from imud.contracts.status import DeviceStatus, FrameStatus, LinesStatus, PollingStatus, SerialLineCounters, UtcStatus
from imud.model.ledger import LEDGER_FIELDS, bytes_open, frames_open, lost
from imud.model.options import shown
from imud.model.sample import Position
from imud.model.units import NS_PER_MS, NS_PER_US


def times(count: int) -> str:
    """Format a number of repetitions, for example `1 time`."""
    return f"{count} time{'' if count == 1 else 's'}"


def rows(status: DeviceStatus) -> Iterator[tuple[str, str]]:
    """Yield name and text of all rows. Each name occurs once."""
    clock, ledger = status.clock, dict.fromkeys(LEDGER_FIELDS, 0) | status.ledger
    accounted = "all accounted for" if closes(ledger) else "NOT ALL ACCOUNTED FOR"
    yield "link", f"{status.state}; {status.link}, driver {status.driver}, opened {times(status.connects)}"
    yield "identity", ", ".join(f"{name} {value}" for name, value in status.identity.items()) or "not known"
    if status.frame is not None:
        yield "axes", axes(status.frame)
    yield "rate", f"{status.rate_hz:.1f} Hz measured, {status.expected_rate_hz:.1f} Hz by the device's clock"
    yield (
        "clock",
        f"{clock.sync}, skew {clock.skew_ppm:+.2f} ppm, residual {clock.residual_ns / NS_PER_US:.1f} µs, "
        f"error {clock.t_err_ns / NS_PER_MS:.3f} ms, {clock.resets} resets",
    )
    yield "latency", latency(status)
    yield (
        "samples",
        f"{ledger['samples']}; lost {lost(ledger)} (device {ledger['lost_gap_device']}, damaged "
        f"{ledger['lost_crc']}, overrun {ledger['lost_overrun']}, queue {ledger['lost_queue']}), "
        f"{ledger['lost_unknown']} gaps of unknown size"
        + (f"; {frames} lost CAN frames" if (frames := ledger["frames_lost"]) else ""),
    )
    yield (
        "bytes",
        f"{ledger['bytes_in']} = {ledger['bytes_in_good_frames']} in good frames"
        f" + {ledger['bytes_in_bad_frames']} in bad frames + {ledger['bytes_skipped']} skipped"
        f" + {ledger['bytes_pending']} pending: {accounted}",
    )
    yield (
        "kernel",
        f"{status.kernel.overrun} overruns, {status.kernel.framing} framing, {status.kernel.parity} parity",
    )
    yield from parts(status)


def axes(frame: FrameStatus) -> str:
    """Format axes and heading."""
    own = frame.convention == "device"
    words = f"{frame.frame if own else f'{frame.convention}, {frame.frame}'}; heading {frame.heading}"
    if frame.attitude is AttitudeSource.HOST:
        return f"{words} to the start of the attitude filter; imud computes the attitude on the host"
    if frame.heading is Heading.RELATIVE:
        words += " to power-on" + ("; declination_deg is ignored" if frame.declination_deg is not None else "")
    elif frame.declination_deg is not None:
        words += f" with a declination of {frame.declination_deg:g}°"
    return words


def parts(status: DeviceStatus) -> Iterator[tuple[str, str]]:
    """Yield name and text of the rows that exist for some devices only."""
    clock = status.clock
    if status.declared is not None and status.declared.state is not SettingsState.UNDECLARED:
        yield "settings", declared(status.declared)
    if status.declared is not None and status.declared.unsaved:
        yield "unsaved", f"a change is not saved: run `imud command {status.name} save`"
    optional = (("unused", status.unused), ("position", position(status.position) if status.position else ""))
    yield from ((name, words) for name, words in optional if words)
    if status.status_bit_names and status.status_bits is not None:
        yield "status", ", ".join(status.status_words) or "no known bit is set"
    if status.settings:
        yield "present", ", ".join(f"{name} {value}" for name, value in status.settings.items())
    if status.polling is not None:
        yield "polling", polling(status.polling)
    if status.serial_line is not None:
        yield "line", serial_line(status.serial_line)
    if clock.edges:
        missed = f", {clock.triggers_missed} triggers without a frame" if clock.triggers_missed else ""
        yield (
            "pulses",
            f"{clock.edges}, {clock.edges_unpaired} without a sample{missed}; "
            f"{clock.samples_unpaired} samples without a pulse",
        )
    if status.lines is not None:
        for name, count in status.lines.edges.items():
            yield name, watched(status.lines, name, count)
        if status.lines.sin:
            yield "sin", driven(status.lines)
        others = status.lines.problems.keys() - status.lines.edges.keys() - {"sin"}
        yield from ((name, status.lines.problems[name]) for name in sorted(others))
    if status.utc is not None:
        yield "utc", utc(status.utc)


def position(place: Position) -> str:
    """Format a position."""
    words = [f"{degrees(place.latitude_rad):.7f}°, {degrees(place.longitude_rad):.7f}°"]
    if place.height_m is not None:
        words.append(f"{place.height_m:.2f} m")
    for name, value in (("quality", place.quality), ("satellites", place.satellites)):
        words += [] if value is None else [f"{name} {value}"]
    return ", ".join(words)


def declared(settings: SettingsStatus) -> str:
    """Format the differences between declared settings and device settings."""
    words = str(settings.state)
    if settings.differences:
        words += ": " + ", ".join(
            f"{name} is {'not reported' if one.actual is None else shown(one.actual)}, declared {shown(one.declared)}"
            for name, one in settings.differences.items()
        )
    if settings.unverified:
        words += f"; not reported by the device: {', '.join(settings.unverified)}"
    return words + (f" ({settings.problem})" if settings.problem else "")


def polling(polls: PollingStatus) -> str:
    """Format the reads of a polled device."""
    return (
        f"{polls.polls} reads, {polls.late} late, {polls.missed} missed, {polls.stale} stale, {polls.failed} failed;"
        f" {polls.late_mean_ns / NS_PER_US:.1f} µs after the deadline,"
        f" maximum {polls.late_worst_ns / NS_PER_US:.1f} µs; vanished {times(polls.vanished)}"
    )


def serial_line(line: SerialLineCounters) -> str:
    """Format the faults of an RS-485 bus."""
    return (
        f"{line.timeouts} requests without a reply; {line.late_bytes} bytes without a request, {line.strange_bytes} "
        f"invalid bytes; {line.echoes} echoes (all devices of the bus)"
    )


def watched(lines: LinesStatus, name: str, edges: int) -> str:
    """Format the row of one GPIO input line."""
    words = f"{edges} edges, {lines.edges_lost.get(name, 0)} lost"
    if name == "alarm":
        level = {True: "ACTIVE", False: "inactive", None: "level unknown"}[lines.alarm]
        words = f"{level}, raised {times(lines.alarms)}; {words}"
    return words + problem_of(lines, name)


def driven(lines: LinesStatus) -> str:
    """Format the row of SIN."""
    return (
        f"{lines.triggers} triggers, {lines.triggers_missed} missed;"
        f" {lines.trigger_late_mean_ns / NS_PER_US:.1f} µs after the deadline,"
        f" maximum {lines.trigger_late_worst_ns / NS_PER_US:.1f} µs{problem_of(lines, 'sin')}"
    )


def problem_of(lines: LinesStatus, name: str) -> str:
    """Format the problem of a GPIO line in brackets; empty if the line has no problem."""
    return f" ({lines.problems[name]})" if name in lines.problems else ""


def utc(status: UtcStatus) -> str:
    """Format the RMC sentences, the PPS pulses, and the samples for chronyd."""
    words = []
    if status.source:
        refused = ", ".join(f"{cause} {count}" for cause, count in status.refused.items())
        words.append(
            f"{status.source}: {status.sentences} sentences, {status.sent} sent"
            + (f", not sent: {refused}" if refused else "")
        )
    if status.pulses or status.pulses_ignored:
        words.append(f"{status.pulses} pulses, {status.pulses_ignored} ignored")
    if status.chrony_sent or status.chrony_refused:
        words.append(f"sent to chronyd {status.chrony_sent}, refused {status.chrony_refused}")
    return ("; ".join(words) or "no pulse and no sentence yet") + (f" ({status.problem})" if status.problem else "")


def closes(ledger: dict[str, int]) -> bool:
    """Return whether a ledger balances: both open sums are zero."""
    return bytes_open(ledger) == 0 and frames_open(ledger) == 0


def latency(status: DeviceStatus) -> str:
    """Format the mean time from measurement to publication."""
    count = sum(status.latency_buckets)
    mean = f"{status.latency_sum_ns / count / NS_PER_MS:.3f} ms mean over {count} samples" if count else "no samples"
    return f"{mean}; {held(status)}"


def held(status: DeviceStatus) -> str:
    """Format the hold of the samples, and the client or output that limits it."""
    limit = f"limit {status.hold_wanted_ns / NS_PER_MS:g} ms" + (f", {status.hold_by}" if status.hold_by else "")
    return f"batching {status.hold_ns / NS_PER_MS:g} ms ({limit})"
