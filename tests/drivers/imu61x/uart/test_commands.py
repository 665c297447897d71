"""Every command of table 12: golden bytes, and the message that ends its reply.
Steps of scripts: both modes, results by one option, and the requests to a device without replies. Verbs with the
simulated device."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from math import nan, radians
from typing import Any

import pytest

from imud.contracts.command import Kept, Target
from imud.contracts.script import Reply, ReplyFrame, Request, RequestScript, Silence
from imud.drivers.imu61x.common import crc32
from imud.drivers.imu61x.uart import commands as c
from imud.drivers.imu61x.uart import driver as calibrating
from imud.drivers.imu61x.uart import settings
from imud.drivers.imu61x.uart.codec import Parameter, pack_acknowledgement, pack_parameters
from imud.drivers.imu61x.uart.commands import Command, Imu61xUartOptions, OutputMode
from imud.drivers.imu61x.uart.driver import CALIBRATIONS, DRIVER
from imud.drivers.imu61x.uart.settings import BaudChange
from imud.model.errors import BadArgument, CommandError, NoReply, Rejected
from imud.model.sample import Measurement
from imud.model.units import NS_PER_S
from imud.sim.imu61x.uart import REFUSING, STATUS, VARIANTS, Imu61xHardware, Imu61xModule, Imu61xSettings
from imud.sim.physics import Noise, Still, swing
from tests.support.old_spellings import script_of
from tests.support.script_runners import unanswered_ms
from tests.support.simulated_modules import Imu61xBench, done, every_variant, imu61x_bench, run_script, variant_bench

STREAM_HEX = "55AA 0300 1800 0000803F" + 20 * "00" + "52D88EE8"
"""Command frame that a device executed."""


@pytest.mark.manual("A 1.6 request", "A 1.6 CMD 1", "A 1.6 CMD 2", "A 1.3 rate and line", "A 1.6 CMD 6")
def test_commands_the_ends_of_their_replies_and_the_reading_of_parameters() -> None:
    assert c.output_mode(c.OutputMode.STREAM).payload == bytes.fromhex(STREAM_HEX)

    assert [command.value for command in c.Command] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 14, 15]

    request = c.save()
    for result in (0, 1, 0xFFFF):
        assert request.is_end(ReplyFrame(0x7777, pack_acknowledgement(5, result)))
    assert not request.is_end(ReplyFrame(0x7777, pack_acknowledgement(6, 0)))
    assert not request.is_end("OK")

    s1 = ReplyFrame(0xFF, bytes(22))
    assert c.ask_status().is_end(s1)
    assert not c.ask_status().is_end(ReplyFrame(5, pack_acknowledgement(1, 0)))
    assert c.ask_installation_status().is_end(s1)
    assert c.ask_installation_status().is_end(ReplyFrame(5, pack_acknowledgement(8, 0)))

    request = c.ask_ahrs()
    assert request.is_sample is not None
    assert request.is_sample(Measurement(54, 0, 0))
    assert not request.is_end(ReplyFrame(5, pack_acknowledgement(2, 0)))
    assert request.is_part(ReplyFrame(5, pack_acknowledgement(2, 0)))

    with pytest.raises(BadArgument, match="at most 200 Hz at 115200 baud, got 400 Hz"):
        c.set_rate(400, baud=115200)

    assert c.output_mode(c.OutputMode.COMMAND, baud=921600).baud == 921600
    assert c.output_mode(c.OutputMode.COMMAND).baud == 0

    for index in (3, 31):
        request = c.read_parameter(Parameter(index))
        assert request.is_end(ReplyFrame(6, pack_parameters(1.5, index)))
        assert not request.is_end(ReplyFrame(6, pack_parameters(1.5, index + 1)))
        acknowledged = ReplyFrame(99, pack_acknowledgement(6, 1))
        assert (request.is_end(acknowledged), request.is_part(acknowledged)) == (False, True)


@pytest.mark.parametrize(
    ("request_", "command", "param1", "param3"),
    [
        (c.ask_status(), 1, "00000000", 0), (c.ask_ahrs(), 2, "00000000", 0),
        (c.output_mode(c.OutputMode.STREAM), 3, "0000803F", 0),
        (c.output_mode(c.OutputMode.COMMAND), 3, "0000C842", 0), (c.reset_heading(0), 4, "00000000", 0),
        (c.reset_heading(360), 4, "0000B443", 0), (c.reset_heading(22.5), 4, "0000B441", 0),
        (c.save(), 5, "00000000", 0), (c.read_parameter(Parameter.AHRS_RATE), 6, "00000000", 21),
        (c.start_installation_calibration(), 7, "00000000", 0), (c.ask_installation_status(), 8, "00000000", 0),
        (c.restart(), 9, "00000000", 0), (c.calibrate_gyro(), 10, "00000000", 0),
        (c.set_baud(115200), 14, "0000E147", 3), (c.set_baud(1500000), 14, "001BB749", 3),
        (c.set_rate(400), 14, "0000C843", 21), (c.set_bus_mode(c.BusMode.UART_ONLY), 14, "00000000", 27),
        (c.set_bus_mode(c.BusMode.BY_PIN), 14, "00004040", 27), (c.set_i2c_address(0x18), 14, "0000C041", 30),
        (c.set_i2c_address(0x1B), 14, "0000D841", 30), (c.set_filter(0xB, 0xB), 14, "00003B43", 31),
        (c.set_filter(0, 4), 14, "00008040", 31), (c.factory_reset(), 15, "00000000", 0),
    ],
)  # fmt: skip
@pytest.mark.manual("A 1.6 request")
def test_bytes(request_: Request, command: int, param1: str, param3: int) -> None:
    body = (
        b"\x55\xaa" + command.to_bytes(2, "little") + b"\x18\x00"
        + bytes.fromhex(param1) + bytes(4) + param3.to_bytes(4, "little") + bytes(12)
    )  # fmt: skip
    assert request_.payload == body + crc32(body).to_bytes(4, "little")
    assert len(request_.payload) == 34


@pytest.mark.manual("A 1.3 rate and line")
def test_plain_numbers_are_not_enum_members_and_rates_fit() -> None:
    # a type checker rejects it; without a type checker no frame is made either
    makers: list[Callable[[Any], Request]] = [c.set_bus_mode, c.output_mode, c.read_parameter]
    for make, value in zip(makers, (1, 1, 21), strict=True):
        with pytest.raises(AttributeError):
            make(value)
    for baud, most_hz in ((115200, 200), (230400, 400), (460800, 400), (1500000, 400)):
        assert c.max_rate_hz(baud) == most_hz
        c.set_rate(most_hz, baud=baud)


def _baud() -> RequestScript[float]:
    return c.read(Parameter.BAUD)


@every_variant
def test_command_mode_is_restored(variant: str) -> None:
    for mode in OutputMode:
        far = variant_bench(variant, Imu61xSettings(mode=mode))
        assert far.run(c.in_command_mode(_baud)) == 115200
        far.samples(800)
        assert bool(far.samples(1000)) is (mode is OutputMode.STREAM)


def test_every_request_in_command_mode_can_be_undone() -> None:
    """A script that is cancelled after CMD 3 leaves the bytes that make the device stream."""
    far = imu61x_bench(answers_while_streaming=False)
    script = c.in_command_mode(_baud)
    request = next(script)
    undone = []
    with pytest.raises(StopIteration):  # noqa: PT012  # driven by hand
        while True:
            undone.append((request.name, request.undo == c.STREAM))
            request = script.send(far.ask(request))
    assert undone[0] == ("status", False)
    assert [undo for name, undo in undone[1:] if name != "output mode STREAM"] == [True] * 3


def test_a_result_is_judged_by_the_option_and_no_reply_is_an_error() -> None:
    far = imu61x_bench(Imu61xSettings(mode=OutputMode.COMMAND), result_done=1)
    assert far.run(c.ordered(c.reset_heading(0), 1)) is True
    with pytest.raises(Rejected, match="heading reset: expected result 0"):
        far.run(c.ordered(c.reset_heading(0), 0))
    far = imu61x_bench(Imu61xSettings(mode=OutputMode.COMMAND), acknowledges=False)
    assert far.run(c.ordered(c.reset_heading(0), 0)) is False
    assert Imu61xUartOptions() == Imu61xUartOptions(result_done=0)
    assert c.result_of(Silence(())) is c.result_of(Reply(("text",))) is None
    for script in (c.settled(), c.acknowledged(c.reset_heading(0), 0)):
        with pytest.raises(NoReply, match="status: expected a reply, got none"):
            run_script(script, lambda _request: Silence(()))


@pytest.mark.parametrize(
    ("script", "timeouts_ms"),
    [
        (c.settled(), [300] * 10), (_baud(), [300] * 5), (c.resume_streaming(), [300] * 5),
        (c.in_command_mode(_baud), [300] * 7), (settings.save(), [300] * 11),
        (settings.change_baud(921600, 115200), [300] * 11), (settings.start_streaming(), [300] * 5 + [3000]),
        (c.acknowledged(c.calibrate_gyro(), 0), [10_000] + [300] * 10),
        (c.acknowledged(c.start_installation_calibration(), 0), [10_000] + [300] * 10),
        (c.acknowledged(c.save(), 0), [5000] + [300] * 10), (c.acknowledged(c.factory_reset(), 0), [5000] + [300] * 10),
    ],
)  # fmt: skip
def test_requests_to_a_device_without_replies(script: RequestScript[object], timeouts_ms: list[float]) -> None:
    assert [*unanswered_ms(script)] == timeouts_ms


def act(far: Imu61xBench, name: str, options: Imu61xUartOptions | None = None, **arguments: Any) -> Any:
    return far.run(script_of(DRIVER, Target(options, far.baud), name, arguments))


ARGUMENTS: dict[str, dict[str, Any]] = {
    "rate": {"rate_hz": 50}, "filter": {"accel_filter": "5 Hz", "gyro_filter": 13}, "i2c_address": {"address": "0x1A"},
    "bus": {"bus": "i2c"}, "heading": {"heading_deg": 90}, "baud": {"baud": 230400},
}  # fmt: skip
CODED = [name for name, one in VARIANTS.items() if one.result_done]
"""Variants with another result than 0 for done."""
WITHOUT_K1 = ("save", "heading", "installation_status")
"""Verbs with no evidence but an acknowledgement; also CMD 8 without another reply."""


@pytest.mark.parametrize("variant", ["executes commands while it streams", "no K1", *CODED])
@pytest.mark.parametrize("name", [*DRIVER.verbs, *ARGUMENTS])
def test_every_action(variant: str, name: str) -> None:
    """Other tests run the scripts in every variant; here an action must pass its arguments to the script."""
    far = variant_bench(variant, uptime_us=20_000_000, noise=Noise(3))
    options = Imu61xUartOptions(result_done=done(variant))
    if variant == "no K1" and name in WITHOUT_K1 and name != "installation_status":
        with pytest.raises(CommandError, match="it is not known whether the device executed the command"):
            act(far, name, options, **ARGUMENTS.get(name, {}))
    else:
        act(far, name, options, **ARGUMENTS.get(name, {}))
    far.samples(1000)
    assert bool(far.samples(100)) is (name != "stop_streaming")
    assert far.baud == far.module.baud


ORDERS = (
    "stop_streaming", "save", "restart", "baud", "rate", "filter", "i2c_address", "bus", "heading", "calibrate_gyro",
    "calibrate_installation", "factory_reset",
)  # fmt: skip


@pytest.mark.parametrize("name", ORDERS)
def test_every_order_to_a_device_that_refuses_is_an_error(name: str) -> None:
    """The device keeps its values and continues to stream."""
    settings = Imu61xSettings(rate_hz=200)
    far = imu61x_bench(settings, behaviour=REFUSING, uptime_us=20_000_000)
    with pytest.raises(CommandError):
        act(far, name, **ARGUMENTS.get(name, {}))
    assert far.module.settings == far.module.flash == settings
    assert far.baud == 115200
    assert len(far.samples(100)) >= 15


@pytest.mark.manual("A 1.6 CMD 3 stream", "A 1.6 CMD 3 command", "A 1.6 CMD 14, 3")
def test_answers_of_actions() -> None:
    far = imu61x_bench()
    answer = act(far, "stop_streaming")
    assert (answer.verified, answer.evidence) == (True, "samples arrived before the command, and none after it")
    assert answer.result["output_mode"] == "command"
    assert "start_streaming" in answer.result["configuration"]
    assert not far.samples(50)
    # an unchanged device causes the same observations
    assert not act(far, "stop_streaming").verified
    sample = act(far, "sample_once")
    assert (sample.verified, set(sample.result) > {"accel_m_s2"}) == (True, True)
    assert act(far, "start_streaming").verified
    assert far.samples(50)
    for name in ("start_streaming", "sample_once"):
        assert not act(far, name).verified

    far = imu61x_bench()
    assert act(far, "baud", baud=460800) == BaudChange(460800, saved=False)
    assert far.baud == far.module.baud == 460800

    far = imu61x_bench()
    assert act(far, "status")["model_number"] == 614
    assert set(act(far, "sample_once").result) > {"accel_m_s2", "gyro_rad_s"}

    far = imu61x_bench(noise=Noise(3))
    answer = act(far, "calibrate_gyro")
    values = ", ".join(f"{one:g}" for one in answer.result["gyro_offset_deg_s"])
    assert (answer.verified, answer.evidence) == (True, f"the parameters changed to {values}")
    assert len(act(far, "calibrate_installation").result["installation_angles_deg"]) == 3

    far = imu61x_bench(uptime_us=20_000_000)
    assert getattr(act(far, "restart"), "product", "") == "IMU61x"


def test_a_rate_that_the_line_does_not_carry_is_refused_and_a_fixed_rate_is_to_be_changed() -> None:
    far = imu61x_bench()
    words = "output_rate_hz and baud: expected at most 200 Hz at 115200 baud, got 400 Hz .* 400 Hz need 230400 baud"
    with pytest.raises(BadArgument, match=words):
        act(far, "rate", rate_hz=400)
    assert far.asked == []
    act(far, "baud", baud=230400)
    act(far, "rate", rate_hz=400)
    assert len(far.samples(100)) >= 39
    with pytest.raises(BadArgument, match="lower the output rate first"):
        act(far, "baud", baud=115200)
    assert len(far.samples(100)) >= 35
    for name, words in (("stop_streaming", "no program receives samples"), ("factory_reset", "`uart.baud`")):
        assert words in DRIVER.verbs[name].help

    far = imu61x_bench(Imu61xSettings(baud=921600))
    answer = far.run(script_of(DRIVER, Target(None, 921600, fixed_baud=921600), "factory_reset", {}))
    assert answer.verified
    assert (
        answer.result.configuration
        == "change `uart.baud` from 921600 to 115200 or auto: imud uses it at its next start"
    )
    answer = far.run(script_of(DRIVER, Target(None, 115200, 0), "factory_reset", {}))
    assert (answer.verified, answer.result.configuration) == (False, "")
    assert answer.evidence == "all parameters had their factory values before the command"


@pytest.mark.parametrize(
    ("name", "arguments", "named"),
    [
        ("baud", {"baud": 9600}, "one of 115200, 230400, 460800, 921600, 1500000"), ("baud", {"baud": True}, "baud"),
        ("rate", {"rate_hz": 0}, "one of 1, 10, 50, 100, 200, 400"), ("rate", {"rate_hz": 100.5}, "output_rate_hz"),
        ("bus", {"bus": 1}, '"spi"'), ("i2c_address", {"address": 0x1C}, "address"),
        ("i2c_address", {"address": "0x1c"}, "address"), ("i2c_address", {"address": "18"}, "address"),
        ("filter", {"accel_filter": 16, "gyro_filter": 0}, "accel_filter"),
        ("filter", {"accel_filter": "9 Hz", "gyro_filter": 0}, '"0.2 Hz", "1 Hz", "2 Hz", "5 Hz", "10 Hz", "15 Hz"'),
        ("filter", {"accel_filter": -1, "gyro_filter": 0}, "accel_filter"),
        ("filter", {"accel_filter": 0, "gyro_filter": True}, "gyro_filter"),
        ("heading", {"heading_deg": -0.1}, "from 0 to 360"), ("heading", {"heading_deg": 360.1}, "from 0 to 360"),
        ("heading", {"heading_deg": nan}, "from 0 to 360"), ("heading", {"heading_deg": True}, "from 0 to 360"),
        ("heading", {"heading_deg": "90"}, "from 0 to 360"),
    ],
)  # fmt: skip
@pytest.mark.manual("A 1.6 other values")
def test_unsupported_values_are_rejected(name: str, arguments: dict[str, Any], named: str) -> None:
    far = imu61x_bench()
    with pytest.raises(BadArgument, match=named):
        act(far, name, **arguments)
    assert not far.asked


ACKNOWLEDGING = [calibrating.calibrate_gyro, calibrating.calibrate_installation]
CALIBRATING = frozenset({Command.CALIBRATE_GYRO, Command.CALIBRATE_INSTALLATION})
# Maximum time of a calibration of 3 s, ns: imud waits for K1, and for a device that is quiet after each reply
LIMIT_NS = {"no K1": 20e9, "quiet after an answer": 17e9, "all at once": 17e9}


@every_variant
@pytest.mark.manual("A 1.5 parameters 8 to 10", "A 1.6 CMD 10")
def test_gyro_calibration_takes_the_bias_off(variant: str) -> None:
    far = variant_bench(variant, noise=Noise(3))
    before = far.samples(2000)
    begun_ns = far.now_ns
    result = far.run(calibrating.calibrate_gyro(done=done(variant)))
    offsets_deg_s = result.values
    assert result.changed
    assert 3e9 <= far.now_ns - begun_ns < LIMIT_NS.get(variant, 9e9)
    far.samples(800)
    after = far.samples(2000)
    assert any(abs(radians(offset)) > 3e-4 for offset in offsets_deg_s)
    for axis in range(3):
        means = [sum(m.gyro_rad_s[axis] for m in part if m.gyro_rad_s) / len(part) for part in (before, after)]
        assert means[0] - means[1] == pytest.approx(radians(offsets_deg_s[axis]), abs=3e-4)  # the bias drifts
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
    assert 3e9 <= far.now_ns - begun_ns < LIMIT_NS.get(variant, 9e9)
    far.samples(800)
    assert len(far.samples(100)) >= 5


def test_results_codes_and_missing_acknowledgements_of_calibrations() -> None:
    far = imu61x_bench(motion=swing())
    with pytest.raises(Rejected, match=r"gyro calibration: expected result 0 \(done\), got 2"):
        far.run(calibrating.calibrate_gyro())

    with pytest.raises(
        Rejected, match=r"expected result 0 .*got 1: the device rejected the command or `options.result_done`"
    ):
        imu61x_bench(result_done=1).run(calibrating.calibrate_gyro())
    for script in ACKNOWLEDGING:
        with pytest.raises(NoReply, match="got none from a device that replies: it is not known whether"):
            imu61x_bench(ignores=CALIBRATING).run(script())
        with pytest.raises(Rejected, match=r"calibration: expected result 0 \(done\), got 2"):
            imu61x_bench(refuses=CALIBRATING).run(script())


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
    assert duration_s <= (far.now_ns - begun_ns) / 1e9 < duration_s + 5


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


@pytest.mark.parametrize(
    ("seconds", "at_begin", "at_end", "words"),
    [
        (8, {"install_off_deg": (0.0, 0.0, 0.0)}, {}, "verified: the parameters changed to 0.149333, 3.99999, 0"),
        (99, {"install_off_deg": (0.0, 0.0, 0.0)}, {}, "changed to 0, 0, 0, which can be the start of a calibration"),
        (29, {}, {}, "the parameters still change, to 0.149333, 3.99999, 0"),
        (8, {}, {"calibration_fault": 2}, "sent, not verified: the device reports calibration fault 2"),
        (8, None, {}, "expected a reply, got none"),
    ],
)
def test_only_new_parameters_without_a_fault_are_verified(
    seconds: int, at_begin: dict[str, Any] | None, at_end: dict[str, Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Other(Imu61xModule):
        def _calibrate(self, command: Command, now_ns: int) -> None:
            super()._calibrate(command, now_ns)
            self.settings = replace(self.settings, **(at_begin or {}))
            self._busy_ns = 10**18 if at_begin is None else self._busy_ns

        def _finish_calibration(self, command: Command, done_ns: int) -> None:
            super()._finish_calibration(command, done_ns)
            self.hardware = replace(self.hardware, status=replace(STATUS, **at_end))

    monkeypatch.setattr("tests.support.simulated_modules.Imu61xModule", Other)
    monkeypatch.setattr("imud.sim.imu61x.uart.CALIBRATION_NS", seconds * NS_PER_S)
    far = imu61x_bench(Imu61xSettings(install_off_deg=(3.0, 3.0, 3.0)), motion=Still(radians(4)))
    with nullcontext() if at_begin is not None else pytest.raises(NoReply, match=words):
        assert words in far.run(calibrating.calibrate_installation()).words


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
