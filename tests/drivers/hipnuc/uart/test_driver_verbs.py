"""Verbs and calibrations of a HiPNUC device: bytes on the wire, and their effect on the simulated device."""

import math
from typing import Any

import pytest

from imud.contracts.command import Calibration, Kept, RestMeans, Target, Verdict
from imud.contracts.script import Outcome, Rejection, Reply, Request, RequestScript, Silence
from imud.drivers.hipnuc.uart.driver import CALIBRATIONS, DRIVER
from imud.model.errors import BadArgument, NoReply, Rejected
from tests.support.old_spellings import script_of
from tests.support.simulated_modules import run_script

OK = Reply(("OK",))
TARGET = Target(None, 115200)
VERSION = Reply(("PNAME=HI14R3", "OK"))


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
        ("save", {}, "SAVECONFIG"),
        ("output_none", {}, "UNLOGALL; LOG HI91 ONTIME 0; LOG HI92 ONTIME 0"),
        ("output", {"message": "HI92", "rate_hz": 0}, "LOG HI92 ONTIME 0"),
        ("output_on_mark", {"message": "HI91"}, "LOG HI91 ONTIME 0; LOG HI91 ONMARK 1"),
        ("output_once", {"message": "HI91"}, "LOG HI91 ONMARK ONCE"),
        ("output_enabled", {"enabled": False}, "LOG DISABLE"),
        ("output_enabled", {"enabled": True}, "LOG ENABLE"),
        ("mode", {"axes": 9}, "CONFIG ATT MODE 1"),
        ("mode", {"axes": 6}, "CONFIG ATT MODE 0"),
        ("level", {"level": "automatic"}, "CONFIG ATT RST 3"),
        ("yaw", {"angle_deg": 16}, "CONFIG YAW 1 16"),
        ("yaw", {"angle_deg": 1.5, "relative": True}, "CONFIG YAW 0 1.5"),
        ("mounting", {"turned": "y_down"}, "CONFIG IMU URFR 1,0,0,0,0,1,0,-1,0"),
        ("mounting", {"turned": "x_up"}, "CONFIG IMU URFR 0,0,-1,0,1,0,1,0,0"),
        ("mounting", {"turned": [0, -1, 0, 1, 0, 0.0009, 0, 0, 1]}, "CONFIG IMU URFR 0,-1,0,1,0,0.0009,0,0,1"),
        ("magnetic_calibration", {"enabled": True}, "CONFIG IMU EN_MCAL 1"),
        ("pin", {"function": "sout_div", "pin": 9}, "CONFIG PMUX4 IO9"),
        ("alarm", {"axis": "Y", "min_deg": -5, "max_deg": 5}, "CONFIG PMUX5 Y,-5,5,0,1"),
        ("sout_divider", {"divisor": 4}, "CONFIG PMUX4 DIV4"),
    ],
)
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
HALF_TURN = "a number from -180 to 180"


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("output", {"message": "HI91", "rate_hz": 500}, "expected at most 100 Hz"),  # too much for 115200 baud
        ("output", {"message": "HI91", "rate_hz": 300}, RATES),
        ("output", {"message": "HI93", "rate_hz": 1}, "known: hi91, hi92"),
        ("output_on_mark", {"message": None}, "imud settings bow --set output.MESSAGE=on_mark"),
        ("output_once", {"message": None}, 'one of "HI91", "HI92"'),
        ("mode", {"axes": 7}, 'one of "6-axis", "9-axis"'),
        ("level", {"level": None}, '"automatic", "cancel", "relative"'),
        ("mounting", {"turned": [1.0] * 8}, "or a list of 9, each item a number"),
        ("mounting", {"turned": [1, 0, 0.0011, 0, 1, 0, 0, 0, 1]}, "expected a rotation .* orthonormal within 0.001, "),
        ("magnetic_calibration", {"enabled": 2}, "true or false"),
        ("yaw", {"angle_deg": 180.1}, HALF_TURN),
        ("yaw", {"angle_deg": math.nan}, HALF_TURN),
        ("yaw", {"angle_deg": True}, HALF_TURN),
        ("yaw", {"angle_deg": 5, "relative": None}, "true or false"),
        ("pin", {"function": "sin", "pin": 10}, "a whole number from 1 to 9"),
        ("pin", {"function": "sin", "pin": 0}, "a whole number from 1 to 9"),
        ("pin", {"function": "pps", "pin": 1}, "known: alarm, led, sin, sout, sout_div"),
        ("alarm", {"axis": "X", "min_deg": 5, "max_deg": -5}, "expected the minimum below the maximum"),
        ("alarm", {"axis": "Z", "min_deg": -5, "max_deg": 5}, "known: x, y"),
        ("sout_divider", {"divisor": 0}, "from 1 to 64"),
        ("sout_divider", {"divisor": 65}, "from 1 to 64"),
        ("baud", {"baud": 1200}, "one of 9600, 115200, 230400, 256000, 460800, 921600"),
    ],
)
@pytest.mark.manual("B 2.2.4 YAW range", "B 2.2.4 divider")
def test_bad_arguments_send_nothing(name: str, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(BadArgument, match=message):
        sent(name, [], **arguments)


@pytest.mark.parametrize(("relative", "expected"), [(False, [pytest.approx(math.pi / 6)]), (True, [])])
def test_a_relative_heading_has_no_expected_value(relative: bool, expected: list[float]) -> None:
    """The samples contain the heading 15°; the verb set 45°."""
    verb = DRIVER.verbs["yaw"]
    found = verb.expected(verb.arguments({"angle_deg": 45, "relative": relative}))
    means = RestMeans(None, None, (0, 0, math.pi / 12))
    assert [one.value(means) for one in found] == expected


@pytest.mark.manual("B 2.2.1 REBOOT")
def test_refusal_silence_output_and_restart() -> None:
    with pytest.raises(Rejected, match="ERR 3"):
        sent("save", [Rejection(("ERR 3",))])
    with pytest.raises(NoReply, match="SAVECONFIG: expected OK, got no reply"):
        sent("save", [Silence(())])
    left: list[Outcome] = [OK, OK, *([Silence(())] * 7)]
    with pytest.raises(NoReply, match="expected a reply at 115200 or 921600 baud"):
        sent("baud", left, baud=921600)

    requests, value = sent("restart", [Reply(()), Silence(()), Silence(()), Silence(()), VERSION])
    assert requests[0].silent
    assert getattr(value, "product", "") == "HI14R3"


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


@pytest.mark.parametrize(
    ("lines", "verdict"),
    [
        (("MB=14.14, -2.08, -8.75", "OK"), Verdict(True, "bias 14.14, -2.08, -8.75 µT")),
        (("MB=0.00, 0.00, 0.00", "OK"), Verdict(False, "bias 0, 0, 0 µT")),
        (("MC=1", "OK"), Verdict(False, "the device does not report its bias")),
    ],
)
@pytest.mark.manual("B 8.1.1 result")
def test_verdict_of_the_magnetometer(lines: tuple[str, ...], verdict: Verdict) -> None:
    ask = CALIBRATIONS["magnetometer"].verdict
    assert ask is not None
    (request,), found = asked(ask(TARGET), [Reply(lines)])
    assert (request.payload, found) == (b"LOG MAGCONFIG\r\n", verdict)
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
