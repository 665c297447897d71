"""Assembly of samples from frames without counter and time (CANopen TPDOs, J1939 and NMEA 2000 PGNs).

A device sends several kinds of frames (a TPDO, a PGN), each kind with its own period. Some devices send the frames of
one instant back to back (a burst), some devices send each kind by its own timer. The rules:

- The fastest kind is the *anchor*; of several equally fast kinds, the anchor is the first kind after the longest pause.
  Each frame of the anchor makes one sample, with the arrival of this frame as its time.
- A sample contains every frame that arrived since the previous sample. **Each frame is part of exactly one sample.** A
  sample lacks the kinds that did not arrive.
- A kind is *near* if it arrives within a quarter of a period of the anchor. The anchor waits for the near kinds that
  are due. A near frame that arrives more than half a period from the anchor is from another burst. It becomes a sample
  of its own, without the anchor. A kind that is not near waits for the next anchor.
- A kind that arrives again ends the sample. imud ignores a copy: the same frame immediately after the frame, or the
  copy of a gateway (`frame_copies.py`).
- If the SIDs of two kinds agree, the SID decides in place of the time.
- Until the anchor is known (LEARNING_STEPS periods), a sample ends when a kind arrives again, before the longest pause.
- imud counts a lost sample only if the SID or the period of the anchor proves the loss (`SidSeries`, `Cadence`).
- imud counts a lost frame of any kind only if the SID or the period of this kind proves the loss (`KindLosses`).
- If many samples lack the anchor, imud selects another anchor.

`same_address.py` detects several devices with the same address.
"""

from collections import deque
from collections.abc import Container, Sequence
from itertools import pairwise
from statistics import median
from typing import Final, NamedTuple

import msgspec

from imud.drivers.hipnuc.frame_copies import COPY_NS, REPETITION_NS, FrameCopies
from imud.drivers.hipnuc.same_address import SameAddress
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S

LEARNING_STEPS: Final = 8  # number of periods of the fastest kind before imud selects the anchor
EQUAL_RATES: Final = 1.1  # maximum ratio of the mean periods of two equally fast kinds
# Ratios of a distance across lost frames to the median: minimum, and maximum during learning
GAP_LEAST, GAP_MOST = 1.5, 4.5


class Learned(NamedTuple):
    """Properties of the frames of a device."""

    anchor: int  # kind whose frames make the samples
    period_ns: int  # time between two frames of the anchor, ns


def learned_from(frames: Sequence[tuple[int, int]]) -> Learned | None:
    """Return the anchor of frames (kind, arrival time in ns). Return None before LEARNING_STEPS periods of a kind."""
    times: dict[int, list[int]] = {}
    for kind, t_ns in frames:
        times.setdefault(kind, []).append(t_ns)
    if max(map(len, times.values())) <= LEARNING_STEPS:
        return None
    steps = {kind: (of[-1] - of[0]) / (len(of) - 1) for kind, of in times.items() if 2 * len(of) > LEARNING_STEPS}
    limit_ns = EQUAL_RATES * min(steps.values())
    fast = [kind for kind, step_ns in steps.items() if step_ns <= limit_ns]
    pauses: dict[int, list[int]] = {kind: [0] for kind in fast}
    for (_, before_ns), (kind, t_ns) in pairwise(frame for frame in frames if frame[0] in pauses):
        pauses[kind].append(t_ns - before_ns)
    anchor = max(fast, key=lambda kind: (median(pauses[kind][1:] or [0]), -kind))
    distances = [b - a for a, b in pairwise(times[anchor])]
    middle_ns = median(distances)
    # few lost frames change the mean; distances that alternate change the median
    gaps = [step_ns for step_ns in distances if step_ns > GAP_LEAST * middle_ns]
    has_gap = 0 < len(gaps) <= len(distances) // 4 and max(gaps) < GAP_MOST * middle_ns
    return Learned(anchor, int(middle_ns if has_gap else steps[anchor]))


SILENCE_NS: Final = NS_PER_S  # Maximum gap that counts as loss, ns. After a longer gap the device was silent.
SILENCE_PERIODS: Final = 4  # minimum length of a silence, in periods
PERIOD_LEAST_NS: Final = NS_PER_MS  # minimum period, ns: no device sends faster than 1 kHz
STEADY: Final = 1 / 8  # maximum spread of the lateness of a steady device, in periods
STEADY_BURSTS: Final = 3  # number of equally late bursts that prove a loss by a steady device
UNSTEADY_BURSTS: Final = 16  # the same number for an unsteady device
NEAR_SHARE: Final = 0.25  # maximum difference of two times that count as equal, in periods
# Number of consecutive distances, all shorter or all longer and equal within 1/4, that mean a new rate
ODD_BURSTS: Final = 8
PHASE_SHARE, PERIOD_SHARE = 8, 128  # divisors of the lateness of one burst that correct the phase and the period


class Cadence:
    """Period of the bursts of one device. The period proves lost bursts. Synchronization: one thread."""

    __slots__ = (
        "_due_ns", "_is_silent", "_late_ns", "_least_ns", "_newest_ns", "_odd_ns", "_room", "_usual_ns", "period_ns",
    )  # fmt: skip

    def __init__(self, period_ns: int, newest_ns: int) -> None:
        """`newest_ns`: arrival time of the newest burst."""
        self.period_ns = max(period_ns, PERIOD_LEAST_NS)  # time between two bursts, ns
        self._newest_ns = newest_ns
        self._due_ns = newest_ns  # expected arrival of the newest burst
        self._usual_ns: deque[int] = deque(maxlen=UNSTEADY_BURSTS)  # lateness of the newest punctual bursts
        self._least_ns = 0  # minimum of `_usual_ns`; 0 if it is empty
        self._late_ns: list[int] = []  # lateness of the bursts since a gap, relative to the bursts before the gap
        self._room = 0  # number of bursts that fit into the long distances since the gap
        self._is_silent = False
        self._odd_ns: list[int] = []

    def steps_to(self, t_ns: int) -> int:
        """Return the number of periods from the newest burst to a time."""
        return (2 * (t_ns - self._newest_ns) + self.period_ns) // (2 * self.period_ns)

    def begin(self, t_ns: int) -> tuple[int, bool]:
        """Start a burst. Return the number of lost bursts that are now proven, and whether their number is unknown."""
        step_ns, period_ns = t_ns - self._newest_ns, self.period_ns
        late_ns = t_ns - self._due_ns - period_ns
        self._newest_ns = t_ns
        is_punctual = 3 * period_ns <= 4 * step_ns <= 5 * period_ns
        if (self._odd_ns or not is_punctual) and self._add_odd(step_ns, late_ns):
            self.rebase(t_ns)
            return 0, False
        if 2 * late_ns < -period_ns:  # another burst of the same period
            return 0, False
        self._due_ns += period_ns
        usual_ns, least_ns = self._usual_ns, self._least_ns
        if 2 * (late_ns - least_ns) < period_ns:
            if self._room or self._late_ns:
                self._close_gap()
            oldest_ns = usual_ns[0] if usual_ns else least_ns
            usual_ns.append(late_ns)
            self._least_ns = late_ns if late_ns <= least_ns else min(usual_ns) if oldest_ns == least_ns else least_ns
            self._due_ns += late_ns // PHASE_SHARE
            self.period_ns = max(period_ns + late_ns // PERIOD_SHARE, PERIOD_LEAST_NS)
            return 0, False
        self._is_silent |= step_ns > max(SILENCE_NS, SILENCE_PERIODS * period_ns)
        self._late_ns.append(late_ns)
        self._room += max(int(step_ns / period_ns + NEAR_SHARE) - 1, 0)
        return self._judge(least_ns)

    def rebase(self, t_ns: int) -> None:
        """Expect the next burst one period after this burst, which does not prove a loss."""
        self._newest_ns = self._due_ns = t_ns
        self._close_gap()

    def _close_gap(self) -> None:
        self._late_ns.clear()
        self._room = 0
        self._is_silent = False

    def _judge(self, least_ns: int) -> tuple[int, bool]:
        """Return the losses if enough bursts are equally late: a delay would decrease."""
        period_ns, spread_ns = self.period_ns, max(self._usual_ns, default=0) - least_ns
        is_steady = spread_ns < STEADY * period_ns
        late_ns = self._late_ns[-(STEADY_BURSTS if is_steady else UNSTEADY_BURSTS) :]
        limit_ns = max(NEAR_SHARE * period_ns, 1.5 * spread_ns)
        if len(late_ns) < (STEADY_BURSTS if is_steady else UNSTEADY_BURSTS) or max(late_ns) - min(late_ns) > limit_ns:
            del self._late_ns[:-UNSTEADY_BURSTS]
            return 0, False
        shift_ns, was_silent, room = min(late_ns) - least_ns, self._is_silent, self._room
        missed = (2 * shift_ns + period_ns) // (2 * period_ns)
        self._due_ns += shift_ns
        self._close_gap()
        if was_silent:
            return 0, True
        # a shift by a part of a period, or by several short delays, is another phase and not a loss
        is_loss = abs(shift_ns - missed * period_ns) <= NEAR_SHARE * period_ns and missed <= room
        return (missed if is_loss else 0), False

    def _add_odd(self, step_ns: int, late_ns: int) -> bool:
        """Use a new rate after ODD_BURSTS similar distances. Return whether the rate changed."""
        odd, period_ns = self._odd_ns, self.period_ns
        if 3 * period_ns <= 4 * step_ns <= 5 * period_ns or (step_ns < period_ns and 4 * late_ns > -period_ns):
            odd.clear()  # a short distance can make up for a delay
            return False
        if odd and ((odd[0] > period_ns) is not (step_ns > period_ns) or 4 * abs(step_ns - odd[0]) > odd[0]):
            odd.clear()
        odd.append(step_ns)
        if len(odd) < ODD_BURSTS:
            return False
        self.period_ns = max(int(median(odd)), PERIOD_LEAST_NS)
        self._usual_ns.clear()
        self._least_ns = 0
        odd.clear()
        return True


SID_RUN: Final = 8  # number of equal steps of the SID after which imud knows the step
SID_MODULUS_LEAST, SID_MODULUS_MOST = 250, 256  # Range of the modulus of SIDs. The standard has 253.

LATE_BURSTS: Final = 4  # number of bursts that can arrive together


class SidSeries:
    """Series of the SIDs of one kind. Synchronization: one thread."""

    __slots__ = ("_modulus", "_newest", "_run", "_step")

    def __init__(self) -> None:
        self._newest: int | None = None
        self._modulus = 0  # 0: unknown
        self._step = 0  # newest difference of two SIDs
        self._run = 0  # number of consecutive differences of this size

    @property
    def is_known(self) -> bool:
        """Whether the SIDs have risen by equal steps."""
        return self._run >= SID_RUN

    def add(self, sid: int | None, *, is_next: bool) -> int | None:
        """Add a SID. Return the number of missing SIDs before it; None if the SIDs do not show this number.

        `is_next`: the period shows no loss before the SID.
        """
        newest, self._newest = self._newest, sid
        if sid is None or newest is None:
            return None
        rise = sid - newest
        if rise < 0 and self._modulus:
            rise += self._modulus
        elif rise < 0 and self.is_known:
            modulus = newest + self._step - sid
            if is_next and SID_MODULUS_LEAST <= modulus <= SID_MODULUS_MOST:
                self._modulus = modulus
            return None
        if self.is_known and rise > 0 and rise % self._step == 0:
            return rise // self._step - 1
        self._run = self._run + 1 if rise == self._step and rise > 0 else 0
        self._step = rise
        return None


def fits_time(missing: int, steps: int, *, is_instant: bool) -> bool:
    """Return whether this number of SIDs can be missing in `steps` periods.

    `is_instant`: the SID numbers the bursts, not the frames.
    """
    if not missing:
        return True
    # SIDs of a counter that other messages share rise without a gap in time, as the SIDs of late bursts
    return missing <= steps + LATE_BURSTS if is_instant else abs(steps - 1 - missing) <= missing // 8


class KindLosses:
    """Lost frames of one kind, according to its own SID and period. Synchronization: one thread."""

    __slots__ = ("_cadence", "_learning", "_sids")

    def __init__(self) -> None:
        self._learning: list[tuple[int, int]] = []
        self._cadence: Cadence | None = None  # None: the period is unknown
        self._sids = SidSeries()

    def add(self, t_ns: int, sid: int | None) -> int:
        """Add a frame. Return the number of lost frames that are now proven."""
        cadence = self._cadence
        if cadence is None:
            self._sids.add(sid, is_next=False)
            self._learning.append((0, t_ns))
            learned = learned_from(self._learning) if len(self._learning) > LEARNING_STEPS else None
            if learned is not None:
                self._cadence = Cadence(learned.period_ns, t_ns)
                self._learning.clear()
            return 0
        if sid is None:
            return cadence.begin(t_ns)[0]
        steps = cadence.steps_to(t_ns)
        missing = self._sids.add(sid, is_next=steps == 1)
        # after a longer time, whole turns can be missing
        if missing is None or steps >= SID_MODULUS_LEAST // 2 or not fits_time(missing, steps, is_instant=False):
            return cadence.begin(t_ns)[0]
        if missing or steps != 1:
            cadence.rebase(t_ns)
        else:
            cadence.begin(t_ns)
        return missing


# Number of frames near the anchor, less FAR_WEIGHT for each other frame, from which a kind is near
NEAR_FRAMES: Final = 4
NEAR_FRAMES_MAX, FAR_WEIGHT = 8, 4
AWAY_PERIODS: Final = 10  # number of its periods without a kind after which imud no longer waits for the kind
SIDS_AGREE: Final = 4  # number of equal SIDs, less the different SIDs, after which the SID decides
SIDS_AGREE_MAX: Final = 8
# Limit of samples without the anchor, see STRAY_WEIGHT. Above the limit, imud selects an anchor.
STRAYS_MAX: Final = 40
STRAY_WEIGHT: Final = 2  # weight of a sample without the anchor; each sample with the anchor subtracts 1
# Number of equal consecutive distances for the first m; for another m; for a multiple of the known m (losses can cause
# a multiple).
AGREE_FIRST, AGREE_OTHER, AGREE_MULTIPLE = 2, 3, 4


class _Kind:
    """State of one kind of frame."""

    __slots__ = (
        "agree", "anchors", "behind_ns", "every", "leads", "losses", "missed", "near", "run", "seen_ns",
        "step", "step_ns",
    )  # fmt: skip

    def __init__(self) -> None:
        self.every = 0  # periods of the anchor between two frames of this kind; 0 if unknown
        self.seen_ns: int | None = None  # arrival of the newest frame
        self.anchors = 0  # number of anchors since the newest frame
        self.leads = False  # whether the frames arrive before the anchor
        self.step_ns = 0  # time between the two newest frames
        self.step = 0  # the same time in periods of the anchor
        self.run = 0  # number of consecutive steps of this length
        self.near = NEAR_FRAMES  # frames near the anchor, less the other frames
        self.agree = 0  # frames with the SID of the anchor, less the other frames
        self.missed = 0  # number of samples that waited for this kind in vain since its newest frame
        self.behind_ns = 0  # delay that short distances may still make up for, ns
        self.losses = KindLosses()

    @property
    def has_shared_sid(self) -> bool:
        return self.agree >= SIDS_AGREE

    def is_due(self, t_ns: int, period_ns: int, *, is_even: bool) -> bool:
        """Return whether an anchor at `t_ns` waits for the kind. `is_even`: one period after the previous anchor."""
        if self.near < NEAR_FRAMES or not self.every or self.seen_ns is None or self.missed >= AWAY_PERIODS:
            return False
        if self.every == 1:
            return True
        since = round((t_ns - self.seen_ns) / period_ns)
        # After a loss, use the time to count periods. If frames arrive together, use the number of anchors.
        by_count = not is_even and self.anchors - self.leads == self.every
        return by_count or (since > 0 and since % self.every == 0)

    def arrive(self, t_ns: int, anchor_ns: int, period_ns: int) -> None:
        """Add the arrival of a frame. `anchor_ns`: arrival of the newest anchor."""
        offset_ns = (t_ns - anchor_ns) % period_ns
        if 4 * offset_ns <= period_ns or 4 * offset_ns >= 3 * period_ns:  # NEAR_SHARE
            if self.near < NEAR_FRAMES_MAX:
                self.near += 1
        else:
            self.near = max(self.near - FAR_WEIGHT, 0)
        if self.seen_ns is not None:
            self.step_ns = t_ns - self.seen_ns
            late_ns = self.behind_ns + self.step_ns - self.every * period_ns
            self.behind_ns = late_ns if self.every and late_ns > NEAR_SHARE * period_ns else 0
            if 4 * self.step_ns > period_ns:
                self.leads = 2 * offset_ns > period_ns
            is_usual = 4 * abs(self.step_ns - self.every * period_ns) < period_ns  # `round` is slow
            self._learn(self.every if is_usual else round(self.step_ns / period_ns))
        self.seen_ns, self.missed, self.anchors = t_ns, 0, 0

    def _learn(self, step: int) -> None:
        self.run = self.run + 1 if step == self.step else 1
        self.step = step
        every = self.every
        needed = AGREE_FIRST if not every else AGREE_OTHER if step % every else AGREE_MULTIPLE
        if step > 0 and step != every and self.run >= needed:
            self.every = step


class Part(msgspec.Struct, frozen=True, gc=False):
    """Frame of the present sample."""

    data: bytes
    t_ns: int  # arrival time
    sid: int | None


class Assembled(NamedTuple):
    """Frames of one sample."""

    frames: list[tuple[int, bytes]]  # kind and data, in the order of arrival
    t_first_ns: int  # arrival of the anchor; of the first frame in a sample without the anchor


class Assembly:
    """Assembly of the samples of one device. It counts all frames of the ledger except `frames_good`; the codec counts
    bytes. Synchronization: one thread.
    """

    def __init__(self, ledger: Ledger, kinds: Container[int] | None = None) -> None:
        """`kinds`: kinds that the assembly uses; None: all."""
        self._ledger = ledger
        self._allowed = kinds
        self._parts: dict[int, Part] = {}  # present sample by kind, in the order of arrival
        self._newest: tuple[int, bytes, int] | None = None  # kind, data and arrival of the newest frame
        self._copies = FrameCopies()
        self._learning: list[tuple[int, int]] = []  # kinds and arrivals of the frames since the start of learning
        self._kinds: dict[int, _Kind] = {}
        self._anchor: int | None = None  # None: unknown
        self._anchor_ns = 0  # arrival of the newest anchor
        self._anchor_sid: int | None = None
        self._due: set[int] = set()  # kinds for which the anchor of the present sample waits
        self._cadence = Cadence(0, 0)
        self._sids = SidSeries()
        self._strays = 0
        self._same_address = SameAddress()
        self._incomplete = 0  # number of bursts without the anchor since the newest anchor

    @property
    def period_ns(self) -> int:
        """Time between two samples, ns; 0 if unknown."""
        return 0 if self._anchor is None else self._cadence.period_ns

    @property
    def problem(self) -> str:
        """Address conflict that the frames show, one sentence; empty without a conflict."""
        return self._same_address.problem

    def add_frame(self, kind: int, data: bytes, t_rx_ns: int, sid: int | None = None) -> Sequence[Assembled]:
        """Add one frame. Return the samples that it completes, oldest first."""
        if (self._allowed is not None and kind not in self._allowed) or self._is_repeated(kind, data, t_rx_ns):
            self._ledger.frames_ignored += 1
            return ()
        self._newest = (kind, data, t_rx_ns)
        self._same_address.add_frame(kind, t_rx_ns, sid)
        if self._anchor is None:
            return self._add_unknown(kind, Part(data, t_rx_ns, sid))
        done = []
        if self._parts and (kind in self._parts or self._separates(kind, t_rx_ns, sid)):
            done.append(self._take())
            if self._anchor is None:
                return done + self._add_unknown(kind, Part(data, t_rx_ns, sid))
        self._parts[kind] = Part(data, t_rx_ns, sid)
        self._ledger.frames_pending += 1
        self._track(kind, t_rx_ns, sid)
        if self._anchor in self._parts and not self._due:
            done.append(self._take())
        return done

    def flush(self) -> Sequence[Assembled]:
        """Return the incomplete sample: no frame follows."""
        return [self._take()] if self._parts else ()

    def watched(self, measurements: list[Measurement]) -> list[Measurement]:
        """Return the measurements of samples. Watch their values for an address conflict."""
        for one in measurements:
            self._same_address.add_values(one)
        return measurements

    def reset(self) -> None:
        """Drop the incomplete sample."""
        ledger = self._ledger
        ledger.frames_ignored += len(self._parts)
        ledger.frames_pending -= len(self._parts)
        self._parts.clear()
        self._due.clear()
        self._newest = None
        self._copies.reset()

    def _is_repeated(self, kind: int, data: bytes, t_rx_ns: int) -> bool:
        """Return whether the bus or a gateway delivered a frame again."""
        is_copy = self._copies.is_copy(kind, data, t_rx_ns)
        if self._is_repetition(kind, data, t_rx_ns):
            return True
        if not is_copy:
            return False
        if self._anchor is None:
            self._drop_learned_copies()
            return True
        known = self._kinds.get(kind)
        # frames that waited arrive together
        return known is None or 2 * known.behind_ns < max(known.every, 1) * self._cadence.period_ns

    def _drop_learned_copies(self) -> None:
        """Remove the copies from the frames of the learning, which arrived before the proof of copies."""
        newest_ns: dict[int, int] = {}
        frames = self._learning
        self._learning = []
        for kind, t_ns in frames:
            if kind in newest_ns and t_ns - newest_ns[kind] < COPY_NS:
                continue
            newest_ns[kind] = t_ns
            self._learning.append((kind, t_ns))

    def _is_repetition(self, kind: int, data: bytes, t_rx_ns: int) -> bool:
        """Return whether the bus repeated the newest frame."""
        newest = self._newest
        if newest is None or newest[0] != kind or newest[1] != data:
            return False
        known, after_ns = self._kinds.get(kind), t_rx_ns - newest[2]
        if known is None or not known.every or self._anchor is None:
            return after_ns < REPETITION_NS
        period_ns = known.every * self._cadence.period_ns
        # frames that waited arrive together, and their data can be equal
        return after_ns < min(REPETITION_NS, period_ns // 8) and 2 * known.behind_ns < period_ns

    def _separates(self, kind: int, t_rx_ns: int, sid: int | None) -> bool:
        """Return whether a frame is from another burst than the present sample."""
        kinds, parts, period_ns = self._kinds, self._parts, self._cadence.period_ns
        known = kinds.get(kind)
        anchor = parts.get(self._anchor) if self._anchor is not None else None
        age_ns = 0
        if known is not None and known.near >= NEAR_FRAMES:
            for number, part in parts.items():
                if kinds[number].near >= NEAR_FRAMES:
                    age_ns = t_rx_ns - part.t_ns
                    break
        if known is not None and sid is not None and known.has_shared_sid:
            for number, part in parts.items():
                if part.sid is not None and kinds[number].has_shared_sid:
                    if part.sid == sid:
                        return 4 * age_ns > 3 * period_ns
                    if 2 * age_ns <= period_ns:  # a loss, or the SIDs no longer agree
                        kinds[kind if number == self._anchor else number].agree -= 1
                    return True
        return 2 * age_ns > period_ns or (anchor is not None and 2 * (t_rx_ns - anchor.t_ns) > period_ns)

    def _track(self, kind: int, t_rx_ns: int, sid: int | None) -> None:
        """Update the state of a kind. An anchor then waits for the kinds that are due."""
        period_ns, kinds = self._cadence.period_ns, self._kinds
        known = kinds.get(kind)
        if known is None:
            known = kinds[kind] = _Kind()
        self._ledger.frames_lost += known.losses.add(t_rx_ns, sid)
        if kind != self._anchor:
            known.arrive(t_rx_ns, self._anchor_ns, period_ns)
            self._due.discard(kind)
            return
        is_even = 3 * period_ns <= 4 * (t_rx_ns - self._anchor_ns) <= 5 * period_ns
        known.arrive(t_rx_ns, t_rx_ns, period_ns)
        known.every = 1
        self._anchor_ns = t_rx_ns
        for number, one in kinds.items():
            one.anchors += 1
            if number not in self._parts and one.is_due(t_rx_ns, period_ns, is_even=is_even):
                self._due.add(number)

    def _take(self) -> Assembled:
        """End the present sample and return its frames."""
        parts, ledger, kinds = self._parts, self._ledger, self._kinds
        frames = [(kind, part.data) for kind, part in parts.items()]
        ledger.frames_pending -= len(parts)
        ledger.frames_in_samples += len(parts)
        for kind in self._due:
            kinds[kind].missed += 1
        first_ns = next(iter(parts.values())).t_ns
        anchor = parts.get(self._anchor) if self._anchor is not None else None
        if anchor is not None:
            first_ns = anchor.t_ns
            self._strays = max(self._strays - 1, 0)
            self._compare_sids(anchor)
            shares = anchor.sid is not None and any(
                one.has_shared_sid for number, one in kinds.items() if number != self._anchor
            )
            self._count_losses(first_ns, anchor.sid, is_instant=shares)
        elif self._anchor is not None:
            known = [(kinds[kind], part.t_ns) for kind, part in parts.items()]
            burst_ns = [t_ns for one, t_ns in known if one.near >= NEAR_FRAMES and one.every]
            if any(kinds[kind].has_shared_sid for kind in parts) or self._cadence.steps_to(first_ns) > 0:
                self._incomplete += 1  # the anchor is lost, the sample is not
            if burst_ns and self._cadence.steps_to(burst_ns[0]) > 0:
                self._count_by_period(burst_ns[0])
            self._strays += STRAY_WEIGHT
        parts.clear()
        self._due.clear()
        if self._strays >= STRAYS_MAX:
            self._learn_again()
        return Assembled(frames, first_ns)

    # --- losses -------------------------------------------------------------------------------------------------------

    def _compare_sids(self, anchor: Part) -> None:
        """Compare the SIDs of a sample. Constant SIDs do not show the instant."""
        before, self._anchor_sid = self._anchor_sid, anchor.sid
        if anchor.sid is None or anchor.sid == before:
            return
        for kind, part in self._parts.items():
            known = self._kinds[kind]
            known.agree = min(known.agree + 1, SIDS_AGREE_MAX) if part.sid == anchor.sid else max(known.agree - 1, 0)

    def _count_losses(self, t_ns: int, sid: int | None, *, is_instant: bool) -> None:
        """Count the lost samples before an anchor. `is_instant`: the SID numbers the bursts, not the frames."""
        cadence = self._cadence
        steps = cadence.steps_to(t_ns)
        missing = self._sids.add(sid, is_next=steps == 1)
        if missing is not None:
            missing = max(missing - self._incomplete, 0)
        self._incomplete = 0
        # after a longer time, whole turns can be missing
        if missing is not None and steps < SID_MODULUS_LEAST // 2 and fits_time(missing, steps, is_instant=is_instant):
            self._ledger.lost_gap_device += missing
            if missing or steps != 1:
                cadence.rebase(t_ns)
                return
        self._count_by_period(t_ns)

    def _count_by_period(self, t_ns: int) -> None:
        before_ns = self._cadence.period_ns
        lost, is_unknown = self._cadence.begin(t_ns)
        period_ns = self._cadence.period_ns
        if abs(period_ns - before_ns) > NEAR_SHARE * before_ns:  # another rate
            for kind in self._kinds.values():
                kind.every = max(round(kind.step_ns / period_ns), 1) if kind.every else 0
        self._ledger.lost_gap_device += lost
        self._ledger.lost_unknown += is_unknown

    # --- learning -----------------------------------------------------------------------------------------------------

    def _add_unknown(self, kind: int, part: Part) -> list[Assembled]:
        """Add a frame during learning."""
        done = []
        while kind in self._parts:
            times = [*(one.t_ns for one in self._parts.values()), part.t_ns]
            pauses = [after - before for before, after in pairwise(times)]
            cut = 1 + next((place for place, pause_ns in enumerate(pauses) if 4 * pause_ns >= 3 * max(pauses)), 0)
            parts = list(self._parts.items())
            self._parts = dict(parts[:cut])
            done.append(self._take())
            self._parts = dict(parts[cut:])
        self._parts[kind] = part
        self._ledger.frames_pending += 1
        self._learning.append((kind, part.t_ns))
        learned = learned_from(self._learning)
        if learned is not None:
            self._use(learned)
            if self._anchor in self._parts and not self._due:
                done.append(self._take())
        return done

    def _use(self, learned: Learned) -> None:
        """Use an anchor. The frames of the learning show the properties of the other kinds."""
        frames, self._learning = self._learning, []
        self._anchor = learned.anchor
        self._cadence = Cadence(learned.period_ns, frames[-1][1])
        self._sids = SidSeries()
        self._kinds = {kind: _Kind() for kind, _ in frames}
        self._kinds[learned.anchor].near = NEAR_FRAMES_MAX
        begin = next(place for place, (kind, _) in enumerate(frames) if kind == learned.anchor)
        for kind, t_ns in frames[begin:]:
            self._track(kind, t_ns, self._parts[kind].sid if kind in self._parts else None)
        if learned.anchor not in self._parts:
            self._due.clear()

    def _learn_again(self) -> None:
        self._anchor, self._strays = None, 0
        self._kinds = {}
