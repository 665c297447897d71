"""Corrections of the fit of arrivals by aiding sources (edges, a pulse per second, UTC) without a step.

`sync` names the best source of a time stamp:

- `utc`: the device counter agrees with the host's UTC. Its milliseconds bound the time stamp. An edge is more
  accurate and stays in use.
- `edge`: the kernel's time stamp of the sample's SOUT pulse or SIN trigger. If the event of a sample is lost, the line
  through the other events, for at most two samples. Or the pulse per second, if it is more accurate than the arrivals.
- `regression`: the fit of arrivals, less its delay behind the edges if edges have shown this delay.

If a source, an interval or the delay changes, `Slew` removes the difference slowly. Until then, the difference is part
of the error. `Holdover` continues the time after a jump of the counter to UTC, until a new fit is accurate.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import hypot, sqrt
from typing import Final

import msgspec

from imud.contracts.lines import SIN_DELAY_US, Edge, SoutTiming, TimeBits, TriggerStamp, TriggerTiming, UtcReference
from imud.contracts.status import ClockStatus
from imud.host.clock import SteadyTime
from imud.model.sample import Measurement, Sync
from imud.model.units import NS_PER_S, NS_PER_US
from imud.sampling.device_utc import DeviceUtc, PpsAge
from imud.sampling.edge_pairing import EdgePairing, EdgeStamp, MarkPairing, PulseDecoder, rising_edges

SLEW: Final = 500e-6  # maximum correction of a settled clock, as a share of the elapsed time: 0.5 ms per second
SLEW_SETTLING: Final = 0.2  # maximum correction while the fit is young
SETTLED_AFTER_NS: Final = 10 * NS_PER_S
# Span of a fit that ends holdover, ns. A younger fit is inaccurate, and holdover is at most 0.8 ms off by then.
HOLDOVER_NS: Final = 16 * NS_PER_S
HOLDOVER_RATE: Final = 50e-6  # maximum rate error of steady time compared to UTC: the tolerance of a crystal
TICK_SHARE: Final = 0.5  # error of the start of a tick, ticks: the position of the measurement in the tick is unknown
# maximum number of consecutive samples without an edge before the fit of arrivals replaces the edges
UNPAIRED_MOST: Final = 2
# Standard deviation of a time stamp, in mean distances from the line. Delays are exponentially distributed.
STAMP_SPREADS: Final = 2.0
# Minimum delay from the edge to the kernel's time stamp, ns. The mean of the time stamps does not show it.
STAMP_FLOOR_NS: Final = 3 * NS_PER_US


class Slew:
    """Difference between published and estimated time, reduced to zero at a limited rate, without a step."""

    __slots__ = ("left_ns",)

    def __init__(self) -> None:
        self.left_ns = 0.0  # published time minus estimated time, ns

    def set(self, left_ns: float) -> None:
        self.left_ns = left_ns

    def add(self, change_ns: float) -> None:
        """Add a change of the published time, or the negative change of the estimate."""
        self.left_ns += change_ns

    def advance(self, elapsed_ns: int, age_ns: int) -> float:
        """Reduce the difference for the elapsed time and the age of the fit. Return the rest, ns."""
        left = self.left_ns
        if left:
            most = elapsed_ns * (SLEW if age_ns > SETTLED_AFTER_NS else SLEW_SETTLING)
            if left > most:
                left -= most
            elif left < -most:
                left += most
            else:
                left = 0.0
            self.left_ns = left
        return left


class Holdover:
    """Line from the end of the old fit, in use until the new fit is accurate. Its error grows with time. By default,
    its rate is the rate of UTC: after a jump to UTC, the old fit of the crystal is no longer valid."""

    __slots__ = ("_device_ns", "_error_ns", "_t_ns", "least_ns", "slope", "slope_error")

    def __init__(
        self, device_ns: int, t_ns: int, error_ns: float, tick_ns: int, least_ns: int = HOLDOVER_NS,
        slope: float = 1.0, slope_error: float = HOLDOVER_RATE,
    ) -> None:  # fmt: skip
        self._device_ns = device_ns
        self._t_ns = t_ns
        self._error_ns = hypot(error_ns, TICK_SHARE * tick_ns)
        self.least_ns = least_ns  # span of the new fit that ends holdover, ns
        self.slope = slope  # host ns per device ns
        self.slope_error = slope_error

    def at(self, device_ns: int) -> int:
        return self._t_ns + int(self.slope * (device_ns - self._device_ns))

    def error_ns(self, device_ns: int) -> float:
        return self._error_ns + self.slope_error * (device_ns - self._device_ns)


@dataclass(slots=True, eq=False)
class EdgeSource:
    """Aiding source with an edge for each sample: SOUT or SIN."""

    pairing: EdgePairing
    offset_ns: int  # instant of measurement minus event, ns
    sigma_ns: float  # one-sigma error of `offset_ns`, ns
    mask: int = 0  # status bit of samples with an event; 0 without such a bit
    stamp_error_ns: int = 0  # one-sigma error of the newest event's time stamp, ns; 0 if unknown
    bit_seen: bool = False

    @property
    def error_ns(self) -> float:
        return hypot(STAMP_SPREADS * self.pairing.spread_ns, self.sigma_ns, self.stamp_error_ns) + STAMP_FLOOR_NS

    def add_event(self, event: EdgeStamp, error_ns: int) -> None:
        """Add an event. `error_ns` is the one-sigma error of its time stamp."""
        self.stamp_error_ns = error_ns
        self.pairing.add_events((event,))

    def silent(self, status: int | None) -> bool:
        """Return whether the status of the device shows that this sample has no event."""
        if status is None:
            return False
        if status & self.mask:
            self.bit_seen = True
            return False
        return self.bit_seen


class AidingSources:
    """All aiding sources of a device's time. Each source is in use after its first edge. Add edges in the order of
    time, before the frames that follow them. Synchronization: none; one thread."""

    __slots__ = (
        "_bits", "_device_ns", "_fix_ns", "_host", "_pps", "_pulses", "_sin_timing", "_source", "_sources",
        "_sout_timing", "edge_seq", "error_ns", "marks", "sin", "slew", "sout", "sout_offset_ns", "sync", "utc",
        "utc_reference",
    )  # fmt: skip

    def __init__(
        self, tick_ns: int, tick_modulus: int, bits: TimeBits, sout_timing: SoutTiming, sin_timing: TriggerTiming,
        host: SteadyTime,
    ) -> None:  # fmt: skip
        self._bits = bits
        self._host = host
        self._sout_timing = sout_timing
        self._sin_timing = sin_timing
        self._pulses = PulseDecoder(int(sout_timing.width_us * NS_PER_US))
        # in the order of their first edges; the first source has priority
        self._sources: list[EdgeSource] = []
        self._source: EdgeSource | None = None
        self._fix_ns = 0.0  # correction of the fit of arrivals, ns
        self._device_ns: int | None = None
        self._pps: PpsAge | None = None
        self.sout: EdgeSource | None = None
        self.sin: EdgeSource | None = None
        self.sout_offset_ns = 0  # time from a pulse on SOUT to its measurement, ns
        self.marks: MarkPairing | None = None
        self.utc = DeviceUtc(tick_ns, tick_modulus)
        # the host's estimate of UTC relative to CLOCK_MONOTONIC; None if unknown
        self.utc_reference: UtcReference | None = None
        self.slew = Slew()
        self.error_ns = 0.0  # one-sigma error of the newest time stamp, ns
        self.sync = Sync.ARRIVAL  # source of the newest time stamp
        self.edge_seq: int | None = None  # number of the event of the newest sample; None without an event

    def add_status(self, status: ClockStatus) -> ClockStatus:
        """Return the status of a clock with the status of its aiding sources."""
        sout, sin, reference = self.sout, self.sin, self.utc_reference
        first = sout or sin
        return msgspec.structs.replace(
            status,
            edges=first.pairing.events if first else 0,
            edges_unpaired=sout.pairing.events_unpaired if sout else 0,
            samples_unpaired=first.pairing.samples_unpaired if first else 0,
            triggers_missed=sin.pairing.events_unpaired if sin else 0,
            reference_error_ns=reference.error_ns if reference else 0,
        )

    def on_sout_edges(self, edges: Sequence[Edge]) -> None:
        """Add edges of SOUT, rising and falling."""
        if self.sout is None:
            timing = self._sout_timing
            self.sout_offset_ns = int(timing.offset_us * NS_PER_US)
            pairing = EdgePairing(int(timing.width_us * NS_PER_US))
            sigma_ns = timing.bias_us * NS_PER_US / sqrt(3)
            self.sout = EdgeSource(pairing, self.sout_offset_ns, sigma_ns, self._bits.sync_out)
            self._sources.append(self.sout)
        steady_ns = self._host.steady_ns
        self.sout.pairing.add_events([(steady_ns(t_ns), number) for t_ns, number in self._pulses.decode(edges)])

    def on_divided_edges(self, edges: Sequence[Edge]) -> None:
        """Add edges of SOUT_DIV. `SampleClock.take_marks` returns their samples."""
        if self.marks is None:
            self.marks = MarkPairing()
        self.marks.add_pulses(rising_edges(edges))

    def on_trigger_stamps(self, stamps: Iterable[TriggerStamp]) -> None:
        """Add triggers of imud on SIN. The device answers each trigger with one frame."""
        if self.sin is None:
            timing = self._sin_timing
            pairing = EdgePairing(int(SIN_DELAY_US * NS_PER_US))
            self.sin = EdgeSource(pairing, int(timing.offset_us * NS_PER_US), timing.bias_us * NS_PER_US / sqrt(3))
            self._sources.append(self.sin)
        for t_ns, err_ns, number in stamps:
            self.sin.add_event((self._host.steady_ns(t_ns), number), err_ns)

    def on_pps_edges(self, edges: Sequence[Edge]) -> None:
        """Add edges of the pulse per second on the device's SIN."""
        if self._pps is None:
            self._pps = PpsAge()
        self._pps.add_pulses(self._host.steady_ns(t_ns) for t_ns, _ in rising_edges(edges))

    def set_utc_reference(self, reference: UtcReference | None) -> None:
        """Set the host's present estimate of UTC, or None."""
        self.utc_reference = reference
        if reference is not None:  # UTC minus steady time
            reference = UtcReference(reference.offset_ns + self._host.offset_ns, reference.error_ns)
        self.utc.set_reference(reference)

    def restart(self) -> None:
        """Restart with a new device time or fit."""
        self._source = self._device_ns = None
        self._fix_ns = 0.0
        self.slew.set(0.0)
        for source in self._sources:
            source.pairing.restart()
        if self._pps:
            self._pps.intervals.clear()
        self.utc.reset()

    def steer(
        self, m: Measurement, device_ns: int, arrival_ns: int, fit_ns: int, fit_error_ns: float, fit_sync: Sync,
        period_ns: float, slope: float, slope_error: float, age_ns: int,
    ) -> int:  # fmt: skip
        """Return the time of the sample at `device_ns`, at `fit_ns` in the fit. Set `error_ns`, `sync` and `edge_seq`.

        `arrival_ns` is the latest start of the frame. `period_ns` is the time between samples. `slope` is host ns per
        device ns, and `slope_error` its one-sigma error. `age_ns` is the age of the fit.
        """
        elapsed_ns = device_ns - self._device_ns if self._device_ns is not None else 0
        self._device_ns = device_ns
        before, fix_before = self._source, self._fix_ns
        advanced = 2 * elapsed_ns > period_ns  # a shorter time is too short for a slope
        source, paired = None, False
        for candidate in self._sources:
            pairing = candidate.pairing
            own = False
            if advanced and not (candidate.mask and candidate.silent(m.status)):
                own = pairing.pair(device_ns, arrival_ns, fit_ns, fit_error_ns, period_ns, slope)
            else:
                pairing.skip(device_ns)
            if source is None and pairing.running and pairing.misses <= UNPAIRED_MOST:
                source, paired = candidate, own
        if source is not None and source is before and self._pps is None and self.utc.reference is None:
            fix_ns, error_ns, by_pps = fix_before, fit_error_ns, False  # no other source can change the result
        else:
            fix_ns, error_ns, by_pps = self._fix(m, device_ns, arrival_ns, fit_ns, fit_error_ns, slope, slope_error)
        self._source, self._fix_ns = source, fix_ns
        if source is None:
            wanted_ns = fit_ns + int(fix_ns)
            self.edge_seq = None
        else:
            pairing = source.pairing
            error_ns = source.error_ns
            wanted_ns = (pairing.stamp_ns if paired else pairing.due_ns) + source.offset_ns
            self.edge_seq = pairing.number if paired else None
        slew = self.slew
        # remove the step slowly
        if source is not before or (source is None and fix_ns != fix_before):
            was_ns = before.pairing.due_ns + before.offset_ns if before else fit_ns + fix_before
            slew.add(was_ns - (source.pairing.due_ns + source.offset_ns if source else fit_ns + fix_ns))
        left_ns = slew.advance(elapsed_ns, age_ns) if slew.left_ns else 0.0
        self.error_ns = error_ns + abs(left_ns)
        self.sync = Sync.UTC if self.utc.active else Sync.EDGE if source or by_pps else fit_sync
        return wanted_ns + int(left_ns)

    def _fix(
        self, m: Measurement, device_ns: int, arrival_ns: int, fit_ns: int, fit_error_ns: float, slope: float,
        slope_error: float,
    ) -> tuple[float, float, bool]:  # fmt: skip
        """Return (correction of the fit, ns; error after it, ns; whether the pulse per second decides)."""
        fix_ns = 0.0
        # the delay of the fit behind the edges
        for source in self._sources:
            if source.pairing.learned:
                fix_ns = source.offset_ns - source.pairing.delay_ns
                fit_error_ns = hypot(fit_error_ns, source.pairing.delay_error_ns)
                break
        utc, pps, ticks = self.utc, self._pps, m.dev_ticks
        at_ns = fit_ns + int(fix_ns)
        if utc.reference is not None and ticks is not None:
            refused = bool(self._bits.not_utc and m.status is not None and m.status & self._bits.not_utc)
            utc.add_sample(ticks, device_ns, arrival_ns, at_ns, fit_error_ns, slope, refused=refused)
            if utc.active and utc.intervals.known:
                doubt_ns = hypot(fit_error_ns, utc.tick_error_ns)
                more_ns, error_ns = utc.intervals.combined(device_ns, at_ns, doubt_ns, float(utc.reference.error_ns))
                return fix_ns + more_ns, hypot(error_ns, utc.tick_error_ns), False
        if pps is not None:
            if m.pps_age_ms is not None:
                pps.add_age(m.pps_age_ms, device_ns, arrival_ns, at_ns, fit_error_ns, slope, slope_error)
            if pps.is_better(device_ns, fit_error_ns):
                more_ns, error_ns = pps.intervals.combined(device_ns, at_ns, fit_error_ns, 0.0)
                return fix_ns + more_ns, error_ns, True
        return fix_ns, fit_error_ns, False
