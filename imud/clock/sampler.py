"""The clock of one device: the only maker of `Sample`. It gives each measurement its place in the host's time.

Per message: device time is unwrapped and checked against the host's (`unwrap`, `_believable`), the point (device time,
arrival less wire time) goes to the lower envelope (`envelope`), and the line of the envelope, less half of the bias
the link can hide (`arrival`), is the time of measurement; corrections are slewed (`slew`). Until the line has enough
behind it, and for devices without time, a message is dated by its arrival. Lines beside the data and UTC improve on
that (`aids`) where there are any; without them they cost a comparison.

Three rules hold for any input: `t_ns` rises strictly, is never after arrival, and a device clock that jumps starts a
new fit instead of carrying the stamps along.
Synchronization: none; one thread.
"""

from math import hypot, sqrt
from typing import Final

from imud.clock.aids import AidingSources
from imud.clock.arrival import FIRST_SPREAD_NS, ArrivalSpread, LinkDelay
from imud.clock.coast import Holdover
from imud.clock.correction import corrected
from imud.clock.envelope import SLOPE_HIGHEST, Envelope
from imud.clock.inputs import LineInputs
from imud.clock.jump import EARLY_NS, EARLY_SIGMAS, FIRST_EARLY_NS, LATE_NS, Jump
from imud.clock.number import SampleNumber
from imud.clock.slew import SETTLED_AFTER_NS, Slew
from imud.clock.unwrap import DeviceTime
from imud.contracts.status import ClockStatus
from imud.contracts.timing import NO_TIME_BITS, SoutTiming, TimeBits, TriggerTiming
from imud.sample import Measurement, Sample, Sync
from imud.units import NS_PER_MS, NS_PER_S

ENOUGH_POINTS: Final = 8
ENOUGH_SPAN_NS: Final = 100 * NS_PER_MS
ENOUGH_HOLDS: Final = 20
"""A line counts once it is laid under so many points, and spans so much time or so many periods of a latency timer."""
COAST_NS: Final = 16 * NS_PER_S
"""The same where a known line goes on: a young one swings, and the known one is 0.3 ms off by then at worst."""
YOUNG_NS: Final = 32 * NS_PER_S
YOUNG_FACTOR: Final = 1.5
"""A corridor this short has not seen the timer's beat, and a stalled read in it weighs more."""
T_ERR_MOST: Final = 0xFFFF_FFFF
"""`t_err_ns` is 32 bits wide wherever it is published."""
SIGMA_OF_RANGE: Final = 1 / sqrt(12)
WIRE_SLACK: Final = 1.05
"""Messages that follow each other this much faster than the wire can carry them did not come over such a wire."""
_ARRIVAL: Final = Sync.ARRIVAL


class SampleClock(LineInputs):
    """Makes samples of one device's measurements.

    `tick_ns` and `tick_modulus` describe the device's counter, `byte_ns` is the time of a byte on the wire (0: none
    known), `hold_ns` how long an adapter may hold bytes back (USB latency timer). A counter with `tick_ns` 0 numbers
    the samples: it tells how many are missing, and the arrivals tell when they were. `bits`, `sout` and `sin` are for
    lines, which are given to the methods of `LineInputs`.
    """

    def __init__(
        self,
        device: str,
        *,
        tick_ns: int,
        tick_modulus: int,
        byte_ns: int,
        hold_ns: int,
        bits: TimeBits = NO_TIME_BITS,
        sout: SoutTiming | None = None,
        sin: TriggerTiming | None = None,
    ) -> None:
        super().__init__(tick_ns, tick_modulus, bits, sout, sin)
        self._device = device
        self._time = DeviceTime(tick_ns, tick_modulus)
        self._number = SampleNumber(tick_modulus) if tick_ns == 0 else None
        self._delay = LinkDelay(byte_ns, hold_ns)
        self._spread = ArrivalSpread()
        self._slew = Slew()
        self._envelope: Envelope | None = None
        self._coast: Holdover | None = None
        self._sync = Sync.ARRIVAL
        """By the fit of arrivals."""
        self._told_sync = Sync.ARRIVAL
        self._seq = 0
        self._t_ns = 0
        self._t_err_ns = 0
        self._t_err = 0.0
        self._t_rx_ns = 0
        self._resets = 0
        self._begun = False
        self._epoch_x = 0
        self._shift_ns = 0.0
        self._error_ns = 0.0
        self._jump = Jump()
        self.missed = 0
        """Samples missing right before the newest one, by device time."""

    def sample(self, m: Measurement, t_rx_ns: int, utc_offset_ns: int, t_begin_ns: int | None = None) -> Sample:
        """The measurement with its place in time, as the next sample of the device.

        `t_rx_ns` is CLOCK_MONOTONIC right after the read that completed the message; it must not fall. Where it stands
        still for more messages than there is room for before it, `t_rx_ns` of the sample is lifted by nanoseconds.
        `utc_offset_ns` is CLOCK_REALTIME minus CLOCK_MONOTONIC at the same moment. `t_begin_ns` is CLOCK_MONOTONIC when
        the message began on the wire, where that is known (its first frame came earlier); None: by its size.
        """
        if t_rx_ns < self._t_rx_ns:  # noqa: PLR1730 - a call of max() costs 60 ns on the sample path
            t_rx_ns = self._t_rx_ns
        size_bytes, ticks = m.size_bytes, m.dev_ticks
        byte_ns = self._delay.byte_ns or 1
        trailing_ns = m.trailing_bytes * byte_ns
        y = t_rx_ns - size_bytes * byte_ns - trailing_ns if t_begin_ns is None else t_begin_ns
        if ticks is None or self._number is not None:
            wanted, t_dev_ns, sync = self._by_arrival(ticks, y, size_bytes), None, _ARRIVAL
        else:
            wanted = self._by_device(ticks, y, trailing_ns, t_rx_ns, size_bytes)
            t_dev_ns, sync = self._time.raw_ns, self._sync
        edge_seq, aids, slew, own = None, self._aids, self._slew, self.own_status
        if aids is not None:
            if t_dev_ns is not None and (sync is not _ARRIVAL or self._coast is not None):
                wanted, slew = self._steered(aids, m, wanted, y), aids.slew
                sync, edge_seq = aids.sync, aids.edge_seq
            self._told_sync = sync
        t_ns = wanted if wanted <= y else y
        if t_ns <= self._t_ns:
            t_ns = self._t_ns + 1
        t_err = self._t_err
        if t_ns != wanted:
            slew.left_ns += t_ns - wanted
            t_err += abs(t_ns - wanted)
        if t_ns > t_rx_ns:  # noqa: PLR1730 - as above
            t_rx_ns = t_ns
        self._t_ns, self._t_rx_ns = t_ns, t_rx_ns
        self._seq = seq = self._seq + 1
        self._t_err_ns = t_err_ns = int(t_err) + 1 if t_err < T_ERR_MOST else T_ERR_MOST
        if aids is not None and aids.marks is not None:
            aids.marks.take(t_ns - aids.before_measurement_ns, seq, self._period_ns())
        return Sample(
            self._device, seq, t_ns, t_err_ns, sync, t_rx_ns, t_ns + utc_offset_ns, t_dev_ns,
            m.accel_m_s2, m.gyro_rad_s, m.mag_t, m.quat_wxyz, m.euler_rad, m.temperature_c, m.pressure_pa,
            m.incli_rad, m.status if own is None else own | (m.status or 0), m.pps_age_ms, edge_seq,
        )  # fmt: skip

    def sample_asked(
        self, m: Measurement, t_ns: int, t_err_ns: int, t_rx_ns: int, utc_offset_ns: int, edge_seq: int | None = None
    ) -> Sample:
        """A measurement that the host asked for, as the next sample of the device.

        `t_ns` is CLOCK_MONOTONIC right before the asking, or by the data-ready edge of number `edge_seq`; `t_err_ns` is
        its one-sigma error, `t_rx_ns` right after the answer. A `t_ns` that does not rise is lifted, and the error too.
        """
        self.missed, self._sync = 0, _ARRIVAL if edge_seq is None else Sync.EDGE
        self._spread.add(t_ns)
        t_err_ns = min(t_err_ns + max(0, self._t_ns + 1 - t_ns), T_ERR_MOST)
        self._t_ns = t_ns = max(t_ns, self._t_ns + 1)
        self._t_rx_ns = t_rx_ns = max(t_rx_ns, self._t_rx_ns, t_ns)
        self._seq, self._t_err_ns = self._seq + 1, t_err_ns
        return Sample(
            self._device, self._seq, t_ns, t_err_ns, self._sync, t_rx_ns, t_ns + utc_offset_ns, None,
            m.accel_m_s2, m.gyro_rad_s, m.mag_t, m.quat_wxyz, m.euler_rad, m.temperature_c, m.pressure_pa,
            m.incli_rad, m.status, m.pps_age_ms, edge_seq,
        )  # fmt: skip

    @property
    def expected_rate_hz(self) -> float:
        """Samples per second of the host by the device's own stamps; 0 while unknown."""
        period_ns = self._period_ns()
        return NS_PER_S / period_ns if period_ns else 0.0

    def status(self) -> ClockStatus:
        """The state of the estimate at the newest sample."""
        fitted = self._envelope if self._sync is not Sync.ARRIVAL else None
        aids = self._aids
        sout, sin = (aids.sout, aids.sin) if aids else (None, None)
        first = sout or sin
        return ClockStatus(
            sync=self._told_sync if aids else self._sync,
            offset_ns=self._t_ns - self._time.raw_ns if self._begun else 0,
            skew_ppm=(1 / fitted.slope - 1) * 1e6 if fitted else 0.0,
            residual_ns=int(fitted.residual_ns if fitted else self._spread.sigma_ns),
            t_err_ns=self._t_err_ns,
            resets=self._resets,
            hold_ns=self._delay.hold_ns,
            edges=first.pairing.events if first else 0,
            edges_unpaired=sout.pairing.events_unpaired if sout else 0,
            samples_unpaired=first.pairing.samples_unpaired if first else 0,
            triggers_missed=sin.pairing.events_unpaired if sin else 0,
            reference_error_ns=self.reference.error_ns if self.reference else 0,
        )

    def link_changed(self, *, byte_ns: int, hold_ns: int) -> None:
        """Another baud rate or port: what is known of arrivals no longer holds. `t_ns` goes on rising."""
        self._delay = LinkDelay(byte_ns, hold_ns)
        self._spread = ArrivalSpread()
        self._forget()

    def restart(self) -> None:
        """The device or the link came back: the next stamp begins anew and counts neither as a reset nor as a gap."""
        self._begun = False
        self._spread = ArrivalSpread()
        if self._number is not None:
            self._number.begun = False
        self.missed = 0
        self._forget()

    def follow(self, other: "SampleClock") -> None:
        """Go on where another clock of the same device ends: `seq` and `t_ns` keep rising."""
        self._seq, self._t_ns, self._t_rx_ns = other._seq, other._t_ns, other._t_rx_ns
        self.reference = other.reference

    # --- by arrival ----------------------------------------------------------------------------------------------

    def _by_arrival(self, ticks: int | None, y: int, size_bytes: int) -> int:
        """Time of a message without device time; it may have a number."""
        spread, number = self._spread, self._number
        self.missed = 0
        if number is None or ticks is None:
            spread.add(y)
        else:
            steps = number.steps(ticks, y, spread.period_ns)
            if steps:
                self.missed = steps - 1
                spread.add(y, steps)
            else:
                self._resets += number.begun
                self._spread = spread = ArrivalSpread()
                spread.add(y)
            number.take(ticks, y)
        return self._from_arrival(y, size_bytes, spread.period_ns, spread.sigma_ns)

    def _from_arrival(self, y: int, size_bytes: int, period_ns: float, sigma_ns: float) -> int:
        bias_ns = self._delay.floor_ns + self._delay.held_ns(period_ns, size_bytes)
        self._t_err = SIGMA_OF_RANGE * bias_ns + sigma_ns
        return y - int(bias_ns / 2)

    # --- by device time ------------------------------------------------------------------------------------------

    def _by_device(self, ticks: int, y: int, trailing_ns: int, t_rx_ns: int, size_bytes: int) -> int:
        """Time of a message with device time; leaves its error in `_t_err`."""
        time, envelope = self._time, self._envelope
        if envelope is None:
            self._begin(ticks, y, t_rx_ns)
            return self._from_arrival(y, size_bytes, self._period_ns(), FIRST_SPREAD_NS)
        x_before = time.even_ns
        time.advance(ticks)
        x = time.even_ns
        line = envelope.y_ref + envelope.slope * (x - envelope.x_ref)
        height = y - line
        if time.watched and self._sync is not _ARRIVAL and corrected(time, envelope, x_before, y):
            x = time.even_ns
            line = envelope.y_ref + envelope.slope * (x - envelope.x_ref)
            height = y - line
        odd = height < -EARLY_NS or height > LATE_NS or self._jump.late_reads
        if odd and self._jumped(height, x - x_before, t_rx_ns):
            told_ns = self._turned(ticks, y)
            if told_ns is not None:
                return told_ns
            self._reset(ticks, y)
            return self._from_arrival(y, size_bytes, self._period_ns(), FIRST_SPREAD_NS)
        self.missed = time.missed
        if envelope.add(x, y, trailing_ns, height):
            if envelope.recent_ns > EARLY_NS + EARLY_SIGMAS * self._error_ns:
                self._reset(ticks, y)  # messages come late for good: the device's clock stood still for a while
            elif not self._wire_carries(size_bytes):
                self._delay = LinkDelay(0, self._delay.hold_ns)
                self._start(y)
            else:
                line = self._refit(x, x - x_before, line, size_bytes)
        if self._sync is _ARRIVAL:
            if self._coast is not None:
                self._t_err = self._coast.error_ns(x)
                return self._coast.at(x)
            return self._from_arrival(y, size_bytes, self._period_ns(), FIRST_SPREAD_NS)
        left = self._slew.over(x - x_before, x - self._epoch_x) if self._slew.left_ns else 0.0
        error = self._error_ns + envelope.slope_error * (x - envelope.x_fit) + abs(left) + time.doubt_ns
        self._t_err = error if height < LATE_NS else error + height
        return int(line - self._shift_ns + left)

    def _begin(self, ticks: int, y: int, t_rx_ns: int) -> None:
        """Take the first stamp of a fit: of a new device, or of one whose clock runs on over a changed link."""
        time = self._time
        if self._begun and time.peek_ns(ticks) <= SLOPE_HIGHEST * (t_rx_ns - self._t_rx_ns) + FIRST_EARLY_NS:
            time.advance(ticks)
        else:
            self._resets += self._begun
            self._begun = True
            time.begin(ticks)
        self.missed = time.missed
        self._start(y)

    def _reset(self, ticks: int, y: int) -> None:
        """The device's clock started anew."""
        self._resets += 1
        self.missed = 0
        self._time.begin(ticks)
        self._start(y)

    def _turned(self, ticks: int, y: int) -> int | None:
        """Time of a message whose counter jumped, if it jumped to UTC or within it; then time goes on over the jump."""
        aids = self._aids
        if aids is None:
            return None
        above = aids.utc.above(ticks, y, FIRST_SPREAD_NS + self._delay.hold_ns)
        if above is None:
            return None
        period_ns, tick_ns, error_ns = self._period_ns() or 1.0, self._time.tick_ns, float(self._t_err_ns)
        by_utc = y + above + tick_ns // 2
        t_ns = self._t_ns + int(max(round((by_utc - self._t_ns) / period_ns), 1) * period_ns)
        unknown = self._sync is _ARRIVAL and self._coast is None
        if unknown or abs(t_ns - by_utc) > tick_ns + 2 * error_ns:
            t_ns, error_ns = max(by_utc, self._t_ns + 1), aids.utc.tick_error_ns  # or the device samples anew
        self.missed = 0
        self._time.begin(ticks)
        self._start(y)
        aids.utc.turned()
        self._coast = coast = Holdover(self._epoch_x, t_ns, error_ns, tick_ns)
        self._t_err = coast.error_ns(self._epoch_x)
        self._epoch_x -= SETTLED_AFTER_NS  # time went on: corrections stay slow
        return t_ns

    def _steered(self, aids: AidingSources, m: Measurement, wanted: int, y: int) -> int:
        """What lines and UTC make of a time by the fit; leaves its error in `_t_err`."""
        x, coast, envelope = self._time.even_ns, self._coast, self._envelope
        assert envelope is not None
        line, age_ns = coast or envelope, x - self._epoch_x
        t_ns = aids.steer(
            m, x, y, wanted, self._t_err, self._sync, self._period_ns(), line.slope, line.slope_error, age_ns
        )
        self._t_err = aids.error_ns
        return t_ns

    def _start(self, y: int) -> None:
        """A new fit from the present device time on."""
        self._forget()
        self._epoch_x = self._time.even_ns
        self._envelope = Envelope(self._epoch_x, y, self._delay.hold_ns)

    def _forget(self) -> None:
        self._envelope = self._coast = None
        self._sync = _ARRIVAL
        self._jump.late_reads = 0
        self._slew.left_ns = 0.0
        if self._aids is not None:
            self._aids.restart()

    def _jumped(self, height: float, elapsed_ns: int, t_rx_ns: int) -> bool:
        """Whether a message so far before or behind the line says that the device's clock jumped."""
        envelope = self._envelope
        assert envelope is not None
        if height < -EARLY_NS:
            return self._jump.early(envelope, height, elapsed_ns, None if self._sync is _ARRIVAL else self._error_ns)
        return self._jump.late(envelope, height, elapsed_ns, t_rx_ns, new_read=t_rx_ns > self._t_rx_ns)

    def _refit(self, x: int, elapsed_ns: int, line_before: float, size_bytes: int) -> float:
        """Take over a line that changed, without a step; returns its value at `x`."""
        envelope = self._envelope
        assert envelope is not None
        delay = self._delay
        period_ns = self._period_ns()
        line = envelope.y_ref + envelope.slope * (x - envelope.x_ref)
        told = line_before - self._shift_ns + self._slew.left_ns
        if period_ns:
            envelope.held_ns = delay.held_ns(period_ns, size_bytes)
            envelope.held_count = int(delay.hold_ns / period_ns) + 2
        bias_ns = delay.floor_ns + envelope.hidden_ns
        self._shift_ns = delay.floor_ns / 2 + envelope.shift_ns
        self._error_ns = hypot(envelope.error_ns, SIGMA_OF_RANGE * bias_ns) + self._time.error_ns
        if delay.hold_ns and envelope.span_ns < YOUNG_NS:
            self._error_ns *= YOUNG_FACTOR
        if self._sync is not _ARRIVAL:
            self._slew.left_ns = told - (line - self._shift_ns)
        elif envelope.count >= ENOUGH_POINTS and envelope.span_ns >= max(
            ENOUGH_SPAN_NS if self._coast is None else COAST_NS, ENOUGH_HOLDS * delay.hold_ns
        ):
            self._sync = Sync.REGRESSION
            told = self._coast.at(x) if self._coast else self._t_ns + elapsed_ns * envelope.slope
            self._coast = None
            self._slew.left_ns = told - (line - self._shift_ns)
        return line

    def _wire_carries(self, size_bytes: int) -> bool:
        """Whether the wire time fits the rate; a pty or a USB device names any baud rate it likes."""
        envelope, period_ns = self._envelope, self._period_ns()
        if envelope is None or not period_ns or envelope.span_ns < NS_PER_S:
            return True
        return period_ns * WIRE_SLACK >= size_bytes * self._delay.byte_ns

    def _period_ns(self) -> float:
        """Host time between samples; 0 while unknown."""
        if self._number is not None:
            return self._spread.period_ns
        time, envelope = self._time, self._envelope
        return time.period.period_ticks * time.tick_ns * (envelope.slope if envelope else 1.0)
