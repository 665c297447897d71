"""Calibrations of simulated devices in all variants. The status of the device decides the end, not K1."""

from collections.abc import Callable
from math import radians

import pytest

from imud.contracts.command import Kept, Target
from imud.contracts.script import RequestScript
from imud.drivers.imu61x.uart import driver as calibrating
from imud.drivers.imu61x.uart.commands import Command
from imud.drivers.imu61x.uart.driver import CALIBRATIONS
from imud.model.errors import NoReply, Rejected
from imud.sim.imu61x.uart import Imu61xHardware, Imu61xSettings
from imud.sim.physics import Noise, Still, swing
from tests.support.simulated_modules import Imu61xBench, done, every_variant, imu61x_bench, variant_bench

ACKNOWLEDGING = [calibrating.calibrate_gyro, calibrating.calibrate_installation]


@every_variant
@pytest.mark.manual("A 1.5 parameters 8 to 10", "A 1.6 CMD 10")
def test_gyro_calibration_takes_the_bias_off(variant: str) -> None:
    if variant == "no K1":
        return  # below
    far = variant_bench(variant, noise=Noise(3))
    before = far.samples(2000)
    begun_ns = far.now_ns
    offsets_deg_s = far.run(calibrating.calibrate_gyro(done=done(variant)))
    assert 3e9 <= far.now_ns - begun_ns < 8e9  # 3 s of calibration and the quiet time of the device
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
    if variant == "no K1":
        return  # below
    tilted = Still(radians(4), radians(0), radians(0))  # 312: roll about Y, which is pitch in ZYX
    far = variant_bench(variant, motion=tilted)
    begun_ns = far.now_ns
    angles = far.run(calibrating.calibrate_installation(done=done(variant)))
    assert angles == pytest.approx((0, 4, 0), abs=1e-5)
    assert 3e9 <= far.now_ns - begun_ns < 8e9
    far.samples(800)
    assert len(far.samples(100)) >= 5


@pytest.mark.parametrize("script", ACKNOWLEDGING)
def test_without_an_acknowledgement_it_is_not_known_whether_it_began(
    script: Callable[[], RequestScript[object]],
) -> None:
    with pytest.raises(NoReply, match="got none from a device that replies: it is not known whether"):
        imu61x_bench(acknowledges=False).run(script())
    refuses = frozenset({Command.CALIBRATE_GYRO, Command.CALIBRATE_INSTALLATION})
    with pytest.raises(Rejected, match=r"calibration: expected result 0 \(done\), got 2"):
        imu61x_bench(refuses=refuses).run(script())


def test_results_and_codes_of_calibrations() -> None:
    far = imu61x_bench(motion=swing())
    with pytest.raises(Rejected, match=r"gyro calibration: expected result 0 \(done\), got 2"):
        far.run(calibrating.calibrate_gyro())

    with pytest.raises(
        Rejected, match=r"expected result 0 .*got 1: the device rejected the command or `options.result_done`"
    ):
        imu61x_bench(result_done=1).run(calibrating.calibrate_gyro())

    far = imu61x_bench(noise=Noise(3))
    assert far.run(calibrating.calibrate_gyro(rest=1)) == (0, 0, 0)
    with pytest.raises(NoReply, match=r"within 60 s, got calibration status 0 \(`options.calibration_done`: 7\)"):
        imu61x_bench().run(calibrating.calibrate_installation(rest=7))

    far = imu61x_bench(Imu61xSettings(gyro_off_deg_s=(0.0, 0.0, 0.0)), reports_calibration=False, noise=None)
    begun_ns = far.now_ns
    assert far.run(calibrating.calibrate_gyro()) == (0, 0, 0)
    assert 10e9 <= far.now_ns - begun_ns < 12e9


@pytest.mark.parametrize("reports", [True, False])
@pytest.mark.manual("A 1.6 CMD 8")
def test_installation_calibration_without_end(reports: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.sim.imu61x.uart.CALIBRATION_NS", 10**15)
    far = imu61x_bench(reports_calibration=reports)
    words = "got calibration status 1" if reports else "got result 9"
    with pytest.raises(NoReply, match=f"expected its end within 60 s, {words}"):
        far.run(calibrating.calibrate_installation())


@every_variant
def test_state_of_the_installation_calibration_as_sent(variant: str) -> None:
    far = variant_bench(variant)
    assert far.run(calibrating.installation_status()) == done(variant)


TARGET = Target(None, 115200)


@pytest.mark.parametrize("kind", CALIBRATIONS)
def test_it_runs_to_its_end_and_is_saved(kind: str) -> None:
    calibration = CALIBRATIONS[kind]
    bench = Imu61xBench(hardware=Imu61xHardware(motion=Still()))
    bench.run(calibration.begin(TARGET))
    if calibration.kept is Kept.BY_SAVE:
        assert calibration.save is not None
        bench.run(calibration.save(TARGET))
