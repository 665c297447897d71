"""The daemon with FIFOs as GPIO lines: `python -m tests.bench.sout_daemon CONFIG`. The FIFO `edges` is next to CONFIG.

A FIFO delivers the same bytes through the same system calls as the descriptor of a GPIO chip.
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
        self._fd = os.open(self.path, os.O_RDWR)  # also open for writing, so that the FIFO does not end

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
