"""Clock of one device. It makes all samples and time-stamps each measurement in host time.

Steps for each frame (`SampleClock.sample`, then `_by_device`):

    ticks ──────────────────▶ device time (`device_time`) ─┐
    arrival less wire time ────────────────────────────────┴▶ distance above or below the fit (`arrival_fit`)
        ├─ the device corrected its counter: remove the correction from the device time
        ├─ the counter jumped: start a new fit, or continue by UTC (`Holdover`)
        └─ otherwise: add the point to the fit
    time stamp = fit − half of the bias that the link can hide (`arrival_time.LinkDelay`) + remaining `Slew`
        └─ edges, a pulse per second and UTC correct the time stamp (`steering`)

Before the fit is accurate, and for devices without device time, the arrival time makes the time stamp. The clock
computes in steady time, which nothing steers (`imud.host.clock`). Its input and output are in CLOCK_MONOTONIC.

Three rules hold for any input: `t_ns` rises strictly, `t_ns` is never after the arrival, and a jump of the device
counter starts a new fit and does not move the time stamps. Synchronization: none; one thread.
"""

from collections.abc import Callable, Sequence
from functools import partial
from math import hypot
from typing import Any, Final, NamedTuple

from imud.contracts.lines import (
    NO_TIME_BITS,
    Edge,
    Mark,
    SoutTiming,
    TimeBits,
    TriggerStamp,
    TriggerTiming,
    UtcReference,
)
from imud.contracts.observer import InputObserver
from imud.contracts.status import ClockStatus
from imud.formats.kernel import KernelFormat
from imud.formats.slot import SYNC_CODES
from imud.host.clock import UNSTEERED, SteadyTime
from imud.model.sample import T_ERR_MOST, Measurement, Sample, Sync
from imud.model.units import NS_PER_S
from imud.sampling.arrival_fit import ENOUGH_SPAN_NS, SLOPE_HIGHEST, ArrivalFit
from imud.sampling.arrival_time import FIRST_SPREAD_NS, ArrivalTime, LinkDelay, error_parts
from imud.sampling.device_time import FIRST_EARLY_NS, JUMP_EARLY_NS, JUMP_LATE_NS, DeviceTime, JumpDetector
from imud.sampling.gaps import GAP_PERIODS, CounterLine
from imud.sampling.stamp_time import StampTime
from imud.sampling.steering import SETTLED_AFTER_NS, AidingSources, Holdover, Slew

StartRun = Callable[..., Any]  # function of the kernel that starts a run, with its first argument

_EARLY_NS: Final = -JUMP_EARLY_NS
_T_ERR_MOST: Final = float(T_ERR_MOST)
# Before each time stamp. Times of a replay are negative if the capture is longer than the uptime of the host.
_BEFORE_ALL_NS: Final = -(1 << 62)


class RunStart(NamedTuple):
    """State at the start of a run, with the names of `SampleClock`."""

    device: str
    seq: int  # sequence number of the newest sample
    t_ns: int  # time stamp of the newest sample, ns
    t_rx_ns: int  # CLOCK_MONOTONIC of the read, ns
    utc_offset_ns: int
    byte_ns: int
    waited_ns: int
    bias_ns: float
    error_ns: float  # one-sigma error of the fit, ns
    sync: Sync
    own_status: int | None


def add_even_run(
    samples: list[Sample],
    events: Sequence[object],
    at: int,
    start: RunStart,
    time: DeviceTime,
    fit: ArrivalFit,
    host: SteadyTime,
) -> float:
    """Append samples until an event needs `SampleClock.sample`. Return the error of the newest time stamp, ns."""
    device, seq, newest_ns, t_rx_ns, utc_offset_ns, byte_ns, waited_ns, bias_ns, fit_error_ns, sync, own = start
    offset_ns, even_from_ns = host.offset_ns, host.even_from_ns
    ref_arrival_ns, ref_device_ns, slope = fit.ref_arrival_ns, fit.ref_device_ns, fit.slope
    slope_error, fitted_ns, until_ns = fit.slope_error, fit.fitted_ns, fit.until_ns
    doubt_ns, ticks, device_ns, raw_ns = time.doubt_ns, time.ticks, time.even_ns, time.raw_ns
    period_ticks, modulus, tick_ns = time.period.period_ticks, time.modulus, time.tick_ns
    keep, add_arrival, before, newest_error_ns = samples.append, fit.add_arrival, len(samples), 0.0
    for index in range(at, len(events)):
        m = events[index]
        if type(m) is not Measurement or m.dev_ticks is None:
            break
        step = (m.dev_ticks - ticks) % modulus
        trailing_ns = m.trailing_bytes * byte_ns
        arrival_ns = t_rx_ns - (m.size_bytes * byte_ns + trailing_ns + offset_ns)
        # a gap, a repeated counter value, or a change of the host's rate
        if step != period_ticks or not step or arrival_ns < even_from_ns:
            break
        next_ns = device_ns + (step_ns := step * tick_ns)
        fit_ns = ref_arrival_ns + slope * (next_ns - ref_device_ns)
        above_ns = arrival_ns - fit_ns
        is_new = not waited_ns or above_ns <= 0.0  # a held frame above the fit contains no new information
        if not is_new:
            above_ns = max(above_ns - waited_ns, 0.0)
        steady_ns = int(fit_ns - bias_ns)
        t_ns = steady_ns + offset_ns
        if (
            # an early or late frame, a fit that is due, or a time stamp that needs a correction
            not _EARLY_NS <= above_ns < JUMP_LATE_NS
            or (is_new and next_ns >= until_ns)
            or not even_from_ns <= steady_ns <= arrival_ns
            or not newest_ns < t_ns <= t_rx_ns
        ):
            break
        if is_new:
            add_arrival(next_ns, arrival_ns, trailing_ns, above_ns)
        ticks, device_ns, raw_ns, newest_ns = m.dev_ticks, next_ns, raw_ns + step_ns, t_ns
        seq += 1
        newest_error_ns = fit_error_ns + slope_error * (device_ns - fitted_ns) + doubt_ns
        keep(
            Sample(
                device, seq, t_ns, int(newest_error_ns) + 1 if newest_error_ns < _T_ERR_MOST else T_ERR_MOST, sync,
                t_rx_ns, t_ns + utc_offset_ns, raw_ns, m.accel_m_s2, m.gyro_rad_s, m.mag_t, m.quat_wxyz, m.euler_rad,
                m.temperature_c, m.pressure_pa, m.incli_rad, m.status if own is None else own | (m.status or 0),
                m.pps_age_ms, None, m.velocity_enu_m_s, m.position, m.heave_m, m.gnss_utc_ns,
            )
        )  # fmt: skip
    if len(samples) > before:
        time.advance_evenly(ticks, len(samples) - before)
    return newest_error_ns


YOUNG_NS: Final = 32 * NS_PER_S
# Factor for the error of a fit that is shorter than YOUNG_NS. The beat of the latency timer is not visible yet.
YOUNG_FACTOR: Final = 1.2
_ARRIVAL: Final = Sync.ARRIVAL
_KERNEL_MODULUS: Final = 1 << 32  # the kernel supports only this modulus of the device counter


class SampleClock:
    """Clock of one device, which makes samples of measurements.

    `tick_ns` and `tick_modulus` describe the device counter. With `tick_ns` 0, the counter numbers the samples: the
    clock counts lost samples with it, and uses the arrival times. `stamp_modulus` is the modulus of `pps_age_ms`, ms,
    for frames without device counter; 0 if `pps_age_ms` is not usable. `byte_ns` is the time of one byte on the wire, 0
    if unknown. `hold_ns` is the maximum delay in an adapter (USB latency timer). `bits` are status bits about time.
    `sout` and `sin` describe the instant of the measurement relative to an edge. The caller updates `host`.

    `on_unknown_gap` is called for each gap of unknown size. Add edges, triggers and UTC before the frames that follow
    them.
    """

    __slots__ = (
        "_aiding", "_arrivals", "_delay", "_device", "_error_ns", "_fit", "_fit_begin_ns", "_fit_bias_ns",
        "_fit_error_ns", "_fit_sync", "_holdover", "_host", "_jump", "_known", "_line", "_make_aiding",
        "_on_unknown_gap", "_own_status", "_resets", "_run", "_seq", "_slew", "_stamps", "_sync", "_t_err_ns", "_t_ns",
        "_t_rx_ns", "_time", "missed", "observer", "waited_ns",
    )  # fmt: skip

    def __init__(
        self, device: str, *, tick_ns: int, tick_modulus: int, byte_ns: int, hold_ns: int, stamp_modulus: int = 0,
        bits: TimeBits = NO_TIME_BITS, sout: SoutTiming | None = None, sin: TriggerTiming | None = None,
        host: SteadyTime = UNSTEERED, on_unknown_gap: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        self._device, self._host, self._on_unknown_gap = device, host, on_unknown_gap
        self._make_aiding = partial(
            AidingSources, tick_ns, tick_modulus, bits, sout or SoutTiming(), sin or TriggerTiming(), host
        )
        self._aiding: AidingSources | None = None
        self._time = DeviceTime(tick_ns, tick_modulus, on_unknown_gap)
        self._stamps = StampTime(stamp_modulus) if stamp_modulus else None
        self._delay = LinkDelay(byte_ns, hold_ns)
        self._arrivals = ArrivalTime(self._delay, 0 if tick_ns else tick_modulus, on_unknown_gap)
        # lowest position of the device counter relative to the fit; None before the first fit is in use
        self._line: CounterLine | None = None
        self._jump, self._slew = JumpDetector(), Slew()
        self._holdover: Holdover | None = None
        self._fit: ArrivalFit | None = None
        self._fit_begin_ns = 0  # device time
        # distance from the fit down to the time of measurement, and its error
        self._fit_bias_ns = self._fit_error_ns = 0.0
        self._fit_sync = Sync.ARRIVAL  # REGRESSION if the fit is in use
        self._sync = Sync.ARRIVAL  # source of the newest time stamp if there are aiding sources
        self._known, self._resets = False, 0  # known: the device time has started
        self._seq = self._t_err_ns = 0
        self._t_ns = self._t_rx_ns = _BEFORE_ALL_NS
        self._error_ns = 0.0  # one-sigma error of the newest time stamp before its correction
        self._own_status: int | None = None
        self._run: Any = None  # `Run` of the kernel, which has the state of the newest samples; None without a run
        self.missed = 0  # number of lost samples directly before the newest sample, without gaps of unknown size
        # Observer of the input; None if no recording runs. Set by `SamplePath.observe`.
        self.observer: InputObserver | None = None
        self.waited_ns = 0  # set by the path: maximum time of the next frames in the kernel's buffer

    def sample(  # noqa: PLR0912 - each function call costs time on the sample path
        self, m: Measurement, t_rx_ns: int, utc_offset_ns: int, t_begin_ns: int | None = None
    ) -> Sample:
        """Return the next sample of the device.

        `t_rx_ns` is CLOCK_MONOTONIC right after the read of the last byte. It must not fall. If it is constant for more
        frames than time stamps fit before it, the clock increases `t_rx_ns` of the sample by some ns. `utc_offset_ns`
        is CLOCK_REALTIME minus CLOCK_MONOTONIC. `t_begin_ns` is CLOCK_MONOTONIC at the start of the frame on the wire;
        None: computed from its size.
        """
        if self._run is not None:
            self.settle()
        if t_rx_ns < self._t_rx_ns:  # noqa: PLR1730 - a call of max() costs 60 ns on the sample path
            t_rx_ns = self._t_rx_ns
        size_bytes, ticks, byte_ns = m.size_bytes, m.dev_ticks, self._delay.byte_ns or 1
        trailing_ns, host = m.trailing_bytes * byte_ns, self._host
        offset_ns, even_from_ns = host.offset_ns, host.even_from_ns
        on_wire_ns = size_bytes * byte_ns + trailing_ns
        arrival_ns = t_rx_ns - (on_wire_ns + offset_ns) if t_begin_ns is None else host.steady_ns(t_begin_ns)
        if t_begin_ns is None and arrival_ns < even_from_ns:  # the host's rate changed after this time
            arrival_ns = host.steady_ns(t_rx_ns) - on_wire_ns
        if ticks is None and self._stamps is not None and m.pps_age_ms is not None:
            ticks = self._stamped(self._stamps, m.pps_age_ms, arrival_ns)
        if ticks is None or not self._time.tick_ns:
            wanted_ns, t_dev_ns, sync = self._by_arrival(m, ticks, arrival_ns), None, _ARRIVAL
        else:
            wanted_ns = self._by_device(ticks, arrival_ns, trailing_ns, t_rx_ns, size_bytes)
            t_dev_ns, sync = self._time.raw_ns, self._fit_sync
        edge_seq = None
        aiding, slew, own = self._aiding, self._slew, self._own_status
        if aiding is not None:
            if t_dev_ns is not None and (sync is not _ARRIVAL or self._holdover is not None):
                wanted_ns, slew = self._steered(aiding, m, wanted_ns, arrival_ns), aiding.slew
                sync, edge_seq = aiding.sync, aiding.edge_seq
            self._sync = sync
        error_ns, steady_ns = self._error_ns, wanted_ns if wanted_ns <= arrival_ns else arrival_ns
        t_ns = steady_ns + offset_ns
        if steady_ns < even_from_ns:
            t_ns, error_ns = min(host.monotonic_ns(steady_ns), t_rx_ns), error_ns + host.error_ns(steady_ns)
        # time stamps rise strictly
        if t_ns <= self._t_ns:
            steady_ns += self._t_ns + 1 - t_ns
            t_ns = self._t_ns + 1
        if steady_ns != wanted_ns:
            slew.add(steady_ns - wanted_ns)  # the next samples remove the correction slowly
            error_ns += abs(steady_ns - wanted_ns)
        if t_ns > t_rx_ns:  # noqa: PLR1730 - as above
            t_rx_ns = t_ns
        self._t_ns, self._t_rx_ns = t_ns, t_rx_ns
        self._seq = seq = self._seq + 1
        self._t_err_ns = t_err_ns = int(error_ns) + 1 if error_ns < _T_ERR_MOST else T_ERR_MOST
        if aiding is not None and aiding.marks is not None:
            aiding.marks.add_sample(t_ns - aiding.sout_offset_ns, seq, self._period_ns())
        return Sample(
            self._device, seq, t_ns, t_err_ns, sync, t_rx_ns, t_ns + utc_offset_ns, t_dev_ns,
            m.accel_m_s2, m.gyro_rad_s, m.mag_t, m.quat_wxyz, m.euler_rad, m.temperature_c, m.pressure_pa,
            m.incli_rad, m.status if own is None else own | (m.status or 0), m.pps_age_ms, edge_seq,
            m.velocity_enu_m_s, m.position, m.heave_m, m.gnss_utc_ns,
        )  # fmt: skip

    def add_run(
        self, samples: list[Sample], events: Sequence[object], at: int, t_rx_ns: int, utc_offset_ns: int
    ) -> int:
        """Append samples of `events` from index `at` on. Return the index of the first event that needs `sample`."""
        if self._run is not None:
            self.settle()
        time, fit, sync = self._time, self._fit, self._fit_sync
        unusual = time.watched or time.rephased or self._jump.late_reads or self._slew.left_ns
        if sync is _ARRIVAL or fit is None or unusual or self._aiding is not None:
            return at
        before = len(samples)
        start = RunStart(
            self._device, self._seq, self._t_ns, max(t_rx_ns, self._t_rx_ns), utc_offset_ns, self._delay.byte_ns or 1,
            self.waited_ns, self._fit_bias_ns, self._fit_error_ns, sync, self._own_status,
        )  # fmt: skip
        error_ns = add_even_run(samples, events, at, start, time, fit, self._host)
        if len(samples) > before:
            newest = samples[-1]
            self._seq, self._t_ns, self._t_rx_ns = newest.seq, newest.t_ns, newest.t_rx_ns
            self._t_err_ns, self._error_ns, self.missed = newest.t_err_ns, error_ns, 0
        return at + len(samples) - before

    @property
    def t_ns(self) -> int:
        """Time stamp of the newest sample."""
        return self._t_ns if self._run is None else int(self._run.t_ns)

    def t_rx_ns(self) -> int:  # a property would cost 500 instructions
        """Return CLOCK_MONOTONIC at the read of the newest sample."""
        return self._t_rx_ns if self._run is None else self._run.t_rx_ns

    def stamp_frames(
        self, start: StartRun, kind: KernelFormat, frames: bytes, word_is_status: bool, t_rx_ns: int, utc_offset_ns: int
    ) -> bytes:
        """Return the slots of the usual frames of a kind at the start of the bytes, as `add_run`; empty if `sample` or
        `add_run` must process the first frame. The kernel then keeps the state until `settle`."""
        run, host = self._run, self._host
        if run is None and (run := self._start_run(start, kind)) is None:
            return b""
        try:
            slots: bytes = run.stamp(
                frames, word_is_status, t_rx_ns, utc_offset_ns, self.waited_ns, host.offset_ns, host.even_from_ns
            )
        except OverflowError:  # a value with more than 64 bits
            return b""
        if slots:
            self._run, self.missed = run, 0
        return slots

    def _start_run(self, start: StartRun, kind: KernelFormat) -> Any:
        """Return a run of the kernel with the present state; None if the next frames need Python."""
        time, fit = self._time, self._fit
        if (
            self._fit_sync is _ARRIVAL or fit is None or self._aiding is not None or time.watched or time.rephased
            or self._jump.late_reads or time.modulus != _KERNEL_MODULUS
        ):  # fmt: skip
            return None
        try:
            return start(
                kind.name, (
                    SYNC_CODES[self._fit_sync], -1 if self._own_status is None else self._own_status, self._seq,
                    self._t_ns, self._t_rx_ns, self._delay.byte_ns or 1, self._fit_bias_ns, self._fit_error_ns,
                ),
                (
                    time.ticks, time.even_ns, time.raw_ns, time.tick_ns, time.period.period_ticks, time.doubt_ns,
                    fit.ref_arrival_ns, fit.ref_device_ns, fit.fitted_ns, fit.until_ns, fit.slope, fit.slope_error,
                    fit.wait_most, self._fit_begin_ns, self._slew.left_ns,
                ),
                fit.open_bin(), StampTime.NO_STATE if self._stamps is None else self._stamps.state(),
            )  # fmt: skip
        except OverflowError:  # a value with more than 64 bits, for example after many jumps of the counter
            return None

    def settle(self) -> None:
        """Copy the state of the kernel back, and end its run. Do nothing without a run."""
        run, self._run = self._run, None
        if run is None:
            return
        fit = self._fit
        assert fit is not None
        frames, ticks, self._seq, self._t_ns, self._t_rx_ns, error_ns, left_ns, open_bin, added, stamps = run.state()
        self._slew.set(left_ns)
        if self._stamps is not None and stamps is not None:
            self._stamps.set_state(stamps)
        self._time.advance_evenly(ticks, frames)
        fit.set_open_bin(open_bin, added)
        self._error_ns = error_ns
        self._t_err_ns = int(error_ns) + 1 if error_ns < _T_ERR_MOST else T_ERR_MOST

    def sample_polled(
        self, m: Measurement, t_ns: int, t_err_ns: int, t_rx_ns: int, utc_offset_ns: int, edge_seq: int | None = None
    ) -> Sample:
        """Return the next sample of a device that imud polls.

        `t_ns` is CLOCK_MONOTONIC right before the poll, or of the data-ready edge with the number `edge_seq`.
        `t_err_ns` is its one-sigma error. `t_rx_ns` is CLOCK_MONOTONIC right after the reply. If `t_ns` does not rise,
        the clock increases `t_ns` and the error.
        """
        self.missed, self._fit_sync = 0, _ARRIVAL if edge_seq is None else Sync.EDGE
        self._arrivals.spread.add_arrival(t_ns)
        t_err_ns = min(t_err_ns + max(0, self._t_ns + 1 - t_ns), T_ERR_MOST)
        self._t_ns = t_ns = max(t_ns, self._t_ns + 1)
        self._t_rx_ns = t_rx_ns = max(t_rx_ns, self._t_rx_ns, t_ns)
        self._seq, self._t_err_ns = self._seq + 1, t_err_ns
        return Sample(
            self._device, self._seq, t_ns, t_err_ns, self._fit_sync, t_rx_ns, t_ns + utc_offset_ns, None,
            m.accel_m_s2, m.gyro_rad_s, m.mag_t, m.quat_wxyz, m.euler_rad, m.temperature_c, m.pressure_pa,
            m.incli_rad, m.status, m.pps_age_ms, edge_seq, m.velocity_enu_m_s, m.position, m.heave_m, m.gnss_utc_ns,
        )  # fmt: skip

    # --- aiding sources ------------------------------------------------------------------------------------------

    def _sources(self) -> AidingSources:
        """Return the aiding sources. Create them at the first use, because the clock is faster without them."""
        self.settle()
        if self._aiding is None:
            self._aiding = self._make_aiding()
        return self._aiding

    def add_edges(self, line: str, edges: Sequence[Edge]) -> None:
        """Add edges of the line `sout`, `sout_div` or `pps` before the frames that follow them."""
        if line == "sout":
            self._sources().on_sout_edges(edges)
        elif line == "sout_div":
            self._sources().on_divided_edges(edges)
        elif line == "pps":
            self._sources().on_pps_edges(edges)
        if self.observer is not None:
            self.observer.edges(line, edges)

    def add_triggers(self, stamps: Sequence[TriggerStamp]) -> None:
        """Add triggers of imud on SIN before the frames that answer them."""
        self._sources().on_trigger_stamps(stamps)
        if self.observer is not None:
            self.observer.call("aiding", "on_trigger_stamps", stamps)

    def set_utc_reference(self, reference: UtcReference | None) -> None:
        """Set the host's estimate of UTC, or None. The clock uses it to detect a device with UTC."""
        if reference is not None or self._aiding is not None:
            self._sources().set_utc_reference(reference)
        if self.observer is not None:
            self.observer.call("clock", "set_utc_reference", reference)

    @property
    def utc_reference(self) -> UtcReference | None:
        """Return the host's estimate of UTC; None if unknown."""
        return self._aiding.utc_reference if self._aiding else None

    def set_own_status(self, bits: int | None) -> None:
        """Set status bits of imud, which `sample` adds to the status of the next samples. None removes them."""
        self.settle()
        self._own_status = bits
        if self.observer is not None:
            self.observer.call("clock", "set_own_status", bits)

    def take_marks(self) -> list[Mark]:
        """Return the new SOUT_DIV pulses with their sample, in order. Each pulse is returned once."""
        marks = self._aiding.marks if self._aiding is not None else None
        return marks.take_marks() if marks is not None else []

    # --- state ---------------------------------------------------------------------------------------------------

    @property
    def expected_rate_hz(self) -> float:
        """Return the sample rate according to the device counter, Hz in host time; 0 if unknown."""
        period_ns = self._period_ns()
        if self._line is not None and self._fit is not None:
            period_ns *= self._line.slope / self._fit.slope  # the slope of the fit is inaccurate if frames wait
        return NS_PER_S / period_ns if period_ns else 0.0

    @property
    def resets(self) -> int:
        """Number of resets of the device counter."""
        return self._resets + self._arrivals.resets

    @property
    def has_open_gap(self) -> bool:
        """Whether the next sample shows if the samples of the newest gap are lost, or late."""
        return self._time.has_open_gap

    def take_open_gap(self) -> int:
        """Return the number of samples of the open gap, which are lost. Close the gap."""
        return self._time.take_open()

    @property
    def has_scattered_time(self) -> bool:
        """Whether the device time does not show lost samples, because it scatters."""
        return self._time.period.is_scattered

    def status(self) -> ClockStatus:
        self.settle()
        fit = self._fit if self._fit_sync is not Sync.ARRIVAL else None
        sync, spread_ns = self._sync if self._aiding else self._fit_sync, self._arrivals.spread.sigma_ns
        tick_error_ns = self._time.error_ns if self._error_ns else None  # a poll sets no `_error_ns`
        status = ClockStatus(
            sync, self._t_ns - self._time.raw_ns if self._known else 0, (1 / fit.slope - 1) * 1e6 if fit else 0.0,
            int(fit.residual_ns if fit else spread_ns), self._t_err_ns, self.resets, self._delay.hold_ns,
            steering_ppm=self._host.rate * 1e6,
            parts=error_parts(sync, self._t_err_ns, self._delay, fit or self._arrivals.fit, spread_ns, tick_error_ns),
        )  # fmt: skip
        return self._aiding.add_status(status) if self._aiding else status

    def link_changed(self, *, byte_ns: int, hold_ns: int) -> None:
        """Start a new fit, for another baud rate or port."""
        self.settle()
        self._delay = LinkDelay(byte_ns, hold_ns)
        self._arrivals.change_link(self._delay)
        self._drop_fit()
        if self.observer is not None:
            self.observer.call("clock", "link_changed", byte_ns=byte_ns, hold_ns=hold_ns)

    def restart(self) -> None:
        """Start again after the device or the link was missing. This does not count as a reset. If the device counter
        continued, the clock counts the lost samples. Otherwise the gap has an unknown size."""
        self.settle()
        self._known, self.missed = False, 0
        self._time.period.restart()
        self._arrivals.restart()
        if self._stamps is not None:
            self._stamps.restart()
        self._drop_fit()
        if self.observer is not None:
            self.observer.call("clock", "restart")

    def expect_rate(self) -> None:
        """Expect another sample rate: imud sends a request that can change it. Count no losses by the previous rate."""
        self.settle()
        self._time.change.expect(self._time.even_ns)
        if self.observer is not None:
            self.observer.call("clock", "expect_rate")

    def continue_from(self, other: "SampleClock") -> None:
        """Continue the sequence numbers and time stamps of another clock of the same device."""
        other.settle()
        self._seq, self._t_ns, self._t_rx_ns = other._seq, other._t_ns, other._t_rx_ns
        self.set_utc_reference(other.utc_reference)

    def _stamped(self, stamps: StampTime, stamp: int, arrival_ns: int) -> int | None:
        """Return the ticks of a frame with `pps_age_ms` only; None if `pps_age_ms` is not usable for the time stamp."""
        was_in_use = stamps.in_use
        ticks = stamps.ticks(stamp, arrival_ns, self._time.ticks if self._known else None)
        if was_in_use is not stamps.in_use:
            self._known, self._line = stamps.in_use, None
            self._drop_fit()
            self._time.begin(stamps.before)
        return ticks

    def _by_arrival(self, m: Measurement, ticks: int | None, arrival_ns: int) -> int:
        """Return the time of a frame without device time, which may have a number. Set `_error_ns`."""
        arrivals = self._arrivals
        t_ns = arrivals.time_stamp(
            ticks, arrival_ns, m.size_bytes, alone=not self._known, triggered=m.pps_age_ms is not None,
            is_first=not self._seq,
        )  # fmt: skip
        self.missed, self._error_ns = arrivals.missed, arrivals.error_ns
        return t_ns

    def _less_bias(self, arrival_ns: int, size_bytes: int) -> int:
        """Return the time of a frame before the fit is in use. Set `_error_ns`."""
        t_ns, self._error_ns = self._delay.before(arrival_ns, size_bytes, self._period_ns(), float(FIRST_SPREAD_NS))
        self._error_ns += self.waited_ns
        return t_ns

    # --- by device time ------------------------------------------------------------------------------------------

    def _by_device(self, ticks: int, arrival_ns: int, trailing_ns: int, t_rx_ns: int, size_bytes: int) -> int:
        """Return the time of a frame with device time. Set `_error_ns`."""
        time, fit = self._time, self._fit
        if fit is None:
            self._begin(ticks, arrival_ns, t_rx_ns)
            return self._less_bias(arrival_ns, size_bytes)
        before_ns = time.even_ns
        time.advance(ticks)
        device_ns = time.even_ns
        fit_ns = fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)
        above_ns = arrival_ns - fit_ns
        if waited := self.waited_ns and above_ns > 0.0:  # arrival is between the fit and the read
            arrival_ns -= int(min(above_ns, self.waited_ns))
            above_ns = max(above_ns - self.waited_ns, 0.0)
        if time.rephased:
            return self._begin_phase(fit, device_ns, arrival_ns, size_bytes)
        if (
            time.watched
            and self._fit_sync is not _ARRIVAL
            and (above_ns >= _EARLY_NS or not self._ran_on(device_ns, arrival_ns))
            and time.absorb_correction(fit, before_ns, arrival_ns)
        ):
            device_ns = time.even_ns
            fit_ns = fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)
            above_ns = arrival_ns - fit_ns
        # late reads: frames after a long pause of the host
        odd = above_ns < _EARLY_NS or above_ns > JUMP_LATE_NS or self._jump.late_reads
        if odd and self._jump.is_jump(
            fit, above_ns, device_ns - before_ns, None if self._fit_sync is _ARRIVAL else self._fit_error_ns, t_rx_ns,
            self._t_rx_ns,
        ):  # fmt: skip
            step_ns = device_ns - before_ns if above_ns < 0.0 else self._jump.first_step_ns
            return self._after_jump(above_ns, ticks, arrival_ns, size_bytes, time.has_continued(step_ns))
        self.missed = time.missed
        if not waited and fit.add_arrival(device_ns, arrival_ns, trailing_ns, above_ns):
            if self._jump.stood_still(fit, self._fit_error_ns):
                # All frames stay late: the link delays them, or the device counter stopped for a time. The counter
                # continued, so this is no reset.
                self._start_fit(arrival_ns)
            elif other := self._delay.corrected(fit, self._period_ns(), size_bytes):
                self._delay = other  # the link has another delay than expected
                self._start_fit(arrival_ns)
            else:
                fit_ns = self._refit(fit, device_ns, device_ns - before_ns, fit_ns, size_bytes)
        if self._fit_sync is _ARRIVAL:
            if self._holdover is not None:
                self._error_ns = self._holdover.error_ns(device_ns)
                return self._holdover.at(device_ns)
            return self._less_bias(arrival_ns, size_bytes)
        slew = self._slew
        error_ns = self._fit_error_ns + fit.slope_error * (device_ns - fit.fitted_ns) + time.doubt_ns
        fit_ns -= self._fit_bias_ns
        if slew.left_ns:
            left_ns = slew.advance(device_ns - before_ns, device_ns - self._fit_begin_ns)
            fit_ns, error_ns = fit_ns + left_ns, error_ns + abs(left_ns)
        self._error_ns = error_ns if above_ns < JUMP_LATE_NS else error_ns + above_ns
        return int(fit_ns)

    def _begin(self, ticks: int, arrival_ns: int, t_rx_ns: int) -> None:
        """Start a fit: for a new device, or for a device that continued its counter while the link changed."""
        time, line = self._time, self._line
        elapsed_ns = time.elapsed_ns(ticks)
        if self._known and (
            elapsed_ns <= SLOPE_HIGHEST * (t_rx_ns - self._t_rx_ns) + FIRST_EARLY_NS
            or (line is not None and line.carries(time.even_ns + elapsed_ns, arrival_ns))
        ):
            time.advance(ticks)
            self.missed = time.missed
        else:
            missed = time.missed_since(line, ticks, arrival_ns) if line is not None and not self._known else None
            self._begin_counter(ticks, arrival_ns, missed, time.take_open())
            self._resets += self._known
            self._known = True
        self._start_fit(arrival_ns)

    def _begin_counter(self, ticks: int, arrival_ns: int, missed: int | None, missed_before: int) -> None:
        """Start with a new counter value. `missed` is the number of samples that are lost directly before it, None if
        unknown; `missed_before` is the number of samples of an earlier gap."""
        if missed is None and self._seq:
            period_ns = self._period_ns()
            if not period_ns or arrival_ns - self._host.steady_ns(self._t_ns) >= GAP_PERIODS * period_ns:
                self._on_unknown_gap()
        self.missed = (missed or 0) + missed_before
        self._line = None
        self._time.begin(ticks)

    def _after_jump(self, above_ns: float, ticks: int, arrival_ns: int, size_bytes: int, has_continued: bool) -> int:
        """Return the time of the first frame after a jump of the counter: by UTC if known, else by arrival.

        `has_continued`: whether the step of the counter is usual. The counter then only seems to jump: frames in the
        fit were delayed, for example by a serial device server, or the present frames are delayed. This is no reset.
        """
        aiding, time = self._aiding, self._time
        ran_on = above_ns > 0.0 or has_continued or self._ran_on(time.even_ns, arrival_ns)
        if aiding is not None:
            utc_ns = aiding.utc.above(ticks, arrival_ns, FIRST_SPREAD_NS + self._delay.hold_ns)
            if utc_ns is not None:
                utc_ns += arrival_ns + time.tick_ns // 2
                missed = time.missed - time.missed_before + time.take_open()
                return self._hold_over(aiding, ticks, arrival_ns, utc_ns, missed if ran_on else None)
        if ran_on:
            if above_ns > 0.0 and self._jump.is_late_since_gap(time.period.period_ticks * time.tick_ns):
                self._on_unknown_gap()
            self._resets += above_ns > 0.0 and not has_continued
            self.missed = time.missed
        else:
            self._resets += 1
            time.take_open()  # the step between two counters does not show lost samples
            self._begin_counter(ticks, arrival_ns, None, time.missed_before)
        self._start_fit(arrival_ns)
        return self._less_bias(arrival_ns, size_bytes)

    def _ran_on(self, device_ns: int, arrival_ns: int) -> bool:
        """Return whether the counter continued at a frame below the fit. In this case, the fit is late."""
        return self._line is not None and self._line.carries(device_ns, arrival_ns)

    def _hold_over(self, aiding: AidingSources, ticks: int, arrival_ns: int, utc_ns: int, missed: int | None) -> int:
        """Return the time of a frame after a jump of its counter to UTC or within UTC. Start holdover."""
        period_ns, tick_ns, error_ns = self._period_ns() or 1.0, self._time.tick_ns, float(self._t_err_ns)
        newest_ns = self._host.steady_ns(self._t_ns)
        steps = max(round((utc_ns - newest_ns) / period_ns), 1)
        t_ns = newest_ns + int(steps * period_ns)
        unknown = self._fit_sync is _ARRIVAL and self._holdover is None
        if unknown or abs(t_ns - utc_ns) > tick_ns + 2 * error_ns:
            t_ns, error_ns = max(utc_ns, newest_ns + 1), aiding.utc.tick_error_ns  # the device restarted its sampling
        elif missed is None and error_ns + tick_ns < period_ns:
            missed = steps - 1
        self._begin_counter(ticks, arrival_ns, missed, self._time.missed_before)
        self._start_fit(arrival_ns)
        aiding.utc.confirm()
        self._holdover = holdover = Holdover(self._fit_begin_ns, t_ns, error_ns, tick_ns)
        self._error_ns = holdover.error_ns(self._fit_begin_ns)
        self._fit_begin_ns -= SETTLED_AFTER_NS  # corrections stay slow, because the time stamps continue
        return t_ns

    def _begin_phase(self, fit: ArrivalFit, device_ns: int, arrival_ns: int, size_bytes: int) -> int:
        """Return the time of a sample after a change of the device's rate. Its position in the tick is unknown."""
        # The rate of the crystal did not change. The clock keeps this rate, and uses the previous fit until a new fit
        # is accurate.
        self._time.rephased, self.missed = False, self._time.missed
        holdover, slope, slope_error = self._holdover, fit.slope, fit.slope_error
        if self._fit_sync is not _ARRIVAL:
            t_ns = fit.ref_arrival_ns + slope * (device_ns - fit.ref_device_ns) - self._fit_bias_ns + self._slew.left_ns
            error_ns = self._fit_error_ns + slope_error * (device_ns - fit.fitted_ns) + abs(self._slew.left_ns)
            holdover = Holdover(device_ns, int(t_ns), error_ns, self._time.tick_ns, ENOUGH_SPAN_NS, slope, slope_error)
        self._start_fit(arrival_ns, slope, slope_error)
        self._holdover = holdover
        self._error_ns = holdover.error_ns(device_ns) if holdover is not None else 0.0
        return holdover.at(device_ns) if holdover is not None else self._less_bias(arrival_ns, size_bytes)

    def _start_fit(self, arrival_ns: int, slope: float = 1.0, slope_error: float = SLOPE_HIGHEST - 1) -> None:
        self._drop_fit()
        self._fit_begin_ns = self._time.even_ns
        self._fit = ArrivalFit(self._fit_begin_ns, arrival_ns, self._delay.hold_ns, slope, slope_error)

    def _drop_fit(self) -> None:
        self._fit, self._holdover, self._fit_sync = None, None, _ARRIVAL
        self._jump.reset()
        self._slew.set(0.0)
        if self._aiding is not None:
            self._aiding.restart()

    def _refit(self, fit: ArrivalFit, device_ns: int, elapsed_ns: int, fit_ns_before: float, size_bytes: int) -> float:
        """Use a changed fit without a step of the time stamps. Return the value of the fit at `device_ns`."""
        delay = self._delay
        period_ns = self._period_ns()
        fit_ns = fit.ref_arrival_ns + fit.slope * (device_ns - fit.ref_device_ns)
        published_ns = fit_ns_before - self._fit_bias_ns + self._slew.left_ns
        if period_ns:
            fit.set_pause(delay.held_ns(period_ns, size_bytes), int(delay.hold_ns / period_ns) + 2)
        self._fit_bias_ns = delay.floor_ns / 2 + fit.shift_ns
        self._fit_error_ns = hypot(fit.error_ns, delay.bias_error_ns(fit.hidden_ns)) + self._time.error_ns
        if delay.hold_ns and fit.span_ns < YOUNG_NS:
            self._fit_error_ns *= YOUNG_FACTOR
        if self._fit_sync is not _ARRIVAL:
            self._slew.set(published_ns - (fit_ns - self._fit_bias_ns))
        elif fit.is_known(self._holdover.least_ns if self._holdover else ENOUGH_SPAN_NS):
            self._fit_sync = Sync.REGRESSION
            newest_ns = self._host.steady_ns(self._t_ns)
            held_ns = self._holdover.at(device_ns) if self._holdover else newest_ns + elapsed_ns * fit.slope
            self._holdover = None
            self._slew.set(held_ns - (fit_ns - self._fit_bias_ns))
        if self._line is not None:
            self._line.follow(fit, self._fit_error_ns)
        elif self._fit_sync is not _ARRIVAL:
            self._line = CounterLine(fit, self._fit_error_ns)
        return fit_ns

    def _steered(self, aiding: AidingSources, m: Measurement, fit_ns: int, arrival_ns: int) -> int:
        """Return the time of a frame, corrected by the aiding sources. Set `_error_ns`."""
        device_ns, fit = self._time.even_ns, self._holdover or self._fit
        assert fit is not None
        t_ns = aiding.steer(
            m, device_ns, arrival_ns, fit_ns, self._error_ns, self._fit_sync, self._period_ns(), fit.slope,
            fit.slope_error, device_ns - self._fit_begin_ns,
        )  # fmt: skip
        self._error_ns = aiding.error_ns
        return t_ns

    def _period_ns(self) -> float:
        time, fit = self._time, self._fit
        if not time.tick_ns:
            return self._arrivals.spread.period_ns
        return time.period.period_ticks * time.tick_ns * (fit.slope if fit else 1.0)
