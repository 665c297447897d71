"""Calibrations of simulated devices in all variants. Changed parameters show the end, not K1, S1 or CMD 8."""

from collections.abc import Callable
from dataclasses import replace
from math import radians

import pytest

from imud.contracts.command import Kept, Target
from imud.contracts.script import RequestScript
from imud.drivers.imu61x.uart import driver as calibrating
from imud.drivers.imu61x.uart.commands import Command
from imud.drivers.imu61x.uart.driver import CALIBRATIONS
from imud.model.errors import NoReply, Rejected
from imud.sim.imu61x.uart import STATUS, Imu61xHardware
from imud.sim.physics import Noise, Still, swing
from tests.support.simulated_modules import Imu61xBench, done, every_variant, imu61x_bench, variant_bench

ACKNOWLEDGING = [calibrating.calibrate_gyro, calibrating.calibrate_installation]
CALIBRATING = frozenset({Command.CALIBRATE_GYRO, Command.CALIBRATE_INSTALLATION})
# Maximum time of a calibration of 3 s, ns: imud waits for K1, and for a device that is quiet after each reply
LIMIT_NS = {"no K1": 14e9, "quiet after an answer": 12e9, "all at once": 12e9}


@every_variant
@pytest.mark.manual("A 1.5 parameters 8 to 10", "A 1.6 CMD 10")
def test_gyro_calibration_takes_the_bias_off(variant: str) -> None:
    far = variant_bench(variant, noise=Noise(3))
    before = far.samples(2000)
    begun_ns = far.now_ns
    result = far.run(calibrating.calibrate_gyro(done=done(variant)))
    offsets_deg_s = result.values
    assert result.changed
    assert 3e9 <= far.now_ns - begun_ns < LIMIT_NS.get(variant, 6e9)
    far.samples(800)
    after = far.samples(2000)
    assert any(abs(radians(offset)) > 3e-4 for offset in offsets_deg_s)
    for axis in range(3):
        means = [sum(m.gyro_rad_s[axis] for m in part if m.gyro_rad_s) / len(part) for part in (before, after)]
        assert means[0] - means[1] == pytest.approx(radians(offsets_deg_s[axis]), abs=2.5e-4)  # the bias drifts
        assert abs(means[1]) < 2.5e-4


@every_variant
@pytest.mark.manual("A 1.5 parameters 16 to 18", "A 1.6 CMD 7")
def test_installation_calibration_ends_with_the_angles(variant: str) -> None:
    tilted = Still(radians(4), radians(0), radians(0))  # 312: roll about Y, which is pitch in ZYX
    far = variant_bench(variant, motion=tilted)
    begun_ns = far.now_ns
    result = far.run(calibrating.calibrate_installation(done=done(variant)))
    assert result.changed
    assert result.values == pytest.approx((0, 4, 0), abs=1e-5)
    assert 3e9 <= far.now_ns - begun_ns < LIMIT_NS.get(variant, 6e9)
    far.samples(800)
    assert len(far.samples(100)) >= 5


@pytest.mark.parametrize("script", ACKNOWLEDGING)
def test_without_an_acknowledgement_it_is_not_known_whether_it_began(
    script: Callable[[], RequestScript[object]],
) -> None:
    with pytest.raises(NoReply, match="got none from a device that replies: it is not known whether"):
        imu61x_bench(ignores=CALIBRATING).run(script())
    with pytest.raises(Rejected, match=r"calibration: expected result 0 \(done\), got 2"):
        imu61x_bench(refuses=CALIBRATING).run(script())


def test_results_and_codes_of_calibrations() -> None:
    far = imu61x_bench(motion=swing())
    with pytest.raises(Rejected, match=r"gyro calibration: expected result 0 \(done\), got 2"):
        far.run(calibrating.calibrate_gyro())

    with pytest.raises(
        Rejected, match=r"expected result 0 .*got 1: the device rejected the command or `options.result_done`"
    ):
        imu61x_bench(result_done=1).run(calibrating.calibrate_gyro())


CALIBRATION_S = (0.2, 8, 25)


@pytest.mark.parametrize("duration_s", CALIBRATION_S)
@pytest.mark.parametrize(("script", "fault"), [(script, fault) for script in ACKNOWLEDGING for fault in (0, 1, 2)])
def test_the_end_is_a_change_of_the_parameters(
    script: Callable[[], RequestScript[calibrating.Calibrated]], fault: int, duration_s: float,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A fault code in S1 does not show the progress: the device calibrates for a short or a long time."""
    monkeypatch.setattr("imud.sim.imu61x.uart.CALIBRATION_NS", int(duration_s * 1e9))
    far = imu61x_bench(noise=Noise(3), motion=Still(radians(4)), status=replace(STATUS, calibration_fault=fault))
    begun_ns = far.now_ns
    result = far.run(script())
    assert result.changed
    assert result.words.startswith("verified: the parameters changed to ")
    assert any(result.values)
    assert duration_s <= (far.now_ns - begun_ns) / 1e9 < duration_s + 2


@pytest.mark.parametrize("whole_status", [True, False])
@pytest.mark.parametrize("script", ACKNOWLEDGING)
def test_without_a_change_the_result_is_not_verified(
    script: Callable[[], RequestScript[calibrating.Calibrated]], whole_status: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("imud.sim.imu61x.uart.CALIBRATION_NS", 10**15)
    far = imu61x_bench(whole_status=whole_status)
    begun_ns = far.now_ns
    result = far.run(script())
    assert (result.values, result.changed) == ((0, 0, 0), False)
    assert result.words.startswith("sent, not verified: the parameters stayed at 0, 0, 0 for 30 s")
    assert 30e9 <= far.now_ns - begun_ns < 35e9


@every_variant
@pytest.mark.manual("A 1.6 CMD 8")
def test_state_of_the_installation_calibration_as_sent(variant: str) -> None:
    far = variant_bench(variant)
    assert far.run(calibrating.installation_status()) == {
        "frame_id": "0x000c",
        "payload": f"08 00 {done(variant):02x} 00",
    }


TARGET = Target(None, 115200)


@pytest.mark.parametrize("kind", CALIBRATIONS)
def test_it_runs_to_its_end_and_is_saved(kind: str) -> None:
    calibration = CALIBRATIONS[kind]
    bench = Imu61xBench(hardware=Imu61xHardware(motion=Still(radians(4)), noise=Noise(3)))
    answer = bench.run(calibration.begin(TARGET))
    assert answer is None or answer.done
    if calibration.kept is Kept.BY_SAVE:
        assert calibration.save is not None
        bench.run(calibration.save(TARGET))
