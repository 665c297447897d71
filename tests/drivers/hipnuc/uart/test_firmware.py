"""Commands of older and newer firmware: bytes, values, refused values, firmware without them, and calibrations."""

import re
from itertools import chain
from typing import Any, get_args

import msgspec
import pytest

from imud.contracts.command import Target, Verdict
from imud.contracts.setting import combined
from imud.drivers.hipnuc.uart import firmware as f
from imud.drivers.hipnuc.uart.commands import send_if_known
from imud.drivers.hipnuc.uart.driver import CALIBRATIONS, DRIVER
from imud.drivers.hipnuc.uart.settings import SETTINGS, matrix_of, report_values, shown
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.model.options import value_problem
from imud.model.units import NS_PER_S
from imud.sim.hipnuc.uart_settings import DIGITS, VARIANTS, Behaviour, ModuleSettings, Output
from tests.support.simulated_modules import HipnucLine, hardware_of

NEWER, INS, OLDER = (VARIANTS[name] for name in ("firmware 1.7", "INS, firmware 1.7", "older firmware"))
URFR_134 = (-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0)  # X left, Y back, Z up: half a turn about Z
URFR_205 = (0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0)  # X front, Y right, Z down


def line_of(behaviour: Behaviour, **hardware: Any) -> HipnucLine:
    return HipnucLine(hardware=hardware_of(behaviour, firmware=behaviour.firmware, **hardware))


def values_of(line: HipnucLine) -> dict[str, Any]:
    values: dict[str, Any] = msgspec.to_builtins(
        combined(line.run(SETTINGS.read(Target(None, line.baud), None))).values
    )
    return values


CHANGES: list[tuple[Behaviour, str, Any, list[str], dict[str, Any]]] = [
    *((NEWER, "mode", mode, [f"CONFIG ATT MODE {number}"], {"att_mode": number})
      for mode, number in (("9-axis", 1), ("humanoid", 4), ("slow_vehicle", 5), ("low_dynamics", 7))),
    (NEWER, "coordinates", 4, ["CONFIG IMU COORD 4"], {"coord": 4}),
    (NEWER, "mounting", "134", ["CONFIG IMU URFR 134"], {"urfr": URFR_134}),
    (NEWER, "mounting", 205, ["CONFIG IMU URFR 205"], {"urfr": URFR_205}),
    (NEWER, "mounting", "z_down", ["CONFIG IMU URFR 1,0,0,0,-1,0,0,0,-1"], {"urfr": (1, 0, 0, 0, -1, 0, 0, 0, -1)}),
    (NEWER, "port_output", {"com2": {"hi91": 10}}, ["LOG COM2 HI91 ONTIME 0.1"],
     {"outputs": {"COM2 HI91": Output(100)}}),
    (NEWER, "port_output", {"com2": {"hi92": "on_mark"}}, ["LOG COM2 HI92 ONTIME 0", "LOG COM2 HI92 ONMARK 1"],
     {"outputs": {"COM2 HI92": Output(on_mark=True)}}),
    (NEWER, "port_baud", {"com2": 921600}, ["SERIALCONFIG COM2 921600", "LOG VERSION"], {"port_baud": 921600}),
    (INS, "output", {"gga": 1, "hi81": 20}, ["LOG GGA ONTIME 1", "LOG HI81 ONTIME 0.05"],
     {"outputs": {"GGA": Output(1000)}, "hi81": Output(50)}),
    (INS, "output", {"rmc": 1, "sxt": 5}, ["LOG RMC ONTIME 1", "LOG SXT ONTIME 0.2"],
     {"outputs": {"RMC": Output(1000), "SXT": Output(200)}}),
    (INS, "baseline", 1.5, ["SETBASELINE 1.5"], {"baseline_m": 1.5}),
    *((OLDER, name, value, [f"CONFIG IMU {code} {value}"], {"codes": {code: str(value)}})
      for name, code, value in (
          ("zero_rate_update", "ZARU", 0.25), ("accel_bandwidth", "ABW", 6), ("accel_range", "ARG", 3),
          ("gyro_bandwidth", "GBW", 2), ("gyro_range", "GRG", 1), ("inclination_format", "INC_FMT", 1))),
]  # fmt: skip


@pytest.mark.parametrize(("behaviour", "name", "given", "asked", "changed"), CHANGES)
def test_settings_are_written_read_back_saved_and_kept(
    behaviour: Behaviour, name: str, given: Any, asked: list[str], changed: dict[str, Any]
) -> None:
    line, setting = line_of(behaviour), SETTINGS.table[name]
    assert setting.write is not None
    assert SETTINGS.save is not None
    assert SETTINGS.restart is not None
    value = msgspec.convert(given, setting.type)
    before = values_of(line)
    assert name not in before or not setting.agrees(value, before[name])
    line.asked.clear()
    line.run(setting.write(Target(None, line.baud), value))
    assert line.asked == asked
    read = line.run(SETTINGS.read(Target(None, line.baud), {setting.report}))
    assert setting.agrees(value, combined(read).values[name])
    line.run(SETTINGS.save(Target(None, line.baud)))
    line.run(SETTINGS.restart(Target(None, line.baud)))
    assert {one: getattr(line.module.settings, one) for one in changed} == changed
    assert all(value_problem(one, SETTINGS.table[key].type) == "" for key, one in values_of(line).items())
    assert line.ledger.replies_unsolicited == 0
    assert (line.ledger.frames_ignored > 0) == behaviour.newer


# commands that the manual does not contain
UNKNOWN = [(name, given, asked[0]) for _, name, given, asked, _ in CHANGES if given not in ("9-axis", "z_down")]


@pytest.mark.parametrize("version", ["1.5.6", "1.7.1"])
@pytest.mark.parametrize(("name", "given", "asked"), UNKNOWN)
def test_a_firmware_without_the_command_is_named(version: str, name: str, given: Any, asked: str) -> None:
    """Newer firmware replies ERR to an unknown command. Older firmware does not reply."""
    line, setting = HipnucLine(), SETTINGS.table[name]
    if version == "1.7.1":
        line = line_of(Behaviour(refuses=(asked,), newer=True, firmware=171))
    has_value = name in ("mode", "mounting")  # the manual contains the command with other values
    reply = "ERR" if has_value or version == "1.7.1" else "no reply"
    words = f"{asked}: not supported by firmware {version}: expected OK, got {reply}"
    assert setting.write is not None
    with pytest.raises(Rejected, match=f"^{re.escape(words)}$"):
        line.run(setting.write(Target(None, line.baud), msgspec.convert(given, setting.type)))


def write(name: str, line: HipnucLine, value: Any) -> Any:
    setting = SETTINGS.table[name]
    assert setting.write is not None
    return setting.write(Target(None, line.baud), value)


LOSSES: list[tuple[str, Any]] = [
    ("LOG MCAL STAT", lambda line: send_if_known(f.ask_calibration())),
    ("CONFIG MCAL START", lambda line: CALIBRATIONS["magnetometer_start"].begin(Target(None, line.baud))),
    ("LOG COM2", lambda line: write("port_output", line, {"com2": {"hi91": 10}})),
    ("SERIALCONFIG COM2", lambda line: write("port_baud", line, {"com2": 921600})),
]


@pytest.mark.parametrize(("command", "make"), LOSSES, ids=[command for command, _ in LOSSES])
def test_lost_reply_is_no_missing_command(command: str, make: Any) -> None:
    """A lost reply does not show that the firmware lacks the command: imud sends the command again."""
    line = line_of(Behaviour(newer=True, firmware=172, loses=(command,)))
    line.run(make(line))
    assert sum(asked.startswith(command) for asked in line.asked) == 2


def test_newer_firmware_without_a_reply_has_the_command() -> None:
    line = line_of(Behaviour(newer=True, firmware=172, ignores=("LOG MCAL STAT",)))
    with pytest.raises(NoReply, match=r"expected OK or ERR, got no reply, but firmware 1\.7\.2 replies to"):
        line.run(send_if_known(f.ask_calibration()))


def test_a_command_without_any_reply_of_the_device_is_no_missing_command() -> None:
    line = line_of(NEWER)
    line.connected = False
    with pytest.raises(NoReply, match="LOG VERSION"):
        line.run(send_if_known(f.ask_calibration()))


def test_digits_are_the_directions_of_the_physical_axes() -> None:
    assert len(get_args(f.Digits)) == 24
    assert set(get_args(f.Digits)) == set(DIGITS)
    assert matrix_of("024") == matrix_of(24) == ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    assert (*chain(*matrix_of("134")),) == URFR_134
    assert (*chain(*matrix_of(205)),) == URFR_205
    same = SETTINGS.table["mounting"].agrees
    assert same("level", "024")
    assert same(24, "024")
    assert same([1, 0, 0, 0, 1, 0, 0, 0, 1], "024")
    assert not same("z_down", "024")
    for text, value in (("024", "024"), ("24", "024"), ("134", "134"), ("135", None), ("025", None), ("1340", None)):
        assert report_values({"URFR": text}).get("mounting") == value


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (134, ""), (115, "three different axes, got 115 (left, left, down): two are parallel"),
        (124, "right-handed axes, got 124 (left, front, up)"), (234, "three different axes, got 234 (front, back, up)"),
        (189, "three digits from 0 to 5, got 189"), (25, "right-handed axes, got 025 (right, front, down)"),
    ],
)  # fmt: skip
def test_impossible_digits_are_rejected_before_a_write(given: int, words: str) -> None:
    if not words:
        SETTINGS.check(Target(None, 115200), {"mounting": given})
        return
    with pytest.raises(BadArgument) as caught:
        SETTINGS.check(Target(None, 115200), {"mounting": given})
    assert str(caught.value).startswith(f"mounting: expected {words}")
    assert "possible values: 024, 035" in str(caught.value)
    assert value_problem(f"{given:03}", SETTINGS.table["mounting"].type)
    with pytest.raises(BadArgument):
        f.mounting_by_digits(f"{given:03}")


def test_unknown_values_are_reported_and_cannot_be_set() -> None:
    for raw, name, value in (({"ATT_MODE": "3"}, "mode", "3"), ({"COORD": "2"}, "coordinates", 2)):
        assert report_values(raw) == {name: value}
        assert shown(raw) == {name: str(value)}
        assert value_problem(value, SETTINGS.table[name].type)
    assert report_values({"ABW": "7", "ZARU": "x", "GRG": "", "INC_FMT": "1"}) == {"inclination_format": 1}


def test_reports_of_several_ports_and_their_text() -> None:
    raw = {"COM3 BAUD": "460800", "COMCONFIG 1": "SERIALCONFIG COM2 921600", "COMCONFIG 2": "LOG COM2 HI91 ONTIME 0",
           "COMCONFIG 3": "LOG HI91 ONTIME 0.01", "COM4": "12345", "BASELINE": "-1.5"}  # fmt: skip
    assert report_values(raw) == {
        "output": {"hi91": 100}, "port_output": {"com2": {"hi91": 0}}, "port_baud": {"com2": 921600, "com3": 460800},
        "baseline": -1.5,
    }  # fmt: skip
    assert shown(raw) == {
        "output.hi91": "100 Hz", "port_output.com2.hi91": "off", "port_baud.com2": "921600 bit/s",
        "port_baud.com3": "460800 bit/s", "baseline": "-1.5 m", "COM4": "12345",
    }  # fmt: skip
    agrees = SETTINGS.table["port_output"].agrees
    assert agrees({"com2": {"hi91": 0}}, {"com2": {"hi91": 0, "hi92": 5}})
    assert not agrees({"com3": {"hi91": 0}}, {"com2": {"hi91": 0}})


@pytest.mark.parametrize("change", ["BEFORE_ANSWER", "AFTER_ANSWER"])
def test_the_baud_rate_of_the_port_of_imud_is_restored(change: str) -> None:
    kind = type(NEWER.rate_change)[change]
    line = line_of(Behaviour(newer=True, firmware=170, rate_change=kind))
    write = SETTINGS.table["port_baud"].write
    assert write is not None
    with pytest.raises(BadArgument, match="imud uses COM1; imud restored 115200 baud: use `baud`"):
        line.run(write(Target(None, 115200), {"com1": 921600}))
    assert (line.baud, line.module.baud) == (115200, 115200)


def test_verbs_of_older_firmware_and_ins_models() -> None:
    line = line_of(OLDER)
    for kind in (1, 4):
        line.act("reset_attitude", kind=kind)
    assert line.asked == ["CONFIG ATT RST 1", "CONFIG ATT RST 4"]
    assert line_of(INS).act("ins_config") == {"BASELINE": "1"}
    for name, given in (("reset_attitude", {"kind": 1}), ("ins_config", {})):
        with pytest.raises(Rejected, match=r"not supported by firmware 1\.7\.0: expected OK, got ERR"):
            line_of(NEWER).act(name, **given)
    with pytest.raises(BadArgument, match="expected one of 1, 4"):
        DRIVER.verbs["reset_attitude"].arguments({"kind": 2})


STATES: list[tuple[list[str], Verdict]] = [
    (["STATE=RUNNING", "PROGRESS=45%"], Verdict(False, "STATE RUNNING", 0.45)),
    (["STATE=DONE", "PROGRESS=100%"], Verdict(True, "STATE DONE", 1.0)),
    (["MCAL: FINISHED"], Verdict(True, "MCAL FINISHED")), (["100%"], Verdict(True, "", 1.0)),
    (["PROG: 7"], Verdict(False, "", 0.07)), (["STATE=NOT CALIBRATED"], Verdict(False, "STATE NOT CALIBRATED")),
    (["STATE=NOT DONE"], Verdict(False, "STATE NOT DONE")),
    (["STATE=FAILED", "PROGRESS=100"], Verdict(False, "STATE FAILED", 1.0, has_failed=True)),
    (["STATE=RUNNING", "ERROR=0"], Verdict(False, "STATE RUNNING, ERROR 0")),
    (["STATE=DONE", "ERROR=7"], Verdict(False, "STATE DONE, ERROR 7", has_failed=True)),
    (["RESULT=UNCALIBRATED"], Verdict(False, "RESULT UNCALIBRATED")),
    (["STAT=2"], Verdict(False, "STAT 2")),  # a form that imud does not know: shown, not verified
]  # fmt: skip


@pytest.mark.parametrize(("lines", "verdict"), STATES)
def test_states_of_a_calibration(lines: list[str], verdict: Verdict) -> None:
    assert f.read_calibration([*lines, "OK"]) == verdict


@pytest.mark.parametrize("planar", [False, True])
def test_a_calibration_by_command_reports_its_progress(planar: bool) -> None:
    calibration = CALIBRATIONS["magnetometer_2d" if planar else "magnetometer_start"]
    target = Target(None, 115200)
    iron, spin = (14.14e-6, -2.08e-6, -8.75e-6), (0.0, 0.0, 2.0)
    line = line_of(NEWER, hard_iron_t=iron)
    magnetometer = line.module._magnetometer
    assert calibration.unready is not None
    assert calibration.verdict is not None
    assert line.run(calibration.unready(target)) == ""
    line.run(calibration.begin(target))
    assert line.asked[-1] == ("CONFIG MCAL START 2D" if planar else "CONFIG MCAL START")
    verdict = line.run(calibration.verdict(target))
    assert (verdict.done, verdict.words, verdict.progress) == (False, "bias 0, 0, 0 µT, STATE RUNNING", 0.0)
    for number in range(2, 6):
        magnetometer.sample(number * NS_PER_S, spin if planar else (2.0, 2.0, 2.0))
    verdict = line.run(calibration.verdict(target))
    assert (verdict.done, verdict.progress) == (False, pytest.approx(6 / 6.2832, abs=0.01))
    for half_s in (11, 12):
        magnetometer.sample(half_s * NS_PER_S // 2, spin if planar else (2.0, 2.0, 2.0))
    verdict = line.run(calibration.verdict(target))
    assert (verdict.done, verdict.words) == (True, "bias 14.14, -2.08, -8.75 µT, STATE DONE")
    assert verdict.bias_t == pytest.approx(iron)
    assert line.asked[-2:] == ["LOG MCAL STAT", "LOG MAGCONFIG"], "the bias is not older than the state"
    old = HipnucLine(ModuleSettings(att_mode=1))
    assert old.run(calibration.unready(target)) == (
        "LOG MCAL STAT: not supported by firmware 1.5.6: expected OK, got no reply"
    )
