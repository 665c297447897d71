"""What the clock is told besides messages: where on a pulse the measurement is, what the host knows of UTC, which
status bits of a device speak of time; and which sample a divided pulse belongs to."""

from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from msgspec import Meta

from imud.contracts.settings import Settings

SOUT_WIDTH_US: Final = 80.0
"""SOUT is high for so long, and the first byte follows its falling edge (HiPNUC manual 1.2.2, PMUX2)."""
SIN_DELAY_US: Final = 125.0
"""From the rising edge on SIN to the frame leaving, on average (HiPNUC manual 1.2.1)."""


class SoutTiming(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where on a SOUT pulse the measurement is. No manual says: the rising edge itself is an assumption."""

    offset_us: Annotated[float, Meta(ge=-100_000, le=100_000)] = 0.0
    """Instant of measurement minus rising edge, µs; negative when the device measures before its pulse."""
    bias_us: Annotated[float, Meta(ge=0, le=100_000)] = SIN_DELAY_US - SOUT_WIDTH_US
    """How far the truth can be from that, µs; 0 when it was calibrated. A triggered device begins its pulse 45 µs after
    the trigger (125 µs to the frame, of which 80 µs are the pulse), so no more than that is expected."""
    width_us: Annotated[float, Meta(ge=0, le=100_000)] = SOUT_WIDTH_US
    """Length of the pulse, µs: a rising edge that got lost is counted back from the falling one."""


class TriggerTiming(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where behind a trigger on SIN the measurement is."""

    offset_us: Annotated[float, Meta(ge=-100_000, le=100_000)] = 0.0
    """Instant of measurement minus trigger, µs."""
    bias_us: Annotated[float, Meta(ge=0, le=100_000)] = SIN_DELAY_US
    """How far the truth can be from that, µs: a device may measure at any time before the frame leaves."""


class TriggerStamp(NamedTuple):
    """One trigger that the host gave on SIN."""

    t_ns: int
    """CLOCK_MONOTONIC when the line was driven."""
    err_ns: int
    """One-sigma error of `t_ns`."""
    number: int
    """Counts the triggers from 1."""


class UtcReference(NamedTuple):
    """What the host knows of UTC."""

    offset_ns: int
    """UTC (CLOCK_REALTIME) minus CLOCK_MONOTONIC."""
    error_ns: int
    """One-sigma error of `offset_ns`, as the system's clock discipline states it."""


@dataclass(frozen=True, slots=True)
class TimeBits:
    """Masks of a device's status bits that speak of time; 0 for a bit it does not have."""

    sync_out: int = 0
    """Set in a frame that belongs to a pulse on SOUT. Believed once it was seen set: older firmware sends zeros."""
    not_utc: int = 0
    """Set while the device's time is not synchronised to UTC."""


NO_TIME_BITS: Final = TimeBits()
"""Of a device that says nothing of time in its status."""


class Mark(NamedTuple):
    """One pulse on SOUT_DIV: a camera was triggered."""

    t_ns: int
    """CLOCK_MONOTONIC of its rising edge, as the kernel stamped it."""
    number: int
    """`Edge.number` of the rising edge."""
    seq: int | None
    """`Sample.seq` of the sample it belongs to; None when that sample was lost."""
