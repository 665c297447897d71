"""Lines: single wires beside a device's data, which say when something happened (SOUT, PPS) or that it did (ALARM)."""

from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple, Protocol

from msgspec import Meta

from imud.errors import LinkError
from imud.kit.settings import Settings


class Edge(NamedTuple):
    """One change of a line's level."""

    t_ns: int
    """CLOCK_MONOTONIC as the kernel stamped it."""
    rising: bool
    """Whether the line became active."""
    number: int
    """Counts the edges of this line from 1, those that were lost on the way included."""


class LineSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which wire: by chip and number, or by a name that is on one chip only."""

    line: Annotated[int, Meta(ge=0, le=1023)] | Annotated[str, Meta(min_length=1, max_length=64)]
    """Number of the line on its chip, or its name, for example `GPIO17`."""
    chip: Annotated[str, Meta(max_length=64)] = ""
    """`/dev/gpiochip0`, `gpiochip0`, or a chip's label; empty to look for the line's name on all chips."""
    active_low: bool = False
    """Whether a low level means active: a line behind an inverting level shifter."""


OnEdges = Callable[[Sequence[Edge]], None]
"""Called in the loop's thread with edges in their order."""
OnLineEnd = Callable[[LinkError], None]
"""Called once when the line is gone; nothing comes after it."""


class InputLine(Protocol):
    """A line that is watched. Synchronization: the loop's thread only."""

    title: str
    """The line for people, for example `gpiochip0 line 17 (GPIO17)`."""
    edges_lost: int
    """Edges that the kernel dropped since `open`, because they were not read in time."""

    def open(self) -> None:
        """Request the line. Raises LinkMissing, LinkBusy (naming the holder), LinkDenied, LinkError."""
        ...

    def start(self, on_edges: OnEdges, on_end: OnLineEnd) -> None:
        """Deliver edges from now on. Needs a running loop and an open line."""
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
