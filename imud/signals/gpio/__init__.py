"""GPIO character devices through libgpiod 2: the inputs and outputs that `imud.contracts.lines` specifies."""

from typing import Final

from imud.contracts.lines import LineFactory
from imud.signals.gpio.line_request import GpioInput, GpioOutput

__all__ = ["GPIO_LINES", "GpioInput", "GpioOutput"]

GPIO_LINES: Final = LineFactory(GpioInput, GpioOutput)
