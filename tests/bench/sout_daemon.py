"""The daemon with its lines on FIFOs: `python -m tests.bench.sout_daemon CONFIG`. The FIFO `edges` is beside the file.

What a GPIO chip gives by its descriptor a FIFO gives here: the same bytes for the same system calls.
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from imud import config
from imud.contracts.lines import InputOptions, LineFactory
from imud.daemon import Daemon
from imud.host import event_loop
from imud.host.log import STDERR, log_to
from imud.lines.gpio import GpioInput, GpioOutput


class FifoInput(GpioInput):
    path = ""

    def __init__(self, settings: InputOptions, purpose: str, rising_only: bool = False) -> None:
        super().__init__(settings, purpose, rising_only)

    def _open(self, _config: Callable[[Any], Any], _events: int | None) -> None:
        self._fd = os.open(self.path, os.O_RDWR)  # its own writer too, so that it never ends

    def level(self) -> bool:
        return False

    def _release(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def main() -> None:
    file = Path(sys.argv[1])
    FifoInput.path = str(file.parent / "edges")
    settings = config.load(file)

    async def serve() -> None:
        daemon = Daemon(settings, lines=LineFactory(FifoInput, GpioOutput))
        daemon.install_signals()
        await daemon.run()

    with log_to(STDERR, settings.log_level):
        event_loop.run(serve())


if __name__ == "__main__":
    main()
