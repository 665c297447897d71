"""The guide of a calibration: checks rest, starts it on the device, watches the samples, and verifies the result.

    ready? ──▶ rest? ──▶ begin ──▶ rest? ──▶ samples as expected? ──▶ save        the device must not move
    ready? ──▶ begin ──▶ turning, until the device says that it is done ──▶ field as expected?      it is turned

It looks at the newest sample ten times a second. Progress goes out as events.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import permutations
from math import atan2, cos, dist, hypot, pi, sin, sqrt
from typing import Any, Final

from imud.contracts.command import (
    Calibration,
    CalibrationResult,
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
from imud.model.units import NS_PER_S, RAD_PER_DEG
from imud.sampling.clock import SampleClock

WINDOW_SAMPLES: Final = 20
"""At ten looks per second, two seconds."""
RATE_BAND_RAD_S: Final = 1.0 * RAD_PER_DEG
"""About the mean: ten times the noise of these sensors; a hand that holds the device moves it more."""
RATE_MEAN_RAD_S: Final = 5.0 * RAD_PER_DEG
"""The bias of an uncalibrated gyroscope is below; a slow steady turn is above."""
ACCEL_BAND_M_S2: Final = 0.5
STANDARD_GRAVITY_M_S2: Final = 9.80665
GRAVITY_TOLERANCE: Final = 0.05
"""Of the mean's length: scale errors and local gravity are below one percent."""


class RestWindow:
    """The newest samples of a device. Memory is bounded by WINDOW_SAMPLES."""

    def __init__(self) -> None:
        self._accel: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._gyro: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._euler: deque[Vector3] = deque(maxlen=WINDOW_SAMPLES)
        self._incli: deque[Pair] = deque(maxlen=WINDOW_SAMPLES)
        self.samples = 0
        """Samples seen since the last `clear`."""

    def add(self, sample: Sample) -> None:
        """Add a sample."""
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
        """Forget all samples."""
        self._accel.clear()
        self._gyro.clear()
        self._euler.clear()
        self._incli.clear()
        self.samples = 0

    @property
    def full(self) -> bool:
        """Whether there are enough samples to judge."""
        return self.samples >= WINDOW_SAMPLES

    def motion(self) -> str:
        """What moves, one clause with its figure and limit; empty at rest. Judges what samples there are."""
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
        """Means of the samples; angles as circular means."""
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
    """Length of the largest deviation from the mean."""
    a, b, c = mean
    return max(hypot(x - a, y - b, z - c) for x, y, z in vectors)


def _circular_mean(angles: Iterable[tuple[float, ...]]) -> tuple[float, ...]:
    """Means of several angles; empty for none."""
    axes = zip(*angles, strict=True)
    return tuple(atan2(sum(sin(one) for one in axis), sum(cos(one) for one in axis)) for axis in axes)


_ORDERS: Final = tuple(permutations(range(3)))
"""Axes by falling absolute value."""
CELLS: Final = 8 * len(_ORDERS)
POINTS_MAX: Final = 1024
"""Points for the coverage; later ones are not kept. A slow turning of five minutes has some 700."""
POINT_DISTANCE_T: Final = 5e-6
"""An eighth of a cell in Earth's field."""
FIT_POINTS_MIN: Final = 12
T_PER_UT: Final = 1e-6
STEP_MAX_NS: Final = NS_PER_S
"""A longer pause between two samples is not integrated."""
TURNS_WANTED_RAD: Final = 2 * pi
"""Manual B, section 8.1.1: each axis at least once through 360°."""
COVERAGE_WANTED: Final = 0.6
"""Share of the cells: a hand reaches more than 40 of 48; with fewer than 29 the fit depends on noise."""
FIELD_MIN_T: Final = 22e-6
FIELD_MAX_T: Final = 67e-6
"""Earth's field at the surface, 22 to 67 µT (IGRF)."""
RESIDUAL_MAX: Final = 0.05
"""RMS distance from the sphere over its radius: 5 % of the horizontal field turn the heading by about 3°."""


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere fitted to the ends of field vectors."""

    centre_t: Vector3
    radius_t: float
    residual: float
    """RMS distance of the points from it, as a share of the radius."""


class Turning:
    """Samples of a device that is being turned.

    The fit uses sums over all samples. For the coverage POINTS_MAX points are kept, none nearer to the one before than
    POINT_DISTANCE_T. So memory, and the time of one question, are bounded.
    """

    def __init__(self) -> None:
        self._points: list[Vector3] = []
        self._fit = _SphereFit()
        self._turned = [0.0, 0.0, 0.0]
        self._t_ns: int | None = None

    def add(self, sample: Sample) -> None:
        """Add a sample."""
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
        """Forget the field so far: the device corrects it in another way from now on."""
        self._points.clear()
        self._fit = _SphereFit()

    @property
    def turned_rad(self) -> Vector3:
        """Angle turned about each axis of the sensor, whatever the direction."""
        x, y, z = self._turned
        return (x, y, z)

    @property
    def has_field(self) -> bool:
        """Whether any sample had a magnetic field."""
        return bool(self._points)

    def cells(self, sphere: Sphere | None) -> int:
        """The covered cells as a bit mask, seen from the centre of the sphere."""
        a, b, c = sphere.centre_t if sphere is not None else (0.0, 0.0, 0.0)
        mask = 0
        for x, y, z in self._points:
            mask |= 1 << cell_of((x - a, y - b, z - c))
        return mask

    def fit(self) -> Sphere | None:
        """Fit the sphere; None while the points are too few or lie in a plane."""
        return self._fit.sphere()


class _SphereFit:
    """Linear least squares for the sphere, from sums; in µT, so that they are well scaled."""

    def __init__(self) -> None:
        self._count = 0
        self._sums = [[0.0] * 5 for _ in range(5)]
        """Products of (2x, 2y, 2z, 1, |m|²) with each other: normal equations, their right side, its square."""

    def add(self, field_t: Vector3) -> None:
        """Add a point."""
        x, y, z = (value / T_PER_UT for value in field_t)
        row = (2 * x, 2 * y, 2 * z, 1.0, x * x + y * y + z * z)
        self._count += 1
        for sums, left in zip(self._sums, row, strict=True):
            for column, right in enumerate(row):
                sums[column] += left * right

    def sphere(self) -> Sphere | None:
        """The sphere; None while the points are too few or lie in a plane."""
        if self._count < FIT_POINTS_MIN:
            return None
        solved = _solve([list(row) for row in self._sums[:4]])
        if solved is None:
            return None
        a, b, c, d = solved
        squared = d + a * a + b * b + c * c
        if squared <= 0:
            return None
        right_side = [row[4] for row in self._sums]
        # A point at distance e from the sphere misses its equation by about 2 r e.
        missed = right_side[4] - sum(value * right for value, right in zip(solved, right_side[:4], strict=True))
        residual = sqrt(max(missed, 0.0) / self._count) / (2 * squared)
        return Sphere((a * T_PER_UT, b * T_PER_UT, c * T_PER_UT), sqrt(squared) * T_PER_UT, residual)


def cell_of(direction: Vector3) -> int:
    """The cell, 0 … 47, in which a direction lies: octant by signs, then the order of the absolute values."""
    octant = sum((value < 0) << axis for axis, value in enumerate(direction))
    order = tuple(sorted(range(3), key=lambda axis: -abs(direction[axis])))
    return octant * len(_ORDERS) + _ORDERS.index(order)


def coverage(mask: int) -> float:
    """Share of the cells that are in the mask."""
    return mask.bit_count() / CELLS


def _solve(matrix: Sequence[list[float]]) -> list[float] | None:
    """Solve four linear equations with their right sides in the fifth column; None for a singular system.

    Gaussian elimination with partial pivoting; `matrix` is changed.
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

REST_LIMIT_NS: Final = 20 * NS_PER_S
"""For the device to come to rest, and for its samples to be enough to see it."""
TURN_LIMIT_NS: Final = 300 * NS_PER_S
"""The manual names one to two minutes."""
REPORT_NS: Final = NS_PER_S // 2
ASK_NS: Final = 3 * NS_PER_S
"""Between two questions to the device while it is turned; each may cost it some samples."""
SETTLE_NS: Final = 2 * NS_PER_S
"""After the end, before the samples are looked at: the attitude filter of the device follows."""


class CalibrationRun:
    """Guide of one device's calibrations, one at a time; an attachment. Synchronization: the loop's thread only."""

    def __init__(self, transport: Transport, notices: DeviceEvents) -> None:
        self._transport = transport
        self._notices = notices
        self._running: asyncio.Task[CalibrationResult] | None = None
        self._look: asyncio.Future[tuple[int, Sample | None]] | None = None
        self._now_ns = 0
        self._seen_seq = 0

    # --- the contract of attachments ---------------------------------------------------------------------------------

    def start(self, _clock: SampleClock) -> None:
        """No-op: nothing runs by itself."""

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Pass on the newest sample, ten times a second."""
        self._now_ns = now_ns
        if self._look is not None and not self._look.done():
            self._look.set_result((now_ns, newest))

    def stop(self) -> None:
        """End the calibration that runs: the device's link ended; may be called twice."""
        if self._look is not None and not self._look.done():
            self._look.set_exception(CommandError("the device's link ended during the calibration"))

    def close(self) -> None:
        """End what runs; may be called twice."""
        self.cancel()

    # --- a calibration -----------------------------------------------------------------------------------------------

    async def run(self, kind: str, calibration: Calibration, *, save: bool) -> CalibrationResult:
        """Run a calibration to its end. Raises CommandError where it cannot begin, was cancelled, or was disturbed."""
        if self._running is not None:
            raise CommandError("another calibration of this device is running")
        if save and calibration.kept is not Kept.BY_SAVE:
            raise CommandError(f"{kind}: expected no `save`, for its result lasts {calibration.kept}")
        task = self._running = asyncio.ensure_future(self._run(kind, calibration, save))
        try:
            return await task
        except asyncio.CancelledError:
            if task.cancelled():
                raise CommandError("the calibration was cancelled; the device may have finished it by itself") from None
            task.cancel()
            raise
        finally:
            self._running = None

    def cancel(self) -> bool:
        """End the calibration that runs; return whether there was one."""
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
        """Run a calibration whose begin was reported, and report its end; errors are left to the caller."""
        if calibration.handling is Handling.REST:
            device, checks, problem = await self._at_rest(kind, calibration)
        else:
            device, checks, problem = await self._turned(kind, calibration)
        problem = problem or _failed(checks)
        saved = calibration.kept is Kept.BY_DEVICE and not problem
        if save and not problem and calibration.save is not None:
            await self._transport.run_script(calibration.save)
            saved = True
        self._report(kind, "end", problem or "verified", verified=not problem, saved=saved)
        return CalibrationResult(kind, not problem, problem, device, checks, saved, calibration.kept)

    async def _at_rest(self, kind: str, calibration: Calibration) -> tuple[str, tuple[Check, ...], str]:
        """Calibrate a device that must not move; return the device's words, the checks, and what is wrong."""
        await self._rest(kind)
        window = RestWindow()
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
            return _words(answer), (), f"the device moved while it was calibrated: {moved}; hold it still and repeat"
        await self._pause(SETTLE_NS)
        means = await self._rest(kind)
        return _words(answer), tuple(_check(one, means) for one in calibration.expected), ""

    async def _turned(self, kind: str, calibration: Calibration) -> tuple[str, tuple[Check, ...], str]:
        """Calibrate a device that is turned; return the device's words, the checks, and what is wrong."""
        ask = calibration.verdict
        before = verdict = await self._transport.run_script(ask) if ask is not None else Verdict(done=False, words="")
        await self._transport.run_script(calibration.begin)
        turning, begun_ns = Turning(), self._now_ns
        report_ns = ask_ns = begun_ns
        problem = "the device did not end the calibration"
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
            if verdict.done and _turned_enough(turning) and (verdict.words != before.words or before.done):
                problem = ""
                self._report_turning(kind, turning, verdict)
                break
        checks = _field_checks(turning)
        if problem:
            problem = f"{problem} within {TURN_LIMIT_NS // NS_PER_S} s; {_advice(turning, checks)}"
        return verdict.words, checks, problem

    # --- looking -----------------------------------------------------------------------------------------------------

    async def _rest(self, kind: str) -> RestMeans:
        """Wait until the device rests and return the means of its samples. Raises CommandError."""
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
            raise CommandError(f"{kind}: expected the device at rest, got: {words}; put it down, away from vibration")
        raise CommandError(f"{kind}: expected samples of the device, got none for {REST_LIMIT_NS // NS_PER_S} s")

    async def _pause(self, duration_ns: int) -> None:
        end_ns = self._now_ns + duration_ns
        while self._now_ns < end_ns:
            await self._next()

    async def _next(self, until: asyncio.Future[Any] | None = None) -> tuple[int, Sample | None]:
        """Return the next look: the time, and the newest sample if it is a new one.

        With `until`, returns early without a sample when that is done.
        """
        look = self._look = asyncio.get_running_loop().create_future()
        try:
            if until is not None:
                await asyncio.wait({look, until}, return_when=asyncio.FIRST_COMPLETED)
                if not look.done():
                    return self._now_ns, None
            now_ns, newest = await look
        finally:
            self._look = None
        if newest is None or newest.seq == self._seen_seq:
            return now_ns, None
        self._seen_seq = newest.seq
        return now_ns, newest

    # --- reports -----------------------------------------------------------------------------------------------------

    def _report(self, kind: str, phase: str, words: str, **detail: str | int | float | bool | None) -> None:
        message = f"calibration {kind}: {words}"
        self._notices.raise_event(self._now_ns, EventKind.CALIBRATION, message, kind=kind, phase=phase, **detail)

    def _report_turning(self, kind: str, turning: Turning, verdict: Verdict) -> None:
        sphere = turning.fit()
        mask = turning.cells(sphere)
        share = coverage(mask)
        turned = min(turning.turned_rad) / TURNS_WANTED_RAD
        progress = min(1.0, share / COVERAGE_WANTED, turned)
        x, y, z = turning.turned_rad
        self._report(
            kind, "turn", f"{progress:.0%} of the directions and turns", progress=progress, coverage=share,
            cells=f"{mask:012x}", turned_x_rad=x, turned_y_rad=y, turned_z_rad=z,
            field_t=sphere.radius_t if sphere else None, residual=sphere.residual if sphere else None,
            device=verdict.words, device_progress=verdict.progress,
        )  # fmt: skip


def _turned_enough(turning: Turning) -> bool:
    share = coverage(turning.cells(turning.fit()))
    return share >= COVERAGE_WANTED and min(turning.turned_rad) >= TURNS_WANTED_RAD


def _check(expectation: Expectation, means: RestMeans) -> Check:
    value = expectation.value(means)
    return _bounded(expectation.name, value, expectation.limit, expectation.unit)


def _bounded(name: str, value: float | None, limit: float, unit: str) -> Check:
    return Check(name, value, limit, unit, value is not None and value <= limit)


def _field_checks(turning: Turning) -> tuple[Check, ...]:
    sphere = turning.fit()
    if sphere is None:
        return (Check("residual of the field", None, RESIDUAL_MAX, "", False),)
    low, high = FIELD_MIN_T, FIELD_MAX_T
    return (
        _bounded("residual of the field", sphere.residual, RESIDUAL_MAX, ""),
        Check("field strength", sphere.radius_t, high, "T", low <= sphere.radius_t <= high),
    )


def _failed(checks: tuple[Check, ...]) -> str:
    """The first check that is not passed, as a sentence; empty for none."""
    for check in checks:
        if check.value is None:
            return f"{check.name}: the samples do not tell it"
        if not check.passed:
            unit = f" {check.unit}" if check.unit else ""
            return f"{check.name}: expected at most {check.limit:.3g}{unit}, got {check.value:.3g}{unit}"
    return ""


def _advice(turning: Turning, checks: tuple[Check, ...]) -> str:
    """What to do about a turning that did not end, one clause."""
    if not turning.has_field:
        return "its samples have no magnetic field: has it a magnetometer, and does its output carry it?"
    share = coverage(turning.cells(turning.fit()))
    if share < COVERAGE_WANTED:
        return f"it was turned into {share:.0%} of the directions, {COVERAGE_WANTED:.0%} are needed: turn it over, too"
    least = min(turning.turned_rad)
    if least < TURNS_WANTED_RAD:
        return "about one axis it was turned by less than 360°: turn it about each of its axes"
    if any(not check.passed for check in checks):
        return "the field is disturbed: go outdoors, or at least 30 cm from iron, motors, computers and telephones"
    return "the field is good: repeat it more slowly, for one to two minutes"


def _words(answer: object) -> str:
    """The device's answer for people."""
    if answer is None or answer is True:
        return ""
    if isinstance(answer, tuple | list):
        return ", ".join(f"{value:.6g}" if isinstance(value, float) else str(value) for value in answer)
    return str(answer)
