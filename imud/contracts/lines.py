"""GPIO lines of a device next to its data link: options, inputs and outputs.

SOUT, SOUT_DIV, data ready   device → host                        instant of a measurement
SIN                          host → device                        trigger of a measurement
PPS                          receiver → host and SIN of device    start of a UTC second
ALARM                        device → host                        an angle is outside its range
reset                        host → device                        restart
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, NamedTuple, Protocol, get_args

from msgspec import Meta
from msgspec.structs import fields

from imud.host.threads import BusThread, StartWorker
from imud.model.errors import LinkError
from imud.model.host_object import HostObject, OptionalSocket, names
from imud.model.options import Options

RESET_VERB: Final = "reset"  # command of a device with the line `reset`
TRIGGER_VERB: Final = "trigger"  # command of a device with the line `sin`
LINE_VERBS: Final = (RESET_VERB, TRIGGER_VERB)
# Width of a SOUT pulse, µs. The first byte follows the falling edge (HiPNUC manual 1.2.2, PMUX2).
SOUT_WIDTH_US: Final = 80.0
SIN_DELAY_US: Final = 125.0  # mean time from the rising edge on SIN to the start of the frame, µs (HiPNUC manual 1.2.1)


class SoutTiming(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Instant of the measurement relative to a SOUT pulse. No manual states it: imud assumes the rising edge."""

    offset_us: Annotated[float, Meta(ge=-100_000, le=100_000)] = 0.0
    """Instant of measurement minus rising edge, µs; negative if the device measures before its pulse."""
    # A triggered device starts its pulse 45 µs after the trigger: 125 µs to the frame minus the pulse of 80 µs. The
    # default therefore assumes at most 45 µs.
    bias_us: Annotated[float, Meta(ge=0, le=100_000)] = SIN_DELAY_US - SOUT_WIDTH_US
    """Maximum error of `offset_us`, µs; 0 if the offset was calibrated."""
    width_us: Annotated[float, Meta(ge=0, le=100_000)] = SOUT_WIDTH_US
    """Width of the pulse, µs. imud derives the time of a lost rising edge from the falling edge."""


class TriggerTiming(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Instant of the measurement relative to a trigger on SIN."""

    offset_us: Annotated[float, Meta(ge=-100_000, le=100_000)] = 0.0
    """Instant of measurement minus trigger, µs."""
    bias_us: Annotated[float, Meta(ge=0, le=100_000)] = SIN_DELAY_US
    """Maximum error of `offset_us`, µs. A device may measure at any time before it sends the frame."""


class TriggerStamp(NamedTuple):
    """One trigger that imud sent on SIN."""

    t_ns: int  # CLOCK_MONOTONIC at the rising edge
    err_ns: int  # one-sigma error of `t_ns`
    number: int  # number of the trigger, starting at 1


class UtcReference(NamedTuple):
    """Estimate of UTC by the host."""

    offset_ns: int  # UTC (CLOCK_REALTIME) minus CLOCK_MONOTONIC
    error_ns: int  # one-sigma error of `offset_ns`


@dataclass(frozen=True, slots=True)
class TimeBits:
    """Masks of the status bits about time; 0 if the device does not have the bit."""

    # Set in a frame that belongs to a pulse on SOUT. imud uses the bit after the device has set it once: older firmware
    # always sends zero.
    sync_out: int = 0
    not_utc: int = 0  # set while the device time is not synchronized to UTC


NO_TIME_BITS: Final = TimeBits()


class Mark(NamedTuple):
    """One pulse on SOUT_DIV, for example the trigger of a camera."""

    t_ns: int  # CLOCK_MONOTONIC of the rising edge, as time-stamped by the kernel
    number: int  # `Edge.number` of the rising edge
    seq: int | None  # `Sample.seq` of the sample of this pulse; None if the sample was lost


Offset = Annotated[float, Meta(ge=-100_000, le=100_000)]
Bias = Annotated[float, Meta(ge=0, le=100_000)]


class Edge(NamedTuple):
    """One level change of a line."""

    t_ns: int  # CLOCK_MONOTONIC, as time-stamped by the kernel
    rising: bool  # whether the line became active
    # Number of the edge of this line, starting at 1. It counts rising, falling and lost edges, and continues after the
    # line was opened again.
    number: int


class LineOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Address of a line: chip and offset, or a unique line name."""

    line: Annotated[int, Meta(ge=0, le=1023)] | Annotated[str, Meta(min_length=1, max_length=31)]
    """Number of the line on its chip, or its name, for example `GPIO17`."""
    chip: Annotated[str, Meta(max_length=64, extra=names(HostObject.GPIO_CHIP))] = ""
    """`/dev/gpiochip0`, `gpiochip0`, or the label of the chip; empty: imud searches all chips for the
    name of the line."""
    active_low: bool = False
    """Whether a low level means active, for example behind an inverting level shifter."""

    def __post_init__(self) -> None:
        if isinstance(self.line, int) and not self.chip:
            raise ValueError("expected the key chip next to the number of a line, got no chip")


class InputOptions(LineOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Input: a line that the device drives."""

    bias: Literal["as-is", "pull-up", "pull-down", "disabled"] = "as-is"
    """Bias resistor in the GPIO chip. An open line without a resistor causes false edges."""


class SoutOptions(InputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of SOUT."""

    offset_us: Offset = 0.0
    """Instant of measurement minus rising edge, µs; negative if the device measures before its pulse."""
    bias_us: Bias = SIN_DELAY_US - SOUT_WIDTH_US
    """Maximum error of `offset_us`, µs; 0 if it was calibrated."""
    width_us: Bias = SOUT_WIDTH_US
    """Width of the pulse, µs."""

    @property
    def timing(self) -> SoutTiming:
        """Instant of the measurement relative to a pulse."""
        return SoutTiming(offset_us=self.offset_us, bias_us=self.bias_us, width_us=self.width_us)


class DividedOptions(InputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of SOUT_DIV."""

    divisor: Annotated[int, Meta(ge=1, le=64)] = 8
    """Samples per pulse, as set in the device (`CONFIG PMUX4 DIV8`; factory value 8)."""


class PpsOptions(InputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the pulse per second."""

    chrony: OptionalSocket = ""
    """Socket of chronyd that receives the pulses, for example `/run/chrony.imud.sock`; empty: none. Without `rmc`,
    chronyd needs another source for the second."""
    chrony_sample_bytes: Literal[32, 40] | None = None
    """Length of a sample for chronyd: 32 for a chronyd with a 32-bit `time_t`, otherwise 40; null: imud reads the
    program of chronyd."""


class ReadyOptions(InputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of data ready."""

    edge: Literal["rising", "falling"] = "rising"
    """Edge after which the host can read new data; `rising` is from inactive to active."""
    offset_us: Offset = 0.0
    """Instant of measurement minus edge, µs; negative if the device measures before the edge."""
    bias_us: Bias = 100.0
    """Maximum error of `offset_us`, µs; 0 if it was calibrated. The default is an assumption."""


class OutputOptions(LineOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Output: a line that imud drives."""

    open_drain: bool = False
    """Whether a pull-up resistor makes the high level. Then no current flows into a device without power."""


class TriggerOptions(OutputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of SIN."""

    rate_hz: Annotated[float, Meta(ge=0, le=1000)] = 100.0
    """Rising edges per second; 0: edges only on request."""
    pulse_ms: Annotated[float, Meta(ge=0.01, le=500)] = 1.0
    """Width of a pulse, ms, at most half a period. A slow optocoupler needs more than 1 ms."""
    offset_us: Offset = 0.0
    """Instant of measurement minus trigger, µs."""
    bias_us: Bias = SIN_DELAY_US
    """Maximum error of `offset_us`, µs; 0 if it was calibrated."""

    @property
    def timing(self) -> TriggerTiming:
        """Instant of the measurement relative to a trigger."""
        return TriggerTiming(offset_us=self.offset_us, bias_us=self.bias_us)


class ResetOptions(OutputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the reset line."""

    active_low: bool = True
    """Whether a low level resets the device (pin nRST)."""
    hold_ms: Annotated[float, Meta(ge=0.01, le=10_000)] = 10.0
    """Width of the reset pulse, ms."""
    wait_s: Annotated[float, Meta(ge=0, le=60)] = 3.0
    """Start-up time of the device after the pulse, s: 3 s for an IMU61x (manual, note 1 of 2.2)."""
    at_start: bool = False
    """Whether imud resets the device once at its start, before the first request."""


class DeviceLines(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """GPIO lines of one device."""

    sout: SoutOptions | None = None
    """SOUT of the device: a pulse before each frame."""
    sout_div: DividedOptions | None = None
    """SOUT_DIV of the device: a pulse every `divisor` samples."""
    sin: TriggerOptions | None = None
    """SIN of the device, driven by imud: one frame for each rising edge (ONMARK)."""
    alarm: InputOptions | None = None
    """ALARM of the device: active while an angle is outside its range."""
    reset: ResetOptions | None = None
    """Reset of the device, driven by imud."""
    data_ready: ReadyOptions | None = None
    """Data ready of the device: new values are available."""
    pps: PpsOptions | None = None
    """Pulse per second at SIN of the device, also connected to the host."""


# Option types, by key of `DeviceLines`
LINE_SCHEMAS: Final[Mapping[str, type[LineOptions]]] = {
    field.name: get_args(field.type)[0] for field in fields(DeviceLines)
}


class AlarmRange(NamedTuple):
    """Permitted range of one angle. The ALARM line is active while the angle is outside the range."""

    euler_index: int  # index of the angle in `Sample.euler_rad`
    low_deg: float
    high_deg: float
    enabled: bool


class AlarmRanges(NamedTuple):
    """Meaning of the ALARM line, from the device settings."""

    # Range by the axis name of the device, without axes that the device settings lack
    by_axis: Mapping[str, AlarmRange]
    pin_setting: str  # name of the setting that selects the function of the pin, for error messages
    mounting_setting: str  # name of the setting for the mounting orientation, for error messages


OnEdges = Callable[[Sequence[Edge]], None]  # Receives edges in their order. Called in the thread of the loop.
OnLineEnd = Callable[[LinkError], None]  # Receives the error that ended the line. Called once; no further calls follow.


class InputLine(Protocol):
    """Input line that delivers edges. Synchronization: the thread of the loop only."""

    title: str  # readable name of the line, for example `gpiochip0 line 17 (GPIO17)`

    @property
    def edges_lost(self) -> int:
        """Number of edges that the kernel dropped from a full buffer, since the first request of the line. The count
        does not include edges so close together that the interrupt thread of the kernel saw one edge."""
        ...

    def open(self) -> None:
        """Request the line. Raises LinkMissing, LinkBusy (with the holder), LinkDenied or LinkError."""
        ...

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        """Deliver edges; without `watch` only during `drain`. Requires a running loop and an open line."""
        ...

    def fileno(self) -> int:
        """Return a descriptor that becomes readable at each edge; -1 if there is none."""
        ...

    def drain(self) -> None:
        """Deliver the edges that the kernel has buffered. Does not block."""
        ...

    def level(self) -> bool:
        """Return whether the line is active. Raises LinkError."""
        ...

    def close(self) -> None:
        """Release the line. A second call does nothing."""
        ...


class WatchedInput(Protocol):
    """Input line that opens again after a failure. Synchronization: the thread of the loop only."""

    def tick(self, now_ns: int) -> None:
        """Open the line if an attempt is due. Call this method at 10 Hz."""
        ...

    def close(self) -> None:
        """Release the line. A second call does nothing."""
        ...


class PulseReceiver(Protocol):
    """Receiver of a pulse per second. `imud.device` implements it; `imud.lines` cannot import `imud.device`."""

    def on_pulses(self, edges: Sequence[Edge], /) -> None:
        """Process edges of the line in their order."""
        ...


class LineOwner(Protocol):
    """Owner of watched lines, which have different keys. Synchronization: the thread of the loop only."""

    def on_edges(self, key: str, edges: Sequence[Edge], /) -> None:
        """Process edges of a line in their order."""
        ...

    def on_level(self, key: str, active: bool | None, /) -> None:
        """Process the level after each opening and after lost edges; None when the line is closed."""
        ...

    def on_line_report(self, key: str, message: str, /) -> None:
        """Report that the line failed for a new reason, or that it is open again."""
        ...


# Returns a watched line from its options, a readable purpose, and its owner. The purpose is also the key of the line.
# The line has only rising edges.
WatchLine = Callable[[InputOptions, str, LineOwner], WatchedInput]


class DrivenOutput(Protocol):
    """Output line that opens again after a failure. `imud.lines` implements it, and outputs may not import that part.
    Synchronization: the thread of the loop only."""

    problem: str  # reason why imud cannot drive the line, one sentence; empty if it can

    def tick(self, now_ns: int) -> None:
        """Open the line if an attempt is due. Call this method at least twice per second."""
        ...

    def set(self, active: bool) -> None:
        """Set the level, now or after the line is open."""
        ...

    def close(self) -> None:
        """Make the line inactive and release it. A second call does nothing."""
        ...


# Returns a driven line from its options and a readable purpose
DriveLine = Callable[[OutputOptions, str], DrivenOutput]


class OutputLine(Protocol):
    """Output line. Synchronization: one thread at a time."""

    title: str

    def open(self) -> None:
        """Request the line and make it inactive. Raises the errors of `InputLine.open`."""
        ...

    def set(self, active: bool) -> None:
        """Set the level of the line. Raises LinkError."""
        ...

    def close(self) -> None:
        """Make the line inactive and release it. A second call does nothing."""
        ...


@dataclass(frozen=True, slots=True)
class LineFactory:
    """Factory of closed lines, from their options and a readable purpose, for example `bow sout`."""

    # Returns a line from `InputOptions`. The last argument is True if only rising edges are necessary.
    make_input: Callable[[Any, str, bool], InputLine]
    make_output: Callable[[Any, str], OutputLine]  # returns a line from `OutputOptions`
    start_worker: StartWorker = BusThread  # starts the thread that drives SIN
