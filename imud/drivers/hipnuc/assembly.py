"""Assembly of samples from frames without counter and time (CANopen TPDOs, J1939 and NMEA 2000 PGNs).

A device sends the frames of one instant back to back, always in the same order: a burst. Each kind of frame (a TPDO, a
PGN) has its own rate. The fast kinds are in every burst, a slow kind is in every m-th burst. **A sample never contains
frames of two periods.** The rules:

- imud learns the kinds, their order, the period and every m from the received frames. It ignores all frames until then:
  four periods of the fast kinds and two periods of each slow kind. It ignores a new fast kind for six bursts.
- The first frame of a burst starts a sample. The sample is complete when it contains all due kinds: the fast kinds and
  each slow kind whose last frame is m bursts old (or 2 m, 3 m … after a loss).
- A sample ends early at a kind that it already contains (except an exact repetition), at a fast kind before the newest
  frame in the order, at a frame more than 3/4 of a period after the first frame, and at lost frames (`reset`). imud
  then counts a lost sample. If only slow kinds are missing, imud makes the sample without them. It does not do so after
  `reset`, or with one fast kind, because then the next sample is already complete.
- Without a started sample, imud ignores all frames except the first kind of a burst. It ignores a slow kind that is not
  due and learns its m again.
- imud counts bursts without any frame by time (`Cadence`): a gap up to 1 s is loss. If a host or a sender stalls and
  the bursts then arrive late and back to back, no sample is lost.
- A kind that is missing for ten of its periods counts as switched off. A new kind joins. If too many frames do not fit,
  imud learns everything again.

A kind with a period that is not a multiple of the fast period is never part of a sample. If the end of one burst and
the start of the next burst are lost, only the arrival times show the loss. They must be exact within 1/4 of a period,
as the time stamps of the kernel are.
"""

from collections.abc import Container, Sequence
from itertools import pairwise
from statistics import fmean, median
from typing import Final, NamedTuple

from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S

PERIODS: Final = 4  # number of equal periods before imud uses a period
STEPS_MAX: Final = 64  # number of periods for a mean if the arrival times vary too much for PERIODS equal periods
FRAMES_MAX: Final = 128  # maximum number of frames during learning: enough for four periods of any device


class Learned(NamedTuple):
    """Properties of the bursts of a device."""

    order: tuple[int, ...]  # kinds in every burst, in their order
    period_ns: int  # time between two bursts, ns


class BurstLearning:
    """Learning of the bursts from frames in the order of their arrival. Synchronization: one thread."""

    def __init__(self) -> None:
        self._frames: list[tuple[int, int]] = []
        self._steps: list[int] = []

    def add_frame(self, kind: int, t_ns: int) -> Learned | None:
        """Add the kind and the arrival time of one frame. Return the properties of the bursts once they are known."""
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
    """Return the kinds that occur once in every slice, if their order is the same in all slices; otherwise None."""
    common = set.intersection(*({kind for kind, _ in one} for one in slices))
    orders = {tuple(kind for kind, _ in one if kind in common) for one in slices}
    order = orders.pop()
    return order if not orders and len(order) == len(common) else None


def _from_head(order: tuple[int, ...], frames: Sequence[tuple[int, int]]) -> tuple[int, ...]:
    """Return the cycle of kinds, started after the longest pause; with the lowest kind if all pauses are equal."""
    heard = [(kind, t_ns) for kind, t_ns in frames if kind in order]
    pauses: dict[int, list[int]] = {kind: [0] for kind in order}
    for (_, before_ns), (kind, t_ns) in pairwise(heard):
        pauses[kind].append(t_ns - before_ns)
    head = max(order, key=lambda kind: (median(pauses[kind][1:] or [0]), -kind))
    begin = order.index(head)
    return order[begin:] + order[:begin]


SILENCE_NS: Final = NS_PER_S  # Maximum gap that counts as loss, ns. After a longer gap the device was silent.
PERIOD_LEAST_NS: Final = NS_PER_MS  # minimum period, ns: no device sends faster than 1 kHz
STEADY_BURSTS: Final = 2  # number of bursts at the normal distance after which imud expects no delayed burst
# Number of consecutive distances, all shorter or all longer and equal within 1/4, that mean a new rate
ODD_BURSTS: Final = 8
SMOOTHING: Final = 16  # weight of the known period against one new distance


class Cadence:
    """Period and missing bursts of one device. Synchronization: one thread."""

    __slots__ = ("_late_ns", "_newest_ns", "_odd_ns", "_silent", "_steady", "period_ns")

    def __init__(self, period_ns: int, newest_ns: int) -> None:
        """`newest_ns`: arrival time of the newest burst."""
        self.period_ns = max(period_ns, PERIOD_LEAST_NS)  # time between two bursts, ns
        self._newest_ns = newest_ns
        self._late_ns = 0  # delay that short distances may still make up for, ns
        self._silent = False
        self._steady = 0
        self._odd_ns: list[int] = []

    @property
    def is_late(self) -> bool:
        """Whether the number of missing bursts in the newest gap is still unknown."""
        return self._late_ns > 0

    def begin(self, t_ns: int) -> tuple[int, int]:
        """Start a burst. Return the number of bursts that are now known to be missing in the last gap, and how many of
        them are lost.
        """
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
        """Use a new rate after ODD_BURSTS similar distances. A delay relative to the old rate is then not a delay."""
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


AWAY_PERIODS: Final = 10  # number of periods without a kind after which the kind counts as switched off
DROPPED_MAX: Final = 16  # number of consecutive dropped samples after which imud learns everything again
STRAYS_MAX: Final = 40
# Limit and weight of frames without a place in a burst; each complete sample subtracts 1. Above the limit, imud learns
# everything again: a device that sends a kind more often than the first kind of a burst causes such frames.
STRAY_WEIGHT: Final = 2
# Number of equal consecutive distances for the first m; for another m; for a multiple of the known m (losses can cause
# a multiple).
AGREE_FIRST, AGREE_OTHER, AGREE_MULTIPLE = 2, 3, 4
# Number of equal consecutive distances for a kind in every burst. Lost bursts shorten the distance of a slow kind; as a
# fast kind it would change the period.
AGREE_FAST: Final = 6


class _Kind:
    """State of one kind of frame."""

    __slots__ = ("every", "number", "run", "seen", "step")

    def __init__(self, number: int, every: int, seen: int) -> None:
        self.number = number
        self.every = every  # bursts between two frames of this kind; 0 if unknown
        self.seen = seen  # burst of the newest frame
        self.step = 0  # bursts between the two newest frames
        self.run = 0  # number of consecutive steps of this length

    def is_due(self, since: int) -> bool:
        """Return whether the kind is due `since` bursts after its last burst."""
        return self.every > 0 and since > 0 and since % self.every == 0

    def learn(self, since: int) -> bool:
        """Learn from the step to one more frame. Return whether `every` changed."""
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
    """Assembly of the samples of one device. It counts all frames of the ledger except `frames_good`; the codec counts
    bytes. Synchronization: one thread.
    """

    def __init__(self, ledger: Ledger, kinds: Container[int] | None = None) -> None:
        """`kinds`: kinds that the assembly uses; None: all."""
        self._ledger = ledger
        self._allowed = kinds
        self._held: dict[int, bytes] = {}  # data of the incomplete sample by kind, in the order of arrival
        self._newest = 0  # kind of the newest frame with a place, in the incomplete sample or in a complete sample
        self._kinds: dict[int, _Kind] = {}
        self._order: list[int] = []
        self._place: dict[int, int] = {}
        self._fast: frozenset[int] = frozenset()  # kinds in every burst; the first kind starts the burst
        self._slow: list[_Kind] = []
        self._head = 0
        self._due: frozenset[int] = frozenset()  # kinds that complete the present burst
        self._burst = 0  # number of the present or newest burst
        self._gap = 0  # number of the first burst after the gap of unknown size
        self._first_ns = self._newest_ns = 0
        self._is_whole = False  # whether the newest burst became a sample and no frame without a place followed
        self._dropped = self._strays = 0
        self._cadence = Cadence(0, 0)
        self._learning: BurstLearning | None = BurstLearning()

    @property
    def period_ns(self) -> int:
        """Time between two samples, ns; 0 if unknown."""
        return self._cadence.period_ns if self._learning is None else 0

    def add_frame(self, kind: int, data: bytes, t_rx_ns: int) -> Sequence[tuple[int, bytes]] | None:
        """Add one frame. If it completes a sample, return the frames of the sample in the order of arrival."""
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
        """Drop the incomplete sample after lost frames. Ignore all frames until the next burst starts."""
        if self._held:
            self._drop_sample()
        self._is_whole = False

    def _fits(self, kind: _Kind, t_rx_ns: int) -> bool:
        """Return whether a frame has a place in the present burst or the next burst. It may start the next burst."""
        if self._kinds.get(kind.number) is not kind:  # the end of the previous sample removed this kind
            return False
        return self._fits_fast(kind, t_rx_ns) if kind.every == 1 else self._fits_slow(kind, t_rx_ns)

    # --- frames of every burst --------------------------------------------------------------------------------------

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
        """Return the frames of the complete sample."""
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

    # --- slow kinds -------------------------------------------------------------------------------------------------

    def _fits_slow(self, kind: _Kind, t_rx_ns: int) -> bool:
        """Return whether a frame of a slow kind has a place in the present burst or starts the next burst."""
        begins = not self._held and self._place[kind.number] < self._place[self._head]
        if not self._held and ((not begins and not self._is_whole) or kind.number == self._newest):
            return False  # the start of the burst is lost, or a repetition
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
        """Learn from a frame of an unknown kind, or from any frame during learning."""
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
        """Place a kind by its newest frame: after the newest frame of the burst, or before the next burst."""
        order = [other for other in self._order if other != kind]
        follows = bool(self._held) or 2 * (t_rx_ns - self._newest_ns) < self._cadence.period_ns
        order.insert(order.index(self._newest) + 1 if follows else 0, kind)
        self._order = order
        self._place = {other: place for place, other in enumerate(order)}

    # --- frames without a place -------------------------------------------------------------------------------------

    def _ends(self, kind: _Kind, t_rx_ns: int) -> bool:
        """Return whether a frame shows that the rest of the incomplete sample is lost."""
        # in quarters of a period; 2 if a slow kind started the burst: the first fast kind must follow soon
        limit = 3 if self._head in self._held else 2
        if 4 * (t_rx_ns - self._first_ns) > limit * self._cadence.period_ns or kind.number in self._held:
            return True
        return kind.every == 1 and self._place[kind.number] < self._place[self._newest]

    def _end(self) -> list[tuple[int, bytes]] | None:
        """End the incomplete sample: return it without its slow kinds, or drop it."""
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
        """Use the learned bursts. The next burst is the first burst that counts."""
        self._learning = None
        self._cadence = Cadence(learned.period_ns, t_rx_ns)
        self._kinds = {number: _Kind(number, 1, self._burst) for number in learned.order}
        self._order = list(learned.order)
        self._place = {number: place for place, number in enumerate(self._order)}
        self._plan()

    def _plan(self) -> None:
        """Update the plan after a change of kinds or rates."""
        kinds = self._kinds
        fast = [number for number in self._order if number in kinds and kinds[number].every == 1]
        if not fast:
            self._relearn()
            return
        self._head = fast[0]
        self._fast = frozenset(fast)
        self._slow = [kind for kind in kinds.values() if kind.every != 1]
