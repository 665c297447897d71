"""As much of gpiod 2 as imud uses: chips of the test's making, and edges through a pipe."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gpiod as real

from imud.signals.gpio.kernel_interface import EVENT


class FakeRequest:
    """A requested line; `feed` is the kernel writing events."""

    def __init__(self, settings: Any) -> None:
        self.settings = settings
        self.fd, self._far = os.pipe()
        self.released = False
        self.value = False
        self.error = 0
        """The errno that `get_value` fails with."""

    def feed(self, *events: tuple[int, int, int]) -> None:
        """Time, id and line_seqno of each."""
        os.write(self._far, b"".join(EVENT.pack(t_ns, kind, 0, seqno, seqno) for t_ns, kind, seqno in events))

    def get_value(self, _offset: int) -> bool:
        if self.error:
            raise OSError(self.error, "by the test")
        return self.value

    def release(self) -> None:
        assert not self.released
        self.released = True
        os.close(self.fd)
        os.close(self._far)


class FakeGpiod:
    """To stand in `sys.modules`. Chips are files of `devices`, by name: label and names of their lines."""

    line = real.line
    LineSettings = real.LineSettings

    def __init__(self, devices: Path, **chips: tuple[str, tuple[str, ...]]) -> None:
        self.chips = chips
        self.errors: dict[str, int] = {}
        """The errno that opening a chip fails with."""
        self.refusal = 0
        """The errno that a request fails with."""
        self.holder = ""
        self.requests: list[FakeRequest] = []
        self.asked: list[tuple[str, int, str, int | None]] = []
        """Chip, offset, consumer and buffer of every request."""
        for name in chips:
            (devices / name).touch()

    def Chip(self, path: str) -> "FakeChip":
        name = os.path.basename(path)
        if number := self.errors.get(name, 0 if name in self.chips else errno.ENOTTY):
            raise OSError(number, "by the test")
        return FakeChip(*self.chips[name], self.holder)

    def request_lines(
        self, path: str, config: dict[int, Any], consumer: str, event_buffer_size: int | None
    ) -> FakeRequest:
        ((offset, settings),) = config.items()
        self.asked.append((os.path.basename(path), offset, consumer, event_buffer_size))
        if self.refusal:
            raise OSError(self.refusal, "by the test")
        self.requests.append(FakeRequest(settings))
        return self.requests[-1]


class FakeChip:
    """A chip that is open."""

    def __init__(self, label: str, names: tuple[str, ...], holder: str) -> None:
        self._label, self._names, self._holder = label, names, holder

    def __enter__(self) -> "FakeChip":
        return self

    def __exit__(self, *_error: object) -> None: ...

    def get_info(self) -> SimpleNamespace:
        return SimpleNamespace(label=self._label, num_lines=len(self._names))

    def get_line_info(self, offset: int) -> SimpleNamespace:
        return SimpleNamespace(name=self._names[offset], consumer=self._holder)
