"""Lines of a simulated device on a gpio-sim chip: its pins on the way out, SIN on the way in.

Interface: Documentation/admin-guide/gpio/gpio-sim.rst.
"""

from collections.abc import Mapping
from pathlib import Path
from time import sleep
from typing import Final, Protocol, TextIO

from imud.sim.ports.pins import Pin, PinFaults, PinModule, Pins
from imud.sim.simulator import StreamModule
from imud.units import NS_PER_MS, NS_PER_S

SIN_LOOK_NS: Final = 4 * NS_PER_MS
"""Interval of reading SIN: a pulse has to be longer."""


class MarkedModule(Protocol):
    """A device with a sync input."""

    def mark(self, now_ns: int) -> None:
        """Pulse its sync input (a rising edge)."""
        ...


class PullFile:
    """A line of a gpio-sim chip, driven through its `pull` file in sysfs; the kernel stamps the edge at the write."""

    def __init__(self, path: Path, settle_s: float = 0.0) -> None:
        """Wait `settle_s` after each rising edge: an edge that comes before the kernel has reported the last one is
        not seen, and a frame must not come before its edge. Raises OSError."""
        self._file = path.open("wb", buffering=0)
        self._settle_s = settle_s

    def __call__(self, _due_ns: int, rising: bool) -> None:
        """Drive the line. Raises OSError."""
        self._file.write(b"pull-up" if rising else b"pull-down")
        if rising and self._settle_s:
            sleep(self._settle_s)

    def close(self) -> None:
        """Close the file; the level stays. May be called twice."""
        self._file.close()


class SinFile:
    """SIN of a device, read from the `value` file of a gpio-sim line that the program under test drives.

    sysfs reports no change there, so the owner looks as often as it likes; the edge is as late as the look.
    """

    def __init__(self, path: Path, module: MarkedModule) -> None:
        self._path, self._module = path, module
        self._level = True  # a line that is high from the beginning has no edge

    def look(self, now_ns: int) -> None:
        """Pass a rising edge since the last call to the module. Raises OSError."""
        level = self._path.read_bytes().strip() == b"1"
        if level and not self._level:
            self._module.mark(now_ns)
        self._level = level


class SimulatedLines:
    """The lines next to a device's data: its pins on the way out, SIN on the way in. Synchronization: one thread."""

    def __init__(
        self, module: StreamModule, files: Mapping[Pin, PullFile], faults: PinFaults | None = None,
        truth: TextIO | None = None, sin: Path | None = None,
    ) -> None:  # fmt: skip
        """`files` and `truth` are closed by `close`. Raises ValueError for pins that this device does not have."""
        self._files, self._truth = files, truth
        self._pins: Pins | None = None
        if files:
            if not isinstance(module, PinModule):
                raise ValueError("pins: this device has none that are simulated")
            self._pins = Pins(module, files, faults, truth)
        self._sin = SinFile(sin, module) if sin else None

    def step(self, now_ns: int) -> None:
        """Do all that is due, right before the port does. Raises OSError."""
        if self._sin is not None:
            self._sin.look(now_ns)
        if self._pins is not None:
            self._pins.step(now_ns)

    def next_ns(self, now_ns: int) -> int:
        """Latest time of the next call of `step`."""
        next_ns = self._pins.next_ns() if self._pins is not None else None
        latest_ns = now_ns + (SIN_LOOK_NS if self._sin is not None else NS_PER_S)
        return latest_ns if next_ns is None else min(next_ns, latest_ns)

    def summary(self) -> dict[str, int]:
        """Counters by name."""
        return self._pins.summary() if self._pins is not None else {}

    def close(self) -> None:
        """Close the files; may be called twice."""
        for file in self._files.values():
            file.close()
        if self._truth is not None:
            self._truth.close()


def pull_files(text: str, settle_s: float = 0.0) -> dict[Pin, PullFile]:
    """Files by pin from `sout=PATH,alarm=PATH`. Raises ValueError, OSError."""
    files: dict[Pin, PullFile] = {}
    for part in filter(None, text.split(",")):
        name, _, path = part.partition("=")
        if name not in set(Pin) or not path:
            raise ValueError(f"pin {part!r}: expected NAME=PATH with one of {', '.join(Pin)}")
        files[Pin(name)] = PullFile(Path(path), settle_s)
    return files
