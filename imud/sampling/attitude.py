"""Attitude of one device from its angular rate and acceleration, for devices that send no attitude.

The library vqf implements the filter VQF (Laidig and Seel, Information Fusion 91, 2023).

The filter integrates the angular rate, corrects roll and pitch with gravity, and estimates the gyro bias at rest and in
motion. Nothing corrects the heading: yaw is the rotation since the start of the filter. The start has yaw 0.

    gap of t_ns          reaction
    up to GAP_MAX_NS     repeat the values of the next sample for each lost sample
    longer               restart the filter with the last heading and the last gyro bias

The filter has a fixed period: it is the median interval of the last BLOCK samples. imud scales the angular rate by the
real interval. If the median changes by more than PERIOD_CHANGE, imud restarts the filter with the new period.
"""

from collections.abc import Sequence
from importlib import import_module
from math import cos, isfinite, sin
from typing import Any, Final

from msgspec.structs import replace

from imud.attitude.conventions import UNSETTLED_BIT, DeviceAxes
from imud.attitude.published import TO_EULER
from imud.attitude.rotation import IDENTITY, quat_from_matrix, quat_product, transposed
from imud.host.installation import needs_extra
from imud.model.errors import ImudError
from imud.model.sample import Quaternion, Sample, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S, RAD_PER_DEG

GAP_MAX_NS: Final = 250 * NS_PER_MS  # at 200 °/s, an angular rate that changes in this time leaves an error of some 10°
FIRST_PERIOD_NS: Final = 10 * NS_PER_MS  # period of the filter until the first block is complete, ns
BLOCK: Final = 32  # number of intervals for the median
PERIOD_CHANGE: Final = 0.1  # maximum deviation of the median interval from the period of the filter, relative
# Time constant of the correction with gravity, s: the default of vqf. The filter then averages this time at its start.
SETTLING_NS: Final = 3 * NS_PER_S
# One-sigma error of the estimated gyro bias below which the filter has settled, rad/s. It starts with 0.5 °/s.
SETTLED_RAD_S: Final = 0.1 * RAD_PER_DEG
UNSETTLED_RAD_S: Final = 0.2 * RAD_PER_DEG  # error above which the filter is no longer settled, rad/s
UNKNOWN_RAD_S: Final = 0.2 * RAD_PER_DEG  # error of the bias after a restart, rad/s
GAP_PERIODS: Final = 4  # a gap is also longer than this number of periods
STEPS_MAX: Final = 64  # maximum number of steps of the filter for one sample: 40 us
PERIOD_MAX_NS: Final = NS_PER_S  # maximum period of the filter, ns: no device that measures rotation is slower


def check_extra() -> None:
    """Raise ImudError if vqf is not installed."""
    _vqf()


def _vqf() -> Any:
    with needs_extra("attitude", ImudError):
        return import_module("vqf").VQF


class HostAttitude:
    """Filter for the samples of one device, before imud rotates them to the published axes."""

    def __init__(self, axes: DeviceAxes) -> None:
        """`axes` are the axes of the device. Raises ImudError if vqf is not installed."""
        self.saved: dict[str, Any] = {}  # state of `_filter`, from the last `save`
        self._period_ns = FIRST_PERIOD_NS
        self._filter = _vqf()(self._period_ns / NS_PER_S)
        self._array = import_module("numpy").array
        self._started_ns = 0  # `t_ns` of the first sample of the filter
        self._newest_ns: int | None = None  # `t_ns` of the newest sample; None before the first sample
        self._intervals_ns: list[int] = []  # intervals of the present block
        self._settled = False
        self._bias: Vector3 = (0.0, 0.0, 0.0)  # gyro bias at the end of the previous block, rad/s
        self._yaw_rad = 0.0  # yaw of the newest sample
        # Rotation from the navigation frame of the filter to the frame of the device; None: start with `_yaw_rad`
        self._turn: Quaternion | None = None
        self.set_axes(axes)

    def set_axes(self, axes: DeviceAxes) -> None:
        """Compute the attitude in other axes."""
        matrix = transposed(axes.to_z_up)
        self._from_up = None if matrix == IDENTITY else quat_from_matrix(matrix)
        self._to_euler = TO_EULER[axes.order]
        self._turn = None

    def samples(self, samples: Sequence[Sample]) -> list[Sample]:
        """Return the samples with their attitude. Samples without a finite angular rate and acceleration stay
        unchanged, and so do samples with an attitude of the device."""
        return [self._sample(sample) for sample in samples]

    def _sample(self, sample: Sample) -> Sample:
        gyro, accel = sample.gyro_rad_s, sample.accel_m_s2
        if gyro is None or accel is None or sample.quat_wxyz is not None or sample.euler_rad is not None:
            return sample
        if not isfinite(sum(gyro) + sum(accel)):
            return sample
        self._add(gyro, accel, sample.t_ns)
        w, x, y, z = self._filter.getQuat6D().tolist()
        if not isfinite(w + x + y + z):  # values near the maximum of a float
            self._restart(keeps_bias=False)
            self._newest_ns, self._intervals_ns, self._bias = None, [], (0.0, 0.0, 0.0)
            return sample
        quat = self._published((w, x, y, z))
        euler = self._to_euler(quat)
        self._yaw_rad = euler[2]
        status = sample.status if self._settled else (sample.status or 0) | 1 << UNSETTLED_BIT
        if len(self._intervals_ns) == BLOCK:
            self._end_block(accel, sample.t_ns)
        return replace(sample, quat_wxyz=quat, euler_rad=euler, status=status)

    def _add(self, gyro: Vector3, accel: Vector3, t_ns: int) -> None:
        """Pass the values of one sample to the filter."""
        before_ns, self._newest_ns = self._newest_ns, t_ns
        interval_ns = 0 if before_ns is None else t_ns - before_ns
        if before_ns is None:
            self._started_ns = t_ns
        else:
            self._intervals_ns.append(interval_ns)
            if interval_ns > max(GAP_MAX_NS, GAP_PERIODS * self._period_ns):
                self._restart(keeps_bias=True)
                self._started_ns, interval_ns = t_ns, 0
        steps = min(max(1, round(interval_ns / self._period_ns)), STEPS_MAX)
        scale = interval_ns / (steps * self._period_ns)
        # the filter subtracts its bias with its own period
        (x, y, z), (bx, by, bz) = gyro, self._bias
        rate, force = (
            self._array((bx + (x - bx) * scale, by + (y - by) * scale, bz + (z - bz) * scale)),
            self._array(accel, float),
        )
        for _ in range(steps):
            self._filter.update(rate, force)

    def _end_block(self, accel: Vector3, t_ns: int) -> None:
        """Follow the period of the samples, and decide whether the filter has settled."""
        median_ns = min(max(1, sorted(self._intervals_ns)[BLOCK // 2]), PERIOD_MAX_NS)
        self._intervals_ns = []
        if abs(median_ns - self._period_ns) > PERIOD_CHANGE * self._period_ns:
            self._period_ns = median_ns
            self._restart(keeps_bias=True)
            self._started_ns = t_ns
            self._filter.update(self._array((0.0, 0.0, 0.0)), self._array(accel, float))
            w, x, y, z = self._filter.getQuat6D().tolist()
            self._published((w, x, y, z))  # the next sample continues the yaw of this sample
            return
        bias, error_rad_s = self._filter.getBiasEstimate()
        x, y, z = bias.tolist()
        self._bias = (x, y, z)
        limit_rad_s = UNSETTLED_RAD_S if self._settled else SETTLED_RAD_S
        self._settled = error_rad_s <= limit_rad_s and t_ns - self._started_ns >= SETTLING_NS

    def _restart(self, *, keeps_bias: bool) -> None:
        """Start a filter that continues the heading."""
        before, self._filter = self._filter, _vqf()(self._period_ns / NS_PER_S)
        if keeps_bias:
            self._filter.setBiasEstimate(before.getBiasEstimate()[0], UNKNOWN_RAD_S)
        self._settled, self._turn = False, None

    def _published(self, quat: Quaternion) -> Quaternion:
        """Return the rotation from sensor axes to the navigation frame of the device."""
        if self._turn is None:
            up = quat if self._from_up is None else quat_product(self._from_up, quat)
            half_rad = (self._yaw_rad - self._to_euler(up)[2]) / 2
            turn = (cos(half_rad), 0.0, 0.0, sin(half_rad))
            self._turn = turn if self._from_up is None else quat_product(turn, self._from_up)
        return quat_product(self._turn, quat)

    # --- recordings ---------------------------------------------------------------------------------------------------

    def filter_state(self) -> dict[str, Any]:
        """Return the state of the filter, by the names of vqf."""
        state: dict[str, Any] = self._filter.state
        return state

    def save(self) -> None:
        """Prepare the attributes for a recording."""
        self.saved = self.filter_state()

    def resume(self) -> None:
        """Continue from the attributes of a recording, whose types and ranges are valid (`imud.sampling.state`)."""
        restored = _vqf()(self._period_ns / NS_PER_S)
        restored.state = self.saved
        self._filter = restored
