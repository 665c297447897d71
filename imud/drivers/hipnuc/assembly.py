"""Assembly of samples from frames without counter and time (CANopen TPDOs, J1939 and NMEA 2000 PGNs).

A device sends the frames of one instant back to back, always in the same order: a burst. Each kind of frame (a TPDO, a
PGN) has its own rate; the fastest kinds are in every burst, a slower one in every m-th. **Frames of two periods are
never mixed.** The rule:

- Which kinds there are, their order, the period and every m are learned by what is heard. Frames until then, four
  periods of the fastest kind, and two of its own for each slower one, are ignored. One that joins the fast ones later
  is ignored for six.
- A sample begins with the frame that begins a burst. It is whole, and made at once, when all kinds are held that are
  due in this burst: the fast ones, and those of which the last came m bursts ago (or 2 m, 3 m … where one was lost).
- It ends when a kind comes that is already held (but an exact repetition right after itself is ignored), or a fast one
  that stands before the newest one held, or any frame later than 3/4 of a period after the first, or when frames are
  known to be missing (`reset`). Then it is dropped, as one lost sample; or, if all it lacks is slower kinds, it is a
  sample without them (but not after `reset`, nor for a device with one fast kind, whose next sample is whole already).
- A frame that does not begin a burst while nothing is held is ignored: what it belongs to is whole, or dropped, or
  has lost its beginning. A slower kind that is not due is ignored, and shows that its m has to be learned anew.
- Bursts of which nothing came are counted by time (`burst_timing`): a gap up to 1 s is loss. A host or a sender that
  stalls between two bursts, which then come later and back to back, costs nothing.
- A kind that stays away for ten of its periods is taken as switched off; another one that comes, joins. When nothing
  fits any more, everything is learned again.

A kind whose period is no whole multiple of the fastest one's has no place in this and stays ignored. What time alone
can show (the end of one burst and the beginning of the next are lost, unknown to the host) needs times of arrival that
are right to 1/4 of a period; those of the kernel are.
"""

from collections.abc import Container, Sequence
from itertools import pairwise
from statistics import fmean, median
from typing import Final, NamedTuple

from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S

PERIODS: Final = 4
"""Periods that must look alike."""
STEPS_MAX: Final = 64
"""Number of periods to average where arrival times vary so much that four periods are never alike."""
FRAMES_MAX: Final = 128
"""Frames kept while learning; they have room for four periods of more kinds than any device has."""


class Learned(NamedTuple):
    """Learned properties of a device's bursts."""

    order: tuple[int, ...]
    """Kinds that are in every burst, as they are sent."""
    period_ns: int
    """From burst to burst."""


class BurstLearning:
    """Learning from frames in the order they arrive. Synchronization: one thread."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, int]] = []
        self._steps: list[int] = []

    def add_frame(self, kind: int, t_ns: int) -> Learned | None:
        """Add the kind and time of arrival of one frame; return the bursts once they are known."""
        frames = self._frames
        frames.append((kind, t_ns))
        places = [place for place, (other, _) in enumerate(frames) if other == kind]
        if len(places) <= PERIODS:
            if len(frames) > FRAMES_MAX:
                del frames[: FRAMES_MAX // 2]
            return None
        slices = [frames[begin:end] for begin, end in pairwise(places)]
        order = _in_every(slices)
        if order is None:
            del frames[: places[1]]
            return None
        times = [frames[place][1] for place in places]
        steps = [b - a for a, b in pairwise(times)]
        self._steps += steps[-1:]
        if 2 * max(steps) > 3 * min(steps) and len(self._steps) < STEPS_MAX:
            del frames[: places[1]]
            return None
        period = median(steps) if len(self._steps) < STEPS_MAX else fmean(self._steps)
        return Learned(_from_head(order, frames), int(period))


def _in_every(slices: Sequence[Sequence[tuple[int, int]]]) -> tuple[int, ...] | None:
    """Return the kinds that occur once in every slice, if their order is the same in all; else None."""
    common = set.intersection(*({kind for kind, _ in one} for one in slices))
    orders = {tuple(kind for kind, _ in one if kind in common) for one in slices}
    order = orders.pop()
    return order if not orders and len(order) == len(common) else None


def _from_head(order: tuple[int, ...], frames: Sequence[tuple[int, int]]) -> tuple[int, ...]:
    """The same cycle of kinds, begun after the longest pause; the lowest kind where all pauses are alike."""
    heard = [(kind, t_ns) for kind, t_ns in frames if kind in order]
    pauses: dict[int, list[int]] = {kind: [0] for kind in order}
    for (_, before_ns), (kind, t_ns) in pairwise(heard):
        pauses[kind].append(t_ns - before_ns)
    head = max(order, key=lambda kind: (median(pauses[kind][1:] or [0]), -kind))
    begin = order.index(head)
    return order[begin:] + order[:begin]


SILENCE_NS: Final = NS_PER_S
"""A longer gap is silence of the device, not loss."""
PERIOD_LEAST_NS: Final = NS_PER_MS
"""Shortest period: no device sends faster than 1 kHz."""
STEADY_BURSTS: Final = 2
"""Number of bursts at the usual distance after which no delayed burst is expected any more."""
ODD_BURSTS: Final = 8
"""Number of distances in a row, all shorter or all longer and within 1/4 of each other, that are another rate."""
SMOOTHING: Final = 16
"""Weight of what is known of the period against one more distance."""


class Cadence:
    """Period and missing bursts of one device. Synchronization: one thread."""

    __slots__ = ("_late_ns", "_newest_ns", "_odd_ns", "_silent", "_steady", "period_ns")

    def __init__(self, period_ns: int, newest_ns: int) -> None:
        """`newest_ns`: arrival of the newest burst."""
        self.period_ns = max(period_ns, PERIOD_LEAST_NS)
        """Between two bursts."""
        self._newest_ns = newest_ns
        self._late_ns = 0
        """Lateness that may still be made up for."""
        self._silent = False
        self._steady = 0
        self._odd_ns: list[int] = []

    @property
    def is_late(self) -> bool:
        """Whether a gap is not settled yet."""
        return self._late_ns > 0

    def begin(self, t_ns: int) -> tuple[int, int]:
        """A burst begins to arrive: returns how many bursts are now known to be missing in a gap before it (`is_late`
        since), and how many of those are loss."""
        step_ns, period_ns = t_ns - self._newest_ns, self.period_ns
        self._newest_ns = t_ns
        if 4 * step_ns > 5 * period_ns:
            self._long(step_ns)
            return 0, 0
        if 4 * step_ns < 3 * period_ns:
            self._short(step_ns)
            return 0, 0
        self.period_ns += (step_ns - period_ns) // SMOOTHING
        self._odd_ns.clear()
        if not self._late_ns:
            return 0, 0
        self._late_ns += min(0, step_ns - period_ns)
        self._steady += 1
        return self._settle() if self._steady >= STEADY_BURSTS else (0, 0)

    def _long(self, step_ns: int) -> None:
        self._late_ns += step_ns - self.period_ns
        self._silent |= step_ns > SILENCE_NS
        self._steady = 0
        self._add_odd(step_ns, 1)

    def _short(self, step_ns: int) -> None:
        made_up_ns = self.period_ns - step_ns
        self._steady = 0
        if self._late_ns:
            self._late_ns = max(0, self._late_ns - made_up_ns)
            self._odd_ns.clear()
        else:
            self._add_odd(step_ns, -1)

    def _add_odd(self, step_ns: int, side: int) -> None:
        """Adopt another rate; what was late by the old one was not."""
        odd = self._odd_ns
        if odd and ((odd[0] - self.period_ns) * side < 0 or 4 * abs(step_ns - odd[0]) > odd[0]):
            odd.clear()
        odd.append(step_ns)
        if len(odd) >= ODD_BURSTS:
            self.period_ns = max(int(median(odd)), PERIOD_LEAST_NS)
            self._late_ns, self._silent = 0, False
            odd.clear()

    def _settle(self) -> tuple[int, int]:
        missed = (2 * self._late_ns + self.period_ns) // (2 * self.period_ns)
        lost = 0 if self._silent else missed
        self._late_ns, self._silent, self._steady = 0, False, 0
        return missed, lost


AWAY_PERIODS: Final = 10
"""Of a kind, until it is taken as switched off."""
DROPPED_MAX: Final = 16
"""Samples dropped in a row, until everything is learned again."""
STRAYS_MAX: Final = 40
STRAY_WEIGHT: Final = 2
"""Frames without a place in a burst, twice their number less that of whole samples, until everything is learned again:
a device that sends more of a kind than its beginning kind leaves one or more of them per sample."""
AGREE_FIRST, AGREE_OTHER, AGREE_MULTIPLE = 2, 3, 4
"""Equal distances in a row that make an m: the first one; another one; one that losses could have made."""
AGREE_FAST: Final = 6
"""The same for a kind that is to be in every burst: bursts that are lost whole shorten the distance of a slower one,
and once it counted as fast, its burst would be taken for the period."""


class _Kind:
    """One kind of frame."""

    __slots__ = ("every", "number", "run", "seen", "step")

    def __init__(self, number: int, every: int, seen: int) -> None:
        self.number = number
        self.every = every
        """Bursts from one of this kind to the next; 0 while unknown."""
        self.seen = seen
        """Burst of the newest one."""
        self.step = 0
        """Bursts between the newest two."""
        self.run = 0
        """Steps of this length in a row."""

    def is_due(self, since: int) -> bool:
        """Whether it belongs into the burst `since` bursts after its last one."""
        return self.every > 0 and since > 0 and since % self.every == 0

    def learn(self, since: int) -> bool:
        """Learn from the step to one more frame; return whether that changed `every`."""
        self.run = self.run + 1 if since == self.step else 1
        self.step = since
        every = self.every
        if since == 1:
            needed = AGREE_FAST
        else:
            needed = AGREE_FIRST if not every else AGREE_OTHER if since % every else AGREE_MULTIPLE
        if since < 1 or since == every or self.run < needed:
            return False
        self.every = since
        return True


class Assembly:
    """Whole samples of one device, as sets of frames. The ledger's frames are counted here but for `frames_good`, its
    bytes are the codec's. Synchronization: one thread."""

    def __init__(self, ledger: Ledger, kinds: Container[int] | None = None) -> None:
        """`kinds`: only these are used, others are ignored; None for all."""
        self._ledger = ledger
        self._allowed = kinds
        self._held: dict[int, bytes] = {}
        """Data of the sample that is not whole yet, by kind, in the order they came."""
        self._newest = 0
        """Kind of the newest frame that had a place, held or already in a sample."""
        self._kinds: dict[int, _Kind] = {}
        self._order: list[int] = []
        self._place: dict[int, int] = {}
        self._fast: frozenset[int] = frozenset()
        """Kinds in every burst; the first of them begins it."""
        self._slow: list[_Kind] = []
        self._head = 0
        self._due: frozenset[int] = frozenset()
        """Kinds that make the present burst whole."""
        self._burst = 0
        """Number of the present burst, or of the newest one."""
        self._gap = 0
        """Number of the first burst after the gap that is not settled."""
        self._first_ns = self._newest_ns = 0
        self._is_whole = False
        """Whether the newest burst became a sample, and nothing came since that has no place."""
        self._dropped = self._strays = 0
        self._cadence = Cadence(0, 0)
        self._learning: BurstLearning | None = BurstLearning()

    @property
    def period_ns(self) -> int:
        """Between two samples; 0 while unknown."""
        return self._cadence.period_ns if self._learning is None else 0

    def add_frame(self, kind: int, data: bytes, t_rx_ns: int) -> Sequence[tuple[int, bytes]] | None:
        """Add one frame; return the frames of a sample, in the order they came, when it makes one whole."""
        known = self._kinds.get(kind)
        if self._learning is not None or known is None:
            self._ledger.frames_ignored += 1
            self._meet(kind, t_rx_ns)
            return None
        held, done = self._held, None
        if held:
            if kind == self._newest and held[kind] == data:
                self._ledger.frames_ignored += 1
                return None
            if self._ends(known, t_rx_ns):
                done = self._end()
        if not self._fits(known, t_rx_ns):
            self._ledger.frames_ignored += 1
            return done
        held[kind] = data
        self._newest = kind
        self._newest_ns = t_rx_ns
        self._ledger.frames_pending += 1
        return self._close() if self._due <= held.keys() else done

    def reset(self) -> None:
        """Drop the incomplete sample, since frames are missing here; those until the next burst begins are ignored."""
        if self._held:
            self._drop_sample()
        self._is_whole = False

    def _fits(self, kind: _Kind, t_rx_ns: int) -> bool:
        """Whether a frame has a place in the present burst, or begins the next one, which it then does."""
        if self._kinds.get(kind.number) is not kind:  # what ended before it made it unknown
            return False
        return self._fits_fast(kind, t_rx_ns) if kind.every == 1 else self._fits_slow(kind, t_rx_ns)

    # --- frames that belong into every burst ---------------------------------------------------------------------

    def _fits_fast(self, kind: _Kind, t_rx_ns: int) -> bool:
        if not self._held:
            if kind.number != self._head:
                self._stray()
                return False
            self._begin(t_rx_ns)
        since = self._burst - kind.seen
        kind.seen = self._burst
        if since == 1:
            kind.run = 0
        elif kind.learn(since):
            self._plan()
        return self._learning is None

    def _begin(self, t_rx_ns: int) -> None:
        """Begin a burst."""
        was_late = self._cadence.is_late
        missed, lost = self._cadence.begin(t_rx_ns)
        if missed:
            self._ledger.lost_gap_device += lost
            self._ledger.lost_unknown += not lost
            for kind in self._kinds.values():
                if kind.seen < self._gap:
                    kind.seen -= missed
        self._burst += 1
        if not was_late:
            self._gap = self._burst
        self._first_ns = t_rx_ns
        self._is_whole = False
        self._due = self._fast
        if self._slow:
            due = [kind.number for kind in self._slow if kind.is_due(self._burst - kind.seen)]
            self._due = self._fast.union(due) if due else self._fast

    def _close(self) -> list[tuple[int, bytes]]:
        """Finish the sample: it is whole."""
        held, ledger = self._held, self._ledger
        frames = list(held.items())
        held.clear()
        ledger.frames_pending -= len(frames)
        ledger.frames_in_samples += len(frames)
        self._is_whole = True
        self._dropped = 0
        if self._strays:
            self._strays -= 1
        return frames

    # --- slower kinds --------------------------------------------------------------------------------------------

    def _fits_slow(self, kind: _Kind, t_rx_ns: int) -> bool:
        """Whether a frame of a slower kind has a place in the present burst, or begins the next one."""
        begins = not self._held and self._place[kind.number] < self._place[self._head]
        if not self._held and ((not begins and not self._is_whole) or kind.number == self._newest):
            return False  # of an unknown burst, whose beginning is lost; or a repetition
        since = self._burst + begins - kind.seen
        is_due = kind.is_due(since)
        in_order = not self._held or self._place[kind.number] > self._place[self._newest]
        fits = is_due and in_order and (begins or bool(self._held))
        if begins and fits:
            self._begin(t_rx_ns)
            since = self._burst - kind.seen
        if not fits:
            self._put(kind.number, t_rx_ns)
            begins = not self._held and self._place[kind.number] < self._place[self._head]
            since = self._burst + begins - kind.seen
        kind.seen += since
        if kind.learn(since):
            self._plan()
        return fits and self._learning is None

    def _meet(self, kind: int, t_rx_ns: int) -> None:
        """Learn from a frame of an unknown kind, or from any while learning."""
        if self._allowed is not None and kind not in self._allowed:
            return
        if self._learning is not None:
            learned = self._learning.add_frame(kind, t_rx_ns)
            if learned is not None:
                self._learn(learned, t_rx_ns)
        elif self._held or self._is_whole:
            self._put(kind, t_rx_ns)
            begins = not self._held and self._place[kind] < self._place[self._head]
            self._kinds[kind] = _Kind(kind, 0, self._burst + begins)
            self._plan()

    def _put(self, kind: int, t_rx_ns: int) -> None:
        """Place a kind by its newest frame: behind the newest frame of the burst, or before the next one."""
        order = [other for other in self._order if other != kind]
        follows = bool(self._held) or 2 * (t_rx_ns - self._newest_ns) < self._cadence.period_ns
        order.insert(order.index(self._newest) + 1 if follows else 0, kind)
        self._order = order
        self._place = {other: place for place, other in enumerate(order)}

    # --- frames that do not fit ----------------------------------------------------------------------------------

    def _ends(self, kind: _Kind, t_rx_ns: int) -> bool:
        """Whether such a frame shows that the rest of what is held does not come."""
        # in quarters of a period: the beginning of a burst is not to come long after a slower kind that stands before
        limit = 3 if self._head in self._held else 2
        if 4 * (t_rx_ns - self._first_ns) > limit * self._cadence.period_ns or kind.number in self._held:
            return True
        return kind.every == 1 and self._place[kind.number] < self._place[self._newest]

    def _end(self) -> list[tuple[int, bytes]] | None:
        """Stop waiting for the rest of the sample."""
        frames = self._close() if len(self._fast) > 1 and self._fast <= self._held.keys() else None
        if frames is None:
            self._drop_sample()
        self._is_whole = False
        away = [kind for kind in self._kinds.values() if self._is_away(kind)]
        for kind in away:
            del self._kinds[kind.number]
        if away:
            self._plan()
        return frames

    def _drop_sample(self) -> None:
        """Drop the incomplete sample."""
        self._drop()
        self._ledger.lost_gap_device += 1
        self._is_whole = False
        self._dropped += 1
        if self._dropped >= DROPPED_MAX:
            self._relearn()

    def _drop(self) -> None:
        held, ledger = self._held, self._ledger
        ledger.frames_ignored += len(held)
        ledger.frames_pending -= len(held)
        held.clear()

    def _is_away(self, kind: _Kind) -> bool:
        return kind.number in self._due and self._burst - kind.seen >= AWAY_PERIODS * kind.every

    def _stray(self) -> None:
        self._strays += STRAY_WEIGHT
        if self._strays >= STRAYS_MAX:
            self._relearn()

    # --- learning ------------------------------------------------------------------------------------------------

    def _relearn(self) -> None:
        self._drop()
        self._kinds = {}
        self._is_whole = False
        self._dropped = self._strays = 0
        self._learning = BurstLearning()

    def _learn(self, learned: Learned, t_rx_ns: int) -> None:
        """Adopt what was learned; the next burst is the first one that counts."""
        self._learning = None
        self._cadence = Cadence(learned.period_ns, t_rx_ns)
        self._kinds = {number: _Kind(number, 1, self._burst) for number in learned.order}
        self._order = list(learned.order)
        self._place = {number: place for place, number in enumerate(self._order)}
        self._plan()

    def _plan(self) -> None:
        """Plan anew after kinds came, went, or changed their rates."""
        kinds = self._kinds
        fast = [number for number in self._order if number in kinds and kinds[number].every == 1]
        if not fast:
            self._relearn()
            return
        self._head = fast[0]
        self._fast = frozenset(fast)
        self._slow = [kind for kind in kinds.values() if kind.every != 1]
