"""Guided calibrations of a fake device and of a simulated module, in virtual time.
Coverage, turns and the fitted sphere for points with known results."""

import asyncio
import re
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import replace
from itertools import permutations, product
from math import cos, pi, radians, remainder, sin
from types import SimpleNamespace
from typing import Any, cast

import pytest

from imud.contracts.command import GYRO_ZERO, Calibration, CalibrationResult, Handling, Kept, Target, Verdict
from imud.contracts.lines import DeviceLines
from imud.device.calibration import CalibrationRun, RestWindow, _field_checks, _words
from imud.device.health import DeviceEvents
from imud.device.transport import Transport
from imud.device.turns import Turning, cell_of, coverage
from imud.model.errors import BadArgument, CommandError, NoReply, Rejected
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger
from imud.model.sample import Pair, Sample, Sync, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sim.hipnuc.uart_settings import VARIANTS, HipnucHardware, ModuleSettings
from imud.sim.physics import Motion, Still, Truth, tumble
from tests.support.event_loops import VirtualClock, run_virtually
from tests.support.stories import played
from tests.support.wired_device import WiredDevice

TICK_S = 0.1
HARD_IRON_T: Vector3 = (14.14e-6, -2.08e-6, -8.75e-6)


class GuideRig:
    """A guide with a fake transport and generated samples."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.events: list[Event] = []
        self.ran: list[str] = []
        self.guide = CalibrationRun(cast(Transport, self), DeviceEvents("bow", Ledger(), self.events.append))
        self.motion: Callable[[float], Vector3] = lambda _t_s: (0.0, 0.0, 0.0)
        """Angular rate as a function of the time since the start."""
        self.mag_t: Callable[[float], Vector3 | None] = lambda _t_s: None
        self.silent = False
        self._begin_ns = self.clock.now_ns()

    async def run_script(self, make: Callable[..., Any], *arguments: Any) -> Any:
        made = make(Target(None, 115200))
        return await made if isinstance(made, Awaitable) else made

    def does(self, name: str, answer: object = None, seconds: float = 0.0) -> Callable[[Target], Any]:
        """Return a script that notes its name, lasts for `seconds`, and returns `answer`."""

        async def run() -> object:
            self.ran.append(name)
            await asyncio.sleep(seconds)
            return answer

        return lambda _target: run()

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        run_virtually(self.clock, self._play(story))

    async def _play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        ticking = asyncio.create_task(self._tick())
        try:
            await story()
        finally:
            ticking.cancel()

    async def _tick(self) -> None:
        seq = 0
        while True:
            now_ns = self.clock.now_ns()
            t_s = (now_ns - self._begin_ns) / NS_PER_S
            seq += not self.silent
            self.guide.tick(
                now_ns,
                Sample(
                    "bow", seq, now_ns, 0, Sync.ARRIVAL, now_ns, now_ns, accel_m_s2=(0.0, 0.0, 9.81),
                    gyro_rad_s=self.motion(t_s), mag_t=self.mag_t(t_s),
                )
                if seq
                else None,
            )  # fmt: skip
            await asyncio.sleep(TICK_S)

    def phases(self) -> list[object]:
        assert all(event.kind is EventKind.CALIBRATION for event in self.events)
        return [event.detail["phase"] for event in self.events]


def gyro(rig: GuideRig, **changes: Any) -> Calibration:
    made = Calibration(
        help="measure the bias", section="1.6", handling=Handling.REST, instructions=(),
        begin=rig.does("begin", (0.1, 0.2, 0.3), 3.0), expected=(GYRO_ZERO,), kept=Kept.BY_SAVE,
        save=rig.does("save"),
    )  # fmt: skip
    return replace(made, **changes)


def magnetometer(rig: GuideRig, verdicts: Callable[[], Verdict], **changes: Any) -> Calibration:
    return gyro(
        rig, handling=Handling.TURN, begin=rig.does("begin"), expected=(), kept=Kept.BY_DEVICE, save=None,
        verdict=lambda _target: verdicts(), **changes,
    )  # fmt: skip


# --- at rest ----------------------------------------------------------------------------------------------------------


@played(GuideRig)
async def test_calibration_at_rest_is_verified_and_saved(rig: GuideRig) -> None:
    running = asyncio.ensure_future(rig.guide.run("gyro", gyro(rig), save=True))
    await asyncio.sleep(1.0)
    assert rig.guide.status is not None
    assert (rig.guide.status.phase, rig.guide.status.limit_ns) == ("begin", None)
    result = await running
    assert rig.guide.status is None
    (check,) = result.checks
    assert check.name == "mean angular rate"
    assert check.passed
    assert result == CalibrationResult("gyro", True, "", "0.1, 0.2, 0.3", (check,), True, Kept.BY_SAVE)
    assert rig.ran == ["begin", "save"]
    assert rig.phases() == ["begin", "end"]
    assert rig.events[-1].detail["saved"] is True
    # 2 s at rest, 3 s of the calibration, 2 s for the filter of the device, 2 s at rest
    assert rig.clock.now_ns() / NS_PER_S == pytest.approx(1009, abs=0.5)


@played(GuideRig)
async def test_a_result_is_saved_only_on_request_and_if_it_is_verified(rig: GuideRig) -> None:
    result = await rig.guide.run("gyro", gyro(rig), save=False)
    assert (result.verified, result.saved, rig.ran) == (True, False, ["begin"])
    rig.ran.clear()
    for done in (True, False):
        begin = rig.does("begin", Verdict(done, "the parameters are 0, 0, 0"))
        result = await rig.guide.run("gyro", gyro(rig, begin=begin), save=True)
        assert (result.verified, result.saved, result.device) == (done, done, "the parameters are 0, 0, 0")
        assert result.problem == ("" if done else "the parameters are 0, 0, 0")
    assert rig.ran == ["begin", "save", "begin"]
    expectation = replace(GYRO_ZERO, value=lambda _means: None)
    result = await rig.guide.run("gyro", gyro(rig, expected=(expectation,)), save=False)
    assert result.problem == "mean angular rate: the samples do not contain this value"
    rig.ran.clear()
    rig.motion = lambda _t_s: (0.0, radians(0.3), 0.0)
    result = await rig.guide.run("gyro", gyro(rig), save=True)
    assert result.problem == "mean angular rate: expected at most 0.00175 rad/s, got 0.00524 rad/s"
    assert (result.verified, result.saved, rig.ran) == (False, False, ["begin"])


@played(GuideRig)
async def test_motion_prevents_the_start(rig: GuideRig) -> None:
    rig.motion = lambda _t_s: (0.0, 0.0, 0.5)
    with pytest.raises(
        CommandError, match=r"expected the device at rest, got: it turns at 28\.6 °/s .* put the device on a surface"
    ):
        await rig.guide.run("gyro", gyro(rig), save=False)
    assert rig.ran == []
    assert rig.phases()[-2:] == ["rest", "end"]
    assert rig.events[-1].message.startswith("calibration gyro: expected the device at rest, got: it turns at")
    assert rig.events[-1].detail["verified"] is False


@pytest.mark.parametrize(
    ("rate_rad_s", "silent", "change_s", "words"),
    [
        (0.5, False, 1.7, ""), (0.5, False, 2.05, ""), (0.5, True, 19.05, "it turns at 28.6 °/s"),
        (0.0, True, 19.05, "only 11 samples came"),
    ],
    ids=["no sample follows", "none after the window", "moved, few samples", "at rest, few samples"],
)  # fmt: skip
@played(GuideRig)
async def test_motion_and_too_few_samples_are_reported(
    rig: GuideRig, rate_rad_s: float, silent: bool, change_s: float, words: str
) -> None:
    rig.motion, rig.silent = lambda _t_s: (0.0, 0.0, rate_rad_s), silent
    running = asyncio.create_task(rig.guide.run("gyro", gyro(rig), save=False))
    await asyncio.sleep(change_s)
    rig.silent = not silent
    with pytest.raises(CommandError, match=f"expected the device at rest, got: {words}"):
        await running


@played(GuideRig)
async def test_the_guide_waits_for_rest(rig: GuideRig) -> None:
    rig.motion = lambda t_s: (0.0, 0.0, 0.5 if t_s < 5 else 0.0)
    assert (await rig.guide.run("gyro", gyro(rig), save=False)).verified
    assert rig.phases()[:2] == ["begin", "rest"]
    assert rig.phases().count("rest") == 3  # one event per window of 2 s


@pytest.mark.parametrize("restarts", [False, True])
@played(GuideRig)
async def test_motion_or_a_restart_during_the_calibration_is_an_error(rig: GuideRig, restarts: bool) -> None:
    clock = SimpleNamespace(resets=4)
    rig.guide.start(cast(SampleClock, clock))
    rig.motion = lambda t_s: (0.0, 0.0, 0.5 if 4 < t_s < 4.5 and not restarts else 0.0)
    running = asyncio.ensure_future(rig.guide.run("gyro", gyro(rig), save=True))
    await asyncio.sleep(4)
    clock.resets += restarts
    result = await running
    words = "restarted during the calibration" if restarts else "moved during the calibration: the angular rate changes"
    assert result.problem.startswith(f"the device {words}")
    assert not result.saved
    assert rig.ran == ["begin"]


@played(GuideRig)
async def test_no_samples_and_refusals(rig: GuideRig) -> None:
    async def refuse() -> None:
        raise Rejected("no")

    rig.silent = True
    with pytest.raises(CommandError, match="gyro: expected samples of the device, got no sample for 20 s"):
        await rig.guide.run("gyro", gyro(rig), save=False)
    assert rig.clock.now_ns() >= 1020 * NS_PER_S
    rig.silent = False
    with pytest.raises(CommandError, match="heading: the device cannot save the result"):
        await rig.guide.run("heading", gyro(rig, kept=Kept.NEVER), save=True)
    with pytest.raises(CommandError, match="gyro: set the mode first"):
        await rig.guide.run("gyro", gyro(rig, unready=rig.does("ready?", "set the mode first")), save=False)
    with pytest.raises(Rejected):
        await rig.guide.run("gyro", gyro(rig, begin=lambda _target: refuse()), save=False)
    first = asyncio.create_task(rig.guide.run("gyro", gyro(rig), save=False))
    await asyncio.sleep(1)
    with pytest.raises(CommandError, match="another calibration of this device is running"):
        await rig.guide.run("gyro", gyro(rig), save=False)
    assert (await first).verified


@pytest.mark.parametrize("end", ["stop", "cancel", "close"])
@played(GuideRig)
async def test_a_calibration_can_be_cancelled(rig: GuideRig, end: str) -> None:
    script: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    running = asyncio.create_task(rig.guide.run("gyro", gyro(rig, begin=lambda _target: script), save=False))
    await asyncio.sleep(3)
    getattr(rig.guide, end)()
    with pytest.raises(CommandError, match="link ended" if end == "stop" else "was cancelled"):
        await running
    assert script.cancelled()
    assert rig.phases() == ["begin", "end"], "who looks on is told, too"
    assert rig.events[-1].message == (
        "calibration gyro: the device's link ended during the calibration"
        if end == "stop"
        else "calibration gyro: it was cancelled"
    )
    assert not rig.guide.cancel()
    assert (await rig.guide.run("gyro", gyro(rig), save=False)).verified  # and the next calibration can start


# --- turned -----------------------------------------------------------------------------------------------------------


def turned_by_hand(rig: GuideRig, hard_iron_t: Vector3 = (0.0, 0.0, 0.0)) -> None:
    a, b, c = hard_iron_t

    def mag_t(t_s: float) -> Vector3:
        x, y, z = tumble().at(t_s).mag_t
        return (x + a, y + b, z + c)

    rig.motion, rig.mag_t = lambda t_s: tumble().at(t_s).gyro_rad_s, mag_t


def turned_where_it_is_disturbed(rig: GuideRig) -> None:
    """Return a field that is stronger in one direction."""
    turned_by_hand(rig)

    def mag_t(t_s: float) -> Vector3:
        x, y, z = tumble().at(t_s).mag_t
        factor = 1.4 if tumble().at(t_s).euler_rad[2] > 0 else 0.8
        return (x * factor, y * factor, z * factor)

    rig.mag_t = mag_t


@pytest.mark.manual("B 8.1.1 procedure")
@played(GuideRig)
async def test_the_turns_end_when_the_device_reports_the_end(rig: GuideRig) -> None:
    turned_by_hand(rig, HARD_IRON_T)

    def verdict() -> Verdict:
        done = rig.clock.now_ns() > 1060 * NS_PER_S
        if done:  # this device sends the field without its bias
            return Verdict(done, "bias 14.1, -2.1, -8.8 µT", bias_t=HARD_IRON_T)
        return Verdict(done, "bias 0, 0, 0 µT", bias_t=(0.0, 0.0, 0.0))

    result = await rig.guide.run("magnetometer", magnetometer(rig, verdict), save=False)
    assert result.verified
    assert result.saved
    assert result.device == "bias 14.1, -2.1, -8.8 µT"
    residual, field, offset = result.checks
    assert offset.value == pytest.approx(0.0, abs=1e-9)
    assert residual.value == pytest.approx(0.0, abs=1e-6)
    assert field.value == pytest.approx(45.1e-6, rel=1e-3)
    assert rig.clock.now_ns() > 1060 * NS_PER_S
    turning = [event.detail for event in rig.events if event.detail["phase"] == "turn"]
    # two per second, and the first and the last query
    assert 100 <= len(turning) <= 2 * (rig.clock.now_ns() // NS_PER_S - 1000) + 2
    progress = [float(detail["progress"] or 0) for detail in turning]
    assert (progress[-1], max(progress)) == (1.0, 1.0)
    assert progress[0] < 0.1
    assert int(str(turning[-1]["cells"]), 16).bit_count() == round(48 * float(turning[-1]["coverage"] or 0))


@played(GuideRig)
async def test_a_calibrated_device_only_needs_the_turns(rig: GuideRig) -> None:
    turned_by_hand(rig)
    result = await rig.guide.run("magnetometer", magnetometer(rig, lambda: Verdict(True, "x")), save=False)
    assert result.verified
    assert 1022 * NS_PER_S < rig.clock.now_ns() < 1023 * NS_PER_S  # the end of the first turn about Z


@pytest.mark.parametrize(
    ("prepare", "words"),
    [
        (lambda _rig: None, "its samples contain no magnetic field"),
        (lambda rig: setattr(rig, "mag_t", lambda _t_s: (3e-5, 0.0, 0.0)),
         "turned to 2% of the directions, expected 60%"),
        (lambda rig: setattr(rig, "mag_t", lambda t_s: tumble().at(t_s).mag_t), "turned by less than 360°"),
        (turned_by_hand, "the field is good: repeat the calibration more slowly"),
        (turned_where_it_is_disturbed, "the field is disturbed: go outdoors"),
    ],
    ids=["no field", "at rest", "gyroscope at rest", "not accepted", "disturbed"],
)  # fmt: skip
@pytest.mark.manual("B 8.1.1 procedure", "B 8.1.2 disturbance")
@played(GuideRig)
async def test_advice(rig: GuideRig, prepare: Callable[[GuideRig], object], words: str) -> None:
    prepare(rig)
    asked: list[int] = []

    def verdict() -> Verdict:
        asked.append(rig.clock.now_ns())
        return Verdict(rig.clock.now_ns() > 1290 * NS_PER_S, "bias 0, 0, 0 µT")  # done, with the previous result

    result = await rig.guide.run("magnetometer", magnetometer(rig, verdict), save=False)
    assert 98 <= len(asked) <= 101  # one query every 3 s
    assert not result.verified
    assert not result.saved
    assert result.problem.startswith("the device did not finish the calibration within 300 s; ")
    assert words in result.problem
    assert not any(check.passed for check in result.checks if check.value is None)


# --- a simulated module -----------------------------------------------------------------------------------------------


class ByHand:
    def __init__(self, from_s: float) -> None:
        self._from_s = from_s

    def at(self, t_s: float) -> Truth:
        return Still(0.05, -0.03, 0.4).at(t_s) if t_s < self._from_s else tumble().at(t_s)


class OnTheSpot:
    """A level vehicle that turns about the vertical axis once in ten seconds."""

    def at(self, t_s: float) -> Truth:
        rate_rad_s = 2 * pi / 10
        return Still(0.0, 0.0, remainder(rate_rad_s * t_s, 2 * pi)).at(t_s)._replace(gyro_rad_s=(0.0, 0.0, rate_rad_s))


def module(motion: Motion, att_mode: int, variant: str = "as in the manual") -> WiredDevice:
    behaviour = VARIANTS[variant]
    hardware = HipnucHardware(motion=motion, hard_iron_t=HARD_IRON_T, behaviour=behaviour, firmware=behaviour.firmware)
    return WiredDevice(DeviceLines(), ModuleSettings(att_mode=att_mode), hardware)


@pytest.mark.manual("B 1.1 9-axis mode")
@played(lambda: module(ByHand(5.0), 1))
async def test_magnetometer_of_a_module(it: WiredDevice) -> None:
    await it.wait(2)
    result = await it.device.calibrate("magnetometer", save=False)
    assert result.verified, result.problem
    assert result.device == "bias 14.14, -2.08, -8.75 µT"
    assert any(event.kind is EventKind.CALIBRATION for event in it.events)


@pytest.mark.parametrize(
    ("kind", "motion"), [("magnetometer_start", ByHand(5.0)), ("magnetometer_2d", OnTheSpot())], ids=["3D", "2D"]
)
@played(lambda motion: module(motion, 0, "firmware 1.7"))
async def test_magnetometer_by_a_command_with_the_progress_of_the_device(
    it: WiredDevice, kind: str, motion: Motion
) -> None:
    await it.wait(2)
    result = await it.device.calibrate(kind, save=False)
    assert result.verified, result.problem
    assert result.device == "bias 14.14, -2.08, -8.75 µT, STATE DONE"
    assert [check.name for check in result.checks][-1] == "offset of the field"
    assert len(result.checks) == (1 if kind == "magnetometer_2d" else 3)
    steps = [event.detail for event in it.events if event.detail.get("phase") == "turn"]
    shown = [cast(float, step["device_progress"]) for step in steps]
    assert shown == sorted(shown) or shown[0] == 1.0  # the first query can be before the start
    assert (steps[-1]["progress"], shown[-1]) == (1.0, 1.0)
    assert any(0.0 < one < 1.0 for one in shown)


@pytest.mark.parametrize(
    ("variant", "words"),
    [
        ("calibration ignored", "expected a running calibration, got “bias 0, 0, 0 µT, STATE DONE” of an earlier"),
        ("calibration without bias", "the bias of the device does not fit the measured field: expected an offset of"),
        (
            "calibration fails",
            "the device reports that the calibration failed: bias 0, 0, 0 µT, STATE FAILED",
        ),
    ],
)
@pytest.mark.parametrize(
    ("kind", "motion"), [("magnetometer_start", ByHand(5.0)), ("magnetometer_2d", OnTheSpot())], ids=["3D", "2D"]
)
@played(lambda variant, words, kind, motion: module(motion, 0, variant))
async def test_calibration_without_evidence_is_not_verified(
    it: WiredDevice, variant: str, words: str, kind: str, motion: Motion
) -> None:
    """The device replies OK to the start in each case. The words do not depend on the time limit of the turns."""
    await it.wait(2)
    start_ns = it.clock.now_ns()
    result = await it.device.calibrate(kind, save=False)
    assert (result.verified, result.saved) == (False, False)
    assert words in result.problem
    assert it.clock.now_ns() - start_ns < 100 * NS_PER_S
    assert "restarted" not in result.problem
    if variant != "calibration fails":
        shown = re.search(r"at most 3 µT, got (.*), (.*), (.*) µT", result.problem)
        assert shown is not None
        x_ut, y_ut, z_ut = (float(value) for value in shown.groups())
        expected = (14.14, -2.08, 0.0 if kind == "magnetometer_2d" else -8.75)
        assert (x_ut, y_ut, z_ut) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("earlier", [Verdict(True, "STATE DONE"), Verdict(False, "STATE FAILED", has_failed=True)])
@played(lambda earlier: GuideRig())
async def test_end_of_earlier_calibration_needs_running_state(rig: GuideRig, earlier: Verdict) -> None:
    turned_by_hand(rig)
    calibration = magnetometer(rig, lambda: earlier, reports_start=True)
    result = await rig.guide.run("magnetometer", calibration, save=False)
    assert not result.verified
    assert f"got “{earlier.words}” of an earlier calibration" in result.problem
    assert rig.clock.now_ns() < 1032 * NS_PER_S

    start_ns = rig.clock.now_ns()

    def verdict() -> Verdict:
        is_running = 2 * NS_PER_S < rig.clock.now_ns() - start_ns < 30 * NS_PER_S
        return Verdict(False, "STATE RUNNING") if is_running else Verdict(True, "STATE DONE")

    calibration = magnetometer(rig, verdict, reports_start=True)
    assert (await rig.guide.run("magnetometer", calibration, save=False)).verified


@played(GuideRig)
async def test_lost_replies_do_not_end_the_turns(rig: GuideRig) -> None:
    turned_by_hand(rig)
    queries: list[int] = []

    def verdict() -> Verdict:
        queries.append(rig.clock.now_ns())
        if 3 <= len(queries) <= lost_until:
            raise NoReply("LOG MCAL STAT: expected OK, got no reply")
        return Verdict(len(queries) > 12, f"bias {len(queries) > 12}")

    lost_until = 6
    assert (await rig.guide.run("magnetometer", magnetometer(rig, verdict), save=False)).verified
    queries.clear()
    lost_until = 7
    with pytest.raises(NoReply, match="got no reply"):
        await rig.guide.run("magnetometer", magnetometer(rig, verdict), save=False)


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (Kept.BY_DEVICE, "x: a save is not necessary, because the device saves the result itself; repeat the command"),
        (Kept.NEVER, "x: the device cannot save the result, which lasts until power-off; repeat the command"),
    ],
)
@played(lambda kept, words: GuideRig())
async def test_needless_save_is_refused_with_the_next_step(rig: GuideRig, kept: Kept, words: str) -> None:
    with pytest.raises(CommandError, match=f"^{words} without --save$"):
        await rig.guide.run("x", gyro(rig, kept=kept), save=True)


@pytest.mark.parametrize("kind", ["magnetometer_start", "magnetometer_2d"])
@played(lambda kind: module(ByHand(5.0) if kind == "magnetometer_start" else OnTheSpot(), 0, "lost replies"))
async def test_calibration_with_lost_replies_is_verified(it: WiredDevice, kind: str) -> None:
    await it.wait(2)
    result = await it.device.calibrate(kind, save=False)
    assert result.verified, result.problem


@played(lambda: module(Still(0.05, -0.03, 0.4), 1))
async def test_a_calibration_that_the_firmware_does_not_know(it: WiredDevice) -> None:
    await it.wait(2)
    with pytest.raises(
        CommandError, match=r"^magnetometer_2d: LOG MCAL STAT: not supported by firmware 1\.5\.6: expected OK, got no"
    ):
        await it.device.calibrate("magnetometer_2d", save=False)


@played(lambda: module(Still(0.05, -0.03, 0.4), 0, "firmware 1.7"))
async def test_a_vehicle_that_does_not_turn_is_not_calibrated(it: WiredDevice) -> None:
    await it.wait(2)
    result = await it.device.calibrate("magnetometer_2d", save=False)
    assert not result.verified
    assert result.problem.endswith("within 300 s; it was turned by less than 360°: turn it about the vertical axis")


@pytest.mark.manual("B 2.2.4 YAW range")
@played(lambda: module(Still(0.05, -0.03, 0.4), 0))
async def test_level_and_heading_of_a_module(it: WiredDevice) -> None:
    await it.wait(2)
    level = await it.device.calibrate("level", save=True)
    assert level.verified, level.problem
    assert level.saved
    assert [check.name for check in level.checks] == ["roll", "pitch"]
    heading = await it.device.calibrate("heading", save=False)
    assert heading.verified, heading.problem
    assert [*it.device.last_calibrations] == ["level", "heading"]
    it.module.reboot(it.clock.now_ns())
    await it.wait(5)
    newest = it.samples[-1].euler_rad
    assert newest is not None
    assert abs(newest[0]) < 0.01  # the module has saved the level
    assert abs(newest[2]) > 0.3  # the module cannot save the heading


@pytest.mark.manual("B 2.2.4 rest")
@played(lambda: module(tumble(), 0))
async def test_a_module_in_six_axis_mode_that_moves_refuses_calibrations(it: WiredDevice) -> None:
    await it.wait(2)
    with pytest.raises(
        CommandError, match=r"magnetometer: expected 9-axis mode, .*`imud settings NAME --set mode=9-axis`"
    ):
        await it.device.calibrate("magnetometer", save=False)
    with pytest.raises(BadArgument, match=r"unknown calibration 'gyro'; expected: magnetometer, .*, heading"):
        await it.device.calibrate("gyro", save=False)
    before = it.module.settings.level
    with pytest.raises(CommandError, match="expected the device at rest"):
        await it.device.calibrate("level", save=True)
    assert it.module.settings.level == before
    # imud has sent nothing
    assert not it.device.settings.is_unsaved
    assert not it.device.stop_calibration()
    running = asyncio.ensure_future(it.device.calibrate("level", save=True))
    await it.wait(1)
    it.link.disappear()
    with pytest.raises(CommandError, match="link ended during the calibration"):
        await running


@pytest.mark.parametrize(
    ("answer", "words"),
    [(None, ""), (True, ""), (False, "False"), ((1 / 3, 2), "0.333333, 2"), (["a"], "a"), ("done", "done"), (7, "7")],
)
def test_the_reply_of_a_device_in_words(answer: object, words: str) -> None:
    assert _words(answer) == words


WINDOW_SAMPLES = 20

UP: Vector3 = (0.0, 0.0, 9.80665)
STILL: Vector3 = (0.0, 0.0, 0.0)


def sample(
    accel: Vector3 | None = UP, gyro: Vector3 | None = STILL, euler: Vector3 | None = None, incli: Pair | None = None
) -> Sample:
    return Sample(
        "bow", 1, 1, 0, Sync.ARRIVAL, 1, 1, accel_m_s2=accel, gyro_rad_s=gyro, euler_rad=euler, incli_rad=incli
    )


def window(*samples: Sample) -> RestWindow:
    made = RestWindow()
    for one in samples:
        made.add(one)
    return made


@pytest.mark.parametrize(
    ("samples", "words"),
    [
        ([sample()] * WINDOW_SAMPLES, ""),
        ([sample(gyro=(radians(2), 0.0, 0.0))], ""),  # a constant bias is not a motion
        ([sample(accel=None, gyro=None)], ""),
        ([sample(), sample(gyro=(radians(4), 0, 0))], "the angular rate changes by 2 °/s (at most 1 °/s at rest)"),
        ([sample(gyro=(0, radians(6), 0))], "it turns at 6 °/s (at most 5 °/s at rest)"),
        ([sample(), sample(accel=(2.0, 0.0, 9.80665))],
         "the acceleration changes by 1 m/s² (at most 0.5 m/s² at rest)"),
        ([sample(accel=(0.0, 0.0, 10.80665))],
         "the acceleration differs from gravity by 1 m/s² (at most 0.49 m/s² at rest)"),
    ],
)  # fmt: skip
def test_rest_and_motion(samples: list[Sample], words: str) -> None:
    assert window(*samples).motion() == words


def test_the_newest_samples_count_and_have_means() -> None:
    moved = window(sample(gyro=(1.0, 0, 0)), *[sample()] * (WINDOW_SAMPLES - 1))
    assert moved.full
    assert moved.motion()
    moved.add(sample())
    assert moved.motion() == ""
    moved.clear()
    assert not moved.full
    assert moved.means().gyro_rad_s is None
    means = window(
        sample((1.0, 0.0, 9.0), (0.1, 0.0, 0.0), (0.1, 0.0, pi - 0.1), (0.2, pi)),
        sample((3.0, 0.0, 10.0), (0.3, 0.0, 0.0), (0.3, 0.0, -pi + 0.3), (0.4, -pi)),
    ).means()
    assert (means.accel_m_s2, means.gyro_rad_s) == ((2.0, 0.0, 9.5), (0.2, 0.0, 0.0))
    assert means.euler_rad == pytest.approx((0.2, 0.0, -pi + 0.1))  # angles on both sides of ±180°
    assert means.incli_rad is not None
    assert (means.incli_rad[0], abs(means.incli_rad[1])) == (pytest.approx(0.3), pytest.approx(pi))
    assert window(sample(None, None)).means().incli_rad is None


POINTS_MAX = 1024

CENTRE: Vector3 = (14e-6, -2e-6, -9e-6)


def turned(t_ns: int, mag: Vector3 | None = None, gyro: Vector3 | None = None) -> Sample:
    return Sample("bow", 1, t_ns, 0, Sync.ARRIVAL, t_ns, t_ns, mag_t=mag, gyro_rad_s=gyro)


def of(points: list[Vector3]) -> Turning:
    """Return the result for these field vectors, 0.1 s apart."""
    turning = Turning()
    for number, point in enumerate(points):
        turning.add(turned(number * 100 * NS_PER_MS, point))
    return turning


def axes(x: float, r: float = 45e-6) -> list[Vector3]:
    a, b, c = CENTRE
    return [(a + x, b, c), (a - x, b, c), (a, b + r, c), (a, b - r, c), (a, b, c + r), (a, b, c - r)] * 2


def test_each_cell_is_one_direction_and_coverage_is_seen_from_the_centre() -> None:
    directions = [
        tuple(sign * value for sign, value in zip(signs, values, strict=True))
        for signs in product((1, -1), repeat=3)
        for values in permutations((1.0, 2.0, 3.0))
    ]
    assert {cell_of((x, y, z)) for x, y, z in directions} == set(range(48))
    assert (cell_of((3.0, 2.0, 1.0)), coverage(0b1011)) == (0, 3 / 48)
    # A field of 45 µT with a bias of 60 µT covers half of the directions, seen from the origin.
    truth = [tumble().at(second / 10).mag_t for second in range(1000)]
    turning = of([(x + 60e-6, y, z) for x, y, z in truth])
    sphere = turning.fit()
    assert sphere is not None
    assert sphere.centre_t == pytest.approx((60e-6, 0.0, 0.0), abs=1e-9)
    assert coverage(turning.cells(sphere)) > 0.9
    assert coverage(turning.cells(None)) < 0.6
    turning.restart_field()
    assert not turning.has_field


def test_sphere_of_six_points_and_points_without_a_sphere() -> None:
    """Points on the axes at 45 µT about the centre, then the same with a radius of 40 µT along X."""
    assert of(axes(45e-6)[:-1]).fit() is None, "it needs 12 points"
    sphere = of(axes(45e-6)).fit()
    assert sphere is not None
    assert sphere.centre_t == pytest.approx(CENTRE)
    assert sphere.radius_t == pytest.approx(45e-6)
    assert sphere.residual < 1e-9
    flattened = of(axes(40e-6)).fit()
    assert flattened is not None
    # mean of |m - c|² = (40² + 2·45²)/3 = 1883.3 = r², residuals -283.3, 141.7, 141.7: 200.3 / (2 r²) = 0.0532
    assert flattened.radius_t == pytest.approx(43.4e-6, abs=1e-8)
    assert flattened.residual == pytest.approx(0.0532, abs=1e-4)
    for radius_t, passed in ((21.9e-6, False), (22.1e-6, True), (66.9e-6, True), (67.1e-6, False)):
        residual, strength, _ = _field_checks(of(axes(radius_t, radius_t)), Verdict(True, ""))
        assert (residual.limit, residual.passed) == (0.05, True)
        assert (strength.limit, strength.passed) == (67e-6, passed)
    for apart_t, points in ((4.9e-6, 1), (5.1e-6, 2)):
        assert of([(apart_t / 2, 0.0, 0.0), (-apart_t / 2, 0.0, 0.0)]).cells(None).bit_count() == points
    circle = ((1, 0), (0, 1), (-1, 0), (0, -1), (0.6, 0.8), (-0.6, 0.8))
    plane: list[Vector3] = [(4e-5 * x, 4e-5 * y, 0.0) for x, y in circle]
    for without in ([], [(1e-6, 0.0, 0.0)] * 50, plane * 4, [(0.0, 0.0, 0.0)] * 50):
        assert of(without).fit() is None, without[:6]


def test_offset_of_the_field() -> None:
    """3D: a sphere about CENTRE. 2D: a circle about a tilted axis; the part along the axis is not an offset."""
    sphere = of(axes(45e-6))
    assert sphere.offset(None) == pytest.approx(CENTRE)
    assert sphere.offset((0.0, 0.0, 0.0)) == pytest.approx(CENTRE)
    assert sphere.offset(CENTRE) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)  # the field without the bias

    for axis, u, v in (
        ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ((0.0, 0.6, 0.8), (1.0, 0.0, 0.0), (0.0, 0.8, -0.6)),
    ):
        circle = Turning(is_planar=True)
        assert circle.offset(None) is None
        for number in range(80):
            angle = number * pi / 20
            height = 40e-6 + 1e-6 * (number % 3)  # the vehicle rocks
            x, y, z = (
                30e-6 * a + 20e-6 * (cos(angle) * b + sin(angle) * c) + 7e-6 * b - 5e-6 * c + height * a
                for a, b, c in zip(axis, u, v, strict=True)
            )
            sign = 1 if number < 40 else -1  # the vehicle turns back
            gyro_x, gyro_y, gyro_z = (sign * pi / 2 * value for value in axis)
            circle.add(turned(number * 100 * NS_PER_MS, (x, y, z), (gyro_x, gyro_y, gyro_z)))
        assert circle.share == 1.0
        offset_t = circle.offset((0.0, 0.0, 0.0))
        assert offset_t is not None
        a, b, c = (7e-6 * left - 5e-6 * right for left, right in zip(u, v, strict=True))
        assert offset_t == pytest.approx((a, b, c), abs=2e-7)
        x, y, z = axis
        without_bias_t = circle.offset((a + 9e-6 * x, b + 9e-6 * y, c + 9e-6 * z))
        assert without_bias_t == pytest.approx((0.0, 0.0, 0.0), abs=2e-7)
        circle.restart_field()
        assert circle.share == 0.0
        assert circle.offset(None) is None


def test_turns_and_bounded_memory() -> None:
    turning = Turning()
    for number in range(11):
        turning.add(turned(number * 100 * NS_PER_MS, None, (pi, -pi / 2, 0.0)))
    assert turning.turned_rad == pytest.approx((pi, pi / 2, 0.0))
    for t_ms, turned_z_rad in ((2001, 0.0), (3001, pi)):  # a gap of more than 1 s is not part of the angle
        turning.add(turned(t_ms * NS_PER_MS, None, (0.0, 0.0, pi)))
        assert turning.turned_rad == pytest.approx((pi, pi / 2, turned_z_rad))
    assert not turning.has_field
    # two alternating directions use all points, and a third direction arrives too late
    turning = of([(4e-5, 2e-5, 1e-5), (-4e-5, -2e-5, -1e-5)] * (POINTS_MAX // 2))
    turning.add(turned(10**12, (1e-5, 2e-5, 4e-5)))
    assert turning.cells(None).bit_count() == 2
    near = of([(4e-5, 2e-5, 1e-5 + number * 1e-9) for number in range(POINTS_MAX)])
    near.add(turned(10**12, (1e-5, 2e-5, 4e-5)))
    assert near.cells(None).bit_count() == 2  # equal points use one place
