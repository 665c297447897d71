"""The guide of a calibration: checks rest, starts it on the device, watches the samples, and verifies the result.

    ready? ──▶ rest? ──▶ begin ──▶ rest? ──▶ samples as expected? ──▶ save        the device must not move
    ready? ──▶ begin ──▶ turning, until the device says that it is done ──▶ field as expected?      it is turned

It looks at the newest sample ten times a second. Progress goes out as events.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any, Final

from imud.clock import SampleClock
from imud.contracts.action import Target
from imud.contracts.control.calibration import (
    Calibration,
    CalibrationResult,
    Check,
    Expectation,
    Handling,
    Kept,
    RestMeans,
    Verdict,
)
from imud.errors import CommandError, ImudError
from imud.event import EventKind
from imud.runtime.calibration.rest import RestWindow
from imud.runtime.calibration.turning import (
    COVERAGE_WANTED,
    FIELD_MAX_T,
    FIELD_MIN_T,
    RESIDUAL_MAX,
    TURNS_WANTED_RAD,
    Turning,
    coverage,
)
from imud.runtime.notices import Notices
from imud.sample import Sample
from imud.units import NS_PER_S

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

RunScript = Callable[[Callable[[Target], Any]], Awaitable[Any]]
"""Runs a script that a function makes from the target. Raises CommandError, TransferError, DeviceRefused, LinkError."""


class Guide:
    """Guide of one device's calibrations, one at a time; an attachment. Synchronization: the loop's thread only."""

    def __init__(self, run_script: RunScript, notices: Notices) -> None:
        self._run_script = run_script
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
        if calibration.unready is not None and (words := await self._run_script(calibration.unready)):
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
            await self._run_script(calibration.save)
            saved = True
        self._report(kind, "end", problem or "verified", verified=not problem, saved=saved)
        return CalibrationResult(kind, not problem, problem, device, checks, saved, calibration.kept)

    async def _at_rest(self, kind: str, calibration: Calibration) -> tuple[str, tuple[Check, ...], str]:
        """Calibrate a device that must not move; return the device's words, the checks, and what is wrong."""
        await self._rest(kind)
        window = RestWindow()
        script: asyncio.Future[Any] = asyncio.ensure_future(self._run_script(calibration.begin))
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
        before = verdict = await self._run_script(ask) if ask is not None else Verdict(done=False, words="")
        await self._run_script(calibration.begin)
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
                last, verdict = verdict, await self._run_script(ask)
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
