"""Contract of a driver: the description of one wire protocol for the rest of imud."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar

import msgspec
from msgspec import Meta

from imud.attitude.conventions import (
    RFU_ENU,
    UNSETTLED_BIT,
    UNSETTLED_WORDS,
    AttitudeSource,
    DeviceAxes,
    Heading,
)
from imud.contracts.codec import CanCodec, PolledCodec, StreamCodec
from imud.contracts.command import Calibrations, Verbs
from imud.contracts.firmware import Firmware
from imud.contracts.lines import NO_TIME_BITS, AlarmRanges, DeviceLines, TimeBits
from imud.contracts.script import RequestScript, TransferScript
from imud.contracts.setting import Reports, SettingsTable
from imud.formats.can import CanFilter, CanFrame, CyclicFrame
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Vector3

SensorName = Literal["gyro", "accel"]
Figure = Annotated[float, Meta(gt=0)] | None  # positive number; None if the vendor does not state it


class SensorFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Noise figures of one sensor, SI. For an accelerometer, read m/s² in place of rad/s."""

    random_walk: Figure = None
    """Angle random walk or velocity random walk N, (rad/s)/√Hz."""
    noise_density: Figure = None
    """Root of the one-sided spectral density, (rad/s)/√Hz; √2 N for white noise."""
    bias_instability: Figure = None
    """Minimum Allan deviation divided by 0.664, rad/s."""
    rate_random_walk: Figure = None
    """Rate random walk K, (rad/s)/√s."""
    temperature_slope: Figure = None
    """Change of the bias with temperature, positive or negative, (rad/s)/K."""


class ModelFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Noise figures of one model."""

    gyro: SensorFigures = SensorFigures()
    accel: SensorFigures = SensorFigures()
    source: str = ""
    """Document and section of the figures."""


def _no_filter(_settings: Mapping[str, str], _sensor: SensorName) -> str:
    return ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSheet:
    """Facts about the sensors from the vendor's documents."""

    # Title and version of the manual and its statement about noise, one sentence; empty if there is no manual
    document: str = ""
    # Noise figures by the first characters of the product name; empty if the manual has no figures
    models: Mapping[str, ModelFigures] = field(default_factory=dict)
    # Angular rate of one count on the wire, rad/s; None for floats, or if the scale depends on the frame
    gyro_step_rad_s: float | None = None
    # Acceleration of one count on the wire, m/s²; None for floats, or if the scale depends on the frame
    accel_step_m_s2: float | None = None
    # Describes the low-pass filter of a sensor from the device settings; empty if the filter is not known
    filter_words: Callable[[Mapping[str, str], SensorName], str] = _no_filter

    def figures_of(self, product: str) -> ModelFigures | None:
        """Return the figures with the longest matching start of the product name; None if no start matches."""
        fitting = [begin for begin in self.models if product.startswith(begin)]
        return self.models[max(fitting, key=len)] if fitting else None


# Value of `tick_ns` if the device counter counts samples. A tick is one sample; its duration is not known.
SAMPLE_COUNTER = 0


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity as the device reports it. Strings are empty if the device does not report the value."""

    product: str = ""
    serial_number: str = ""
    firmware: str = ""
    details: Mapping[str, str] | None = None  # other properties, by the names of the device


class KeyProblem(NamedTuple):
    """A value in the configuration that the driver does not support."""

    part: str  # `link` or `options`
    key: str  # key in this part
    message: str  # expected value, received value, and numbers if they matter


class StatusBit(NamedTuple):
    """Meaning of one bit of `Measurement.status`."""

    name: str  # device condition while the bit is set, as readable text
    # Whether a change of the bit is an event: while the bit is set, values are wrong or not valid yet
    notable: bool = False


def status_words(bits: Mapping[int, StatusBit], status: int | None) -> tuple[str, ...]:
    """Return the names of the known bits that are set."""
    return tuple(bit.name for number, bit in bits.items() if status is not None and status >> number & 1)


def status_bits_of(driver: "Driver", attitude: AttitudeSource) -> Mapping[int, StatusBit]:
    """Return the known bits of the status of samples, with the bit of imud for its own attitude."""
    if attitude is AttitudeSource.DEVICE:
        return driver.status_bits
    return {**driver.status_bits, UNSETTLED_BIT: StatusBit(UNSETTLED_WORDS, notable=True)}


def no_problems(_options: Any, _link: Any) -> Sequence[KeyProblem]:
    """Return no problem. Default of drivers without additional rules."""
    return ()


def _unknown_heading(_options: object, _settings: Mapping[str, Any]) -> Heading:
    return Heading.UNKNOWN


@dataclass(frozen=True, slots=True)
class SentAxes:
    """Axes and angles that a device sends."""

    axes: DeviceAxes
    euler_convention: str  # as `Driver.euler_convention`
    navigation_frame: str  # as `Driver.navigation_frame`
    problem: str = ""  # reason if the axes are uncertain, one sentence; empty otherwise


@dataclass(frozen=True, slots=True, kw_only=True)
class Driver:
    """Description of one wire protocol. The subclass decides which links a driver can use."""

    name: str  # family and link, for example `hipnuc-uart`
    title: str  # vendor and products, as readable text
    # Interface version for which another package was written (`imud.contracts.registry`); 0 for drivers of imud
    interface: int = 0
    settings: type[Options]  # type of the driver options (`options` of a device)
    tick_ns: int  # duration of one device tick, ns, or SAMPLE_COUNTER
    tick_modulus: int  # modulus of the device counter: it counts 0 … tick_modulus - 1
    # Modulus of `Measurement.pps_age_ms` without a pulse, ms. imud uses the age to time-stamp frames without device
    # time. 0 if the protocol has no such frames.
    stamp_modulus: int = 0
    euler_convention: str  # order, axes and signs of `euler_rad`, as readable text
    navigation_frame: str  # destination frame of the rotation `quat_wxyz`, for example `ENU`
    axes: DeviceAxes = RFU_ENU  # axes, angles and navigation frame for conversions
    # Returns the axes that the readable device settings select; None: the fields above
    axes_by_settings: Callable[[Mapping[str, str]], SentAxes | None] = lambda _settings: None
    # Returns the reference of yaw from the driver options and the values of the device settings (empty: not read yet)
    heading: Callable[[Any, Mapping[str, Any]], Heading] = _unknown_heading
    # Returns whether the samples contain an attitude of the device, from the driver options. False: they contain
    # angular rate and acceleration, from which imud can compute it.
    sends_attitude: Callable[[Any], bool] = lambda _options: True
    verbs: Verbs = field(default_factory=dict)  # verbs of the device, by name
    # Arguments of `imud settings NAME --set` in place of a removed command, by the name of the command. {NAME} is the
    # argument NAME of the command, {NAME|VALUE} has a default. Empty: `imud settings NAME` replaces the command. Remove
    # the table in the third release after version 0.1.
    renamed: Mapping[str, str] = field(default_factory=dict)
    calibrations: Calibrations = field(default_factory=dict)  # guided calibrations, by kind
    device_settings: SettingsTable | None = None  # table of the device settings; None if the driver does not know them
    firmware: Firmware | None = None  # update of the firmware; None if the driver cannot update it
    # Fields of `Sample` that no frame of the driver contains, among the fields that rules use
    never_sends: frozenset[str] = frozenset()
    # GPIO lines that the device can have: names of fields of `imud.contracts.lines.DeviceLines`
    lines: frozenset[str] = frozenset()
    # Returns the meaning of the ALARM line from the values of the device settings; None if no setting describes it
    alarm_ranges: Callable[[Mapping[str, Any]], AlarmRanges] | None = None
    time_bits: TimeBits = NO_TIME_BITS  # bits of `Measurement.status` about time
    # Meaning of the known bits of `Measurement.status`, by bit number
    status_bits: Mapping[int, StatusBit] = field(default_factory=dict)
    data_sheet: DataSheet = field(default_factory=DataSheet)  # noise, resolution and filters from the vendor's manual
    # Returns the text of the device settings with readable names and units
    shown_settings: Callable[[Mapping[str, str]], Mapping[str, str]] = lambda settings: settings
    # Finds GPIO lines in the configuration that contradict the values of the device settings. Returns a reason, one
    # sentence, by key.
    line_differences: Callable[[Mapping[str, Any], DeviceLines], Mapping[str, str]] = lambda _settings, _lines: {}
    # Finds GPIO lines that contradict the values of the declared settings, before imud has read the device settings
    declared_line_differences: Callable[[Mapping[str, Any], DeviceLines], Mapping[str, str]] = lambda _declared, _: {}
    # Returns restrictions that `imud check` prints, one sentence each. The arguments are the values of the declared
    # settings, the GPIO lines, and whether imud sends UTC sentences to the device.
    limits: Callable[[Mapping[str, Any], DeviceLines, bool], Sequence[str]] = lambda _declared, _lines, _fed: ()
    # Finds problems of driver options together with link options. Both are valid on their own.
    check: Callable[[Any, Any], Sequence[KeyProblem]] = no_problems
    # Returns the name of an unknown frame type (`unknown` of the codec), for example `HI83 (tag 0x83)`
    unknown_name: Callable[[int], str] = str
    # Decoded frame types, and how to select one of them, one clause. `NAME` stands for the name of the device.
    decoded: str = "select another frame type on the device"

    def unknown_words(self, unknown: Mapping[int, int], device: str = "NAME", *, counted: bool = False) -> str:
        """Describe valid frames that the codec cannot decode, with the next step, for the end of a sentence.

        `counted`: with the number of frames of each type.
        """
        types = self.unknown_types(unknown, counted=counted)
        return f"{types}, but no sample; {self.decoded.replace('NAME', device)}"

    def unknown_types(self, unknown: Mapping[int, int], *, counted: bool = True) -> str:
        """Describe valid frames that the codec cannot decode."""
        types = ", ".join(self.unknown_name(one) + f": {count}" * counted for one, count in unknown.items())
        return f"valid frames of unknown types ({types})"

    def sent_axes(self, settings: Mapping[str, str]) -> SentAxes:
        """Return axes and angles of a device with these readable settings (empty: not read yet)."""
        sent = self.axes_by_settings(settings)
        return sent or SentAxes(self.axes, self.euler_convention, self.navigation_frame)

    def problems(self, options: Any, link: Any) -> Sequence[KeyProblem]:
        """Return the problems of `options` together with the link options, for `imud check`. The check looks for keys
        of the link options by name and skips keys that the link does not have."""
        return self.check(options, link)


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamDriver(Driver):
    """Driver of a device that sends a byte stream without requests (UART, RS-232, USB serial)."""

    # Baud rates of the device, bit/s, most likely first. Detection tries them in this order.
    baud_rates: tuple[int, ...]
    # Returns a codec that counts into the ledger, from the driver options
    make_codec: Callable[[Ledger, Any], StreamCodec]
    # Returns the script that reads the identity and does not change the device
    identify: Callable[[], RequestScript[Identity]]
    # Passes the identity to the codec. The meaning of a field can depend on the firmware.
    apply_identity: Callable[[StreamCodec, Identity], None] = lambda _codec, _identity: None
    # Returns the script that makes a silent device send samples; None if the device always sends. The script saves
    # nothing. Its result: whether the device acknowledged, or None if the device settings disable the output (then the
    # script changes nothing). Raises NoReply if the device does not reply.
    wake: Callable[[], RequestScript[bool | None]] | None = None
    # Request that starts the output, if scripts other than `wake` also send it: they cannot know whether it was on
    output_on: bytes = b""
    # Returns why a device with these values of its settings replies but sends no samples, one clause
    why_silent: Callable[[Mapping[str, Any]], str] = lambda _settings: "its output is off"
    # Returns one valid frame with random values, for property tests and fault injection
    example_frame: Callable[[Random], bytes]

    def problems(self, options: Any, link: Any) -> Sequence[KeyProblem]:
        """Return the problems of the driver options, and an unsupported baud rate."""
        baud = getattr(link, "baud", 0)
        found = list(self.check(options, link))
        if isinstance(baud, int) and baud and baud not in self.baud_rates:
            expected = f"a baud rate of {self.name} ({', '.join(map(str, sorted(self.baud_rates)))}) or auto"
            found.append(KeyProblem("link", "baud", f"expected {expected}, got {baud}"))
        return found


def random_vector(random: Random, spread: float) -> Vector3:
    """Return three random numbers around zero, for the examples of the property tests."""
    return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))


D = TypeVar("D", bound=Driver)


def of_kind(drivers: Iterable[Driver], kind: type[D]) -> list[D]:
    """Return the drivers of one kind in the same order."""
    return [driver for driver in drivers if isinstance(driver, kind)]


def nothing_cyclic(_settings: Any) -> Sequence[CyclicFrame]:
    """Return no cyclic frames. Default of devices without cyclic frames."""
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CanDriver(Driver):
    """Driver of a device on a CAN bus, which other devices may use too."""

    # Returns a codec that counts into the ledger, from the driver options
    make_codec: Callable[[Ledger, Any], CanCodec]
    # Returns the filters for all frames of the device, replies included, from the driver options
    filters: Callable[[Any], Sequence[CanFilter]]
    # Returns the filters for all frames that the device can send, frames of unknown types included. imud uses them
    # while no sample arrives.
    sent_by: Callable[[Any], Sequence[CanFilter]]
    node_of: Callable[[int, bool, bytes], int | None]
    """Returns the node number of the device that sends this frame (identifier, whether it has 29 bits, data), or None.

    Only frames with samples have a node number here. The codec must confirm the frame."""
    # Returns driver options for the device with this node number, all other options at their defaults
    node_settings: Callable[[int], Any]
    node_title: Callable[[int], str]  # returns a readable name of this device, for example `node 8`
    # Returns the script that reads the identity and does not change the device
    identify: Callable[[Any], RequestScript[Identity]]
    # Passes the identity to the codec. The frames can depend on the identity.
    apply_identity: Callable[[CanCodec, Identity], None] = lambda _codec, _identity: None
    sample_frames: int  # number of frames per sample
    # Returns the valid frames of one sample in sending order, with random values, for the default options
    example_frames: Callable[[Random], Sequence[CanFrame]]
    # Returns the frames that imud sends cyclically while the link is open. Read-only links do not send them.
    cyclic: Callable[[Any], Sequence[CyclicFrame]] = nothing_cyclic

    def other_nodes(self, options: Any, frames: Iterable[Sequence[CanFrame]]) -> str:
        """Describe the devices that these options do not select; empty if there are none.

        `frames`: first frames of each identifier. A single frame does not show a device.
        """
        filters = self.filters(options)
        repeated = [one[0] for one in frames if len(one) > 1]
        nodes = {
            node
            for one in repeated
            if not any(wanted.matches(one.can_id, one.extended) for wanted in filters)
            and (node := self.node_of(one.can_id, one.extended, one.data)) is not None
        }
        titles = [self.node_title(node) for node in sorted(nodes)]
        if not titles:
            return ""
        more = f" and {len(titles) - NODES_SHOWN} more" * (len(titles) > NODES_SHOWN)
        return (
            f"the log has frames of other devices, which imud ignores: {', '.join(titles[:NODES_SHOWN])}{more}; "
            "--option selects one of them"
        )


NODES_SHOWN: Final = 8  # maximum number of other devices in a text


T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class PolledDriver(Driver):
    """Driver of a device that sends only on request and has no device time: its samples get the host's time."""

    tick_ns: int = SAMPLE_COUNTER
    tick_modulus: int = 2
    link: str  # name of its link, a row of LINKS
    # Values that detection tries if the link has the value `auto`, most likely first: I2C addresses or SPI modes
    targets: tuple[int, ...]
    # Returns the script that reads the identity and changes nothing. Raises DeviceRefused if another device replies.
    probe: Callable[[Any], TransferScript[Identity]]
    # Returns the script that writes the options to the device and returns its settings. Raises DeviceRefused.
    set_up: Callable[[Any], TransferScript[Reports]]
    # Returns a codec that counts into the ledger, from the driver options
    make_codec: Callable[[Ledger, Any], PolledCodec]
    # Returns the maximum time between two updates of the device registers, ns; 0 if it is not known
    update_ns: Callable[[Any], int]
    # Returns the bytes of the first poll with random values, for property tests and fault injection
    example_reading: Callable[[Random], bytes]
    # Returns the minimum bus time of one read of the samples, ns, from the driver options and the link options; 0 if it
    # is not known. The sum over all devices of a bus shows whether the bus can carry their rates.
    read_ns: Callable[[Any, Any], int] = lambda _options, _link: 0
