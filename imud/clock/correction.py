"""A device that sets its counter by a little while its samples go on: what was taken is even, only the stamps moved.

A module on UTC takes back at the first pulse after a break what its crystal gathered: 0.9 ms after 30 s at 30 ppm,
30 ms after ten minutes at 50 ppm. Its sampling does not move with the counter. A step that is no whole number of
periods, or one over samples that were not lost, is therefore held against the arrivals: where they fit the next
sample better than the stamp, the stamp's step is taken out of device time, and fit and edges go on undisturbed.
Corrections within a tick never come here: `unwrap` keeps samples even over them.
"""

from typing import Final

from imud.clock.envelope import Envelope
from imud.clock.unwrap import DeviceTime
from imud.units import NS_PER_MS, NS_PER_S

MOST_NS: Final = 250 * NS_PER_MS
"""A counter that moves by more was not corrected: it is another time. An hour and more without pulses at 50 ppm."""
KNOWN_NS: Final = 5 * NS_PER_S
"""A line through less swings by more than a correction."""
EARLY_SIGMAS: Final = 4
EARLY_TICKS: Final = 0.5
"""A message so far before the line came before its sample, if that was taken when the stamp says."""


def corrected(time: DeviceTime, envelope: Envelope, x_before: int, y: int) -> bool:
    """Whether the counter was set by a little at the newest sample or shortly before; device time is then even again.

    The sample before was at device time `x_before`; the message began no later than `y`.
    """
    period_ns = time.period.period_ticks * time.tick_ns
    if not period_ns or envelope.span_ns < KNOWN_NS:
        return False
    slope, x = envelope.slope, time.even_ns
    due = envelope.y_ref + slope * (x_before - envelope.x_ref)
    early_ns = EARLY_TICKS * time.tick_ns + EARLY_SIGMAS * envelope.error_ns
    early_ns += envelope.slope_error * max(min(x - envelope.x_fit, MOST_NS), 0)
    height = y - due - slope * (x - x_before)
    if time.uneven:
        return _set(time, x_before, (y - due) / slope, height, early_ns, envelope.hold_ns)
    if time.gap and height < -early_ns:
        periods = min(round(-height / (slope * period_ns)), time.gap)
        if periods and height + periods * slope * period_ns >= -early_ns and periods * period_ns <= MOST_NS:
            time.take_back(periods)
            return True
    if -early_ns <= height <= time.doubt_ns / 2:
        time.doubt_ns = 0.0
    return False


def _set(time: DeviceTime, x_before: int, elapsed_ns: float, height: float, early_ns: float, hold_ns: int) -> bool:
    """Make an uneven step even, if the message, `elapsed_ns` after the sample before, fits that better."""
    period_ns = time.period.period_ticks * time.tick_ns
    waited_ns = elapsed_ns - period_ns
    if waited_ns < -early_ns:
        return False
    periods = 1 + int(max(waited_ns - hold_ns, 0.0) / period_ns)
    moved_ns = time.step_ns - periods * period_ns
    if abs(moved_ns) > MOST_NS:
        return False
    late_ns = elapsed_ns - periods * period_ns
    if -early_ns <= height <= late_ns:
        return False
    time.make_even(x_before, periods)
    return True
