"""Requests of the calibrations of a HiPNUC device, and the meaning of its replies."""

import pytest

from imud.contracts.command import Calibration, Kept, Target, Verdict
from imud.contracts.script import Outcome, Rejection, Reply, Request, RequestScript, Silence
from imud.drivers.hipnuc.uart.driver import CALIBRATIONS
from imud.model.errors import NoReply, Rejected
from tests.support.simulated_modules import run_script

TARGET = Target(None, 115200)
OK = Reply(("OK",))


def sent(script: RequestScript[object], *answers: Outcome) -> tuple[list[str], object]:
    left = list(answers)
    commands: list[str] = []

    def answer(request: Request) -> Outcome:
        commands.append(request.payload.decode("ascii").rstrip())
        return left.pop(0)

    value = run_script(script, answer)
    assert not left
    return commands, value


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
def test_commands(kind: str, begun: list[str], saved: list[str]) -> None:
    calibration = CALIBRATIONS[kind]
    assert sent(calibration.begin(TARGET), *[OK] * len(begun))[0] == begun
    assert (calibration.kept is Kept.BY_SAVE) == bool(saved)
    if calibration.save is not None:
        assert sent(calibration.save(TARGET), *[OK] * len(saved))[0] == saved


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
    assert sent(ask(TARGET), Reply(lines)) == (["LOG MAGCONFIG"], verdict)


def test_no_magnetometer() -> None:
    ask = CALIBRATIONS["magnetometer"].verdict
    assert ask is not None
    with pytest.raises(NoReply, match="does the device have a magnetometer"):
        sent(ask(TARGET), Silence(()))
    with pytest.raises(Rejected, match="LOG MAGCONFIG: the device rejected the request: ERR"):
        sent(ask(TARGET), Rejection(("ERR",)))


@pytest.mark.parametrize(("mode", "ready"), [("0", False), ("1", True)])
@pytest.mark.parametrize("kind", ["magnetometer", "magnetometer_once"])
@pytest.mark.manual("B 1.1 9-axis mode")
def test_nine_axes_are_needed(kind: str, mode: str, ready: bool) -> None:
    calibration: Calibration = CALIBRATIONS[kind]
    assert calibration.unready is not None
    words = sent(calibration.unready(TARGET), Reply((f"ATT_MODE: {mode}", "OK")))[1]
    assert (words == "") == ready
