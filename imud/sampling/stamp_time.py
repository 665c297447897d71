"""Ticks of a device whose frames contain only the time since the last pulse (`pps_age_ms`), which restarts."""

from typing import ClassVar, Final

from imud.model.units import NS_PER_MS

PULSE_TICKS: Final = 1000  # time between pulses, ms
EARLY_NS: Final = 100 * NS_PER_MS  # minimum time before the earliest possible arrival, ns, that shows a pulse
DRIFT: Final = 200e-6  # maximum rate error of a device's crystal compared to the host
LATE_NS: Final = 400 * NS_PER_MS  # maximum distance of their lateness from a whole number of turns, ns
# Frames are live if their values and their arrival times rise by the same time, within this share, over this number
# of ticks. A step that differs from the time between arrivals by more than a latency timer restarts the count.
LIVE_TICKS: Final = 640
LIVE_SHARE: Final = 0.04
LIVE_BREAK_NS: Final = 40 * NS_PER_MS
# number of equal values that show that the value is not a time: each frame follows its own pulse (triggers on SIN)
STUCK_MESSAGES: Final = 8
# time without a frame with device time after which `pps_age_ms` makes the time stamps, ns
FOREIGN_NS: Final = 1000 * NS_PER_MS
WRAP: Final = 1 << 32
StampState = tuple[bool, int, int, int, int, int, int, int, float]


class StampTime:
    """Ticks of 1 ms, modulo 2³², from values of 1 ms that restart after `modulus` (`pps_age_ms`)."""

    __slots__ = (
        "_arrival_ns", "_foreign_since_ns", "_foreign_ticks", "_live_arrival_ns", "_live_ticks", "_lowest_ns",
        "_modulus", "_origin_ns", "_pulsed", "_stamp", "_stuck", "_ticks", "before", "in_use",
    )  # fmt: skip

    NO_STATE: ClassVar[StampState] = (False, 0, 0, 0, 0, 0, 0, 0, 0.0)

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._stamp = -1  # newest value; -1 before the first
        self.before = 0  # ticks of the previous frame
        self._ticks = 0  # unwrapped ticks of the newest frame
        self._arrival_ns = 0
        self._origin_ns = 0  # arrival relative to which lateness is measured
        self._lowest_ns = 0.0  # least lateness, with DRIFT added
        self._live_ticks = self._live_arrival_ns = 0  # frame since which the arrivals keep pace
        self._stuck = 0
        self._pulsed = False  # whether a pulse per second resets the value
        self._foreign_ticks: int | None = None
        self._foreign_since_ns = 0
        self.in_use = False  # whether the ticks come from `pps_age_ms`

    def ticks(self, stamp: int, arrival_ns: int, known_ticks: int | None) -> int | None:
        """Return the ticks of a frame; None if `stamp` does not show its time. `known_ticks` are the last ticks of the
        clock, None without ticks. If other frames of the device contain the time, the clock prefers these frames."""
        if self._is_foreign(known_ticks, arrival_ns):
            return None
        if self._stamp < 0:
            self._begin(stamp, arrival_ns, known_ticks)
            return None
        elapsed_ns, before = arrival_ns - self._arrival_ns, self._stamp
        self._stamp, self._arrival_ns = stamp, arrival_ns
        self._stuck = self._stuck + 1 if stamp == before and elapsed_ns > NS_PER_MS else 0  # 0: two frames of one read
        if self._stuck >= STUCK_MESSAGES or (self._stuck and not self.in_use):
            self.in_use = False
            return None
        step, self.before = self._step(stamp, before, arrival_ns, elapsed_ns), self._ticks % WRAP
        self._ticks += step
        if abs(elapsed_ns - step * NS_PER_MS) > LIVE_BREAK_NS:
            self._live_ticks, self._live_arrival_ns = self._ticks, arrival_ns
        self._follow(arrival_ns, elapsed_ns)
        self.in_use = True
        return self._ticks % WRAP

    def state(self) -> StampState:
        """Return the state of the newest frame. The C kernel changes this state."""
        return (
            self.in_use, self._stamp, self.before, self._ticks, self._arrival_ns, self._origin_ns, self._live_ticks,
            self._live_arrival_ns, self._lowest_ns,
        )  # fmt: skip

    def set_state(self, state: StampState) -> None:
        """Set the state after frames of the kernel, at least one."""
        (
            _, self._stamp, self.before, self._ticks, self._arrival_ns, _, self._live_ticks, self._live_arrival_ns,
            self._lowest_ns,
        ) = state  # fmt: skip
        self._stuck, self._foreign_ticks = 0, None

    def restart(self) -> None:
        """Start again: the device or its link was missing."""
        self._stamp = -1
        self.in_use = self._pulsed = False
        self._foreign_ticks = None

    def _is_foreign(self, known_ticks: int | None, arrival_ns: int) -> bool:
        """Return whether other frames of the device contain the time."""
        if known_ticks is None or (self.in_use and known_ticks == self._ticks % WRAP):
            self._foreign_ticks = None
            return False
        if known_ticks != self._foreign_ticks:
            self.restart()
            self._foreign_ticks, self._foreign_since_ns = known_ticks, arrival_ns
        return arrival_ns - self._foreign_since_ns < FOREIGN_NS

    def _begin(self, stamp: int, arrival_ns: int, known_ticks: int | None) -> None:
        """Set the first value. The ticks continue from the frames with device time."""
        since_ms = round((arrival_ns - self._foreign_since_ns) / NS_PER_MS)
        self._ticks = stamp if known_ticks is None else known_ticks + since_ms
        self._stamp, self._arrival_ns, self._origin_ns = stamp, arrival_ns, arrival_ns - self._ticks * NS_PER_MS
        self._lowest_ns, self._stuck = 0.0, 0
        self._live_ticks, self._live_arrival_ns = self._ticks, arrival_ns

    def _late_ns(self, ticks: int, arrival_ns: int) -> float:
        """Return the lateness of a frame at `ticks` after the frame with the smallest lateness, ns."""
        return arrival_ns - self._origin_ns - ticks * NS_PER_MS - self._lowest_ns

    def _step(self, stamp: int, before: int, arrival_ns: int, elapsed_ns: int) -> int:
        """Return the ticks since the previous frame. The value may have wrapped, or a pulse may have reset it."""
        # The first pulse can come at any value. The arrivals then show the time since the previous frame.
        turned = (stamp - before) % self._modulus
        if stamp >= before:
            return turned
        pulsed = (stamp - before) % PULSE_TICKS
        late_ns = self._late_ns(self._ticks + turned, arrival_ns)
        if self._pulsed:
            nearer = abs(late_ns) < abs(self._late_ns(self._ticks + pulsed, arrival_ns))
            self._pulsed = not (nearer and before > PULSE_TICKS)
        elif late_ns < -EARLY_NS:  # too early for a wrap: a pulse reset the value
            self._pulsed = True
            if abs(elapsed_ns - pulsed * NS_PER_MS) > LIVE_BREAK_NS:
                return max(round(elapsed_ns / NS_PER_MS), 1)
        return pulsed if self._pulsed else turned

    def _follow(self, arrival_ns: int, elapsed_ns: int) -> None:
        """Update the smallest lateness. Add the turns of the value that imud missed."""
        self._lowest_ns += DRIFT * elapsed_ns
        if self._ticks - self._live_ticks >= LIVE_TICKS:
            self._add_turns(arrival_ns)
        self._lowest_ns += min(self._late_ns(self._ticks, arrival_ns), 0.0)

    def _add_turns(self, arrival_ns: int) -> None:
        """Add whole turns if the frames are late by whole turns and their values rise as fast as the arrivals."""
        pace = (arrival_ns - self._live_arrival_ns) / ((self._ticks - self._live_ticks) * NS_PER_MS)
        late_ns = self._late_ns(self._ticks, arrival_ns)
        turn = PULSE_TICKS if self._pulsed else self._modulus
        turns = round(late_ns / (turn * NS_PER_MS))
        if turns > 0 and abs(pace - 1) <= LIVE_SHARE and abs(late_ns - turns * turn * NS_PER_MS) <= LATE_NS:
            self._ticks += turns * turn
        self._live_ticks, self._live_arrival_ns = self._ticks, arrival_ns
