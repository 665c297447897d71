"""Lines: GPIO signals of a device next to its data link. Their settings, and what an input and an output provide.

SOUT, SOUT_DIV, data ready   device → host   when a sample was measured
SIN                          host → device   when to measure
PPS                          receiver → host and device's SIN   when a second of UTC begins
ALARM                        device → host   an angle is out of its range
reset                        host → device   restart
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, NamedTuple, Protocol, get_args

from msgspec import Meta
from msgspec.structs import fields

from imud.host.threads import BusThread, StartWorker
from imud.model.errors import LinkError
from imud.model.options import Options

SOUT_WIDTH_US: Final = 80.0
"""Length of a SOUT pulse; the first byte follows its falling edge (HiPNUC manual 1.2.2, PMUX2)."""
SIN_DELAY_US: Final = 125.0
"""From the rising edge on SIN to the frame leaving, on average (HiPNUC manual 1.2.1)."""


class SoutTiming(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Position of the measurement on a SOUT pulse. No manual gives it: the rising edge itself is an assumption."""

    offset_us: Annotated[float, Meta(ge=-100_000, le=100_000)] = 0.0
    """Instant of measurement minus rising edge, µs; negative if the device measures before its pulse."""
    bias_us: Annotated[float, Meta(ge=0, le=100_000)] = SIN_DELAY_US - SOUT_WIDTH_US
    """Bound of the error of `offset_us`, µs; 0 if it was calibrated. A triggered device begins its pulse 45 µs after
    the trigger (125 µs to the frame, of which 80 µs are the pulse), so no more than that is expected."""
    width_us: Annotated[float, Meta(ge=0, le=100_000)] = SOUT_WIDTH_US
    """Length of the pulse, µs: the time of a lost rising edge is derived from the falling edge."""


class TriggerTiming(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Position of the measurement after a trigger on SIN."""

    offset_us: Annotated[float, Meta(ge=-100_000, le=100_000)] = 0.0
    """Instant of measurement minus trigger, µs."""
    bias_us: Annotated[float, Meta(ge=0, le=100_000)] = SIN_DELAY_US
    """Bound of the error of `offset_us`, µs: a device may measure at any time before the frame leaves."""


class TriggerStamp(NamedTuple):
    """One trigger that the host sent on SIN."""

    t_ns: int
    """CLOCK_MONOTONIC at the rising edge."""
    err_ns: int
    """One-sigma error of `t_ns`."""
    number: int
    """Counts the triggers from 1."""


class UtcReference(NamedTuple):
    """The host's estimate of UTC."""

    offset_ns: int
    """UTC (CLOCK_REALTIME) minus CLOCK_MONOTONIC."""
    error_ns: int
    """One-sigma error of `offset_ns`."""


@dataclass(frozen=True, slots=True)
class TimeBits:
    """Masks of a device's status bits about time; 0 for a bit that it does not have."""

    sync_out: int = 0
    """Set in a frame that belongs to a pulse on SOUT. Used once it was seen set: older firmware sends zeros."""
    not_utc: int = 0
    """Set while the device's time is not synchronised to UTC."""


NO_TIME_BITS: Final = TimeBits()
"""Of a device without such status bits."""


class Mark(NamedTuple):
    """One pulse on SOUT_DIV: a camera was triggered."""

    t_ns: int
    """CLOCK_MONOTONIC of its rising edge, as the kernel stamped it."""
    number: int
    """`Edge.number` of the rising edge."""
    seq: int | None
    """`Sample.seq` of the sample it belongs to; None when that sample was lost."""


Offset = Annotated[float, Meta(ge=-100_000, le=100_000)]
Bias = Annotated[float, Meta(ge=0, le=100_000)]


class Edge(NamedTuple):
    """One change of the level of a line."""

    t_ns: int
    """CLOCK_MONOTONIC as the kernel stamped it."""
    rising: bool
    """Whether the line became active."""
    number: int
    """Counts the edges of this line from 1, rising and falling, including lost ones. It continues when the line is
    opened again."""


class LineOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Address of a line: chip and offset, or a line name that exists once."""

    line: Annotated[int, Meta(ge=0, le=1023)] | Annotated[str, Meta(min_length=1, max_length=31)]
    """Number of the line on its chip, or its name, for example `GPIO17`."""
    chip: Annotated[str, Meta(max_length=64)] = ""
    """`/dev/gpiochip0`, `gpiochip0`, or a chip's label; empty to look for the line's name on all chips."""
    active_low: bool = False
    """Whether a low level means active: a line behind an inverting level shifter."""

    def __post_init__(self) -> None:
        if isinstance(self.line, int) and not self.chip:
            raise ValueError("expected the key chip beside the number of a line, got none")


class InputOptions(LineOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An input: a line that the device drives."""

    bias: Literal["as-is", "pull-up", "pull-down", "disabled"] = "as-is"
    """Resistor inside the host's chip: a wire that is not driven floats, and a floating wire makes edges."""


class SoutOptions(InputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SOUT."""

    offset_us: Offset = 0.0
    """Instant of measurement minus rising edge, µs; negative if the device measures before its pulse."""
    bias_us: Bias = SIN_DELAY_US - SOUT_WIDTH_US
    """Bound of the error of `offset_us`, µs; 0 if it was calibrated (`imud.contracts.lines.SoutTiming`)."""
    width_us: Bias = SOUT_WIDTH_US
    """Length of the pulse, µs."""

    @property
    def timing(self) -> SoutTiming:
        """Position of the measurement on a pulse."""
        return SoutTiming(offset_us=self.offset_us, bias_us=self.bias_us, width_us=self.width_us)


class DividedOptions(InputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SOUT_DIV."""

    divisor: Annotated[int, Meta(ge=1, le=64)] = 8
    """Samples per pulse, as the device is set to (`CONFIG PMUX4 DIV8`; 8 as delivered)."""


class PpsOptions(InputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The pulse per second."""

    chrony: str = ""
    """Socket of chronyd's SOCK reference clock that the pulses are sent to, for example `/run/chrony.imud.sock`; empty
    for none. The second of each pulse must be known from `rmc`."""


class ReadyOptions(InputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Data ready."""

    edge: Literal["rising", "falling"] = "rising"
    """The edge after which new data can be read; `rising` is from inactive to active."""
    offset_us: Offset = 0.0
    """Instant of measurement minus edge, µs; negative if the device measures before the edge."""
    bias_us: Bias = 100.0
    """Bound of the error of `offset_us`, µs; 0 if it was calibrated. No manual gives it: 100 is an assumption."""


class OutputOptions(LineOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An output: a line that imud drives."""

    open_drain: bool = False
    """Whether high is left to a pull-up resistor, so that no current flows into a device without power."""


class TriggerOptions(OutputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SIN."""

    rate_hz: Annotated[float, Meta(ge=0, le=1000)] = 100.0
    """Rising edges per second; 0 for single edges on request only."""
    pulse_ms: Annotated[float, Meta(ge=0.01, le=500)] = 1.0
    """Length of a pulse, at most half a period, ms. The HiPNUC manual gives none for triggers; 1 ms passes any level
    shifter, a slow optocoupler needs more."""
    offset_us: Offset = 0.0
    """Instant of measurement minus trigger, µs."""
    bias_us: Bias = SIN_DELAY_US
    """Bound of the error of `offset_us`, µs; 0 if it was calibrated (`imud.contracts.lines.TriggerTiming`)."""

    @property
    def timing(self) -> TriggerTiming:
        """Position of the measurement after a trigger."""
        return TriggerTiming(offset_us=self.offset_us, bias_us=self.bias_us)


class ResetOptions(OutputOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Reset."""

    active_low: bool = True
    """Whether a low level resets the device, as on a pin called nRST."""
    hold_ms: Annotated[float, Meta(ge=0.01, le=10_000)] = 10.0
    """Length of the reset pulse, ms."""
    wait_s: Annotated[float, Meta(ge=0, le=60)] = 3.0
    """Start-up time of the device after the pulse, s: 3 s for an IMU61x (manual, note 1 of 2.2)."""
    at_start: bool = False
    """Whether to pulse it once at the start of imud, before the device is asked for the first time."""


class DeviceLines(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The lines of one device."""

    sout: SoutOptions | None = None
    """SOUT of the device: a pulse before each frame."""
    sout_div: DividedOptions | None = None
    """SOUT_DIV of the device: a pulse every `divisor` samples."""
    sin: TriggerOptions | None = None
    """SIN of the device, driven by imud: one frame for each rising edge (ONMARK)."""
    alarm: InputOptions | None = None
    """ALARM of the device: active while an angle is out of its range."""
    reset: ResetOptions | None = None
    """Reset of the device, driven by imud."""
    data_ready: ReadyOptions | None = None
    """Data ready of the device: it has new values."""
    pps: PpsOptions | None = None
    """The pulse per second that the device's SIN receives, connected to the host as well."""


LINE_SCHEMAS: Final[Mapping[str, type[LineOptions]]] = {
    field.name: get_args(field.type)[0] for field in fields(DeviceLines)
}
"""Schema of each key of `DeviceLines`."""


class AlarmRange(NamedTuple):
    """Range of one angle; the ALARM line is active while the angle is outside it."""

    euler_index: int
    """Index of the angle in `Sample.euler_rad`."""
    low_deg: float
    high_deg: float
    enabled: bool


class AlarmRanges(NamedTuple):
    """Meaning of the ALARM line of a device, by its settings."""

    by_axis: Mapping[str, AlarmRange]
    """By the device's name of the axis; an axis that the settings do not give is missing."""
    pin_setting: str
    """Name of the setting that selects the pin's function, for messages."""
    mounting_setting: str
    """Name of the setting of the mounting orientation, for messages."""


OnEdges = Callable[[Sequence[Edge]], None]
"""Called in the loop's thread with edges in their order."""
OnLineEnd = Callable[[LinkError], None]
"""Called once when the line is gone; no calls follow."""


class InputLine(Protocol):
    """An input whose edges are delivered. Synchronization: the loop's thread only."""

    title: str
    """The line for people, for example `gpiochip0 line 17 (GPIO17)`."""

    @property
    def edges_lost(self) -> int:
        """Edges that the kernel dropped because they were not read in time, over all requests of the line. Not counted
        are edges so close that the kernel's interrupt thread saw them as one."""
        ...

    def open(self) -> None:
        """Request the line. Raises LinkMissing, LinkBusy (naming the holder), LinkDenied, LinkError."""
        ...

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        """Deliver edges; without `watch` only when `drain` is called. Needs a running loop and an open line."""
        ...

    def fileno(self) -> int:
        """Return a descriptor on which something comes with each edge; -1 where there is none."""
        ...

    def drain(self) -> None:
        """Deliver at once the edges that the kernel has buffered. Does not block."""
        ...

    def level(self) -> bool:
        """Return whether the line is active now. Raises LinkError."""
        ...

    def close(self) -> None:
        """Release the line; may be called twice."""
        ...


class WatchedInput(Protocol):
    """An input that is kept open, and opened again after a failure. Synchronization: the loop's thread only."""

    def tick(self, now_ns: int) -> None:
        """Open the line if that is due. Call it at 10 Hz."""
        ...

    def close(self) -> None:
        """Release the line; may be called twice."""
        ...


WatchLine = Callable[[InputOptions, str, OnEdges, Callable[[str], None]], WatchedInput]
"""Makes one from its settings, a purpose for people, what gets rising edges, and what gets a message when the line
fails for a new reason and when it is open again."""


class OutputLine(Protocol):
    """An output. Synchronization: one thread at a time."""

    title: str

    def open(self) -> None:
        """Request the line and set it inactive. Raises as `InputLine.open`."""
        ...

    def set(self, active: bool) -> None:
        """Set the level of the line. Raises LinkError."""
        ...

    def close(self) -> None:
        """Set the line inactive and release it; may be called twice."""
        ...


@dataclass(frozen=True, slots=True)
class LineFactory:
    """Factory of closed lines, from their settings and a purpose for people, for example `bow sout`."""

    make_input: Callable[[Any, str, bool], InputLine]
    """From `InputOptions`; the last argument is True if only rising edges are needed."""
    make_output: Callable[[Any, str], OutputLine]
    """From `OutputOptions`."""
    start_worker: StartWorker = BusThread
    """Starts the thread that drives SIN."""
