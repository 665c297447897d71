"""Timing of lines and of UTC, as the clock uses it: position of the measurement on a pulse, trigger stamps, the host's
UTC reference, a device's status bits about time; and the marks of SOUT_DIV pulses that the clock returns."""

from dataclasses import dataclass
from typing import Annotated, Final, NamedTuple

from msgspec import Meta

from imud.contracts.settings import Settings

SOUT_WIDTH_US: Final = 80.0
"""Length of a SOUT pulse; the first byte follows its falling edge (HiPNUC manual 1.2.2, PMUX2)."""
SIN_DELAY_US: Final = 125.0
"""From the rising edge on SIN to the frame leaving, on average (HiPNUC manual 1.2.1)."""


class SoutTiming(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Position of the measurement on a SOUT pulse. No manual gives it: the rising edge itself is an assumption."""

    offset_us: Annotated[float, Meta(ge=-100_000, le=100_000)] = 0.0
    """Instant of measurement minus rising edge, µs; negative if the device measures before its pulse."""
    bias_us: Annotated[float, Meta(ge=0, le=100_000)] = SIN_DELAY_US - SOUT_WIDTH_US
    """Bound of the error of `offset_us`, µs; 0 if it was calibrated. A triggered device begins its pulse 45 µs after
    the trigger (125 µs to the frame, of which 80 µs are the pulse), so no more than that is expected."""
    width_us: Annotated[float, Meta(ge=0, le=100_000)] = SOUT_WIDTH_US
    """Length of the pulse, µs: the time of a lost rising edge is derived from the falling edge."""


class TriggerTiming(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Position of the measurement after a trigger on SIN."""

    offset_us: Annotated[float, Meta(ge=-100_000, le=100_000)] = 0.0
    """Instant of measurement minus trigger, µs."""
    bias_us: Annotated[float, Meta(ge=0, le=100_000)] = SIN_DELAY_US
    """Bound of the error of `offset_us`, µs: a device may measure at any time before the frame leaves."""


class TriggerStamp(NamedTuple):
    """One trigger that the host sent on SIN."""

    t_ns: int
    """CLOCK_MONOTONIC at the rising edge."""
    err_ns: int
    """One-sigma error of `t_ns`."""
    number: int
    """Counts the triggers from 1."""


class UtcReference(NamedTuple):
    """The host's estimate of UTC."""

    offset_ns: int
    """UTC (CLOCK_REALTIME) minus CLOCK_MONOTONIC."""
    error_ns: int
    """One-sigma error of `offset_ns`."""


@dataclass(frozen=True, slots=True)
class TimeBits:
    """Masks of a device's status bits about time; 0 for a bit that it does not have."""

    sync_out: int = 0
    """Set in a frame that belongs to a pulse on SOUT. Used once it was seen set: older firmware sends zeros."""
    not_utc: int = 0
    """Set while the device's time is not synchronised to UTC."""


NO_TIME_BITS: Final = TimeBits()
"""Of a device without such status bits."""


class Mark(NamedTuple):
    """One pulse on SOUT_DIV: a camera was triggered."""

    t_ns: int
    """CLOCK_MONOTONIC of its rising edge, as the kernel stamped it."""
    number: int
    """`Edge.number` of the rising edge."""
    seq: int | None
    """`Sample.seq` of the sample it belongs to; None when that sample was lost."""
