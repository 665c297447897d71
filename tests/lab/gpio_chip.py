"""GPIO chips of the kernel's gpio-sim. Tests set the levels of inputs and read the levels of outputs.

Interface: Documentation/admin-guide/gpio/gpio-sim.rst (configfs creates a chip, sysfs sets pulls and shows values).
"""

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

CONFIGFS = Path("/sys/kernel/config/gpio-sim")
_numbers = itertools.count()


@dataclass(frozen=True)
class GpioChip:
    path: Path
    """Character device of the chip, for example /dev/gpiochip0."""
    names: tuple[str, ...]
    sysfs: Path
    """Folder with one sim_gpio<offset> per line."""
    device: Path

    def drive(self, line: str | int, level: bool) -> None:
        self._attribute(line, "pull").write_text("pull-up" if level else "pull-down", encoding="ascii")

    def level(self, line: str | int) -> bool:
        return self._attribute(line, "value").read_text(encoding="ascii").strip() == "1"

    def pull(self, line: str) -> Path:
        return self._attribute(line, "pull")

    def value(self, line: str) -> Path:
        return self._attribute(line, "value")

    def unplug(self) -> None:
        _set(self.device / "live", "0")

    def plug_in(self) -> None:
        """Plug the chip in again. Its number can change; the names of its lines stay."""
        _set(self.device / "live", "1")

    def _attribute(self, line: str | int, name: str) -> Path:
        offset = self.names.index(line) if isinstance(line, str) else line
        return self.sysfs / f"sim_gpio{offset}" / name


@contextmanager
def simulated_chip(names: Sequence[str]) -> Iterator[GpioChip]:
    device = CONFIGFS / f"lab{next(_numbers)}"
    bank = device / "bank0"
    lines = [bank / f"line{offset}" for offset, name in enumerate(names) if name]
    made = [device, bank, *lines]
    for folder in made:
        folder.mkdir()
    try:
        _set(bank / "num_lines", str(len(names)))
        for line, name in zip(lines, filter(None, names), strict=True):
            _set(line / "name", name)
        _set(device / "live", "1")
        chip = _get(bank / "chip_name")
        sysfs = Path("/sys/devices/platform") / _get(device / "dev_name") / chip
        yield GpioChip(Path("/dev") / chip, tuple(names), sysfs, device)
    finally:
        if _get(device / "live") == "1":
            _set(device / "live", "0")
        for folder in reversed(made):
            folder.rmdir()


def _set(attribute: Path, value: str) -> None:
    attribute.write_text(value, encoding="ascii")


def _get(attribute: Path) -> str:
    return attribute.read_text(encoding="ascii").strip()
