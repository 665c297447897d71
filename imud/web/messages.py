"""Contract of the messages between `imud web` and its page: JSON objects on a WebSocket. Times are s as floating-point
numbers, since JavaScript has no integers of 64 bits; at an uptime of a year a double still resolves 4 ns."""

from typing import Any, Final, Literal, TypeVar

import msgspec

T = TypeVar("T")

RATES_HZ: Final = (10, 20, 50)
"""Buckets per second that a page can ask for."""
VECTORS: Final = ("accel_m_s2", "gyro_rad_s", "mag_t", "euler_rad")
"""Members of a sample that buckets have."""
SPECTRA: Final = ("accel_m_s2", "gyro_rad_s", "mag_t")
"""Members of a sample whose every value a page can ask for."""

Range = tuple[tuple[float, ...], tuple[float, ...]]
"""Least values of the axes, and greatest."""


class Bucket(msgspec.Struct, frozen=True, omit_defaults=True):
    """The samples of one device in one interval of time. A member is left out where no sample had it."""

    first_s: float
    """Time of the first sample, CLOCK_MONOTONIC."""
    last_s: float
    """Time of the last one."""
    utc_s: float
    """Time of the last one since 1970-01-01 UTC."""
    count: int
    """Samples."""
    seq: int
    """`seq` of the last one."""
    sync: str
    """Source of its time."""
    t_err_s: float
    """Greatest stated error of a time stamp, one sigma."""
    latency_s: float
    """Greatest time from measurement to the arrival of the last byte."""
    accel_m_s2: Range | None = None
    gyro_rad_s: Range | None = None
    mag_t: Range | None = None
    euler_rad: Range | None = None
    quat_wxyz: tuple[float, ...] | None = None
    """Of the last sample that had one."""
    temperature_c: float | None = None
    """Of the last sample that had one."""
    pressure_pa: float | None = None
    """Of the last sample that had one."""


class ToPage(msgspec.Struct, frozen=True, tag_field="kind"):
    """What the page gets."""


class StateMessage(ToPage, frozen=True, tag="state"):
    """Whether there is a daemon."""

    problem: str
    """Why there is none; empty while there is one."""
    version: str
    """Of the daemon, empty while not known."""
    epoch: str
    """Random number of the daemon's start as text, empty while not known."""


class DeviceRow(msgspec.Struct, frozen=True):
    """One device in the overview."""

    name: str
    state: str
    problem: str
    is_well: bool
    driver: str
    link: str
    identity: dict[str, str]
    rate_hz: float
    expected_rate_hz: float
    lost: int
    closes: bool
    """Whether its ledger does."""
    differs: bool
    """Whether its settings differ from the declared ones."""
    alarm: bool
    temperature_c: float | None
    age_s: float | None
    """Of its newest sample; null before the first."""
    t_err_s: float | None
    sync: str
    euler_rad: tuple[float, ...] | None
    accel_m_s2: tuple[float, ...] | None
    gyro_rad_s: tuple[float, ...] | None


class OverviewMessage(ToPage, frozen=True, tag="overview"):
    """All devices."""

    clients: int
    """Of the daemon's socket."""
    devices: tuple[DeviceRow, ...]


class StatusMessage(ToPage, frozen=True, tag="status"):
    """The whole status of one device, as docs/socket.md has it; null where the daemon has no such device."""

    device: str
    now_s: float
    status: dict[str, Any] | None
    lost: int
    bytes_open: int
    """0 in a ledger that closes."""
    frames_open: int
    """0 in a ledger that closes."""
    latency_bounds_s: tuple[float, ...]


class SamplesMessage(ToPage, frozen=True, tag="samples"):
    """Buckets of one device, oldest first."""

    device: str
    rate_hz: int
    buckets: tuple[Bucket, ...]


class RawMessage(ToPage, frozen=True, tag="raw"):
    """Every value of one vector of one device, for a spectrum; samples without it are left out."""

    device: str
    member: str
    seq: tuple[int, ...]
    """A step of more than 1: samples that the page did not get. What imud did not get is a step in `t_s` only."""
    t_s: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]
    """Values of x, of y, of z."""


class NewEvent(msgspec.Struct, frozen=True):
    """One event of the daemon."""

    t_s: float
    device: str
    event: str
    message: str
    detail: dict[str, Any]


class EventsMessage(ToPage, frozen=True, tag="events"):
    """Events as they come; to a new page those that are remembered."""

    events: tuple[NewEvent, ...]


class DroppedMessage(ToPage, frozen=True, tag="dropped"):
    """Messages left out because this browser, or `imud web` itself, was too slow."""

    messages: int
    samples: int
    """Of all devices that are looked at, dropped by the daemon."""


class ProblemMessage(ToPage, frozen=True, tag="problem"):
    """What was wrong with a message of the page."""

    message: str


class Look(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the page shows now: the overview, one device, or nothing (a tab that is hidden)."""

    look: Literal["overview", "device", "nothing"] = "nothing"
    device: str = ""
    rate_hz: Literal[10, 20, 50] = 20
    spectrum: Literal["", "accel_m_s2", "gyro_rad_s", "mag_t"] = ""
    acknowledged: int = 0
    """Messages that the page has dealt with since its last message. A page that only acknowledges leaves out `look`
    by sending the one of before."""


class LoginRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a login."""

    token: str


class CallRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a question or an order."""

    method: str
    params: dict[str, Any] = {}  # msgspec copies a mutable default


encode: Final = msgspec.json.Encoder().encode
"""JSON; NaN and infinity are null."""


def decode_body(body: bytes | str, kind: type[T]) -> T:
    """What a page sent, in this form. Raises ValueError for anything else."""
    try:
        return msgspec.json.decode(body, type=kind)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
