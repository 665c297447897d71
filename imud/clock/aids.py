"""What lines and UTC add to the fit of arrivals: the better of all that is known, told without a step.

Ranked by what the stamp rests on; `sync` names the best of them:

- `utc`: the device's counter agrees with the host's UTC. Its milliseconds bound the stamp; where an edge gives it, that
  is far inside of them and stays.
- `edge`: the sample's SOUT pulse or SIN trigger, as stamped by the kernel; for a sample whose own was lost the line
  through the others, for two samples at most. Or the pulse per second, where it knows more than the arrivals.
- `regression`: the fit of arrivals, less its delay behind the edges where those told it.

Whatever changes below (a source, a bound, the delay), the difference is kept and slewed away, and is part of the error.
"""

from dataclasses import dataclass
from math import hypot
from typing import Final

from imud.clock.marks import Marks
from imud.clock.pairing import Pairing
from imud.clock.pps import PpsAge
from imud.clock.slew import Slew
from imud.clock.utc import DeviceUtc
from imud.contracts.timing import TimeBits, UtcReference
from imud.sample import Measurement, Sync
from imud.units import NS_PER_US

COASTED_MOST: Final = 2
"""So many samples in a row may lack their edge before the fit of arrivals takes over."""
STAMP_SPREADS: Final = 2.0
"""One sigma of a stamp, in mean distances of stamps from their line: they are late, by an exponential law."""
STAMP_FLOOR_NS: Final = 3 * NS_PER_US
"""From the edge to the kernel's stamp at best; the mean of all stamps does not show it."""
REFERENCE_STEP: Final = 4
"""A reference that moves by so many of its errors was set: intervals by the old one say nothing."""


@dataclass(slots=True, eq=False)
class EdgeSource:
    """A line whose events say when samples were taken."""

    pairing: Pairing
    offset_ns: int
    """Instant of measurement minus event."""
    sigma_ns: float
    """One-sigma error of that."""
    mask: int = 0
    """Status bit of samples that have an event; 0 where no bit says so."""
    stamp_error_ns: int = 0
    """One-sigma error of the newest event's stamp, where its maker knows it."""
    bit_seen: bool = False

    @property
    def error_ns(self) -> float:
        """One-sigma error of a stamp of this source."""
        return hypot(STAMP_SPREADS * self.pairing.spread_ns, self.sigma_ns, self.stamp_error_ns) + STAMP_FLOOR_NS

    def silent(self, status: int | None) -> bool:
        """Whether the device says that this sample has no event."""
        if status is None:
            return False
        if status & self.mask:
            self.bit_seen = True
            return False
        return self.bit_seen


class AidingSources:
    """All that can be known of a sample's time besides its arrival. Synchronization: none; one thread."""

    __slots__ = (
        "_bits", "_fix_ns", "_source", "_sources", "_x", "edge_seq", "error_ns", "marks", "pps", "sin",
        "slew", "sout", "sync", "utc",
    )  # fmt: skip

    def __init__(self, tick_ns: int, tick_modulus: int, bits: TimeBits) -> None:
        self._bits = bits
        self._sources: list[EdgeSource] = []
        self._source: EdgeSource | None = None
        self._fix_ns = 0.0
        """What is added to the fit of arrivals."""
        self._x: int | None = None
        self.sout: EdgeSource | None = None
        self.sin: EdgeSource | None = None
        self.marks: Marks | None = None
        self.pps: PpsAge | None = None
        self.utc = DeviceUtc(tick_ns, tick_modulus)
        self.slew = Slew()
        self.error_ns = 0.0
        self.sync = Sync.ARRIVAL
        self.edge_seq: int | None = None

    def listen(self, source: EdgeSource) -> EdgeSource:
        """Use another line; the first one counts where several have an event."""
        self._sources.append(source)
        return source

    @property
    def before_measurement_ns(self) -> int:
        """From a pulse on SOUT to its measurement."""
        return self.sout.offset_ns if self.sout else 0

    def refer(self, reference: UtcReference | None) -> None:
        """What the host knows of UTC now."""
        before = self.utc.reference
        if before and reference:
            step_ns = abs(reference.offset_ns - before.offset_ns)
            if step_ns > REFERENCE_STEP * (reference.error_ns + before.error_ns):
                self.utc.bounds.clear()
        self.utc.reference = reference
        if reference is None:
            self.utc.off()

    def restart(self) -> None:
        """Device time or the fit began anew: nothing that was relative to them holds."""
        self._source = self._x = None
        self._fix_ns = self.slew.left_ns = 0.0
        for source in self._sources:
            source.pairing.restart()
        if self.pps:
            self.pps.bounds.clear()
        self.utc.off()

    def steer(
        self, m: Measurement, x: int, y: int, fit_ns: int, fit_error_ns: float, fit_sync: Sync, period_ns: float,
        slope: float, slope_error: float, age_ns: int,
    ) -> int:  # fmt: skip
        """When the sample at device time `x` was taken, the fit saying `fit_ns`; leaves error, source and edge.

        Its message began no later than `y`; samples are `period_ns` apart, a device ns is `slope` host ns, one sigma
        `slope_error`, and the fit has been going for `age_ns`.
        """
        elapsed_ns = x - self._x if self._x is not None else 0
        self._x = x
        before, fix_before = self._source, self._fix_ns
        advanced = 2 * elapsed_ns > period_ns  # a slope over less than that is none
        source, paired = None, False
        for candidate in self._sources:
            pairing = candidate.pairing
            own = False
            if advanced and not (candidate.mask and candidate.silent(m.status)):
                own = pairing.pair(x, y, fit_ns, fit_error_ns, period_ns, slope)
            else:
                pairing.skip(x)
            if source is None and pairing.running and pairing.misses <= COASTED_MOST:
                source, paired = candidate, own
        if source is not None and source is before and self.pps is None and self.utc.reference is None:
            fix_ns, error_ns, by_pps = fix_before, fit_error_ns, False  # nothing else is asked
        else:
            fix_ns, error_ns, by_pps = self._fix(m, x, y, fit_ns, fit_error_ns, slope, slope_error)
        self._source, self._fix_ns = source, fix_ns
        if source is None:
            wanted = fit_ns + int(fix_ns)
            self.edge_seq = None
        else:
            pairing = source.pairing
            error_ns = source.error_ns
            wanted = (pairing.stamp_ns if paired else pairing.due_ns) + source.offset_ns
            self.edge_seq = pairing.number if paired else None
        slew = self.slew
        if source is not before or (source is None and fix_ns != fix_before):
            was = before.pairing.due_ns + before.offset_ns if before else fit_ns + fix_before
            slew.left_ns += was - (source.pairing.due_ns + source.offset_ns if source else fit_ns + fix_ns)
        left_ns = slew.over(elapsed_ns, age_ns) if slew.left_ns else 0.0
        self.error_ns = error_ns + abs(left_ns)
        self.sync = Sync.UTC if self.utc.on else Sync.EDGE if source or by_pps else fit_sync
        return wanted + int(left_ns)

    def _fix(
        self, m: Measurement, x: int, y: int, fit_ns: int, fit_error_ns: float, slope: float, slope_error: float
    ) -> tuple[float, float, bool]:
        """(What is to be added to the fit, its error then, whether a pulse per second says so)."""
        fix_ns = 0.0
        for source in self._sources:
            if source.pairing.learned:
                fix_ns = source.offset_ns - source.pairing.delay_ns
                fit_error_ns = hypot(fit_error_ns, source.pairing.delay_error_ns)
                break
        utc, pps, ticks = self.utc, self.pps, m.dev_ticks
        at_ns = fit_ns + int(fix_ns)
        if utc.reference is not None and ticks is not None:
            refused = bool(self._bits.not_utc and m.status is not None and m.status & self._bits.not_utc)
            utc.take(ticks, x, y, at_ns, fit_error_ns, slope, refused=refused)
            if utc.on and utc.bounds.known:
                doubt_ns = hypot(fit_error_ns, utc.tick_error_ns)
                more_ns, error_ns = utc.bounds.improved(x, at_ns, doubt_ns, float(utc.reference.error_ns))
                return fix_ns + more_ns, hypot(error_ns, utc.tick_error_ns), False
        if pps is not None:
            if m.pps_age_ms is not None:
                pps.take(m.pps_age_ms, x, y, at_ns, fit_error_ns, slope, slope_error)
            if pps.helps(x, fit_error_ns):
                more_ns, error_ns = pps.bounds.improved(x, at_ns, fit_error_ns, 0.0)
                return fix_ns + more_ns, error_ns, True
        return fix_ns, fit_error_ns, False
