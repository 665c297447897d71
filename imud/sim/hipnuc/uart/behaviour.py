"""Behaviour of a simulated HiPNUC module where the manual leaves it open: what it says in two ways, or not at all.

Drivers must work with each of `VARIANTS`. The manual (V1.5.9) says of SERIALCONFIG and FRESET both "at once" (2.1) and
"after a restart" (end of 2.1, 2.2.5); it gives no time for writing to flash (2.2.2); it does not say what a product
without magnetometer answers to LOG MAGCONFIG (8.1.1), or whether frames go on while a command is carried out.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final


class RateChange(Enum):
    """Moments at which SERIALCONFIG changes the rate of the line."""

    AFTER_RESTART = "after restart"
    """After SAVECONFIG and REBOOT."""
    BEFORE_ANSWER = "before answer"
    """At once: the answer comes at the new rate."""
    AFTER_ANSWER = "after answer"
    """At once: the answer comes at the old rate."""


class ResetEffect(Enum):
    """Moments at which FRESET puts the factory settings in force."""

    RATE_AFTER_RESTART = "rate after restart"
    """All settings at once, but the baud rate after a restart."""
    AFTER_RESTART = "after restart"
    """Nothing changes until a restart."""
    BEFORE_ANSWER = "before answer"
    """Everything at once: the answer comes at the factory's rate."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Behaviour:
    """One way to read the manual."""

    rate_change: RateChange = RateChange.AFTER_RESTART
    factory_reset: ResetEffect = ResetEffect.RATE_AFTER_RESTART
    flash_ms: int = 0
    """Time of SAVECONFIG and FRESET until their answer; no frame is sent meanwhile."""
    quiet_ms: int = 0
    """Time after an answer in which no frame is sent."""
    refuses: tuple[str, ...] = ()
    """Beginnings of commands that are answered with ERR."""
    ignores: tuple[str, ...] = ()
    """Beginnings of commands that are unknown: they get no answer."""


AS_IN_MANUAL: Final = Behaviour()

VARIANTS: Final[Mapping[str, Behaviour]] = {
    "as in the manual": AS_IN_MANUAL,
    "rate changes before the answer": Behaviour(rate_change=RateChange.BEFORE_ANSWER),
    "rate changes after the answer": Behaviour(rate_change=RateChange.AFTER_ANSWER),
    "factory reset after restart": Behaviour(factory_reset=ResetEffect.AFTER_RESTART),
    "factory reset at once": Behaviour(factory_reset=ResetEffect.BEFORE_ANSWER),
    "slow flash": Behaviour(flash_ms=2000),
    "no magnetometer": Behaviour(ignores=("LOG MAGCONFIG",)),
    "magnetometer refused": Behaviour(refuses=("LOG MAGCONFIG",)),
    "quiet after an answer": Behaviour(quiet_ms=700),
    "all at once": Behaviour(
        rate_change=RateChange.BEFORE_ANSWER, factory_reset=ResetEffect.BEFORE_ANSWER, flash_ms=2000, quiet_ms=300
    ),
}
"""The simulated variants by name."""
