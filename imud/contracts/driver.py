"""Contract of a driver, the description of one wire protocol for the rest of imud."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any, NamedTuple, TypeVar

from imud.contracts.action import Actions
from imud.contracts.codec import StreamCodec
from imud.contracts.control.calibration import Calibrations
from imud.contracts.device_settings import DeviceSettings
from imud.contracts.lines import AlarmRanges, DeviceLines
from imud.contracts.sensors.data_sheet import DataSheet
from imud.contracts.session import RequestScript
from imud.contracts.settings import Settings
from imud.contracts.timing import NO_TIME_BITS, TimeBits
from imud.frames.conventions import RFU_ENU, DeviceAxes, Heading
from imud.ledger import Ledger

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
    settings: type[Settings]
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
    device_settings: DeviceSettings | None = None
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
