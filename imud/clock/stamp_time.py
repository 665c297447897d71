"""Time from a short stamp: milliseconds since the last pulse, in a few bits, in messages that carry no other time.

HI92 of HiPNUC has 13 bits: without a pulse per second they free-run and begin anew every 8.192 s; a pulse sets them to
zero. `StampTime` makes ticks of them that go on, for `DeviceTime`:

    stamp  8170 8180 8190    8   18          no pulse: the stamp turned
    ticks  8170 8180 8190 8200 8210
    stamp   970  980  990    2   12          a pulse: 7204 ms ahead would be before the message was measured
    ticks   970  980  990 1002 1012

What a stamp leaves open is decided by arrivals: a message never comes before it was measured, and messages that are
read as they come are not late by whole turns. So a stall shorter than a turn is counted exactly, as the stamp shows it,
and a longer one when messages are on time again. Nothing here reads a clock.
"""

from typing import Final

from imud.units import NS_PER_MS

PULSE_TICKS: Final = 1000
"""From pulse to pulse, in ms."""
EARLY_NS: Final = 100 * NS_PER_MS
"""A message so far before the earliest possible one was not measured then: a pulse came."""
DRIFT: Final = 200e-6
"""Rate error of a device's crystal against the host's, at most."""
LATE_NS: Final = 400 * NS_PER_MS
"""How far from whole turns the lateness of live messages may be."""
LIVE_TICKS: Final = 640
LIVE_SHARE: Final = 0.04
LIVE_BREAK_NS: Final = 40 * NS_PER_MS
"""Messages over so many ticks that come at the pace of their stamps, within this share, are read as they come; a step
that differs from the time between arrivals by more than an adapter's latency timer begins that count anew."""
STUCK_MESSAGES: Final = 8
"""With so many equal stamps the stamp is no time: each message follows a pulse of its own (triggers on SIN)."""
FOREIGN_NS: Final = 1000 * NS_PER_MS
"""After so long without a message that carries time, those with a stamp alone are dated by it."""
WRAP: Final = 1 << 32


class StampTime:
    """Ticks of 1 ms from stamps of 1 ms that begin anew after `modulus`, modulo 2³²."""

    __slots__ = (
        "_arrival_ns", "_foreign_since_ns", "_foreign_ticks", "_live_arrival_ns", "_live_ticks", "_lowest_ns",
        "_modulus", "_origin_ns", "_pulsed", "_stamp", "_stuck", "_ticks", "before", "in_use",
    )  # fmt: skip

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._stamp = -1
        """The newest stamp; -1 before the first."""
        self.before = 0
        """Ticks of the message before the newest one."""
        self._ticks = 0
        """Ticks of the newest message, not wrapped."""
        self._arrival_ns = 0
        self._origin_ns = 0
        """Arrival that lateness is relative to."""
        self._lowest_ns = 0.0
        """Least arrival minus ticks so far, from the origin; it rises by DRIFT."""
        self._live_ticks = self._live_arrival_ns = 0
        """The message since which arrivals have kept pace with the ticks."""
        self._stuck = 0
        self._pulsed = False
        """Whether a pulse per second sets the stamp to zero."""
        self._foreign_ticks: int | None = None
        self._foreign_since_ns = 0
        self.in_use = False
        """Whether ticks come from stamps now."""

    def ticks(self, stamp: int, arrival_ns: int, known_ticks: int | None) -> int | None:
        """Return the ticks of a message; None where the stamp does not show its time.

        `known_ticks` are those that the clock knows last, None for none: if they are not from here, other messages
        carry time, and those are preferred.
        """
        if self._is_foreign(known_ticks, arrival_ns):
            return None
        if self._stamp < 0:
            self._begin(stamp, arrival_ns, known_ticks)
            return None
        elapsed_ns, before = arrival_ns - self._arrival_ns, self._stamp
        self._stamp, self._arrival_ns = stamp, arrival_ns
        self._stuck = self._stuck + 1 if stamp == before and elapsed_ns > NS_PER_MS else 0
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

    def restart(self) -> None:
        """Begin anew: the device or its link was away."""
        self._stamp = -1
        self.in_use = self._pulsed = False
        self._foreign_ticks = None

    def _is_foreign(self, known_ticks: int | None, arrival_ns: int) -> bool:
        """Whether messages that carry time come as well."""
        if known_ticks is None or (self.in_use and known_ticks == self._ticks % WRAP):
            self._foreign_ticks = None
            return False
        if known_ticks != self._foreign_ticks:
            self.restart()
            self._foreign_ticks, self._foreign_since_ns = known_ticks, arrival_ns
        return arrival_ns - self._foreign_since_ns < FOREIGN_NS

    def _begin(self, stamp: int, arrival_ns: int, known_ticks: int | None) -> None:
        """Set the first stamp; ticks go on from those that other messages carried."""
        since_ms = round((arrival_ns - self._foreign_since_ns) / NS_PER_MS)
        self._ticks = stamp if known_ticks is None else known_ticks + since_ms
        self._stamp, self._arrival_ns, self._origin_ns = stamp, arrival_ns, arrival_ns - self._ticks * NS_PER_MS
        self._lowest_ns, self._stuck = 0.0, 0
        self._live_ticks, self._live_arrival_ns = self._ticks, arrival_ns

    def _late_ns(self, ticks: int, arrival_ns: int) -> float:
        """Lateness of a message at `ticks` against the one that was least late."""
        return arrival_ns - self._origin_ns - ticks * NS_PER_MS - self._lowest_ns

    def _step(self, stamp: int, before: int, arrival_ns: int, elapsed_ns: int) -> int:
        """Ticks since the message before; the stamp may have turned or been set to zero between.

        The first pulse comes at any stamp: the arrivals show how long ago the message before was.
        """
        turned = (stamp - before) % self._modulus
        if stamp >= before:
            return turned
        pulsed = (stamp - before) % PULSE_TICKS
        late_ns = self._late_ns(self._ticks + turned, arrival_ns)
        if self._pulsed:
            nearer = abs(late_ns) < abs(self._late_ns(self._ticks + pulsed, arrival_ns))
            self._pulsed = not (nearer and before > PULSE_TICKS)
        elif late_ns < -EARLY_NS:
            self._pulsed = True
            if abs(elapsed_ns - pulsed * NS_PER_MS) > LIVE_BREAK_NS:
                return max(round(elapsed_ns / NS_PER_MS), 1)
        return pulsed if self._pulsed else turned

    def _follow(self, arrival_ns: int, elapsed_ns: int) -> None:
        """Note how late the message is; add the turns that live messages show to be missing."""
        self._lowest_ns += DRIFT * elapsed_ns
        if self._ticks - self._live_ticks >= LIVE_TICKS:
            self._add_turns(arrival_ns)
        self._lowest_ns += min(self._late_ns(self._ticks, arrival_ns), 0.0)

    def _add_turns(self, arrival_ns: int) -> None:
        """Add whole turns by which messages are late that come at the pace of their stamps."""
        pace = (arrival_ns - self._live_arrival_ns) / ((self._ticks - self._live_ticks) * NS_PER_MS)
        late_ns = self._late_ns(self._ticks, arrival_ns)
        turn = PULSE_TICKS if self._pulsed else self._modulus
        turns = round(late_ns / (turn * NS_PER_MS))
        if turns > 0 and abs(pace - 1) <= LIVE_SHARE and abs(late_ns - turns * turn * NS_PER_MS) <= LATE_NS:
            self._ticks += turns * turn
        self._live_ticks, self._live_arrival_ns = self._ticks, arrival_ns
