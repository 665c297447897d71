"""Guide of a calibration: check the rest, start the calibration on the device, check the samples, verify the result.

    ready? ──▶ rest? ──▶ begin ──▶ rest? ──▶ samples as expected? ──▶ save        for a device at rest
    ready? ──▶ begin ──▶ turn the device until it reports the end ──▶ field as expected?   for a turned device

The guide checks the newest sample ten times per second. Events report the progress.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations
from math import atan2, cos, dist, hypot, pi, sin, sqrt
from typing import Any, Final

from msgspec.structs import replace

from imud.contracts.command import (
    REQUESTED_BY,
    Calibration,
    CalibrationResult,
    CalibrationStatus,
    Check,
    Expectation,
    Handling,
    Kept,
    RestMeans,
    Verdict,
)
from imud.device.health import DeviceEvents
from imud.device.transport import Transport
from imud.model.errors import CommandError, ImudError
from imud.model.event import EventKind
from imud.model.sample import Pair, Sample, Vector3
from imud.model.units import NS_PER_S, RAD_PER_DEG, STANDARD_GRAVITY_M_S2, T_PER_UT
from imud.sampling.clock import SampleClock

WINDOW_SAMPLES: Final = 20  # number of samples of a rest: 2 s at ten samples per second
RATE_BAND_RAD_S: Final = 1.0 * RAD_PER_DEG
"""Maximum deviation from the mean at rest, rad/s: ten times the noise. A hand moves the device more."""
RATE_MEAN_RAD_S: Final = 5.0 * RAD_PER_DEG
"""Maximum mean at rest, rad/s: above the bias of an uncalibrated gyroscope, below a slow turn."""
ACCEL_BAND_M_S2: Final = 0.5  # maximum deviation from the mean at rest, m/s²
GRAVITY_TOLERANCE: Final = 0.05
"""Maximum relative difference to standard gravity. Scale errors and local gravity are below 1 %."""


class RestWindow:
    """Newest WINDOW_SAMPLES samples of a device."""

    def __init__(self) -> None:
        self._accel: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._gyro: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._euler: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._incli: deque[Pair] = deque(maxlen=WINDOW_SAMPLES)
        self.samples = 0  # number of samples since the last `clear`

    def add(self, sample: Sample) -> None:
        self.samples += 1
        if sample.accel_m_s2 is not None:
            self._accel.append(sample.accel_m_s2)
        if sample.gyro_rad_s is not None:
            self._gyro.append(sample.gyro_rad_s)
        if sample.euler_rad is not None:
            self._euler.append(sample.euler_rad)
        if sample.incli_rad is not None:
            self._incli.append(sample.incli_rad)

    def clear(self) -> None:
        self._accel.clear()
        self._gyro.clear()
        self._euler.clear()
        self._incli.clear()
        self.samples = 0

    @property
    def full(self) -> bool:
        """Whether the window contains enough samples for a decision."""
        return self.samples >= WINDOW_SAMPLES

    def motion(self) -> str:
        """Return the motion of the present samples with value and limit, one clause; empty at rest."""
        if self._gyro:
            mean = _mean(self._gyro)
            if (band := _band(self._gyro, mean)) > RATE_BAND_RAD_S:
                return _said("the angular rate changes by", band / RAD_PER_DEG, RATE_BAND_RAD_S / RAD_PER_DEG, "°/s")
            if (rate := hypot(*mean)) > RATE_MEAN_RAD_S:
                return _said("it turns at", rate / RAD_PER_DEG, RATE_MEAN_RAD_S / RAD_PER_DEG, "°/s")
        if self._accel:
            mean = _mean(self._accel)
            if (band := _band(self._accel, mean)) > ACCEL_BAND_M_S2:
                return _said("the acceleration changes by", band, ACCEL_BAND_M_S2, "m/s²")
            excess = abs(hypot(*mean) - STANDARD_GRAVITY_M_S2)
            if excess > GRAVITY_TOLERANCE * STANDARD_GRAVITY_M_S2:
                limit = GRAVITY_TOLERANCE * STANDARD_GRAVITY_M_S2
                return _said("the acceleration differs from gravity by", excess, limit, "m/s²")
        return ""

    def means(self) -> RestMeans:
        """Return the means of the samples; circular means for angles."""
        roll_pitch_yaw, incli = _circular_mean(self._euler), _circular_mean(self._incli)
        return RestMeans(
            _mean(self._accel) if self._accel else None,
            _mean(self._gyro) if self._gyro else None,
            (roll_pitch_yaw[0], roll_pitch_yaw[1], roll_pitch_yaw[2]) if roll_pitch_yaw else None,
            (incli[0], incli[1]) if incli else None,
        )


def _said(words: str, value: float, limit: float, unit: str) -> str:
    return f"{words} {value:.3g} {unit} (at most {limit:.3g} {unit} at rest)"


def _mean(vectors: deque[Vector3]) -> Vector3:
    count = len(vectors)
    x, y, z = map(sum, zip(*vectors, strict=True))
    return (x / count, y / count, z / count)


def _band(vectors: deque[Vector3], mean: Vector3) -> float:
    """Return the length of the largest deviation from the mean."""
    a, b, c = mean
    return max(hypot(x - a, y - b, z - c) for x, y, z in vectors)


def _circular_mean(angles: Iterable[tuple[float, ...]]) -> tuple[float, ...]:
    """Return the circular mean of each angle; empty without samples."""
    axes = zip(*angles, strict=True)
    return tuple(atan2(sum(sin(one) for one in axis), sum(cos(one) for one in axis)) for axis in axes)


_ORDERS: Final = tuple(permutations(range(3)))  # possible orders of the axes by absolute value
CELLS: Final = 8 * len(_ORDERS)  # number of cells of the sphere: 48
POINTS_MAX: Final = 1024
"""Maximum number of points for the coverage. A slow calibration of five minutes has about 700."""
POINT_DISTANCE_T: Final = 5e-6  # minimum distance of two points, T: an eighth of a cell in Earth's field
FIT_POINTS_MIN: Final = 12  # minimum number of points for a fit
STEP_MAX_NS: Final = NS_PER_S  # maximum time between two samples in the integral of the angular rate, ns
TURNS_WANTED_RAD: Final = 2 * pi  # minimum angle about each axis, rad (manual B, section 8.1.1)
COVERAGE_WANTED: Final = 0.6
"""Minimum share of cells. A hand reaches 40 of 48 cells. With fewer than 29 cells the fit depends on noise."""
FIELD_MIN_T: Final = 22e-6  # minimum of Earth's field at the surface, T (IGRF)
FIELD_MAX_T: Final = 67e-6  # maximum of Earth's field at the surface, T (IGRF)
RESIDUAL_MAX: Final = 0.05
"""Maximum RMS distance from the sphere, as a share of its radius. 5 % change the heading by about 3°."""


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere fitted to the ends of field vectors."""

    centre_t: Vector3
    radius_t: float
    residual: float  # RMS distance of the points from the sphere, as a share of the radius


class Turning:
    """Samples of a device that a user turns.

    The fit uses sums over all samples. The coverage uses at most POINTS_MAX points with a distance of at least
    POINT_DISTANCE_T. Thus memory and computing time have a limit.
    """

    def __init__(self, *, is_planar: bool = False) -> None:
        """`is_planar`: the device stays level and turns about one axis only."""
        self.is_planar = is_planar
        self._points: list[Vector3] = []
        self._fit = _SphereFit()
        self._turned = [0.0, 0.0, 0.0]
        self._t_ns: int | None = None

    def add(self, sample: Sample) -> None:
        if sample.mag_t is not None:
            self._add_field(sample.mag_t)
        before, self._t_ns = self._t_ns, sample.t_ns
        if before is None or sample.gyro_rad_s is None or sample.t_ns - before > STEP_MAX_NS:
            return
        step_s = (sample.t_ns - before) / NS_PER_S
        for axis, rate in enumerate(sample.gyro_rad_s):
            self._turned[axis] += abs(rate) * step_s

    def _add_field(self, field_t: Vector3) -> None:
        self._fit.add(field_t)
        if len(self._points) < POINTS_MAX and (not self._points or dist(self._points[-1], field_t) >= POINT_DISTANCE_T):
            self._points.append(field_t)

    def restart_field(self) -> None:
        """Remove the field samples: the device now corrects the field in another way."""
        self._points.clear()
        self._fit = _SphereFit()

    @property
    def turned_rad(self) -> Vector3:
        """Angle about each axis of the sensor, rad, summed over both directions."""
        x, y, z = self._turned
        return (x, y, z)

    @property
    def share(self) -> float:
        """Share of the wanted turns and, unless `is_planar`, of the wanted directions, 0 … 1."""
        if self.is_planar:  # a circle in the field has few directions and no sphere
            return min(1.0, max(self._turned) / TURNS_WANTED_RAD)
        return min(1.0, coverage(self.cells(self.fit())) / COVERAGE_WANTED, min(self._turned) / TURNS_WANTED_RAD)

    @property
    def has_field(self) -> bool:
        """Whether a sample contained a magnetic field."""
        return bool(self._points)

    def cells(self, sphere: Sphere | None) -> int:
        """Return the covered cells as a bit mask, seen from the centre of the sphere."""
        a, b, c = sphere.centre_t if sphere is not None else (0.0, 0.0, 0.0)
        mask = 0
        for x, y, z in self._points:
            mask |= 1 << cell_of((x - a, y - b, z - c))
        return mask

    def fit(self) -> Sphere | None:
        """Return the fitted sphere; None if there are too few points or if they lie in a plane."""
        return self._fit.sphere()


class _SphereFit:
    """Linear least-squares fit of a sphere from sums, in µT for numerical accuracy."""

    def __init__(self) -> None:
        self._count = 0
        # products of (2x, 2y, 2z, 1, |m|²): the normal equations with the right side and its square
        self._sums = [[0.0] * 5 for _ in range(5)]

    def add(self, field_t: Vector3) -> None:
        x, y, z = (value / T_PER_UT for value in field_t)
        row = (2 * x, 2 * y, 2 * z, 1.0, x * x + y * y + z * z)
        self._count += 1
        for sums, left in zip(self._sums, row, strict=True):
            for column, right in enumerate(row):
                sums[column] += left * right

    def sphere(self) -> Sphere | None:
        if self._count < FIT_POINTS_MIN:
            return None
        solved = _solve([list(row) for row in self._sums[:4]])
        if solved is None:
            return None
        a, b, c, d = solved
        squared = d + a * a + b * b + c * c  # the mean square distance from the centre: positive
        right_side = [row[4] for row in self._sums]
        # a point at distance e from the sphere has a residual of about 2 r e in its equation
        missed = right_side[4] - sum(value * right for value, right in zip(solved, right_side[:4], strict=True))
        residual = sqrt(max(missed, 0.0) / self._count) / (2 * squared)
        return Sphere((a * T_PER_UT, b * T_PER_UT, c * T_PER_UT), sqrt(squared) * T_PER_UT, residual)


def cell_of(direction: Vector3) -> int:
    """Return the cell of a direction, 0 … 47: its octant, then the order of the absolute values."""
    octant = sum((value < 0) << axis for axis, value in enumerate(direction))
    order = tuple(sorted(range(3), key=lambda axis: -abs(direction[axis])))
    return octant * len(_ORDERS) + _ORDERS.index(order)


def coverage(mask: int) -> float:
    """Return the share of the cells in the mask."""
    return mask.bit_count() / CELLS


def _solve(matrix: Sequence[list[float]]) -> list[float] | None:
    """Solve four linear equations with the right sides in the fifth column; None if they are singular.

    Gaussian elimination with partial pivoting. Changes `matrix`.
    """
    scale = max(abs(value) for row in matrix for value in row[:4])
    for i in range(4):
        pivot = max(range(i, 4), key=lambda row: abs(matrix[row][i]))
        if abs(matrix[pivot][i]) <= 1e-9 * scale:
            return None
        rows = list(matrix)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        matrix = rows
        for row in matrix[i + 1 :]:
            factor = row[i] / matrix[i][i]
            for j in range(i, 5):
                row[j] -= factor * matrix[i][j]
    found = [0.0] * 4
    for i in reversed(range(4)):
        known = sum(matrix[i][j] * found[j] for j in range(i + 1, 4))
        found[i] = (matrix[i][4] - known) / matrix[i][i]
    return found


log = logging.getLogger(__name__)

REST_LIMIT_NS: Final = 20 * NS_PER_S  # maximum wait for the rest of the device, ns
TURN_LIMIT_NS: Final = 300 * NS_PER_S  # maximum time for the turns, ns. The manual specifies one to two minutes.
REPORT_NS: Final = NS_PER_S // 2  # interval of progress events, ns
ASK_NS: Final = 3 * NS_PER_S  # interval of queries during the turns, ns. Each query can cost some samples.
SETTLE_NS: Final = 2 * NS_PER_S
"""Time between the end and the verification, ns: the attitude filter of the device needs it."""


class CalibrationRun:
    """Guide of one calibration at a time; an attachment. Synchronization: the loop's thread only."""

    def __init__(self, transport: Transport, events: DeviceEvents) -> None:
        self._transport = transport
        self._events = events
        self.is_sent = False  # whether imud has sent the start of the newest calibration
        self._running: asyncio.Task[CalibrationResult] | None = None
        self.status: CalibrationStatus | None = None  # running calibration; None if none is running
        self._tick_future: asyncio.Future[tuple[int, Sample | None]] | None = None
        self._now_ns = 0
        self._seen_seq = 0
        self._clock: SampleClock | None = None  # clock of the device; None before imud has found the device

    # --- the attachment ----------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """Watch this clock. A calibration starts only on request."""
        self._clock = clock

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Pass the newest sample to the calibration, ten times per second."""
        self._now_ns = now_ns
        if self._tick_future is not None and not self._tick_future.done():
            self._tick_future.set_result((now_ns, newest))

    def stop(self) -> None:
        """Stop the calibration: the link of the device ended. A second call does nothing."""
        if self._tick_future is not None and not self._tick_future.done():
            self._tick_future.set_exception(CommandError("the device's link ended during the calibration"))

    def close(self) -> None:
        self.cancel()

    # --- a calibration -----------------------------------------------------------------------------------------------

    async def run(self, kind: str, calibration: Calibration, *, save: bool) -> CalibrationResult:
        """Run a calibration to its end. Raises CommandError if it cannot start, was cancelled, or failed."""
        if self._running is not None:
            raise CommandError("another calibration of this device is running")
        if save and calibration.kept is not Kept.BY_SAVE:
            raise CommandError(f"{kind}: cannot save: the result lasts {calibration.kept}")
        limit_ns = None if calibration.handling is Handling.REST else TURN_LIMIT_NS
        self.status = CalibrationStatus(kind, "", self._now_ns, limit_ns, REQUESTED_BY.get())
        self.is_sent = False
        task = self._running = asyncio.ensure_future(self._run(kind, calibration, save))
        try:
            return await task
        except asyncio.CancelledError:
            if not task.cancelled():
                raise
            raise CommandError("the calibration was cancelled; the device can still finish it") from None
        finally:
            self._running = self.status = None

    def cancel(self) -> bool:
        return self._running is not None and self._running.cancel()

    async def _run(self, kind: str, calibration: Calibration, save: bool) -> CalibrationResult:
        if calibration.unready is not None and (words := await self._transport.run_script(calibration.unready)):
            raise CommandError(f"{kind}: {words}")
        self._report(kind, "begin", calibration.help)
        try:
            return await self._begun(kind, calibration, save)
        except (ImudError, asyncio.CancelledError) as error:
            words = str(error).removeprefix(f"{kind}: ") or "it was cancelled"
            self._report(kind, "end", words, verified=False, saved=False)
            raise

    async def _begun(self, kind: str, calibration: Calibration, save: bool) -> CalibrationResult:
        """Run a calibration after its first event, and report its end. The caller reports errors."""
        resets = self._resets
        if calibration.handling is Handling.REST:
            device, checks, problem = await self._at_rest(kind, calibration)
        else:
            device, checks, problem = await self._turned(kind, calibration)
        problem = problem or _failed(checks)
        if self._resets != resets:
            problem = "the device restarted during the calibration; check its power supply and repeat the calibration"
        saved = calibration.kept is Kept.BY_DEVICE and not problem
        if save and not problem and calibration.save is not None:
            await self._transport.run_script(calibration.save)
            saved = True
        self._report(kind, "end", problem or "verified", verified=not problem, saved=saved)
        return CalibrationResult(kind, not problem, problem, device, checks, saved, calibration.kept)

    async def _at_rest(self, kind: str, calibration: Calibration) -> tuple[str, tuple[Check, ...], str]:
        """Calibrate a device at rest. Return the reply of the device, the checks, and the problem."""
        await self._rest(kind)
        window = RestWindow()
        self.is_sent = True
        script: asyncio.Future[Any] = asyncio.ensure_future(self._transport.run_script(calibration.begin))
        try:
            while not script.done():
                _, sample = await self._next(script)
                if sample is not None:
                    window.add(sample)
            answer = script.result()
        finally:
            script.cancel()
        moved = window.motion()
        if moved:
            return (
                _words(answer),
                (),
                f"the device moved during the calibration: {moved}; keep it still and repeat the calibration",
            )
        await self._pause(SETTLE_NS)
        means = await self._rest(kind)
        problem = answer.words if isinstance(answer, Verdict) and not answer.done else ""
        return _words(answer), tuple(check(one, means) for one in calibration.expected), problem

    async def _turned(self, kind: str, calibration: Calibration) -> tuple[str, tuple[Check, ...], str]:
        """Calibrate a turned device. Return the reply of the device, the checks, and the problem."""
        ask = calibration.verdict
        before = verdict = await self._transport.run_script(ask) if ask is not None else Verdict(done=False, words="")
        self.is_sent = True
        await self._transport.run_script(calibration.begin)
        turning, begun_ns = Turning(is_planar=calibration.handling is Handling.SPIN), self._now_ns
        report_ns = ask_ns = begun_ns
        problem = "the device did not finish the calibration"
        while self._now_ns - begun_ns < TURN_LIMIT_NS:
            now_ns, sample = await self._next()
            if sample is not None:
                turning.add(sample)
            if now_ns >= report_ns:
                report_ns = now_ns + REPORT_NS
                self._report_turning(kind, turning, verdict)
            if ask is not None and now_ns >= ask_ns:
                ask_ns = now_ns + ASK_NS
                last, verdict = verdict, await self._transport.run_script(ask)
                if verdict.words != last.words:
                    turning.restart_field()
            if verdict.done and turning.share >= 1.0 and (verdict.words != before.words or before.done):
                problem = ""
                self._report_turning(kind, turning, verdict)
                break
        checks = _field_checks(turning)
        if problem:
            problem = f"{problem} within {TURN_LIMIT_NS // NS_PER_S} s; {_advice(turning, checks)}"
        return verdict.words, checks, problem

    # --- samples -----------------------------------------------------------------------------------------------------

    @property
    def _resets(self) -> int:
        """Number of restarts of the device counter."""
        return self._clock.resets if self._clock is not None else 0

    async def _rest(self, kind: str) -> RestMeans:
        """Wait for the rest of the device and return the means of its samples. Raises CommandError."""
        window, begun_ns, first, moved = RestWindow(), self._now_ns, True, ""
        while self._now_ns - begun_ns < REST_LIMIT_NS:
            now_ns, sample = await self._next()
            if first:
                begun_ns, first = now_ns, False
            if sample is None:
                continue
            window.add(sample)
            if not window.full:
                continue
            moved = window.motion()
            if not moved:
                return window.means()
            self._report(kind, "rest", f"waiting for rest: {moved}")
            window.clear()
        if moved or window.samples:
            words = moved or window.motion() or f"only {window.samples} samples came"
            raise CommandError(
                f"{kind}: expected the device at rest, got: {words}; put the device on a surface without vibration"
            )
        raise CommandError(f"{kind}: expected samples of the device, got no sample for {REST_LIMIT_NS // NS_PER_S} s")

    async def _pause(self, duration_ns: int) -> None:
        end_ns = self._now_ns + duration_ns
        while self._now_ns < end_ns:
            await self._next()

    async def _next(self, until: asyncio.Future[Any] | None = None) -> tuple[int, Sample | None]:
        """Return the time of the next tick, and the newest sample if it is new.

        Return without a sample if `until` is done before the tick.
        """
        look = self._tick_future = asyncio.get_running_loop().create_future()
        try:
            if until is not None:
                await asyncio.wait({look, until}, return_when=asyncio.FIRST_COMPLETED)
                if not look.done():
                    return self._now_ns, None
            now_ns, newest = await look
        finally:
            self._tick_future = None
        if newest is None or newest.seq == self._seen_seq:
            return now_ns, None
        self._seen_seq = newest.seq
        return now_ns, newest

    # --- events ------------------------------------------------------------------------------------------------------

    def _report(self, kind: str, phase: str, words: str, **detail: str | int | float | bool | None) -> None:
        message = f"calibration {kind}: {words}"
        if self.status is not None:
            self.status = replace(self.status, phase=phase, message=words, progress=detail)
        self._events.raise_event(self._now_ns, EventKind.CALIBRATION, message, kind=kind, phase=phase, **detail)

    def _report_turning(self, kind: str, turning: Turning, verdict: Verdict) -> None:
        sphere = turning.fit()
        mask, progress = turning.cells(sphere), turning.share
        x, y, z = turning.turned_rad
        self._report(
            kind, "turn", f"{progress:.0%} of the directions and turns", progress=progress, coverage=coverage(mask),
            cells=f"{mask:012x}", turned_x_rad=x, turned_y_rad=y, turned_z_rad=z,
            field_t=sphere.radius_t if sphere else None, residual=sphere.residual if sphere else None,
            device=verdict.words, device_progress=verdict.progress,
        )  # fmt: skip


def check(expectation: Expectation, means: RestMeans) -> Check:
    """Compare the means of the samples with an expectation."""
    value = expectation.value(means)
    return _bounded(expectation.name, value, expectation.limit, expectation.unit)


def _bounded(name: str, value: float | None, limit: float, unit: str) -> Check:
    return Check(name, value, limit, unit, value is not None and value <= limit)


def _field_checks(turning: Turning) -> tuple[Check, ...]:
    if turning.is_planar:
        return ()
    sphere = turning.fit()
    if sphere is None:
        return (Check("residual of the field", None, RESIDUAL_MAX, "", False),)
    low, high = FIELD_MIN_T, FIELD_MAX_T
    return (
        _bounded("residual of the field", sphere.residual, RESIDUAL_MAX, ""),
        Check("field strength", sphere.radius_t, high, "T", low <= sphere.radius_t <= high),
    )


def _failed(checks: tuple[Check, ...]) -> str:
    """Return the first failed check as a sentence; empty if all checks passed."""
    for check in checks:
        if check.value is None:
            return f"{check.name}: the samples do not contain this value"
        if not check.passed:
            unit = f" {check.unit}" if check.unit else ""
            return f"{check.name}: expected at most {check.limit:.3g}{unit}, got {check.value:.3g}{unit}"
    return ""


def _advice(turning: Turning, checks: tuple[Check, ...]) -> str:
    """Return advice about a calibration that did not end, one clause."""
    if not turning.has_field:
        return (
            "its samples contain no magnetic field; "
            "check that the device has a magnetometer, and that its output contains the field"
        )
    if turning.is_planar:
        words = "the field may be disturbed: go outdoors, and repeat the calibration more slowly"
        return words if turning.share >= 1.0 else "it was turned by less than 360°: turn it about the vertical axis"
    share = coverage(turning.cells(turning.fit()))
    if share < COVERAGE_WANTED:
        return (
            f"it was turned to {share:.0%} of the directions, expected {COVERAGE_WANTED:.0%}: also turn it upside down"
        )
    least = min(turning.turned_rad)
    if least < TURNS_WANTED_RAD:
        return "it was turned by less than 360° about one axis: turn it about each of its axes"
    if any(not check.passed for check in checks):
        return "the field is disturbed: go outdoors, or at least 30 cm from iron, motors, computers and telephones"
    return "the field is good: repeat the calibration more slowly, for one to two minutes"


def _words(answer: object) -> str:
    """Return the reply of the device as text."""
    if answer is None or answer is True:
        return ""
    if isinstance(answer, Verdict):
        return answer.words
    if isinstance(answer, tuple | list):
        return ", ".join(f"{value:.6g}" if isinstance(value, float) else str(value) for value in answer)
    return str(answer)
