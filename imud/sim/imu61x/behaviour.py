"""Behaviour of a simulated IMU61x where the manual is silent: what it does in one way, or in another.

Drivers must work with each of `VARIANTS` (UART) and `REGISTER_VARIANTS` (SPI). The manual does not say what the result
codes of K1 mean, whether commands are obeyed in stream mode, when a baud rate and a factory reset come into force, how
long writing to flash takes and what the device does meanwhile, whether K1 comes at the begin or at the end of a
calibration; on SPI, where BURST_CTRL reads back, and what the other bits of WIN_CTRL are.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from imud.devices.imu61x.common.registers import BURST_CTRL
from imud.devices.imu61x.uart.commands import Command
from imud.units import NS_PER_S

CALIBRATION_NS: Final = 3 * NS_PER_S
"""Length of either calibration."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Imu61xBehaviour:
    """One way to read the manual."""

    answers_while_streaming: bool = True
    """Whether it obeys more than CMD 3 in stream mode."""
    baud_acts_at_start: bool = False
    """Whether a new baud rate waits for the next start."""
    reset_acts_at_start: bool = False
    """Whether CMD 15 changes flash only, and acts at the next start."""
    changes_mode: bool = True
    """Whether it obeys the output mode it acknowledges."""
    acknowledges: bool = True
    """Whether it sends K1 at all."""
    result_done: int = 0
    """Result of K1 for what was carried out."""
    result_refused: int = 2
    """Result of K1 for what was not."""
    refuses: frozenset[Command] = frozenset()
    """Commands that are answered with `result_refused` and not carried out."""
    ignores: frozenset[Command] = frozenset()
    """Commands that are neither answered nor carried out."""
    flash_ms: int = 0
    """Time of CMD 5 and CMD 15 until their answer; nothing is sent and nothing heard meanwhile."""
    quiet_ms: int = 0
    """Time after K1 in which nothing is sent and nothing heard."""
    acknowledges_at_end: bool = False
    """Whether K1 of a calibration comes at its end."""
    reports_calibration: bool = True
    """Whether S1 is long enough to have a calibration status."""


ORDERS: Final = frozenset(Command) - {Command.STATUS, Command.AHRS, Command.READ_PARAMETER}
"""Commands without an answer of their own."""

VARIANTS: Final[Mapping[str, Imu61xBehaviour]] = {
    "obeys while it streams": Imu61xBehaviour(),
    "answers in command mode only": Imu61xBehaviour(answers_while_streaming=False),
    "K1 = 1 means done": Imu61xBehaviour(result_done=1, result_refused=0),
    "no K1": Imu61xBehaviour(acknowledges=False),
    "slow flash": Imu61xBehaviour(flash_ms=2000),
    "quiet after an answer": Imu61xBehaviour(quiet_ms=700),
    "baud rate at the next start": Imu61xBehaviour(baud_acts_at_start=True),
    "factory reset at the next start": Imu61xBehaviour(reset_acts_at_start=True),
    "K1 at the end of a calibration": Imu61xBehaviour(acknowledges_at_end=True),
    "short status": Imu61xBehaviour(reports_calibration=False),
    "all at once": Imu61xBehaviour(
        answers_while_streaming=False, result_done=1, result_refused=0, flash_ms=2000, quiet_ms=700,
        baud_acts_at_start=True, reset_acts_at_start=True,
    ),
}  # fmt: skip
"""The simulated variants by name, each of which carries out its commands."""
REFUSING: Final = Imu61xBehaviour(refuses=ORDERS)
"""A device that answers questions and refuses every order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterBehaviour:
    """One way to read the manual's chapter 2."""

    low_address: bool = True
    """Whether BURST_CTRL reads back in the high byte of the word at 0x0C, as the manual's layout has it."""
    high_address: bool = True
    """Whether it reads back in the low byte of the word at 0x0D, as the vendor's program has it."""
    window_bits: int = 0
    """Bits of WIN_CTRL that are set next to its WINDOW_ID."""

    def burst_ctrl(self, address: int, extended: int) -> int:
        """The word that is read at 0x0C or 0x0D."""
        if address == BURST_CTRL:
            return extended << 8 if self.low_address else 0
        return extended if self.high_address else 0


REGISTER_VARIANTS: Final[Mapping[str, RegisterBehaviour]] = {
    "BURST_CTRL at both addresses": RegisterBehaviour(),
    "BURST_CTRL at 0x0C": RegisterBehaviour(high_address=False),
    "BURST_CTRL at 0x0D": RegisterBehaviour(low_address=False),
    "BURST_CTRL reads zero": RegisterBehaviour(low_address=False, high_address=False),
    "other bits in WIN_CTRL": RegisterBehaviour(window_bits=0xA5FE),
}
"""The simulated variants by name."""
