"""Metrics of devices that are asked for their samples, and of the serial lines that some of them share."""

from collections.abc import Callable
from typing import Final

from imud.contracts.status import PollingStatus, SerialLineCounters
from imud.publishers.metrics.family import DeviceReader, Family, part
from imud.units import NS_PER_S


def _polling(read: Callable[[PollingStatus], float]) -> DeviceReader:
    return part(lambda device: device.polling, read)


def _serial(read: Callable[[SerialLineCounters], float]) -> DeviceReader:
    return part(lambda device: device.serial_line, read)


POLLING_FAMILIES: Final = (
    Family("imud_polls_total", "Deadlines at which the device was read.", (), _polling(lambda p: p.polls)),
    Family(
        "imud_polls_late_total", "Of these, begun more than a quarter of the period after the deadline.", (),
        _polling(lambda p: p.late),
    ),
    Family("imud_polls_missed_total", "Deadlines that passed without a read.", (), _polling(lambda p: p.missed)),
    Family("imud_polls_stale_total", "Reads that gave nothing new.", (), _polling(lambda p: p.stale)),
    Family(
        "imud_poll_delay_seconds_total", "Time from deadline to read, summed over all polls.", (),
        _polling(lambda p: p.late_sum_ns / NS_PER_S),
    ),
    Family(
        "imud_poll_delay_worst_seconds", "Longest time from deadline to read since start.", (),
        _polling(lambda p: p.late_worst_ns / NS_PER_S),
    ),
    Family("imud_transfers_failed_total", "Transfers of polls that failed.", (), _polling(lambda p: p.failed)),
    Family(
        "imud_device_vanished_total", "Times a polled device had to be identified again.", (),
        _polling(lambda p: p.vanished),
    ),
    Family(
        "imud_serial_line_timeouts_total", "Requests on the device's line that nobody answered.", (),
        _serial(lambda line: line.timeouts),
    ),
    Family(
        "imud_serial_line_late_bytes_total", "Bytes on the device's line that came when nothing was asked.", (),
        _serial(lambda line: line.late_bytes),
    ),
    Family(
        "imud_serial_line_strange_bytes_total", "Bytes on the device's line before a reply, or instead of it.", (),
        _serial(lambda line: line.strange_bytes),
    ),
    Family(
        "imud_serial_line_echoes_total", "Requests on the device's line that came back as an echo.", (),
        _serial(lambda line: line.echoes),
    ),
)  # fmt: skip
