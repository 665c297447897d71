"""Lines of GPIO chips through libgpiod 2, for `imud.contracts.lines`."""

from typing import Final

from imud.contracts.lines import LineFactory
from imud.signals.gpio_lines import GpioInput, GpioOutput

__all__ = ["GPIO_LINES", "GpioInput", "GpioOutput"]

GPIO_LINES: Final = LineFactory(GpioInput, GpioOutput)
