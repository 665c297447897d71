"""Contract of a driver, the description of one wire protocol for the rest of imud."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from imud.attitude.conventions import RFU_ENU, DeviceAxes, Heading
from imud.contracts.codec import CanCodec, PolledCodec, StreamCodec
from imud.contracts.command import Actions, Calibrations
from imud.contracts.lines import NO_TIME_BITS, AlarmRanges, DeviceLines, TimeBits
from imud.contracts.script import RequestScript, TransferScript
from imud.contracts.setting import SettingsTable
from imud.formats.can import CanFilter, CanFrame, CyclicFrame
from imud.model.ledger import Ledger
from imud.model.options import Options

SensorName = Literal["gyro", "accel"]
Figure = Annotated[float, Meta(gt=0)] | None
"""A positive figure, None where none is stated."""


class SensorFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Figures of one sensor, SI; (rad/s) stands for the unit of the rate, m/s² for an accelerometer."""

    random_walk: Figure = None
    """Angle or velocity random walk N, (rad/s)/√Hz."""
    noise_density: Figure = None
    """Root of the one-sided spectral density, (rad/s)/√Hz: √2 N of white noise."""
    bias_instability: Figure = None
    """The least Allan deviation over 0.664, rad/s."""
    rate_random_walk: Figure = None
    """K, (rad/s)/√s."""
    temperature_slope: Figure = None
    """Change of the bias with temperature, either sign, (rad/s)/K."""


class ModelFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Figures of one model."""

    gyro: SensorFigures = SensorFigures()
    accel: SensorFigures = SensorFigures()
    source: str = ""
    """Document and section."""


def _no_filter(_settings: Mapping[str, str], _sensor: SensorName) -> str:
    return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSheet:
    """What is known of the sensors of a driver's devices from the vendor's documents."""

    document: str = ""
    """Title and version of the manual, and what it says of noise, in one sentence; empty for a driver without one."""
    models: Mapping[str, ModelFigures] = field(default_factory=dict)
    """Figures by the begin of the product's name; empty where the manual has none for any model."""
    gyro_step_rad_s: float | None = None
    """Value of one count of the angular rate on the wire; None for floats, or where the message decides."""
    accel_step_m_s2: float | None = None
    """The same of the acceleration."""
    filter_words: Callable[[Mapping[str, str], SensorName], str] = _no_filter
    """Describes the device's own low-pass filter of a sensor, from its settings as read back; empty: not known."""

    def figures_of(self, product: str) -> ModelFigures | None:
        """Return the figures of a model by its product name, the longest begin that fits; None for none."""
        fitting = [begin for begin in self.models if product.startswith(begin)]
        return self.models[max(fitting, key=len)] if fitting else None


SAMPLE_COUNTER = 0
"""`tick_ns` of a device whose counter numbers its samples: a tick is one sample, its length is not known."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity as the device reports it. Strings are empty where it reports none."""

    product: str = ""
    serial_number: str = ""
    firmware: str = ""
    details: Mapping[str, str] | None = None
    """Further properties, by the device's own names."""


class KeyProblem(NamedTuple):
    """A value in the configuration with which a driver cannot work."""

    part: str
    """`link` or `options`."""
    key: str
    """The key in that part."""
    message: str
    """What is expected, what came, and figures where they decide."""


class StatusBit(NamedTuple):
    """Meaning of one bit of `Measurement.status`."""

    name: str
    """What the device says while it is set, for people."""
    notable: bool = False
    """Whether its change is an event: values are wrong, or not yet right, while it is set."""


def status_words(bits: Mapping[int, StatusBit], status: int | None) -> tuple[str, ...]:
    """Return the names of the bits that are set, as far as they are known."""
    return tuple(bit.name for number, bit in bits.items() if status is not None and status >> number & 1)


def no_problems(_options: Any, _link: Any) -> Sequence[KeyProblem]:
    """Find no problem: the version for drivers without rules of their own."""
    return ()


def _unknown_heading(_settings: object, _read_back: Mapping[str, str]) -> Heading:
    return Heading.UNKNOWN


@dataclass(frozen=True, slots=True, kw_only=True)
class Driver:
    """Fields that drivers of all wire protocols have; the links that a driver can use follow from its kind."""

    name: str
    """Family and link, for example `hipnuc-uart`."""
    title: str
    """Vendor and products, for people."""
    settings: type[Options]
    """Type of the driver's settings (`options` of a device)."""
    tick_ns: int
    """Length of one device tick in ns, or SAMPLE_COUNTER."""
    tick_modulus: int
    """Device time counts 0 … tick_modulus - 1."""
    stamp_modulus: int = 0
    """After how many ms `Measurement.pps_age_ms` begins anew without a pulse, where it dates messages without device
    time; 0 where there are no such messages."""
    euler_convention: str
    """Order, axes and signs of `euler_rad`, in words."""
    navigation_frame: str
    """The frame that `quat_wxyz` turns into, for example `ENU`."""
    axes: DeviceAxes = RFU_ENU
    """The same of its axes, angles and navigation frame, for conversions."""
    heading: Callable[[Any, Mapping[str, str]], Heading] = _unknown_heading
    """Reference of yaw, from an instance of `settings` and the device's own settings as read back (empty: none yet)."""
    actions: Actions = field(default_factory=dict)
    """Commands that the device executes, by name."""
    calibrations: Calibrations = field(default_factory=dict)
    """Guided calibrations, by kind."""
    device_settings: SettingsTable | None = None
    """Settings that the device keeps itself; None for a driver that does not know them."""
    lines: frozenset[str] = frozenset()
    """GPIO lines that such a device can have: names of `imud.contracts.lines.DeviceLines`."""
    alarm_ranges: Callable[[Mapping[str, str]], AlarmRanges] | None = None
    """Reads the meaning of the ALARM line from the device's settings; None if they have none."""
    time_bits: TimeBits = NO_TIME_BITS
    """Bits of `Measurement.status` about time."""
    status_bits: Mapping[int, StatusBit] = field(default_factory=dict)
    """Meaning of the bits of `Measurement.status`, by number; those that are not known are left out."""
    data_sheet: DataSheet = field(default_factory=DataSheet)
    """What the vendor's manual states of noise, resolution and filters."""
    shown_settings: Callable[[Mapping[str, str]], Mapping[str, str]] = lambda settings: settings
    """Returns settings as they were read back by name and with units, for people."""
    line_differences: Callable[[Mapping[str, str], DeviceLines], Mapping[str, str]] = lambda _settings, _lines: {}
    """Finds lines of the configuration that the device's settings contradict: why, one sentence, by the line's key."""
    declared_line_differences: Callable[[Mapping[str, Any], DeviceLines], Mapping[str, str]] = lambda _declared, _: {}
    """The same for settings that are declared, by their values, before the device is asked."""
    limits: Callable[[Mapping[str, Any], DeviceLines, bool], Sequence[str]] = lambda _declared, _lines, _fed: ()
    """What works, but not with all that the configuration has: from the declared settings by their values, the GPIO
    lines, and whether sentences with UTC are sent. A sentence each, which `imud check` prints."""
    check: Callable[[Any, Any], Sequence[KeyProblem]] = no_problems
    """Finds what does not work in an instance of `settings` and in the settings of a link, each good by itself."""

    def problems(self, options: Any, link: Any) -> Sequence[KeyProblem]:
        """Return what `imud check` reports of `options`, an instance of `settings`, together with a link's settings.

        Links are known by the names of their keys: what a link does not have is not checked.
        """
        return self.check(options, link)


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamDriver(Driver):
    """A device that sends a byte stream by itself (UART, RS-232, USB serial)."""

    baud_rates: tuple[int, ...]
    """Rates of the device in bit/s, most likely first: detection tries them in this order."""
    make_codec: Callable[[Ledger, Any], StreamCodec]
    """Makes a codec that counts into the ledger, from an instance of `settings`."""
    identify: Callable[[], RequestScript[Identity]]
    """Asks the device what it is, and leaves it as it was."""
    read_settings: Callable[[], RequestScript[Mapping[str, str]]]
    """Reads back the device's own settings, by the device's own names, and leaves it as it was."""
    apply_identity: Callable[[StreamCodec, Identity], None] = lambda _codec, _identity: None
    """Passes the identity to the codec, where the meaning of a field depends on the firmware."""
    wake: Callable[[], RequestScript[bool | None]] | None = None
    """Makes a device send samples that answers and sends none, and says whether it acknowledged; nothing is saved.
    Returns None and changes nothing where the device is meant to be silent by its own settings. Raises NoReply where
    nothing answers. None for devices that cannot be silent."""
    why_silent: Callable[[Mapping[str, str]], str] = lambda _settings: "its output is off"
    """Says in one clause why a device that answers sends no samples, from its settings as `read_settings` returns."""
    example_frame: Callable[[Random], bytes]
    """Make one valid frame with random values, for the shared property tests and for fault injection."""

    def problems(self, options: Any, link: Any) -> Sequence[KeyProblem]:
        """Return the driver's own problems, and a bit rate that such a device does not have."""
        baud = getattr(link, "baud", 0)
        found = list(self.check(options, link))
        if isinstance(baud, int) and baud and baud not in self.baud_rates:
            rates = ", ".join(map(str, sorted(self.baud_rates)))
            found.append(KeyProblem("link", "baud", f"expected a rate of {self.name} ({rates}) or auto, got {baud}"))
        return found


D = TypeVar("D", bound=Driver)


def of_kind(drivers: Iterable[Driver], kind: type[D]) -> list[D]:
    """Return the drivers of one kind, in their order."""
    return [driver for driver in drivers if isinstance(driver, kind)]


def nothing_cyclic(_settings: Any) -> Sequence[CyclicFrame]:
    """Return no cyclic frames: the version for devices that need none."""
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CanDriver(Driver):
    """A device on a CAN bus, which it may share with others."""

    make_codec: Callable[[Ledger, Any], CanCodec]
    """Makes a codec that counts into the ledger, from an instance of `settings`."""
    filters: Callable[[Any], Sequence[CanFilter]]
    """The frames that a device with these settings sends, replies included."""
    node_of: Callable[[int, bool, bytes], int | None]
    """Which device of this protocol would send such a frame (identifier, 29 bits or not, data): its number, or None.

    Only for frames that carry samples; the codec must confirm it."""
    node_settings: Callable[[int], Any]
    """Options for the device of that number, the rest at its default."""
    node_title: Callable[[int], str]
    """The device of that number for people, for example `node 8`."""
    identify: Callable[[Any], RequestScript[Identity]]
    """Asks the device with these settings what it is, and leaves it as it was."""
    read_settings: Callable[[Any], RequestScript[Mapping[str, str]]]
    """Reads back the own settings of the device with these settings, by its own names, and leaves it as it was."""
    apply_identity: Callable[[CanCodec, Identity], None] = lambda _codec, _identity: None
    """Passes the identity to the codec, where the frames depend on it."""
    sample_frames: int
    """Frames that make one sample."""
    example_frames: Callable[[Random], Sequence[CanFrame]]
    """Valid frames that make one sample, in the order they are sent, with random values and the default settings."""
    cyclic: Callable[[Any], Sequence[CyclicFrame]] = nothing_cyclic
    """Frames that imud must send for a device with these settings, as long as the link is open; of a link that may not
    send, none are."""


T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class PolledDriver(Driver):
    """A device that sends only on request, without time or messages: its samples are dated by the host's deadlines."""

    tick_ns: int = SAMPLE_COUNTER
    tick_modulus: int = 2
    link: str
    """Name of the link it hangs on, a row of LINKS."""
    targets: tuple[int, ...]
    """Values to try when the link says `auto`, most likely first: I2C addresses, SPI modes."""
    probe: Callable[[Any], TransferScript[Identity]]
    """Reads the identity of a device with these settings. Raises DeviceRefused for another device. Changes nothing."""
    set_up: Callable[[Any], TransferScript[Mapping[str, str]]]
    """Writes the settings to the device, reads them back, returns them by the device's names. Raises DeviceRefused."""
    make_codec: Callable[[Ledger, Any], PolledCodec]
    """Makes a codec that counts into the ledger, from an instance of `settings`."""
    update_ns: Callable[[Any], int]
    """Longest time between two updates of the device's registers, from the settings; 0 for not known."""
    example_reading: Callable[[Random], bytes]
    """Bytes of the first poll with random values, for the shared property tests and for fault injection."""
    read_ns: Callable[[Any, Any], int] = lambda _options, _link: 0
    """Shortest time that one read of the samples takes on the bus, ns, from instances of `settings` and of the link's
    settings; 0 for not known. The sum over the devices of a bus decides whether it carries their rates."""
