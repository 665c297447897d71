"""Lines: single wires beside a device's data, which say when something happened (SOUT, PPS) or that it did (ALARM)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, NamedTuple, Protocol, get_args

from msgspec import Meta
from msgspec.structs import fields

from imud.contracts.settings import Settings
from imud.contracts.timing import SIN_DELAY_US, SOUT_WIDTH_US, SoutTiming, TriggerTiming
from imud.errors import LinkError

Offset = Annotated[float, Meta(ge=-100_000, le=100_000)]
Bias = Annotated[float, Meta(ge=0, le=100_000)]


class Edge(NamedTuple):
    """One change of a line's level."""

    t_ns: int
    """CLOCK_MONOTONIC as the kernel stamped it."""
    rising: bool
    """Whether the line became active."""
    number: int
    """Counts the edges of this line from 1, rising and falling, those that were lost on the way included. It goes on
    when the line is opened again."""


class LineSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which wire: by chip and number, or by a name that is on one chip only."""

    line: Annotated[int, Meta(ge=0, le=1023)] | Annotated[str, Meta(min_length=1, max_length=31)]
    """Number of the line on its chip, or its name, for example `GPIO17`."""
    chip: Annotated[str, Meta(max_length=64)] = ""
    """`/dev/gpiochip0`, `gpiochip0`, or a chip's label; empty to look for the line's name on all chips."""
    active_low: bool = False
    """Whether a low level means active: a line behind an inverting level shifter."""

    def __post_init__(self) -> None:
        if isinstance(self.line, int) and not self.chip:
            raise ValueError("expected the key chip beside the number of a line, got none")


class InputSettings(LineSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A wire that the device drives."""

    bias: Literal["as-is", "pull-up", "pull-down", "disabled"] = "as-is"
    """Resistor inside the host's chip: a wire that nobody drives floats, and a floating wire makes edges."""


class SoutSettings(InputSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SOUT."""

    offset_us: Offset = 0.0
    """Instant of measurement minus rising edge, µs; negative when the device measures before its pulse."""
    bias_us: Bias = SIN_DELAY_US - SOUT_WIDTH_US
    """How far the truth can be from that, µs; 0 when it was calibrated (`imud.contracts.timing.SoutTiming`)."""
    width_us: Bias = SOUT_WIDTH_US
    """Length of the pulse, µs."""

    @property
    def timing(self) -> SoutTiming:
        """Where on a pulse the measurement is."""
        return SoutTiming(offset_us=self.offset_us, bias_us=self.bias_us, width_us=self.width_us)


class DividedSettings(InputSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SOUT_DIV."""

    divisor: Annotated[int, Meta(ge=1, le=64)] = 8
    """How many samples there are to one pulse, as the device is set to (`CONFIG PMUX4 DIV8`; 8 as delivered)."""


class PpsSettings(InputSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The pulse per second."""

    chrony: str = ""
    """Socket of chronyd's SOCK reference clock that is given the pulses, for example `/run/chrony/imud.sock`; empty for
    none. Which second a pulse is must be known from `rmc`."""


class ReadySettings(InputSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Data ready."""

    edge: Literal["rising", "falling"] = "rising"
    """The edge after which new data can be read; `rising` is from inactive to active."""
    offset_us: Offset = 0.0
    """Instant of measurement minus edge, µs; negative when the device measures before it tells so."""
    bias_us: Bias = 100.0
    """How far the truth can be from that, µs; 0 when it was calibrated. No manual says: 100 is an assumption."""


class OutputSettings(LineSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A wire that imud drives."""

    open_drain: bool = False
    """Whether high is left to a pull-up resistor, so that no current flows into a device without power."""


class TriggerSettings(OutputSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """SIN."""

    rate_hz: Annotated[float, Meta(ge=0, le=1000)] = 100.0
    """Rising edges per second; 0 for none but those that are asked for one by one."""
    pulse_ms: Annotated[float, Meta(ge=0.01, le=500)] = 1.0
    """How long a pulse is, or half a period where that is shorter, ms. The manual of HiPNUC names none for triggers; 1
    ms passes any level shifter, a slow optocoupler needs more."""
    offset_us: Offset = 0.0
    """Instant of measurement minus trigger, µs."""
    bias_us: Bias = SIN_DELAY_US
    """How far the truth can be from that, µs; 0 when it was calibrated (`imud.contracts.timing.TriggerTiming`)."""

    @property
    def timing(self) -> TriggerTiming:
        """Where behind a trigger the measurement is."""
        return TriggerTiming(offset_us=self.offset_us, bias_us=self.bias_us)


class ResetSettings(OutputSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Reset."""

    active_low: bool = True
    """Whether a low level resets the device, as on a pin called nRST."""
    hold_ms: Annotated[float, Meta(ge=0.01, le=10_000)] = 10.0
    """How long the line is held active, ms."""
    wait_s: Annotated[float, Meta(ge=0, le=60)] = 3.0
    """How long the device needs after it, s: an IMU61x 3 s (manual, note 1 of 2.2)."""


class DeviceLines(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The wires of one device besides its data."""

    sout: SoutSettings | None = None
    """SOUT of the device: a pulse before each frame."""
    sout_div: DividedSettings | None = None
    """SOUT_DIV of the device: a pulse for every so many samples."""
    sin: TriggerSettings | None = None
    """SIN of the device, driven by imud: one frame for each rising edge (ONMARK)."""
    alarm: InputSettings | None = None
    """ALARM of the device: active while an angle is out of its range."""
    reset: ResetSettings | None = None
    """Reset of the device, driven by imud."""
    data_ready: ReadySettings | None = None
    """Data ready of the device: it has new values."""
    pps: PpsSettings | None = None
    """The pulse per second that the device's SIN gets, at the host too."""


LINE_SCHEMAS: Final[Mapping[str, type[LineSettings]]] = {
    field.name: get_args(field.type)[0] for field in fields(DeviceLines)
}
"""Schema of each key of `DeviceLines`."""


OnEdges = Callable[[Sequence[Edge]], None]
"""Called in the loop's thread with edges in their order."""
OnLineEnd = Callable[[LinkError], None]
"""Called once when the line is gone; nothing comes after it."""


class InputLine(Protocol):
    """A line that is watched. Synchronization: the loop's thread only."""

    title: str
    """The line for people, for example `gpiochip0 line 17 (GPIO17)`."""

    @property
    def edges_lost(self) -> int:
        """Edges that the kernel dropped because they were not read in time, over all times the line was open.

        Edges that follow each other before the kernel's interrupt thread runs become one; nobody counts those.
        """
        ...

    def open(self) -> None:
        """Request the line. Raises LinkMissing, LinkBusy (naming the holder), LinkDenied, LinkError."""
        ...

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        """Deliver edges from now on; without `watch` only when `drain` is called. Needs a loop and an open line."""
        ...

    def drain(self) -> None:
        """Deliver now what the kernel has and the loop did not read yet. Does not wait."""
        ...

    def level(self) -> bool:
        """Whether the line is active now. Raises LinkError."""
        ...

    def close(self) -> None:
        """Release the line; may be called twice."""
        ...


class OutputLine(Protocol):
    """A line that is driven. Synchronization: one thread at a time."""

    title: str

    def open(self) -> None:
        """Request the line and make it inactive. Raises as `InputLine.open`."""
        ...

    def set(self, active: bool) -> None:
        """Drive it. Raises LinkError."""
        ...

    def close(self) -> None:
        """Make it inactive and release it; may be called twice."""
        ...


@dataclass(frozen=True, slots=True)
class LineFactory:
    """Makes closed lines from their settings and a purpose for people, for example `bow sout`."""

    make_input: Callable[[Any, str, bool], InputLine]
    """From `InputSettings`; the last argument says whether falling edges are of no interest."""
    make_output: Callable[[Any, str], OutputLine]
    """From `OutputSettings`."""
