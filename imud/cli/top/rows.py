"""Rows of the table of `imud top`: their columns, their order, and which of them are shown."""

from collections.abc import Callable, Iterable
from math import inf
from typing import Final, NamedTuple

from imud.cli.output import fitted, shortened
from imud.cli.top.history import DeviceHistory, norm
from imud.contracts.status import DeviceState
from imud.ledger import lost
from imud.log import printable
from imud.units import NS_PER_S, NS_PER_US, RAD_PER_DEG

WIDTH: Final = 78
"""Of a row: a terminal of 80 columns less the scroll bar."""
NONE: Final = "-"
NAME_WIDTH: Final = 10
TEXT_MAX: Final = 256
AGE_OLD_S: Final = 999.9
"""Beyond this an age is shown in minutes, hours or days."""

Number = float | int | None


class Column(NamedTuple):
    """One column."""

    title: str
    width: int
    text: Callable[[DeviceHistory, int], str]
    """Of a device at a time (CLOCK_MONOTONIC, ns)."""
    key: Callable[[DeviceHistory, int], float | str]
    """What rows are sorted by."""
    is_number: bool = True
    """Numbers stand to the right, and the largest comes first."""


def _number(
    title: str, width: int, value: Callable[[DeviceHistory, int], Number], show: Callable[[float], str]
) -> Column:
    def text(device: DeviceHistory, now_ns: int) -> str:
        found = value(device, now_ns)
        return NONE if found is None else fitted(found, width, show)

    def key(device: DeviceHistory, now_ns: int) -> float:
        found = value(device, now_ns)
        return -inf if found is None else found

    return Column(title, width, text, key)


def age_s(device: DeviceHistory, now_ns: int) -> float | None:
    """Time since the newest sample was measured, s; None before the first."""
    newest = device.newest
    return None if newest is None else max(now_ns - newest.t_ns, 0) / NS_PER_S


def duration(seconds: float) -> str:
    """Format a time in at most five characters."""
    if seconds < 10:
        return f"{seconds:.2f}s"
    if seconds <= AGE_OLD_S:
        return f"{seconds:.0f}s"
    if seconds < 100 * 3600:
        return f"{seconds / 60:.0f}m" if seconds < 999 * 60 else f"{seconds / 3600:.0f}h"
    return f"{seconds / 86400:.0f}d"


def _angle(index: int) -> Callable[[DeviceHistory, int], Number]:
    def value(device: DeviceHistory, now_ns: int) -> Number:
        newest = device.newest
        return None if newest is None or newest.euler_rad is None else newest.euler_rad[index] / RAD_PER_DEG

    return value


def _accel(device: DeviceHistory, now_ns: int) -> Number:
    return None if device.newest is None else norm(device.newest.accel_m_s2)


def _turn_rate(device: DeviceHistory, now_ns: int) -> Number:
    found = None if device.newest is None else norm(device.newest.gyro_rad_s)
    return None if found is None else found / RAD_PER_DEG


def _error_us(device: DeviceHistory, now_ns: int) -> Number:
    return None if device.newest is None else device.newest.t_err_ns / NS_PER_US


def _counted(name: str) -> Callable[[DeviceHistory, int], Number]:
    return lambda device, now_ns: device.status.ledger.get(name, 0)


def _whole(value: float) -> str:
    return f"{value:.0f}"


def _tenths(value: float) -> str:
    return f"{value:.1f}"


def _hundredths(value: float) -> str:
    return f"{value:.2f}"


STATE_ORDER: Final = (
    DeviceState.FAILED, DeviceState.MISSING, DeviceState.SILENT, DeviceState.SEARCHING, DeviceState.RUNNING,
    DeviceState.FINISHED,
)  # fmt: skip
"""What needs attention comes first."""

NAME: Final = Column(
    "DEVICE",
    NAME_WIDTH,
    lambda device, now_ns: shortened(printable(device.status.name, TEXT_MAX), NAME_WIDTH),
    lambda device, now_ns: device.status.name,
    is_number=False,
)
STATE: Final = Column(
    "STATE",
    9,
    lambda device, now_ns: str(device.status.state),
    lambda device, now_ns: f"{STATE_ORDER.index(device.status.state)}",
    is_number=False,
)
RATE: Final = _number("HZ", 6, lambda device, now_ns: device.status.rate_hz, _tenths)
AGE: Final = Column(
    "AGE",
    5,
    lambda device, now_ns: NONE if (age := age_s(device, now_ns)) is None else duration(age),
    lambda device, now_ns: inf if (age := age_s(device, now_ns)) is None else age,
)
LOST: Final = _number("LOST", 5, lambda device, now_ns: lost(device.status.ledger), _whole)
ERROR: Final = _number("±µs", 5, _error_us, _whole)
SYNC: Final = Column(
    "STAMP",
    5,
    lambda device, now_ns: NONE if device.newest is None else str(device.newest.sync)[:5],
    lambda device, now_ns: "" if device.newest is None else str(device.newest.sync),
    is_number=False,
)

VIEWS: Final[dict[str, tuple[Column, ...]]] = {
    "motion": (
        NAME, STATE, RATE, AGE, LOST, ERROR,
        _number("ROLL°", 6, _angle(0), _tenths),
        _number("PITCH°", 6, _angle(1), _tenths),
        _number("YAW°", 6, _angle(2), _tenths),
        _number("|a|", 5, _accel, _hundredths),
        _number("|ω|°", 5, _turn_rate, _tenths),
    ),
    "losses": (
        NAME, RATE,
        _number("EXPECT", 6, lambda device, now_ns: device.status.expected_rate_hz or None, _tenths),
        LOST,
        _number("DEVICE", 6, _counted("lost_gap_device"), _whole),
        _number("DAMAG", 5, _counted("lost_crc"), _whole),
        _number("OVERR", 5, _counted("lost_overrun"), _whole),
        _number("QUEUE", 5, _counted("lost_queue"), _whole),
        _number("UNKN", 4, _counted("lost_unknown"), _whole),
        _number("CRC", 5, _counted("frames_bad_crc"), _whole),
        _number("OPENS", 5, lambda device, now_ns: device.status.connects, _whole),
        _number("°C", 5, lambda device, now_ns: device.status.temperature_c, _tenths),
    ),
    "clock": (
        NAME, SYNC, ERROR,
        _number("SKEWppm", 8, lambda device, now_ns: device.status.clock.skew_ppm, _hundredths),
        _number("RESIDµs", 7, lambda device, now_ns: device.status.clock.residual_ns / NS_PER_US, _tenths),
        _number("HOLDms", 6, lambda device, now_ns: device.status.hold_ns / 1e6, _tenths),
        _number("STEER", 6, lambda device, now_ns: device.status.clock.steering_ppm, _tenths),
        _number("RESETS", 6, lambda device, now_ns: device.status.clock.resets, _whole),
        _number("PULSES", 6, lambda device, now_ns: device.status.clock.edges, _whole),
        _number("UNPAIR", 6, lambda device, now_ns: device.status.clock.edges_unpaired, _whole),
    ),
}  # fmt: skip
"""Sets of columns, by name; each WIDTH wide at most, with a space between two columns."""

SORTS: Final = (NAME, STATE, RATE, AGE, LOST, ERROR)
"""What rows can be sorted by, in the order in which the key goes through them."""


def head(columns: Iterable[Column]) -> str:
    """Format the titles."""
    return _line((column.title, column) for column in columns)


def row(device: DeviceHistory, columns: Iterable[Column], now_ns: int) -> str:
    """Format one device."""
    return _line((column.text(device, now_ns), column) for column in columns)


def _line(cells: Iterable[tuple[str, Column]]) -> str:
    parts = [
        text[: column.width].rjust(column.width) if column.is_number else text[: column.width].ljust(column.width)
        for text, column in cells
    ]
    return " ".join(parts)


def chosen(
    devices: Iterable[DeviceHistory], sort: Column, now_ns: int, *, backwards: bool = False, words: str = ""
) -> list[DeviceHistory]:
    """Sort devices, the largest number first, and leave out those in which not all `words` occur.

    Words are looked for in name, state, driver, link, problem and identity, whatever their case.
    """
    wanted = words.casefold().split()
    found = [device for device in devices if all(word in _searched(device) for word in wanted)]
    found.sort(key=lambda device: device.status.name)
    found.sort(key=lambda device: sort.key(device, now_ns), reverse=sort.is_number != backwards)
    return found


def _searched(device: DeviceHistory) -> str:
    status = device.status
    parts = (status.name, status.state, status.driver, status.link, status.problem, *status.identity.values())
    return " ".join(parts).casefold()
