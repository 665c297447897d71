"""Messages between `imud web` and its page: JSON objects on a WebSocket.

Times are floating-point numbers in s, because JavaScript has no 64-bit integers. After a year of uptime, a double has a
resolution of 4 ns.
"""

from typing import Any, Final, Literal, TypeVar

import msgspec

from imud.contracts.condition import Reason
from imud.model.bucket import Bucket

T = TypeVar("T")

RATES_HZ: Final = (10, 20, 50)
"""Possible numbers of buckets per second."""
SPECTRA: Final = ("accel_m_s2", "gyro_rad_s", "mag_t")
"""Members of a sample that a page can request completely."""


class ToPage(msgspec.Struct, frozen=True, tag_field="kind"):
    """Base of the messages to the page."""


class StateMessage(ToPage, frozen=True, tag="state"):
    """State of the connection to the daemon."""

    problem: str  # reason for a missing connection; empty if connected
    version: str  # version of the daemon; empty while unknown
    epoch: str  # random number of the daemon's start as a string; empty while unknown


class DeviceRow(msgspec.Struct, frozen=True):
    """One device in the overview."""

    name: str
    state: str  # condition
    is_well: bool
    since_s: float | None  # time of the last change of the condition, CLOCK_MONOTONIC
    reasons: tuple[Reason, ...]
    history: tuple[str | None, ...]  # worst condition in each of the last 60 minutes, the newest last
    work: str  # running command, calibration or change of settings, one sentence; empty without work
    driver: str
    link: str
    identity: dict[str, str]
    heading: str  # reference of yaw; empty while it is not known
    rate_hz: float
    expected_rate_hz: float
    lost: int
    lost_percent: float | None  # share of lost samples in the last minute; null without samples
    temperature_c: float | None  # null if the values are not current
    age_s: float | None  # age of the newest sample; null before the first sample
    t_err_s: float | None  # null if the values are not current
    sync: str
    euler_rad: tuple[float, ...] | None  # null if the values are not current


class OverviewMessage(ToPage, frozen=True, tag="overview"):
    """All devices. Each visible page gets it, for its list of devices."""

    clients: int  # number of clients of the daemon's socket
    now_s: float  # CLOCK_MONOTONIC of the daemon's host
    devices: tuple[DeviceRow, ...]


class StatusMessage(ToPage, frozen=True, tag="status"):
    """Complete status of one device (docs/socket.md); null if the device is not configured."""

    device: str
    now_s: float
    status: dict[str, Any] | None
    lost: int
    bytes_open: int  # 0 if the ledger balances
    frames_open: int  # 0 if the ledger balances
    latency_bounds_s: tuple[float, ...]
    rows: tuple[tuple[str, str], ...]  # name and text, as `imud status` prints them
    is_stale: bool = False  # whether the values of the device are not current, because no new sample arrives


class SamplesMessage(ToPage, frozen=True, tag="samples"):
    """Buckets of one device, oldest first."""

    device: str
    rate_hz: int
    buckets: tuple[Bucket, ...]
    convention: str = ""  # `enu-flu` for a comparison; empty for the convention of the configuration


class RawMessage(ToPage, frozen=True, tag="raw"):
    """Every value of one vector of one device, for a spectrum, without samples that do not contain it."""

    device: str
    member: str
    seq: tuple[int, ...]
    """Sequence numbers. A step above 1: samples that the page did not get. A step in `t_s` also shows lost samples."""
    t_s: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]  # values of x, y and z


class NewEvent(msgspec.Struct, frozen=True):
    """One event of the daemon."""

    t_s: float
    device: str
    event: str
    message: str
    detail: dict[str, Any]


class EventsMessage(ToPage, frozen=True, tag="events"):
    """New events. A page reads the stored events with the method `events`."""

    events: tuple[NewEvent, ...]


class DroppedMessage(ToPage, frozen=True, tag="dropped"):
    """Numbers of dropped messages and samples, because this browser or `imud web` was too slow."""

    messages: int
    samples: int  # number of samples that the daemon dropped, of the devices of all pages


class ProblemMessage(ToPage, frozen=True, tag="problem"):
    """Error in a message of the page."""

    message: str


class Look(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """View of the page: the overview, one device, or nothing (hidden tab)."""

    look: Literal["overview", "device", "nothing"] = "nothing"
    device: str = ""
    other: str = ""  # second device of a comparison; the samples of both devices then have the convention enu-flu
    rate_hz: Literal[10, 20, 50] = 20
    spectrum: Literal["", "accel_m_s2", "gyro_rad_s", "mag_t"] = ""
    acknowledged: int = 0
    """Number of messages that the page has processed since its last message. A page that only acknowledges repeats its
    view."""

    @property
    def is_comparison(self) -> bool:
        return self.look == "device" and bool(self.other)

    @property
    def devices(self) -> tuple[str, ...]:
        """Names of the shown devices."""
        return (self.device, self.other) if self.is_comparison else (self.device,) * (self.look == "device")


class LoginRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a login."""

    token: str


class CallRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of a request."""

    method: str
    params: dict[str, Any] = {}  # msgspec copies a mutable default


encode: Final = msgspec.json.Encoder().encode
"""Encoder of JSON; NaN and infinity become null."""


def decode_body(body: bytes | str, kind: type[T]) -> T:
    """Return a message of a page as `kind`. Raises ValueError if it has another form."""
    try:
        return msgspec.json.decode(body, type=kind)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
