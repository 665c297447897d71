"""Lines of GPIO chips through libgpiod 2, for `imud.kit.lines`."""

from typing import Final

from imud.gpio.lines import GpioInput, GpioOutput
from imud.kit.lines import LineMaker

__all__ = ["LINES", "GpioInput", "GpioOutput"]

LINES: Final = LineMaker(GpioInput, GpioOutput)
