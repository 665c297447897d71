"""Guide of a calibration: check the rest, start the calibration on the device, check the samples, verify the result.

    ready? ──▶ rest? ──▶ begin ──▶ rest? ──▶ samples as expected? ──▶ save        for a device at rest
    ready? ──▶ begin ──▶ turn the device until it reports the end ──▶ field as expected?   for a turned device

The guide checks the newest sample ten times per second. Events report the progress.
"""

import asyncio
import logging
from collections import deque
from collections.abc import Iterable
from math import atan2, cos, hypot, sin
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
from imud.device.turns import (
    COVERAGE_WANTED,
    FIELD_MAX_T,
    FIELD_MIN_T,
    OFFSET_MAX_T,
    RESIDUAL_MAX,
    TURNS_WANTED_RAD,
    Turning,
    coverage,
)
from imud.model.errors import CommandError, ImudError, NoReply
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


log = logging.getLogger(__name__)

REST_LIMIT_NS: Final = 20 * NS_PER_S  # maximum wait for the rest of the device, ns
TURN_LIMIT_NS: Final = 300 * NS_PER_S  # maximum time for the turns, ns. The manual specifies one to two minutes.
REPORT_NS: Final = NS_PER_S // 2  # interval of progress events, ns
ASK_NS: Final = 3 * NS_PER_S  # interval of queries during the turns, ns. Each query can cost some samples.
START_LIMIT_NS: Final = 10 * NS_PER_S
"""Time in which a device must report the calibration that imud started, ns: three queries and a lost reply."""
UNSTARTED_LIMIT_NS: Final = 30 * NS_PER_S  # maximum time of the turns if the device does not report a start, ns
LOST_REPLIES_MAX: Final = 5  # maximum number of queries in sequence without a reply: 15 s
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
            raise CommandError(f"{kind}: {_SAVE_REFUSALS[calibration.kept]}; repeat the command without --save")
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
        if self._resets != resets and not problem:  # the clock can also count a pause of the samples as a restart
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
        turning = Turning(is_planar=calibration.handling is Handling.SPIN)
        start_ns = report_ns = ask_ns = self._now_ns
        lost_replies = 0
        # The end of an earlier calibration is not evidence: after it, the device must report a running calibration.
        has_run = not (calibration.reports_start and (before.done or before.has_failed))
        problem = "the device did not finish the calibration"

        while self._now_ns - start_ns < TURN_LIMIT_NS:
            now_ns, sample = await self._next()
            if sample is not None:
                turning.add(sample)
            if now_ns >= report_ns:
                report_ns = now_ns + REPORT_NS
                self._report_turning(kind, turning, verdict)
            if ask is not None and now_ns >= ask_ns:
                ask_ns = now_ns + ASK_NS
                last = verdict
                try:
                    verdict = await self._transport.run_script(ask)
                    lost_replies = 0
                except NoReply as error:
                    lost_replies += 1
                    log.info("%s: %s: no reply to the query: %s", self._events.device, kind, error)
                    if lost_replies >= LOST_REPLIES_MAX:
                        raise
                if verdict.words != last.words:
                    turning.restart_field()
                has_run = has_run or not (verdict.done or verdict.has_failed)
            if not has_run:
                if _is_unstarted(now_ns - start_ns, turning):
                    return verdict.words, _field_checks(turning, verdict), _describe_missing_start(turning, verdict)
                continue
            if verdict.has_failed:
                advice = _advice(turning, _field_checks(turning, verdict))
                text = f"the device reports that the calibration failed: {verdict.words}; {advice}"
                return verdict.words, _field_checks(turning, verdict), text
            is_new = calibration.reports_start or verdict.words != before.words or before.done
            if verdict.done and turning.share >= 1.0 and is_new:
                problem = _offset_problem(turning, verdict)
                self._report_turning(kind, turning, verdict)
                return verdict.words, _field_checks(turning, verdict), problem

        checks = _field_checks(turning, verdict)
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


OFFSET_NAME: Final = "offset of the field"
_SAVE_REFUSALS: Final = {
    Kept.BY_DEVICE: "a save is not necessary, because the device saves the result itself",
    Kept.NEVER: "the device cannot save the result, which lasts until power-off",
}


def check(expectation: Expectation, means: RestMeans) -> Check:
    """Compare the means of the samples with an expectation."""
    value = expectation.value(means)
    return _bounded(expectation.name, value, expectation.limit, expectation.unit)


def _bounded(name: str, value: float | None, limit: float, unit: str) -> Check:
    return Check(name, value, limit, unit, value is not None and value <= limit)


def _field_checks(turning: Turning, verdict: Verdict) -> tuple[Check, ...]:
    offset_t = turning.offset(verdict.bias_t)
    length_t = None if offset_t is None else hypot(*offset_t)
    offset = _bounded(OFFSET_NAME, length_t, OFFSET_MAX_T, "T")
    if turning.is_planar:
        return (offset,)

    sphere = turning.fit()
    if sphere is None:
        return (Check("residual of the field", None, RESIDUAL_MAX, "", False),)
    low, high = FIELD_MIN_T, FIELD_MAX_T
    return (
        _bounded("residual of the field", sphere.residual, RESIDUAL_MAX, ""),
        Check("field strength", sphere.radius_t, high, "T", low <= sphere.radius_t <= high),
        offset,
    )


def _offset_problem(turning: Turning, verdict: Verdict) -> str:
    """Return that the bias of the device does not fit the measured field; empty if it fits."""
    offset_t = turning.offset(verdict.bias_t)
    if offset_t is None or hypot(*offset_t) <= OFFSET_MAX_T:
        return ""
    offset_text = ", ".join(f"{value / T_PER_UT:.1f}" for value in offset_t)
    return (
        f"the bias of the device does not fit the measured field: expected an offset of at most "
        f"{OFFSET_MAX_T / T_PER_UT:g} µT, got {offset_text} µT; repeat the calibration"
    )


def _is_unstarted(duration_ns: int, turning: Turning) -> bool:
    """Return whether imud stops to wait for the start of the calibration. The complete turns show the offset."""
    return duration_ns >= UNSTARTED_LIMIT_NS or (duration_ns >= START_LIMIT_NS and turning.share >= 1.0)


def _describe_missing_start(turning: Turning, verdict: Verdict) -> str:
    """Return that the device did not start the calibration, and the measured offset."""
    offset = _offset_problem(turning, verdict) if turning.share >= 1.0 else ""
    return (
        f"the device accepted the start, but expected a running calibration, got “{verdict.words}” of an earlier "
        f"calibration; {offset or 'restart the device and repeat the calibration'}"
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
