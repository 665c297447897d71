"""Messages of one read in the usual case of the clock: dated in one loop, with the same result as one by one.

The usual case of a message (`SampleClock._by_device`) is that its counter has stepped by exactly one period, that the
fit of arrivals is in use and does not change by it, and that its stamp is neither lifted nor held back. Whatever else a
message is ends the run before it, with nothing changed by it, and is for `SampleClock.sample`. Of 20 messages that were
read together, a message costs a quarter of what it costs alone.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

from imud.clock.arrival_fit import ArrivalFit
from imud.clock.device_time import JUMP_EARLY_NS, JUMP_LATE_NS, DeviceTime
from imud.host_clock import SteadyTime
from imud.sample import T_ERR_MOST, Measurement, Sample, Sync

_EARLY_NS: Final = -JUMP_EARLY_NS
_T_ERR_MOST: Final = float(T_ERR_MOST)


class RunStart(NamedTuple):
    """What holds for all messages of a run; names are those of `SampleClock`."""

    device: str
    seq: int
    """Of the newest sample."""
    t_ns: int
    """Of the newest sample."""
    t_rx_ns: int
    """When the messages were read."""
    utc_offset_ns: int
    byte_ns: int
    waited_ns: int
    bias_ns: float
    error_ns: float
    """Of the fit."""
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
    """Append samples of the events from `at` on, while each is the usual case; return the error of the newest time.

    `time` and `fit` are as after the newest of them.
    """
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
        if step != period_ticks or not step or arrival_ns < even_from_ns:
            break
        next_ns = device_ns + (step_ns := step * tick_ns)
        fit_ns = ref_arrival_ns + slope * (next_ns - ref_device_ns)
        above_ns = arrival_ns - fit_ns
        is_new = not waited_ns or above_ns <= 0.0
        if not is_new:
            above_ns = max(above_ns - waited_ns, 0.0)
        steady_ns = int(fit_ns - bias_ns)
        t_ns = steady_ns + offset_ns
        if (
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
                m.pps_age_ms, None,
            )
        )  # fmt: skip
    if len(samples) > before:
        time.advance_evenly(ticks, len(samples) - before)
    return newest_error_ns
