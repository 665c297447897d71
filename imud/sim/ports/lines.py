"""GPIO lines inside the process, driven by the simulated device: for tests and the demo."""

import asyncio
from collections.abc import Callable

from imud.contracts.lines import Edge, InputSettings, LineFactory, OnEdges, OnLineEnd, OutputSettings
from imud.errors import LinkError


class MemoryInput:
    """An `InputLine` that the simulated device drives by `edge`. Synchronization: the loop's thread only."""

    def __init__(self, title: str = "memory line", rising_only: bool = False) -> None:
        self.title = title
        self.open_error: LinkError | None = None
        """Error that `open` raises."""
        self.is_open = False
        self._rising_only = rising_only
        self._watch = True
        self._level = False
        self._lost = 0
        self._number = 0
        self._waiting: list[Edge] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_edges: OnEdges | None = None
        self._on_end: OnLineEnd | None = None

    @property
    def edges_lost(self) -> int:
        """Number of edges that `lose` simulated."""
        return self._lost

    # --- the device's side -------------------------------------------------------------------------------------------

    def edge(self, t_ns: int, rising: bool) -> None:
        """Change the level at that time. Delivered by the loop in its next round, or by `drain`."""
        self._level = rising
        if self.is_open and (rising or not self._rising_only):
            self._number += 1
            self._waiting.append(Edge(t_ns, rising, self._number))
            if self._loop is not None and self._watch and len(self._waiting) == 1:
                self._loop.call_soon(self.drain)

    def pulse(self, t_ns: int, width_ns: int) -> None:
        """Pulse the line: up at that time, and down again."""
        self.edge(t_ns, True)
        self.edge(t_ns + width_ns, False)

    def lose(self, count: int) -> None:
        """Simulate edges that the kernel drops."""
        self._number += count
        self._lost += count

    def vanish(self, error: LinkError) -> None:
        """End the line with an error: the chip is removed."""
        on_end = self._on_end
        self.close()
        if on_end is not None:
            on_end(error)

    # --- imud's side -------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Open the line; edges count from now on. Raises `open_error`."""
        if self.open_error is not None:
            raise self.open_error
        self.is_open = True

    def start(self, on_edges: OnEdges, on_end: OnLineEnd, watch: bool = True) -> None:
        """Deliver edges from now on, and those since `open`; without `watch` only when `drain` is called."""
        self._on_edges, self._on_end = on_edges, on_end
        self._loop = asyncio.get_running_loop()
        self._watch = watch
        if watch:
            self._loop.call_soon(self.drain)

    def fileno(self) -> int:
        """Return -1: edges come without the kernel."""
        return -1

    def drain(self) -> None:
        """Deliver the buffered edges."""
        if self._on_edges is not None and self._waiting:
            found, self._waiting = self._waiting, []
            self._on_edges(found)

    def level(self) -> bool:
        """Return the level of the last edge. Raises LinkError."""
        if not self.is_open:
            raise LinkError(f"{self.title} is not open")
        return self._level

    def close(self) -> None:
        """Stop the delivery of edges; may be called twice."""
        self.is_open = False
        self._waiting = []
        self._loop = self._on_edges = self._on_end = None


class MemoryOutput:
    """An `OutputLine` that records its changes."""

    def __init__(
        self,
        title: str = "memory line",
        *,
        now_ns: Callable[[], int] = lambda: 0,
        on_change: Callable[[int, bool], None] | None = None,
    ) -> None:
        """`now_ns` dates changes; without it, all are at 0.

        `on_change` is the device: called with the time and the new level, in the thread that drives the line.
        """
        self.title = title
        self.open_error: LinkError | None = None
        """Error that `open` raises."""
        self.set_error: LinkError | None = None
        """Error that `set` raises."""
        self.is_open = False
        self.active = False
        self.history: list[tuple[int, bool]] = []
        """Time (ns) and level of every change."""
        self._now_ns = now_ns
        self._on_change = on_change

    def open(self) -> None:
        """Open the line, inactive. Raises `open_error`."""
        if self.open_error is not None:
            raise self.open_error
        self.is_open = True
        self._become(False)

    def set(self, active: bool) -> None:
        """Set the level. Raises `set_error`, and LinkError where the line is not open."""
        if self.set_error is not None or not self.is_open:
            raise self.set_error or LinkError(f"{self.title} is not open")
        self._become(active)

    def close(self) -> None:
        """Release the line, inactive; may be called twice."""
        if self.is_open:
            self._become(False)
        self.is_open = False

    def _become(self, active: bool) -> None:
        if active != self.active:
            self.active = active
            now_ns = self._now_ns()
            self.history.append((now_ns, active))
            if self._on_change is not None:
                self._on_change(now_ns, active)


class MemoryLines:
    """Factory of lines inside the process, which keeps them by their purpose, for example `bow sout`."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self.inputs: dict[str, MemoryInput] = {}
        self.outputs: dict[str, MemoryOutput] = {}
        self._now_ns = now_ns
        self.maker = LineFactory(self.input, self.output)

    def input(self, _settings: InputSettings, purpose: str, rising_only: bool = False) -> MemoryInput:
        """Return the input of that purpose; the same one every time."""
        return self.inputs.setdefault(purpose, MemoryInput(purpose, rising_only))

    def output(self, _settings: OutputSettings, purpose: str) -> MemoryOutput:
        """Return the output of that purpose; the same one every time."""
        return self.outputs.setdefault(purpose, MemoryOutput(purpose, now_ns=self._now_ns))
