"""Buckets: of the samples in each interval of time, the least and the greatest value of every axis, so that a plot of
few points per second keeps each peak."""

from collections.abc import Iterable, Sequence
from math import isfinite
from typing import Final

from imud.sample import Sample
from imud.units import NS_PER_S
from imud.web.messages import VECTORS, Bucket, Range, RawMessage

LATE_PERIODS: Final = 2
"""A bucket ends that long after its interval even where no later sample came."""


class Bucketing:
    """Buckets of one device at one rate. Their intervals begin at whole multiples of the period of CLOCK_MONOTONIC."""

    def __init__(self, rate_hz: int) -> None:
        self._period_ns = NS_PER_S // rate_hz
        self._open: list[Sample] = []
        self._number = -1
        """Of the interval of the open bucket, since the clock's zero."""

    def add(self, samples: Iterable[Sample], now_ns: int) -> list[Bucket]:
        """Take samples in order, and return the buckets that are complete."""
        done = []
        for sample in samples:
            number = sample.t_ns // self._period_ns
            if number != self._number:
                done += self._ended()
                self._number = number
            self._open.append(sample)
        if now_ns >= (self._number + 1 + LATE_PERIODS) * self._period_ns:
            done += self._ended()
        return done

    def _ended(self) -> list[Bucket]:
        samples, self._open = self._open, []
        return [bucket_of(samples)] if samples else []


def bucket_of(samples: Sequence[Sample]) -> Bucket:
    """Make the bucket of one sample or more of one device. Values that are not finite are left out."""
    first, last = samples[0], samples[-1]
    ranges = {name: _range([getattr(sample, name) for sample in samples]) for name in VECTORS}
    return Bucket(
        first_s=first.t_ns / NS_PER_S,
        last_s=last.t_ns / NS_PER_S,
        utc_s=last.utc_ns / NS_PER_S,
        count=len(samples),
        seq=last.seq,
        sync=str(last.sync),
        t_err_s=max(sample.t_err_ns for sample in samples) / NS_PER_S,
        latency_s=max(sample.t_rx_ns - sample.t_ns for sample in samples) / NS_PER_S,
        quat_wxyz=_last([sample.quat_wxyz for sample in samples]),
        temperature_c=next((one.temperature_c for one in reversed(samples) if one.temperature_c is not None), None),
        pressure_pa=next((one.pressure_pa for one in reversed(samples) if one.pressure_pa is not None), None),
        **ranges,
    )


def raw_of(device: str, member: str, samples: Iterable[Sample]) -> RawMessage | None:
    """Every value of a vector; None where no sample has it."""
    found = [
        (sample.seq, sample.t_ns / NS_PER_S, vector)
        for sample in samples
        if (vector := getattr(sample, member)) is not None and all(map(isfinite, vector))
    ]
    if not found:
        return None
    numbers, times, vectors = zip(*found, strict=True)
    return RawMessage(device, member, numbers, times, tuple(zip(*vectors, strict=True)))


def _range(vectors: Iterable[tuple[float, ...] | None]) -> Range | None:
    kept = [vector for vector in vectors if vector is not None and all(map(isfinite, vector))]
    if not kept:
        return None
    axes = list(zip(*kept, strict=True))
    return tuple(map(min, axes)), tuple(map(max, axes))


def _last(vectors: Sequence[tuple[float, ...] | None]) -> tuple[float, ...] | None:
    for vector in reversed(vectors):
        if vector is not None and all(map(isfinite, vector)):
            return vector
    return None
