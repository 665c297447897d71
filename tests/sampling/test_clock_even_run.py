"""Frames in one loop (`add_run`): the same samples, losses and state of the clock as frame by frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

import pytest

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
from imud.contracts.status import ClockStatus
from imud.host.clock import SteadyTime
from imud.model.sample import Measurement, Sample
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.sampling.clock import SampleClock

BYTES: Final = 82
BYTE_NS: Final = 10_850
MODULUS: Final = 1 << 12
"""Modulus of the counter, ticks. It wraps several times in a trial."""
ROUNDS: Final = 600
BEGIN_NS: Final = 1000 * NS_PER_S


@dataclass(frozen=True)
class Trial:
    """Properties of the device and its link."""

    name: str
    period_ms: float = 1.0
    hold_ns: int = 0
    most: int = 24
    """Maximum number of frames in a read."""
    waits: bool = False
    """Whether frames wait and are read together."""
    lost: float = 0.0
    odd: float = 0.0
    """Share of frames without device time, and of jumps of the counter."""
    slewed: float = 0.0
    """Rate of CLOCK_MONOTONIC relative to steady time."""
    early_ns: int = 0
    """Time by which some reads are too early, ns."""


TRIALS: Final = (
    Trial("even"), Trial("waits", waits=True), Trial("waits at 200 Hz", period_ms=5.0, most=6, waits=True),
    Trial("USB adapter", hold_ns=16 * NS_PER_MS), Trial("400 Hz in ms", period_ms=2.5),
    Trial("slewed host", waits=True, slewed=20e-6), Trial("losses", lost=0.0005, waits=True),
    Trial("jumps", odd=0.001, waits=True), Trial("early reads", early_ns=200 * NS_PER_US, waits=True),
)  # fmt: skip


class Device:
    """Reads of a device, each with its time and the maximum wait of its frames."""

    def __init__(self, trial: Trial, random: Random) -> None:
        self._trial = trial
        self._random = random
        self._number = self._jumped = 0
        self._t_rx_ns = BEGIN_NS

    def read(self) -> tuple[list[CodecEvent], int, int]:
        """Return the next read."""
        trial, random = self._trial, self._random
        count = random.choice((1, 1, trial.most // 2, trial.most))
        events = [event for place in range(count) for event in self._message(count - 1 - place)]
        period_ns = int(trial.period_ms * NS_PER_MS)
        late_ns = int(random.expovariate(1 / (20 * NS_PER_US))) + (count > 1) * random.randrange(period_ns)
        late_ns -= trial.early_ns * (random.random() < 0.05)
        due_ns = BEGIN_NS + self._number * int(period_ns * 1.00004) + BYTES * BYTE_NS + late_ns
        self._t_rx_ns = max(self._t_rx_ns, due_ns + int(self._number * period_ns * trial.slewed))
        return events, self._t_rx_ns, count * period_ns if trial.waits and count > 1 else 0

    def _message(self, behind: int) -> list[CodecEvent]:
        trial, random = self._trial, self._random
        self._number += 1
        self._jumped += random.randrange(5000) * (random.random() < trial.odd / 2)
        if random.random() < trial.lost:
            return [BadFrame(BadReason.CRC, b"")] if random.random() < 0.5 else []
        ticks = (int(self._number * trial.period_ms) + self._jumped) % MODULUS
        return [
            Measurement(
                BYTES, behind * BYTES, None if random.random() < trial.odd / 2 else ticks,
                accel_m_s2=(float(self._number), 0.0, 9.8), status=random.choice((None, 5)), pps_age_ms=self._number,
            )
        ]  # fmt: skip


class Dated:
    """A clock with its samples of the reads."""

    def __init__(self, trial: Trial) -> None:
        self.host = SteadyTime()
        self.unknown = 0
        self.clock = SampleClock(
            "imu", tick_ns=NS_PER_MS, tick_modulus=MODULUS, byte_ns=BYTE_NS, hold_ns=trial.hold_ns, host=self.host,
            on_unknown_gap=self._on_unknown_gap,
        )  # fmt: skip
        self.samples: list[Sample] = []
        self.missed: list[int] = []
        self.states: list[ClockStatus] = []
        self.in_runs = 0

    def _on_unknown_gap(self) -> None:
        self.unknown += 1

    def take(self, events: Sequence[CodecEvent], t_rx_ns: int, waited_ns: int, *, runs: bool) -> None:
        """Time-stamp the frames of a read, in runs or one by one."""
        self.clock.waited_ns = waited_ns
        at = 0
        while at < len(events):
            after = self.clock.add_run(self.samples, events, at, t_rx_ns, 7) if runs else at
            if after > at:
                self.in_runs += after - at
                self.missed += [self.clock.missed] * (after - at)
                at = after
                continue
            event = events[at]
            at += 1
            if isinstance(event, Measurement):
                self.samples.append(self.clock.sample(event, t_rx_ns, 7))
                self.missed.append(self.clock.missed)
        self.clock.waited_ns = 0
        self.states.append(self.clock.status())


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.thorough) for seed in (1, 2))])
@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.name)
def test_a_run_gives_the_same_samples_as_single_frames(trial: Trial, seed: int) -> None:
    random = Random(f"{trial.name} {seed}")
    device, one, many = Device(trial, random), Dated(trial), Dated(trial)
    for number in range(ROUNDS):
        events, t_rx_ns, waited_ns = device.read()
        own = random.choice((None, 1 << 31))
        for dated in (one, many):
            if trial.slewed:
                dated.host.add_pair(t_rx_ns, int(t_rx_ns * (1 - trial.slewed)))
            if not number % 50:
                dated.clock.set_own_status(own)
            dated.take(events, t_rx_ns, waited_ns, runs=dated is many)
    assert (many.samples, many.missed, many.states) == (one.samples, one.missed, one.states)
    assert many.unknown == one.unknown
    if trial.period_ms == int(trial.period_ms):  # otherwise no step equals the period
        assert many.in_runs > 0.05 * len(many.samples)


def test_no_run_without_a_fit_in_use() -> None:
    for settle in (False, True):
        trial = Trial("even")
        device, dated = Device(trial, Random(1)), Dated(trial)
        for _ in range(ROUNDS * settle):
            dated.take(*device.read(), runs=True)
        if settle:
            assert dated.in_runs
            assert dated.clock._sources().edge_seq is None  # the clock has aiding sources now
        before, (events, t_rx_ns, _) = len(dated.samples), device.read()
        assert dated.clock.add_run(dated.samples, events, 0, t_rx_ns, 0) == 0
        assert len(dated.samples) == before
