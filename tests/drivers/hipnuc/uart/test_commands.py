"""HiPNUC commands: bytes as printed in the manual, and arguments that imud rejects before it sends them.
Scripts, verbs and calibrations with a HiPNUC device, and the end, the parts and the values of its replies."""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import pytest

from imud.contracts.command import Calibration, Kept, RestMeans, Target, Verdict
from imud.contracts.script import Outcome, Rejection, Reply, Request, RequestScript, Silence
from imud.contracts.setting import combined
from imud.drivers.hipnuc.common import AttitudeMode, LevelReset
from imud.drivers.hipnuc.uart import commands as c
from imud.drivers.hipnuc.uart import replies as r
from imud.drivers.hipnuc.uart.commands import OutputMessage, Query, advice, ask, identify, log_ontime, send_once, wake
from imud.drivers.hipnuc.uart.driver import CALIBRATIONS, DRIVER
from imud.drivers.hipnuc.uart.settings import SETTINGS, report_values, why_silent
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.hipnuc.uart_settings import VARIANTS, Behaviour, ModuleSettings, Output, RateChange
from tests.support.old_spellings import script_of
from tests.support.script_runners import offline_runner, unanswered_ms
from tests.support.simulated_modules import HipnucLine, hardware_of, run_script

H91, H92 = c.OutputMessage.HI91, c.OutputMessage.HI92

PRINTED = [
    (c.reboot(), "REBOOT"), (c.save_config(), "SAVECONFIG"), (c.factory_reset(), "FRESET"), (c.unlog_all(), "UNLOGALL"),
    (c.serial_config(115200), "SERIALCONFIG 115200"), (c.attitude_mode(AttitudeMode.SIX_AXIS), "CONFIG ATT MODE 0"),
    (c.attitude_mode(AttitudeMode.NINE_AXIS), "CONFIG ATT MODE 1"),
    (c.level_reset(LevelReset.RELATIVE), "CONFIG ATT RST 2"), (c.level_reset(LevelReset.AUTOMATIC), "CONFIG ATT RST 3"),
    (c.level_reset(LevelReset.CANCEL), "CONFIG ATT RST 5"), (c.yaw(c.YawMode.ABSOLUTE, 16), "CONFIG YAW 1 16"),
    (c.yaw(c.YawMode.RELATIVE, 1.5), "CONFIG YAW 0 1.5"), (c.yaw(c.YawMode.ABSOLUTE, -0.0), "CONFIG YAW 1 0"),
    (c.yaw(c.YawMode.RELATIVE, 1e-5), "CONFIG YAW 0 0.00001"),
    (c.mounting(c.Mounting.Y_DOWN), "CONFIG IMU URFR 1,0,0,0,0,1,0,-1,0"),
    (c.mounting(c.Mounting.Y_UP), "CONFIG IMU URFR 1,0,0,0,0,-1,0,1,0"),
    (c.mounting(c.Mounting.Z_DOWN), "CONFIG IMU URFR 1,0,0,0,-1,0,0,0,-1"),
    (c.mounting(c.Mounting.X_UP), "CONFIG IMU URFR 0,0,-1,0,1,0,1,0,0"),
    (c.mounting(c.Mounting.X_DOWN), "CONFIG IMU URFR 0,0,1,0,1,0,-1,0,0"),
    (c.mounting(c.Mounting.Z_DOWN_X_BACK), "CONFIG IMU URFR -1,0,0,0,1,0,0,0,-1"),
    (c.mounting(c.Mounting.LEVEL_X_LEFT), "CONFIG IMU URFR 0,-1,0,1,0,0,0,0,1"),
    (c.mounting(c.Mounting.LEVEL_X_RIGHT), "CONFIG IMU URFR 0,1,0,-1,0,0,0,0,1"),
    (c.mounting(c.Mounting.LEVEL), "CONFIG IMU URFR 1,0,0,0,1,0,0,0,1"),
    (c.mounting(((0.8, -0.6, 0), (0.6, 0.8, 0), (0, 0, 1))), "CONFIG IMU URFR 0.8,-0.6,0,0.6,0.8,0,0,0,1"),
    (c.magnetic_calibration(True), "CONFIG IMU EN_MCAL 1"), (c.pin_function(c.PinFunction.LED, 2), "CONFIG PMUX3 IO2"),
    (c.pin_function(c.PinFunction.SOUT_DIV, 9), "CONFIG PMUX4 IO9"),
    (c.alarm(c.AlarmAxis.Y, -5, 5, True), "CONFIG PMUX5 Y,-5,5,0,1"),
    (c.alarm(c.AlarmAxis.X, -2.5, 10, False), "CONFIG PMUX5 X,-2.5,10,0,0"), (c.sout_divider(4), "CONFIG PMUX4 DIV4"),
    (c.log_enable(), "LOG ENABLE"), (c.log_disable(), "LOG DISABLE"), (c.log_ontime(H91, 100), "LOG HI91 ONTIME 0.01"),
    (c.log_ontime(H92, 20), "LOG HI92 ONTIME 0.05"), (c.log_ontime(H91, 0), "LOG HI91 ONTIME 0"),
    (c.log_ontime(H91, 1000), "LOG HI91 ONTIME 0.001"), (c.log_onmark(H91), "LOG HI91 ONMARK 1"),
    (c.log_once(H91), "LOG HI91 ONMARK ONCE"), (c.ask(c.Query.VERSION), "LOG VERSION"),
    (c.ask(c.Query.USRCONFIG), "LOG USRCONFIG"), (c.ask(c.Query.COMCONFIG), "LOG COMCONFIG"),
    (c.ask(c.Query.MAGCONFIG), "LOG MAGCONFIG"),
]  # fmt: skip


@pytest.mark.parametrize(("request_", "text"), PRINTED, ids=[text for _, text in PRINTED])
@pytest.mark.manual(
    "B 2 line end", "B 2.2.3 SERIALCONFIG", "B 2.2.4 URFR presets", "B 2.2.4 PMUX3 LED", "B 2.2.5 ONTIME"
)
def test_commands_are_as_printed(request_: Request, text: str) -> None:
    assert (request_.payload, request_.name) == (text.encode() + b"\r\n", text)
    assert request_.repeatable is text.endswith(("VERSION", "USRCONFIG", "COMCONFIG", "MAGCONFIG"))


@pytest.mark.parametrize(
    ("script", "timeouts_ms"),
    [
        (c.restart(115200), [500, 1000, 0] + [500] * 5 + [0, 500, 500] * 5 + [0]),
        (c.change_baud(9600, 115200), [500, 500, 0, 500, 500, 0, 500, 500, 0]),
        (c.reset_to_factory(115200), [5000, 0, 500, 500, 0]),
        (c.send(c.save_config()), [5000]),
    ],
)
def test_timeouts_without_replies(script: RequestScript[object], timeouts_ms: list[float]) -> None:
    assert [*unanswered_ms(script)] == timeouts_ms


@pytest.mark.parametrize("request_", [one for one, _ in PRINTED if not one.silent], ids=lambda one: one.name)
def test_replies_in_lower_case_and_between_nmea_lines_count(request_: Request) -> None:
    """Newer firmware sends NMEA sentences between the lines of a reply."""
    part = {"version": ["PNAME=HI14"], "report": ["ATT_MODE=0"]}.get(request_.kind, [])
    for end, outcome in (("ok", Reply), ("Ok ", Reply), ("err 3", Rejection)):
        ledger = Ledger()
        runner = offline_runner(ledger)
        runner.start(request_, 5)
        for line in ("$GPHDT,1.0,T*00", *part, "$PASHR,1,2*00"):
            assert runner.on_message(line, 6) is None
        assert (runner.on_message(end, 7), ledger.replies_unsolicited) == (outcome((*part, end)), 2)


IDENTITY = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
two_rows: Any = IDENTITY[:2]  # a wrong type on purpose

REFUSED: list[tuple[Callable[[], object], str]] = [
    (lambda: c.mounting(((1, 0, 0), (0, 1, 0), (0, 0, -1))), "determinant"),
    (lambda: c.mounting(((2, 0, 0), (0, 1, 0), (0, 0, 1))), "orthonormal"),
    (lambda: c.mounting(((1, 0.01, 0), (0, 1, 0), (0, 0, 1))), "orthonormal"),
    (lambda: c.mounting(((math.nan, 0, 0), (0, 1, 0), (0, 0, 1))), "orthonormal"),
    (lambda: c.mounting(two_rows), "3 x 3"),
    (lambda: c.alarm(c.AlarmAxis.X, 5, -5, True), "minimum below the maximum"),
    (lambda: c.alarm(c.AlarmAxis.X, 5, 5, True), "minimum below the maximum"),
    (lambda: c.require_room({H91: 200}, 115200), "at most 100 Hz at 115200 baud, got 200 Hz"),
]


@pytest.mark.parametrize(("make", "message"), REFUSED)
def test_invalid_arguments_are_rejected_with_the_expected_values(make: Callable[[], object], message: str) -> None:
    with pytest.raises(BadArgument, match=message) as caught:
        make()
    assert "expected" in str(caught.value)


@pytest.mark.manual("B 3.7 rates by baud rate", "B 2.2.1 REBOOT")
def test_table_3_7_and_the_silent_command() -> None:
    for baud, message, frame_bytes in [(baud, *one) for baud in c.BAUD_RATES for one in ((H91, 82), (H92, 54))]:
        rate = c.MAX_RATE_HZ[message][baud]
        assert rate in c.RATES_HZ
        assert rate * frame_bytes * 10 <= baud
    assert (c.MAX_RATE_HZ[H91][115200], c.MAX_RATE_HZ[H92][115200]) == (100, 200)
    assert [text for request, text in PRINTED if request.silent] == ["REBOOT"]


T = TypeVar("T")
VERSION = ("PNAME=HI14R3", "BUILD=Oct 15 2024", "UUID=043995698D6E1708", "APP_VER=156", "BL_VER=109", "OK")
REPLIES = {
    "LOG USRCONFIG": ("ATT_MODE: 0", "OK"),
    "LOG COMCONFIG": ("BAUD=115200", "LOG HI91 ONTIME 0.01", "OK"),
    "LOG MAGCONFIG": ("MB=14.14, -2.08, -8.75", "OK"),
}


def hold(script: RequestScript[T], answer: Callable[[str], Outcome]) -> T:
    return run_script(script, lambda request: answer(request.name))


@pytest.mark.manual("B 2.2.5 VERSION")
def test_identity_refusal_and_flat_settings() -> None:
    asked: list[str] = []

    def answer(name: str) -> Outcome:
        asked.append(name)
        return Reply(VERSION)

    identity = hold(identify(), answer)
    assert asked == ["LOG VERSION"]
    assert (identity.product, identity.serial_number, identity.firmware) == ("HI14R3", "043995698D6E1708", "1.5.6")
    assert (identity.details or {})["APP_VER"] == "156"
    assert hold(identify(), lambda _: Reply(("PNAME=CH0", "OK"))).firmware == ""
    with pytest.raises(Rejected, match="ERR 3"):
        hold(identify(), lambda _: Rejection(("ERR 3",)))

    assert combined(hold(SETTINGS.read(Target(None, 0), None), lambda name: Reply(REPLIES[name]))).words == {
        "ATT_MODE": "0", "BAUD": "115200", "COMCONFIG 1": "LOG HI91 ONTIME 0.01", "MB": "14.14, -2.08, -8.75",
    }  # fmt: skip
    without = hold(
        SETTINGS.read(Target(None, 0), None), lambda n: Silence(()) if n == "LOG MAGCONFIG" else Reply(REPLIES[n])
    )
    assert {"ATT_MODE", "MB"}.intersection(combined(without).words) == {"ATT_MODE"}
    for silent in ("LOG USRCONFIG", "LOG COMCONFIG"):
        script = SETTINGS.read(Target(None, 0), None)
        with pytest.raises(NoReply, match=silent):
            hold(script, lambda n, silent=silent: Silence(()) if n == silent else Reply(REPLIES[n]))  # type: ignore[misc]  # bound now

    def user_report(name: str) -> Outcome:
        assert name == "LOG USRCONFIG"
        return Reply(REPLIES[name])

    assert set(hold(SETTINGS.read(Target(None, 0), {SETTINGS.table["mode"].report}), user_report)) == {"USRCONFIG"}


def test_no_reply_and_one_that_lost_its_product() -> None:
    for outcome, words in (
        (Silence(()), "LOG VERSION: expected lines up to OK"),
        (Silence(("PNAME=HI14R3",)), "LOG VERSION: expected lines up to OK"),
        (Reply(("OK",)), "LOG VERSION: expected PNAME=.* bytes were lost"),
        (Reply(("NAME=HI14R3", "UUID=043995698D6E1708", "OK")), "LOG VERSION: expected PNAME=.* bytes were lost"),
    ):
        with pytest.raises(NoReply, match=words):
            hold(identify(), lambda _, outcome=outcome: outcome)  # type: ignore[misc]  # bound now


def test_a_late_version_is_not_taken_for_the_settings() -> None:
    """LOG VERSION times out, imud sends LOG USRCONFIG, and then the late reply to LOG VERSION arrives with its OK."""
    ledger = Ledger()
    session = offline_runner(ledger)
    session.start(ask(Query.VERSION), 0)
    assert isinstance(session.on_time(10**9), Silence)
    session.start(ask(Query.USRCONFIG), 10**9)
    assert [session.on_message(line, 10**9 + 1) for line in VERSION] == [None] * len(VERSION)
    assert (ledger.replies_late, ledger.replies_unsolicited) == (1, 0)
    assert session.on_message("ATT_MODE: 0", 10**9 + 2) is None
    assert session.on_message("OK", 10**9 + 2) == Reply(("ATT_MODE: 0", "OK"))
    ledger = Ledger()
    session = offline_runner(ledger)
    session.start(log_ontime(OutputMessage.HI91, 100), 0)
    session.on_time(10**9)
    session.start(ask(Query.VERSION), 10**9)
    outcomes = [session.on_message(line, 10**9 + 1) for line in ("OK", *VERSION)]
    assert (outcomes, ledger.replies_late) == ([None] * 6 + [Reply(VERSION)], 1)


every_variant = pytest.mark.parametrize("behaviour", VARIANTS.values(), ids=VARIANTS)


@every_variant
@pytest.mark.parametrize("baud", [9600, 921600])
@pytest.mark.manual("B 2.2.3 SERIALCONFIG")
def test_another_baud_rate_is_followed_and_saved(behaviour: Behaviour, baud: int) -> None:
    line = HipnucLine(ModuleSettings(hi91=Output(200)), hardware_of(behaviour))
    assert line.act("baud", baud=baud) == baud
    assert line.baud == line.module.baud == line.module.flash.baud == baud
    line.module.reboot(line.now_ns)
    line.wait(line.module.hardware.boot_ms)
    assert line.run(identify()).product == "HI14R3"


class Forgetful(HipnucLine):
    """Device that replies OK to SAVECONFIG and saves nothing."""

    def ask(self, request: Request) -> Outcome:
        outcome = super().ask(request)
        self.module.flash = ModuleSettings()
        return outcome


class Deaf(HipnucLine):
    """Device that replies OK to SERIALCONFIG and keeps its baud rate, also in its report."""

    def ask(self, request: Request) -> Outcome:
        return Reply(("OK",)) if request.name.startswith("SERIALCONFIG") else super().ask(request)


def test_ignored_baud_rate_is_not_saved() -> None:
    """A save would also write other changes to the flash, and the restart would lose the measurement for nothing."""
    line = Deaf()
    with pytest.raises(Rejected, match="replied OK, but still uses 115200 baud and reports 115200; imud did not save"):
        line.act("baud", baud=921600)
    assert not {"SAVECONFIG", "REBOOT"} & set(line.asked)
    assert line.run(identify()).product == "HI14R3"


@pytest.mark.manual("B 2.2.3 a wrong rate")
def test_a_module_that_refuses_does_not_know_or_does_not_save_another_rate_stays_reachable() -> None:
    line = HipnucLine(hardware=hardware_of(Behaviour(refuses=("SERIALCONFIG",))))
    with pytest.raises(Rejected, match="SERIALCONFIG 921600: the device rejected the request: ERR"):
        line.act("baud", baud=921600)
    assert line.run(identify()).product == "HI14R3"
    line = HipnucLine(hardware=hardware_of(Behaviour(ignores=("SERIALCONFIG",))))
    with pytest.raises(NoReply, match="keeps 115200 baud"):
        line.act("baud", baud=921600)
    assert "SAVECONFIG" not in line.asked
    assert line.run(identify()).product == "HI14R3"
    line = Forgetful()
    with pytest.raises(Rejected, match="keeps 115200 baud"):
        line.act("baud", baud=921600)
    assert line.baud == 115200
    assert line.run(identify()).product == "HI14R3"


@pytest.mark.parametrize(
    ("settings", "baud", "words"),
    [
        (ModuleSettings(hi91=Output(10)), 9600, "HI91: expected at most 10 Hz at 9600 baud, got 100 Hz"),
        (ModuleSettings(baud=921600, hi91=Output(1)), 460800, "at most 500 Hz at 460800 baud, got 1000 Hz"),
        (ModuleSettings(hi91=Output(100), hi92=Output(200)), 9600, r"9120 bit/s of frames at 9600 baud, got 10900"),
    ],
)
def test_a_baud_rate_that_does_not_carry_the_present_output_is_refused(
    settings: ModuleSettings, baud: int, words: str
) -> None:
    """10 Hz of HI91 need 8200 bit/s, 5 Hz of HI92 2700 bit/s."""
    line = HipnucLine(settings)
    with pytest.raises(BadArgument, match=words):
        line.act("baud", baud=baud)
    assert line.asked == ["LOG COMCONFIG"]


@pytest.mark.manual("B 2.2.5 output and line", "B 2.2.5 ONTIME")
def test_the_sum_of_all_messages_is_refused_and_a_sum_that_fits_is_not() -> None:
    """100 Hz of HI91 need 82000 of 115200 bit/s. HI92 needs 540 bits per frame: 95 % leave 50 Hz and not 100."""
    line, actual = HipnucLine(), {"output": {"hi91": 100, "hi92": 0}}

    def output(message: str, rate_hz: int) -> None:
        given = {"message": message, "rate_hz": rate_hz}
        line.run(script_of(DRIVER, Target(None, 115200), "output", given, **actual))

    with pytest.raises(BadArgument, match="got 136000 bit/s by HI91 at 100 Hz and HI92 at 100 Hz"):
        output("HI92", 100)
    assert "LOG HI92 ONTIME 0.01" not in line.asked
    output("HI92", 50)
    assert line.module.settings.hi92 == Output(20)
    output("HI91", 25)
    assert line.module.settings.hi91 == Output(40)


@every_variant
@pytest.mark.parametrize("baud", [9600, 115200])
@pytest.mark.manual("B 2.2.7 FRESET")
def test_a_factory_reset_is_in_force_and_followed(behaviour: Behaviour, baud: int) -> None:
    line = HipnucLine(ModuleSettings(baud=baud, att_mode=1, hi91=Output(1000)), hardware_of(behaviour))
    answer = line.act("factory_reset", fixed_baud=baud)
    assert answer["baud"] == line.baud == line.module.baud == 115200
    assert ("configuration" in answer) is (baud != 115200)
    assert line.module.settings == line.module.flash == ModuleSettings()


def test_a_factory_reset_that_is_refused_or_unknown_changes_nothing() -> None:
    before = ModuleSettings(baud=921600, att_mode=1)
    with pytest.raises(Rejected, match="FRESET: the device rejected the request: ERR"):
        HipnucLine(before, hardware_of(Behaviour(refuses=("FRESET",)))).act("factory_reset")
    line = HipnucLine(before, hardware_of(Behaviour(ignores=("FRESET",))))
    with pytest.raises(NoReply, match="FRESET: expected OK, got no reply"):
        line.act("factory_reset")
    assert (line.baud, line.module.settings) == (921600, before)

    assert advice(921600, 0) == advice(921600, 921600) == ""
    assert advice(921600, 115200).startswith("change `baud: 115200` in the configuration to 921600 or auto")
    line = HipnucLine(hardware=hardware_of(Behaviour(rate_change=RateChange.AFTER_ANSWER)))
    line.run(_send(line, "SERIALCONFIG 460800"))
    line.baud = 460800
    assert line.act("restart").product == "HI14R3"
    assert line.baud == line.module.baud == 115200


def _send(line: HipnucLine, command: str) -> RequestScript[None]:
    line.module.receive(command.encode() + b"\r\n", line.now_ns)
    line.wait(20)
    return None
    yield  # makes it a generator


@pytest.mark.parametrize(
    ("settings", "done", "hi91"),
    [
        (ModuleSettings(), "LOG ENABLE", Output(10)),
        (ModuleSettings(hi91=Output()), "LOG ENABLE; HI91 at 100 Hz, not saved", Output(10)),
        (ModuleSettings(baud=9600, hi91=Output()), "LOG ENABLE; HI91 at 10 Hz, not saved", Output(100)),
        (ModuleSettings(hi91=Output(on_mark=True)), "LOG ENABLE; HI91 at 100 Hz, not saved", Output(10)),
    ],
)
def test_a_silent_module_is_woken_by_an_action(settings: ModuleSettings, done: str, hi91: Output) -> None:
    line = HipnucLine(settings)
    line.module.receive(b"LOG DISABLE\r\n", line.now_ns)
    line.wait(300)
    assert line.act("wake") == done
    assert (line.module.settings.hi91, line.module.flash) == (hi91, settings)
    line.wait(300)
    assert line.ledger.frames_in_samples > 1


@pytest.mark.parametrize(
    ("settings", "woken"),
    [
        (ModuleSettings(), True),
        (ModuleSettings(hi91=Output()), None),
        (ModuleSettings(hi91=Output(on_mark=True)), None),
        (ModuleSettings(hi91=Output(on_mark=True), hi92=Output(100)), None),
    ],
)
@pytest.mark.manual("B 2.2.5 LOG ENABLE")
def test_by_itself_only_frames_that_have_a_rate_are_let_out(settings: ModuleSettings, woken: bool | None) -> None:
    line = HipnucLine(settings)
    line.module.receive(b"LOG DISABLE\r\n", line.now_ns)
    line.wait(300)
    assert line.run(wake()) is woken
    assert ("LOG ENABLE" in line.asked) is (woken is True)
    assert line.module.settings == settings


def test_the_reason_of_a_silent_device() -> None:
    for report, words in (
        (("LOG HI91 ONTIME 0.01", "LOG HI92 ONTIME 0.005"), "LOG DISABLE); HI92 has the rate 200 Hz"),
        (("LOG HI92 ONMARK 1", "LOG HI91 ONMARK 1"), "HI91 and HI92 on mark"),
        (("LOG HI91 ONTIME 0",), "no message has a rate"),
        ((), "its output is off, or on mark"),
    ):
        lines = {f"COMCONFIG {number}": line for number, line in enumerate(report)}
        assert words in why_silent(report_values({"BAUD": "115200", **lines}))


FRAME = Reply((), Measurement(82, 0, 5))
OK = Reply(("OK",))
ERR = Rejection(("ERR",))


@pytest.mark.parametrize(
    ("outcomes", "error"),
    [
        ([OK], ""),  # the frame follows
        ([FRAME, OK], ""),  # the frame first, or a frame of the timed output
        ([FRAME, Silence(())], ""),  # newer firmware: the frame is the reply
        ([FRAME, ERR], "the device rejected the request: ERR"),
        ([ERR], "the device rejected the request: ERR"),
        ([Silence(())], "expected OK or a frame, got no reply"),
    ],
)
@pytest.mark.manual("B 2.2.5 ONMARK ONCE")
def test_a_frame_without_ok_answers_a_request_for_one_frame(outcomes: list[Outcome], error: str) -> None:
    asked: list[Request] = []

    def answer(request: Request) -> Outcome:
        asked.append(request)
        return outcomes[len(asked) - 1]

    if error:
        with pytest.raises((NoReply, Rejected), match=error):
            run_script(send_once(OutputMessage.HI91), answer)
    else:
        run_script(send_once(OutputMessage.HI91), answer)
    assert [one.payload for one in asked] == [b"LOG HI91 ONMARK ONCE\r\n", b""][: len(outcomes)]
    assert all(one.kind == "OK" and one.is_end("OK") for one in asked)


@pytest.mark.manual("B 2.2.5 VERSION", "B 2.2.5 USRCONFIG", "B 2.2.5 COMCONFIG", "B 8.1.1 result")
def test_reports_and_numbers_of_the_module() -> None:
    version = r.parse_version(VERSION)
    assert (version.product, version.build, version.uuid) == ("HI14R3", "Oct 15 2024", "043995698D6E1708")
    assert (version.app_ver, version.bl_ver) == (156, 109)
    assert version.report.other == ()
    version = r.parse_version(("PNAME: CH0", "* boot ok *", "APP_VER=beta", "COLOUR=red", "PNAME=again", "OK"))
    assert (version.product, version.uuid, version.app_ver) == ("CH0", "", None)
    assert version.report.values == {"PNAME": "CH0", "APP_VER": "beta", "COLOUR": "red"}
    assert version.report.other == ("* boot ok *", "PNAME=again")

    config = r.parse_report(("ATT_MODE: 1 /* 0:6, 1:9 */", "URFR=1,0,0", "OK"))
    assert config.values == {"ATT_MODE": "1", "URFR": "1,0,0"}
    assert [r.is_end(one) for one in ("OK", "OKAY")] == [True, False]
    assert [r.is_rejection(one) for one in ("ERR", "ERROR: no such command", "ERR_COUNT=3")] == [True, True, False]
    assert [r.is_version_line(one) for one in (*VERSION[:-1], "ATT_MODE: 0")] == [True] * 5 + [False]
    assert [r.is_setting_line(one) for one in (*VERSION[:-1], "ATT_MODE: 0")] == [False] * 5 + [True]

    lines = ("BAUD=115200", "LOG IMU91 ONTIME 0.01", "LOG HI92 COM1 ONTIME 0", "OK")
    com1: Any = ({"HI92": 0.0}, frozenset(), {})
    assert r.parse_comconfig(lines) == ({"HI91": 0.01}, frozenset(), {"COM1": com1})
    assert r.parse_comconfig(lines[2:]) == com1  # the only port is the port of imud
    two = r.parse_comconfig(("LOG COM1 HI91 ONTIME .1", "LOG COM2 GGA ONMARK 1", "LOG COM2 RMC ONTIME 1"))
    both: Any = {"COM1": ({"HI91": 0.1}, set(), {}), "COM2": ({"RMC": 1.0}, {"GGA"}, {})}
    assert two == ({}, frozenset(), both)
    assert r.parse_report(lines) == r.Report({"BAUD": "115200"}, lines[1:3])
    for text, bias_ut in (("14.14, -2.08, -8.75", [14.14, -2.08, -8.75]), ("1,2", None), ("1,nan,2", None), ("", None)):
        assert r.numbers_of(text, 3) == bias_ut


TARGET = Target(None, 115200)
NAMED = Reply(("PNAME=HI14R3", "OK"))


def asked(script: RequestScript[object], answers: list[Outcome] | None = None) -> tuple[list[Request], object]:
    """Return the requests of a script, with one reply each (default: OK), and its result."""
    left = list(answers or [])
    requests: list[Request] = []

    def answer(request: Request) -> Outcome:
        requests.append(request)
        return OK if answers is None else left.pop(0)

    value = run_script(script, answer)
    assert not left
    return requests, value


def sent(name: str, answers: list[Outcome] | None = None, **arguments: Any) -> tuple[list[Request], object]:
    """Return the requests of a verb or a setting, and its result."""
    return asked(script_of(DRIVER, TARGET, name, arguments), answers)


def texts(script: RequestScript[object]) -> list[str]:
    """Return the requests of a script whose replies are OK."""
    return [request.payload.decode("ascii").rstrip() for request in asked(script)[0]]


@pytest.mark.parametrize(
    ("name", "arguments", "command"),
    [
        ("save", {}, "SAVECONFIG"), ("output_none", {}, "UNLOGALL; LOG HI91 ONTIME 0; LOG HI92 ONTIME 0"),
        ("output", {"message": "HI92", "rate_hz": 0}, "LOG HI92 ONTIME 0"),
        ("output_on_mark", {"message": "HI91"}, "LOG HI91 ONTIME 0; LOG HI91 ONMARK 1"),
        ("output_once", {"message": "HI91"}, "LOG HI91 ONMARK ONCE"),
        ("output_enabled", {"enabled": False}, "LOG DISABLE"), ("output_enabled", {"enabled": True}, "LOG ENABLE"),
        ("mode", {"axes": 9}, "CONFIG ATT MODE 1"), ("mode", {"axes": 6}, "CONFIG ATT MODE 0"),
        ("level", {"level": "automatic"}, "CONFIG ATT RST 3"), ("yaw", {"angle_deg": 16}, "CONFIG YAW 1 16"),
        ("yaw", {"angle_deg": 1.5, "relative": True}, "CONFIG YAW 0 1.5"),
        ("mounting", {"turned": "y_down"}, "CONFIG IMU URFR 1,0,0,0,0,1,0,-1,0"),
        ("mounting", {"turned": "x_up"}, "CONFIG IMU URFR 0,0,-1,0,1,0,1,0,0"),
        ("mounting", {"turned": [0, -1, 0, 1, 0, 0.0009, 0, 0, 1]}, "CONFIG IMU URFR 0,-1,0,1,0,0.0009,0,0,1"),
        ("magnetic_calibration", {"enabled": True}, "CONFIG IMU EN_MCAL 1"),
        ("pin", {"function": "sout_div", "pin": 9}, "CONFIG PMUX4 IO9"),
        ("alarm", {"axis": "Y", "min_deg": -5, "max_deg": 5}, "CONFIG PMUX5 Y,-5,5,0,1"),
        ("sout_divider", {"divisor": 4}, "CONFIG PMUX4 DIV4"),
    ],
)  # fmt: skip
@pytest.mark.manual(
    "B 2.2.4 ATT MODE 0", "B 2.2.4 ATT MODE 1", "B 2.2.4 YAW 1", "B 2.2.4 YAW 0", "B 2.2.4 PMUX",
    "B 2.2.4 alarm range", "B 2.2.5 LOG ENABLE", "B 2.2.5 LOG DISABLE", "B 2.2.5 output off", "B 2.2.5 ONMARK 1",
    "B 2.2.5 ONMARK ONCE", "B 2.2.6 UNLOGALL", "B 8.2 EN_MCAL",
)  # fmt: skip
def test_one_command(name: str, arguments: dict[str, Any], command: str) -> None:
    requests, value = sent(name, **arguments)
    assert [request.payload for request in requests] == [f"{one}\r\n".encode() for one in command.split("; ")]
    assert value is None


RATES = r"output.hi91: expected one of 0, 1, 2, 4, 5, 8, 10, 20, 25, 40, 50, 100, 125, 200, 250, 500, 1000, or"
TURNS = "a number from -180 to 360"


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("output", {"message": "HI91", "rate_hz": 500}, "expected at most 100 Hz"),  # too much for 115200 baud
        ("output", {"message": "HI91", "rate_hz": 300}, RATES),
        ("output", {"message": "HI93", "rate_hz": 1}, "known: gga, hi81, hi83, hi91, hi92, rmc, sxt"),
        ("output_on_mark", {"message": None}, "imud settings bow --set output.MESSAGE=on_mark"),
        ("output_once", {"message": None}, 'one of "HI91", "HI92"'), ("mode", {"axes": 7}, 'one of "6-axis", "9-axis"'),
        ("level", {"level": None}, '"automatic", "cancel", "relative"'),
        ("mounting", {"turned": [1.0] * 8}, "or a list of 9, each item a number"),
        ("mounting", {"turned": [1, 0, 0.0011, 0, 1, 0, 0, 0, 1]}, "expected a rotation .* orthonormal within 0.001, "),
        ("magnetic_calibration", {"enabled": 2}, "true or false"), ("yaw", {"angle_deg": 360.1}, TURNS),
        ("yaw", {"angle_deg": math.nan}, TURNS), ("yaw", {"angle_deg": True}, TURNS),
        ("yaw", {"angle_deg": 5, "relative": None}, "true or false"),
        ("pin", {"function": "sin", "pin": 10}, "a whole number from 1 to 9"),
        ("pin", {"function": "sin", "pin": 0}, "a whole number from 1 to 9"),
        ("pin", {"function": "pps", "pin": 1}, "known: alarm, led, sin, sout, sout_div"),
        ("alarm", {"axis": "X", "min_deg": 5, "max_deg": -5}, "expected the minimum below the maximum"),
        ("alarm", {"axis": "Z", "min_deg": -5, "max_deg": 5}, "known: x, y"),
        ("sout_divider", {"divisor": 0}, "from 1 to 64"), ("sout_divider", {"divisor": 65}, "from 1 to 64"),
        ("baud", {"baud": 1200}, "one of 9600, 115200, 230400, 256000, 460800, 921600"),
    ],
)  # fmt: skip
@pytest.mark.manual("B 2.2.4 YAW range", "B 2.2.4 divider")
def test_bad_arguments_send_nothing(name: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(BadArgument, match=message):
        sent(name, [], **arguments)


@pytest.mark.manual("B 2.2.1 REBOOT")
def test_refusal_silence_restart_and_the_expected_value_of_a_heading() -> None:
    with pytest.raises(Rejected, match="ERR 3"):
        sent("save", [Rejection(("ERR 3",))])
    with pytest.raises(NoReply, match="SAVECONFIG: expected OK, got no reply"):
        sent("save", [Silence(())])
    left: list[Outcome] = [OK, OK, *([Silence(())] * 7)]
    with pytest.raises(NoReply, match="expected a reply at 115200 or 921600 baud"):
        sent("baud", left, baud=921600)

    requests, value = sent("restart", [Reply(()), Silence(()), Silence(()), Silence(()), NAMED])
    assert (requests[0].silent, getattr(value, "product", "")) == (True, "HI14R3")

    # The samples contain the heading 15°; the verb set 45°
    for relative, expected in ((False, [pytest.approx(math.pi / 6)]), (True, [])):
        verb = DRIVER.verbs["yaw"]
        found = verb.expected(verb.arguments({"angle_deg": 45, "relative": relative}))
        means = RestMeans(None, None, (0, 0, math.pi / 12))
        assert [one.value(means) for one in found] == expected


@pytest.mark.parametrize(
    ("kind", "begun", "saved"),
    [
        ("magnetometer", ["CONFIG IMU EN_MCAL 1"], []),
        ("magnetometer_once", ["CONFIG IMU EN_MCAL 1"], ["CONFIG IMU EN_MCAL 0", "SAVECONFIG"]),
        ("level", ["CONFIG ATT RST 2"], ["SAVECONFIG"]),
        ("accelerometer_level", ["CONFIG ATT RST 3"], ["SAVECONFIG"]),
        ("heading", ["CONFIG YAW 1 0"], []),
    ],
)
@pytest.mark.manual("B 2.2.4 ATT RST 2", "B 2.2.4 ATT RST 3", "B 8.2 once")
def test_requests_of_a_calibration(kind: str, begun: list[str], saved: list[str]) -> None:
    calibration = CALIBRATIONS[kind]
    assert texts(calibration.begin(TARGET)) == begun
    assert (calibration.kept is Kept.BY_SAVE) == bool(saved)
    if calibration.save is not None:
        assert texts(calibration.save(TARGET)) == saved


@pytest.mark.manual("B 8.1.1 result")
def test_verdict_of_the_magnetometer() -> None:
    for lines, is_done, text, bias_ut in (
        (("MB=14.14, -2.08, -8.75", "OK"), True, "bias 14.14, -2.08, -8.75 µT", (14.14, -2.08, -8.75)),
        (("MB=0.00, 0.00, 0.00", "OK"), False, "bias 0, 0, 0 µT", (0.0, 0.0, 0.0)),
        (("MC=1", "OK"), False, "the device does not report its bias", None),
    ):
        ask = CALIBRATIONS["magnetometer"].verdict
        assert ask is not None
        (request,), verdict = asked(ask(TARGET), [Reply(lines)])
        assert isinstance(verdict, Verdict)
        assert request.payload == b"LOG MAGCONFIG\r\n"
        assert (verdict.done, verdict.words) == (is_done, text)
        bias_t = None if bias_ut is None else pytest.approx(tuple(value * 1e-6 for value in bias_ut))
        assert verdict.bias_t == bias_t
        with pytest.raises(NoReply, match="does the device have a magnetometer"):
            asked(ask(TARGET), [Silence(())])
        with pytest.raises(Rejected, match="LOG MAGCONFIG: the device rejected the request: ERR"):
            asked(ask(TARGET), [Rejection(("ERR",))])


@pytest.mark.parametrize(("mode", "ready"), [("0", False), ("1", True)])
@pytest.mark.parametrize("kind", ["magnetometer", "magnetometer_once"])
@pytest.mark.manual("B 1.1 9-axis mode")
def test_nine_axes_are_needed(kind: str, mode: str, ready: bool) -> None:
    calibration: Calibration = CALIBRATIONS[kind]
    assert calibration.unready is not None
    words = asked(calibration.unready(TARGET), [Reply((f"ATT_MODE: {mode}", "OK"))])[1]
    assert (words == "") == ready
