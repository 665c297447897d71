"""Types of the socket's messages: parameters and results of the methods, and notifications.

docs/socket.schema.json is generated from these types. Tests check every message of a server against it.
"""

from enum import StrEnum
from typing import Annotated, Any, Final

import msgspec

from imud.attitude.conventions import AttitudeSource, Convention, Heading
from imud.attitude.published import FrameWords
from imud.contracts.condition import DeviceCondition
from imud.contracts.firmware import IMAGE_BYTES_MAX, PRODUCT_MAX
from imud.contracts.status import CKernelStatus, DeviceState, DeviceStatus, MqttStatus, OutputState, SocketStatus
from imud.model.bucket import Bucket
from imud.model.event import Event, StoredEvent
from imud.model.sample import FieldInfo, Sample, Sync
from imud.publishers.socket.subscription import Form


class BigNumbers(StrEnum):
    """Form of integers that may exceed 2⁵³ (`epoch`, members in ns). JavaScript and others round larger numbers."""

    NUMBER = "number"  # JSON numbers
    STRING = "string"  # strings of decimal digits


# --- parameters -----------------------------------------------------------------------------------------------------


class NoParams(msgspec.Struct):
    """Parameters of a method without parameters."""


class OptionsParams(msgspec.Struct):
    """Parameters of `options`. A parameter that is absent or null does not change."""

    big_numbers: BigNumbers | None = None


class WatchParams(msgspec.Struct):
    """Parameters of `watch`. Default: all devices and fields, every sample, `json`, convention of the device."""

    devices: list[str] | None = None
    fields: list[str] | None = None
    rate_hz: float | None = None
    encoding: Form | None = None
    convention: Convention | None = None
    latency_ms: float | None = None  # maximum hold of a sample; default: a period of `rate_hz`, at most 20


class PollParams(msgspec.Struct):
    devices: list[str] | None = None
    fields: list[str] | None = None
    convention: Convention | None = None


class EventsParams(msgspec.Struct):
    devices: list[str] | None = None
    enable: bool | None = None
    since_ns: int | None = None  # CLOCK_MONOTONIC, ns: reply with the stored events since then; default: none
    limit: int | None = None  # maximum number of stored events; default and maximum: 1000


class HistoryParams(msgspec.Struct):
    devices: list[str]  # at most 4
    from_ns: int | None = None  # time stamp of a sample (`t_ns`); default: one hour before `to_ns`
    to_ns: int | None = None  # default: newest sample of each device
    points: int | None = None  # maximum number of buckets of each device, 1 to 1000; default 600
    convention: Convention | None = None


class DeviceParams(msgspec.Struct):
    device: str


class NotifyParams(msgspec.Struct):
    device: str
    latency_ms: float | None = None  # maximum delay until the descriptor becomes readable; default 0


class CommandParams(msgspec.Struct):
    device: str
    name: str
    arguments: dict[str, Any] | None = None


class CalibrateParams(msgspec.Struct):
    device: str
    kind: str
    save: bool | None = None


class FirmwareOpenParams(msgspec.Struct):
    """Parameters of `firmware.open`."""

    size_bytes: Annotated[int, msgspec.Meta(ge=1, le=IMAGE_BYTES_MAX)]


class FirmwareUpdateParams(msgspec.Struct):
    """Parameters of `firmware.update`. The client has written the image into the descriptor of `firmware.open`."""

    device: str
    address: Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]  # address of the first byte
    crc32: Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)]  # CRC-32 of the image, as in zlib
    product: Annotated[str, msgspec.Meta(max_length=PRODUCT_MAX)] | None = None  # product according to the user
    version: Annotated[str, msgspec.Meta(max_length=PRODUCT_MAX)] | None = None  # expected version


class SettingsParams(msgspec.Struct):
    device: str
    fresh: bool | None = None


class SettingsChangeParams(msgspec.Struct):
    """Parameters of `settings.plan` and `settings.apply`. Default of `settings`: the declared settings."""

    device: str
    settings: dict[str, Any] | None = None
    save: bool | None = None


class RecordParams(msgspec.Struct):
    devices: list[str] | None = None  # default: all devices, also devices that imud adds later


# --- results --------------------------------------------------------------------------------------------------------


class NothingMore(msgspec.Struct):
    """Result of a method without a result: an empty object."""


class OptionsResult(msgspec.Struct):
    """Result of `options`: all present options, and the epoch in the requested form."""

    big_numbers: BigNumbers
    epoch: int


class DeviceSummary(msgspec.Struct):
    """A device in the result of `devices`."""

    name: str
    device_id: int  # number of the device, as in slots
    driver: str
    link: str
    state: DeviceState
    problem: str
    condition: DeviceCondition | None
    identity: dict[str, str]
    rate_hz: float
    sync: Sync
    ring: str | None  # path of the shared memory of the device; null without shared memory


class StatusResult(msgspec.Struct):
    now_ns: int  # CLOCK_MONOTONIC
    devices: list[DeviceStatus]
    socket: SocketStatus
    configuration: str  # absolute path of the daemon's configuration file; empty without a file
    mqtt: list[MqttStatus]  # the output `mqtt`; empty if it does not run
    outputs: dict[str, str]  # problem of each output, or port of an output, that does not work
    output_states: list[OutputState]  # each output that the configuration enables
    c_kernel: CKernelStatus


class DeviceFrame(msgspec.Struct, omit_defaults=True):
    """Axes and angles of a device's samples. Only the first four members are present if the driver is unknown."""

    driver: str
    euler_convention: str
    navigation_frame: str
    status_bits: dict[str, str]  # name of each bit of `status`, by bit number
    frame: str | msgspec.UnsetType = msgspec.UNSET
    convention: str | msgspec.UnsetType = msgspec.UNSET
    heading: Heading | msgspec.UnsetType = msgspec.UNSET
    attitude: AttitudeSource | msgspec.UnsetType = msgspec.UNSET  # `host`: imud computes the attitude
    declination_deg: float | msgspec.UnsetType | None = msgspec.UNSET
    conventions: dict[str, FrameWords] | msgspec.UnsetType = msgspec.UNSET


class SlotMember(msgspec.Struct):
    name: str
    struct: str  # type of one number as in Python's `struct`: Q u64, q i64, I u32, H u16, B u8, d f64, s bytes
    count: int  # number of adjacent values
    offset: int  # offset of the first byte


class SlotSchema(msgspec.Struct):
    bytes: int
    layout_version: int
    byte_order: str
    fields: list[SlotMember]
    present_bits: dict[str, int]  # bit of `present` for each optional field
    sync_codes: dict[str, int]  # number of each source of time stamps in `sync`


class SchemaResult(msgspec.Struct):
    protocol: int
    fields: list[FieldInfo]
    devices: dict[str, DeviceFrame]
    slot: SlotSchema
    latency_bounds_ns: list[int]  # upper bounds of `latency_buckets`, ns. The last bucket has no bound.
    states: list[DeviceState]  # values of `state`


class WatchResult(msgspec.Struct, omit_defaults=True):
    encoding: Form
    devices: dict[str, int]  # number of each watched device, as in slots
    rate_hz: float
    latency_ms: float  # maximum hold of a sample for this client
    convention: Convention | None = None  # the requested convention; absent without a request


class PollResult(msgspec.Struct, omit_defaults=True):
    now_ns: int  # CLOCK_MONOTONIC
    samples: Annotated[list[Any], msgspec.Meta(extra_json_schema={"items": {"$ref": "#/$defs/Sample"}})]
    """The newest sample of each device, with the requested members. Devices without a sample are absent."""
    convention: Convention | None = None


class EventsResult(msgspec.Struct, omit_defaults=True):
    enable: bool
    # as in `PastEvents`; absent without `since_ns` in the request
    events: list[StoredEvent] = []
    since_ns: int | None = None


class HistoryResult(msgspec.Struct, omit_defaults=True):
    kept_s: int  # maximum number of seconds that imud keeps of each device
    devices: dict[str, list[Bucket]]  # the oldest bucket first
    convention: Convention | None = None


class NotifyResult(msgspec.Struct):
    """Result of `notify`. The descriptor is part of the same message."""

    device: str
    latency_ms: float


class FirmwareOpenResult(msgspec.Struct):
    """Result of `firmware.open`. The descriptor is part of the same message."""

    size_bytes: int


class StopResult(msgspec.Struct):
    stopped: bool


class RecordResult(msgspec.Struct):
    """Result of `record.start`. The descriptor is part of the same message."""

    devices: list[str] | None  # recorded devices; null for all


class RecordStopResult(msgspec.Struct):
    stopped: bool  # whether a recording was running. imud still sends its queue, then end of file.
    records_dropped: int
    """Number of records that imud dropped because the client did not read. The recording marks each loss."""


class SnapshotResult(msgspec.Struct):
    """Result of `record.snapshot`. The descriptor is part of the same message."""

    seconds: float  # duration of the snapshot


# --- notifications --------------------------------------------------------------------------------------------------


class Greeting(msgspec.Struct):
    protocol: int
    version: str
    epoch: int  # random number of this start of the daemon
    rights: list[str]  # `read`, `control`


class DeviceNotice(msgspec.Struct):
    device: str
    device_id: int


class DroppedNotice(msgspec.Struct):
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
