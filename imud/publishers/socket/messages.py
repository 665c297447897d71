"""Types of the socket's messages: parameters and results of the methods, and the notifications.

docs/socket.schema.json is generated from them, and tests check every message of their servers against it.
"""

from enum import StrEnum
from typing import Annotated, Any, Final

import msgspec

from imud.attitude.conventions import Convention, Heading
from imud.attitude.published import FrameWords
from imud.contracts.status import DeviceState, DeviceStatus, SocketStatus
from imud.model.event import Event
from imud.model.sample import FieldInfo, Sample, Sync
from imud.publishers.socket.subscription import Form


class BigNumbers(StrEnum):
    """Forms of integers that may exceed 2⁵³, beyond which JavaScript and others round: `epoch` and members in ns."""

    NUMBER = "number"
    """JSON numbers."""
    STRING = "string"
    """Text of decimal digits."""


# --- parameters -----------------------------------------------------------------------------------------------------


class NoParams(msgspec.Struct):
    """For methods without parameters."""


class OptionsParams(msgspec.Struct):
    """Parameters of `options`; what is left out or null stays as it is."""

    big_numbers: BigNumbers | None = None


class WatchParams(msgspec.Struct):
    """Parameters of `watch`; left out or null: all, all, every sample, JSON, as the device is set, latency by rate."""

    devices: list[str] | None = None
    fields: list[str] | None = None
    rate_hz: float | None = None
    encoding: Form | None = None
    convention: Convention | None = None
    latency_ms: float | None = None
    """How late samples may be; 0: each at once."""


class PollParams(msgspec.Struct):
    """Parameters of `poll`."""

    devices: list[str] | None = None
    fields: list[str] | None = None
    convention: Convention | None = None


class EventsParams(msgspec.Struct):
    """Parameters of `events`."""

    devices: list[str] | None = None
    enable: bool | None = None


class DeviceParams(msgspec.Struct):
    """Parameters of methods about one device."""

    device: str


class NotifyParams(msgspec.Struct):
    """Parameters of `notify`."""

    device: str
    latency_ms: float | None = None
    """How late the descriptor may become readable; left out, null or 0: with each sample at once."""


class CommandParams(msgspec.Struct):
    """Parameters of `command`."""

    device: str
    name: str
    arguments: dict[str, Any] | None = None


class CalibrateParams(msgspec.Struct):
    """Parameters of `calibrate`."""

    device: str
    kind: str
    save: bool | None = None


class SettingsParams(msgspec.Struct):
    """Parameters of `settings.get`."""

    device: str
    fresh: bool | None = None


class SettingsChangeParams(msgspec.Struct):
    """Parameters of `settings.plan` and `settings.apply`; settings that are left out or null are the declared ones."""

    device: str
    settings: dict[str, Any] | None = None
    save: bool | None = None


class RecordParams(msgspec.Struct):
    """Parameters of `record.start`."""

    devices: list[str] | None = None
    """Names; left out or null: all, also those that appear later."""


# --- results --------------------------------------------------------------------------------------------------------


class NothingMore(msgspec.Struct):
    """Result of a method that has none: an empty object."""


class OptionsResult(msgspec.Struct):
    """Result of `options`: all that hold now, and the epoch of the greeting in that form."""

    big_numbers: BigNumbers
    epoch: int


class DeviceSummary(msgspec.Struct):
    """A device in the result of `devices`."""

    name: str
    device_id: int
    """The daemon's number of the device, as in slots."""
    driver: str
    link: str
    state: DeviceState
    problem: str
    identity: dict[str, str]
    rate_hz: float
    sync: Sync
    ring: str | None
    """Path of its shared memory; null without one."""


class StatusResult(msgspec.Struct):
    """Result of `status`."""

    now_ns: int
    """CLOCK_MONOTONIC."""
    devices: list[DeviceStatus]
    socket: SocketStatus


class DeviceFrame(msgspec.Struct, omit_defaults=True):
    """Axes and angles of a device's samples; without a known driver only the first four."""

    driver: str
    euler_convention: str
    navigation_frame: str
    status_bits: dict[str, str]
    """Name of each bit of `status`, by its number."""
    frame: str | msgspec.UnsetType = msgspec.UNSET
    convention: str | msgspec.UnsetType = msgspec.UNSET
    heading: Heading | msgspec.UnsetType = msgspec.UNSET
    declination_deg: float | msgspec.UnsetType | None = msgspec.UNSET
    conventions: dict[str, FrameWords] | msgspec.UnsetType = msgspec.UNSET


class SlotMember(msgspec.Struct):
    """A field of a slot."""

    name: str
    struct: str
    """Type of one number as in Python's `struct`: Q u64, q i64, I u32, H u16, B u8, d f64, s bytes."""
    count: int
    """How many of them stand there, one after the other."""
    offset: int
    """First byte."""


class SlotSchema(msgspec.Struct):
    """Layout of a slot."""

    bytes: int
    layout_version: int
    byte_order: str
    fields: list[SlotMember]
    present_bits: dict[str, int]
    """Bit of `present` for each field that may be absent."""
    sync_codes: dict[str, int]
    """Number of each source of time stamps in `sync`."""


class SchemaResult(msgspec.Struct):
    """Result of `schema`."""

    protocol: int
    fields: list[FieldInfo]
    devices: dict[str, DeviceFrame]
    slot: SlotSchema
    latency_bounds_ns: list[int]
    """Upper bounds of the members of `latency_buckets`, ns; a last bucket without bound follows."""
    states: list[DeviceState]
    """Values of `state`."""


class WatchResult(msgspec.Struct, omit_defaults=True):
    """Result of `watch`."""

    encoding: Form
    devices: dict[str, int]
    """The daemon's number of each device that is watched, as in slots."""
    rate_hz: float
    latency_ms: float
    """How late samples may be for this client."""
    convention: Convention | None = None
    """The one that was asked for; left out where none was."""


class PollResult(msgspec.Struct, omit_defaults=True):
    """Result of `poll`."""

    now_ns: int
    """CLOCK_MONOTONIC."""
    samples: Annotated[list[Any], msgspec.Meta(extra_json_schema={"items": {"$ref": "#/$defs/Sample"}})]
    """The newest sample of each device that has one; with `fields` the members that were asked for."""
    convention: Convention | None = None


class EventsResult(msgspec.Struct):
    """Result of `events`."""

    enable: bool


class NotifyResult(msgspec.Struct):
    """Result of `notify`, which carries the descriptor."""

    device: str
    latency_ms: float


class StopResult(msgspec.Struct):
    """Result of `stop_calibration`."""

    stopped: bool


class RecordResult(msgspec.Struct):
    """Result of `record.start`, which carries the descriptor."""

    devices: list[str] | None
    """What is recorded; null for all."""


class RecordStopResult(msgspec.Struct):
    """Result of `record.stop`."""

    stopped: bool
    """Whether there was a recording; what waits for the client still comes before end of file."""
    records_dropped: int
    """Records that had no room because the client did not read; the recording says where."""


class SnapshotResult(msgspec.Struct):
    """Result of `record.snapshot`, which carries the descriptor."""

    seconds: float
    """How long the snapshot is."""


# --- notifications --------------------------------------------------------------------------------------------------


class Greeting(msgspec.Struct):
    """Parameters of `hello`."""

    protocol: int
    version: str
    epoch: int
    """Random number of this start of the daemon."""
    rights: list[str]
    """`read`, `control`."""


class DeviceNotice(msgspec.Struct):
    """Parameters of `device` and `device_removed`."""

    device: str
    device_id: int


class DroppedNotice(msgspec.Struct):
    """Parameters of `dropped`."""

    device: str
    dropped: int


NOTIFICATIONS: Final[dict[str, Any]] = {
    "hello": Greeting,
    "device": DeviceNotice,
    "device_removed": DeviceNotice,
    "sample": Sample,
    "dropped": DroppedNotice,
    "event": Event,
}
"""Parameters of each notification that the server sends."""
