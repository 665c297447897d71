"""Restart, baud rate and factory reset of simulated devices in all variants: the read-back decides."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from imud.contracts.script import RequestScript
from imud.drivers.imu61x.uart import settings as following
from imud.drivers.imu61x.uart import settings as session
from imud.drivers.imu61x.uart.codec import Parameter
from imud.drivers.imu61x.uart.commands import Command, OutputMode
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.sim.imu61x.uart import REFUSING, Imu61xSettings
from tests.support.simulated_modules import done, every_variant, imu61x_bench, variant_bench


@every_variant
@pytest.mark.manual("A 1.6 CMD 9")
def test_restart_loses_unsaved_settings_and_restarts_the_timer(variant: str) -> None:
    far = variant_bench(variant, uptime_us=20_000_000)
    far.run(session.write_parameter(Parameter.AHRS_RATE, 10))
    assert far.module.settings.rate_hz == 10
    assert far.run(following.restart(done=done(variant))).product == "IMU61x"
    assert far.module.settings == far.module.flash == Imu61xSettings()
    assert far.streams()


@every_variant
def test_a_restart_that_did_not_happen_is_an_error(variant: str) -> None:
    """The device acknowledges or not, and its timer continues."""
    far = variant_bench(variant, uptime_us=20_000_000)
    behaviour = replace(far.module.hardware.behaviour, ignores=frozenset({Command.RESTART}))
    far = imu61x_bench(behaviour=behaviour, uptime_us=20_000_000)
    with pytest.raises(Rejected, match=r"expected a restarted timer, got 2\d\.\d s before and 2\d\.\d s after"):
        far.run(following.restart(done=done(variant)))


def test_restarts_that_are_refused_seen_or_without_end() -> None:
    far = imu61x_bench(behaviour=REFUSING, uptime_us=20_000_000)
    with pytest.raises(Rejected, match=r"and acknowledgement 2 \(0 is done\)"):
        far.run(following.restart())
    far = imu61x_bench(result_done=1, uptime_us=20_000_000)
    assert far.run(following.restart()).product == "IMU61x"
    far = imu61x_bench(uptime_us=20_000_000)
    far.module.hardware = replace(far.module.hardware, boot_ms=60_000)
    with pytest.raises(NoReply, match="status"):
        far.run(following.restart())


@pytest.mark.parametrize("uptime_us", [0, 2**32 - 5_000_000, 2**32 - 25_000_000])
def test_a_young_timer_and_one_that_turns_over_soon_are_waited_for(uptime_us: int) -> None:
    """0.5 s after power-on, a restarted timer would be larger; near its end the timer wraps by itself."""
    far = imu61x_bench(uptime_us=uptime_us)
    begun_ns = far.now_ns
    assert far.run(following.restart()).product == "IMU61x"
    assert far.now_ns - begun_ns < 60e9
    still = imu61x_bench(uptime_us=uptime_us, ignores=frozenset({Command.RESTART}))
    with pytest.raises(Rejected, match="restarted timer"):
        still.run(following.restart())


@every_variant
@pytest.mark.parametrize(("baud", "present"), [(921600, 115200), (115200, 1500000)])
@pytest.mark.manual("A 1.6 CMD 14, 3")
def test_the_baud_rate_changes_and_the_device_is_kept(variant: str, baud: int, present: int) -> None:
    far = variant_bench(variant, Imu61xSettings(baud=present))
    change = far.run(following.change_baud(baud, present, done=done(variant)))
    assert change.baud == baud == far.baud == far.module.baud
    at_start = far.module.hardware.behaviour.baud_acts_at_start
    assert change.saved is at_start
    assert far.module.flash.baud == (baud if at_start else present)
    assert far.module.flash.mode is OutputMode.STREAM
    assert far.streams()


@pytest.mark.parametrize("baud", [115200, 230400])
def test_a_baud_rate_that_does_not_carry_the_output_rate_is_refused(baud: int) -> None:
    """400 Hz of 54 bytes of 10 bits need 216000 bit/s: 230400 baud is enough, 115200 is not."""
    far = imu61x_bench(Imu61xSettings(baud=921600, rate_hz=400))
    if baud == 115200:
        words = "baud: expected at most 200 Hz at 115200 baud, got 400 Hz .216000 bit/s.*; lower the output rate first"
        with pytest.raises(BadArgument, match=words):
            far.run(following.change_baud(baud, 921600))
        assert (far.baud, far.module.baud, far.module.flash.baud) == (921600, 921600, 921600)
    else:
        far.run(following.change_baud(baud, 921600))
    assert len(far.samples(100)) >= 35


def test_rates_that_are_refused_not_saved_or_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lost device uses a third baud rate because of a fault: power-off and power-on restore it."""
    far = imu61x_bench(refuses=frozenset({Command.SET_PARAMETER}))
    with pytest.raises(Rejected, match="keeps 115200 baud"):
        far.run(following.change_baud(921600, 115200))
    assert far.baud == 115200
    assert far.streams()

    far = imu61x_bench()
    wrong = lambda settings, index, value: replace(settings, baud=1500000)  # noqa: E731
    monkeypatch.setattr("imud.sim.imu61x.uart.changed", wrong)
    with pytest.raises(NoReply, match="nothing was saved: switch the device off and on"):
        far.run(following.change_baud(460800, 115200))
    assert far.baud == 115200
    far.restart()
    assert far.streams()


CHANGES: list[Callable[[], RequestScript[object]]] = [
    lambda: following.change_baud(921600, 115200),
    lambda: following.factory_reset(115200),
]


@pytest.mark.parametrize("change", CHANGES)
def test_nothing_changes_without_replies(change: Callable[[], RequestScript[object]]) -> None:
    far = imu61x_bench()
    far.connected = False
    with pytest.raises(NoReply, match="nothing was changed"):
        far.run(change())
    assert far.baud == 115200
    assert "factory reset" not in far.asked
    assert not any(name.startswith("set parameter") for name in far.asked)
    assert far.streams()


@every_variant
@pytest.mark.parametrize("present", [115200, 921600])
@pytest.mark.manual("A 1.1 default rate", "A 1.6 CMD 15")
def test_factory_reset_is_read_back_and_the_line_follows(variant: str, present: int) -> None:
    settings = Imu61xSettings(baud=present, rate_hz=200, filter_control=0, i2c_address=0x1B)
    far = variant_bench(variant, settings)
    change = far.run(following.factory_reset(present, done=done(variant)))
    assert change.baud == far.baud == far.module.baud == 115200
    assert far.module.flash == far.module.settings == Imu61xSettings()
    assert far.streams()


def test_factory_resets_that_are_refused_or_act_at_the_next_start(monkeypatch: pytest.MonkeyPatch) -> None:
    far = imu61x_bench(Imu61xSettings(rate_hz=50), refuses=frozenset({Command.FACTORY_RESET}))
    words = r"expected AHRS_RATE 100, got AHRS_RATE 50; acknowledgement 2 \(0 is done\)"
    with pytest.raises(Rejected, match=words):
        far.run(following.factory_reset(115200))
    assert "restart" not in far.asked
    assert far.streams()

    far = imu61x_bench(Imu61xSettings(filter_control=0x44), ignores=frozenset({Command.FACTORY_RESET}))
    with pytest.raises(Rejected, match="expected FILTER 187, got FILTER 68; acknowledgement none"):
        far.run(following.factory_reset(115200))

    far = imu61x_bench(Imu61xSettings(rate_hz=50), reset_acts_at_start=True)
    far.run(session.write_parameter(Parameter.AHRS_RATE, 10))
    far.run(following.factory_reset(115200))
    assert far.asked.index("restart") < far.asked.index("save")
    assert far.module.flash == Imu61xSettings()
