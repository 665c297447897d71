"""HiPNUC commands: bytes as printed in the manual, and arguments that imud rejects before it sends them."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from imud.contracts.script import Rejection, Reply, Request, RequestScript
from imud.drivers.hipnuc.common import AttitudeMode, LevelReset
from imud.drivers.hipnuc.uart import commands as c
from imud.model.errors import BadArgument
from imud.model.ledger import Ledger
from tests.support.script_runners import offline_runner, unanswered_ms

H91, H92 = c.OutputMessage.HI91, c.OutputMessage.HI92

PRINTED = [
    (c.reboot(), "REBOOT"), (c.save_config(), "SAVECONFIG"), (c.factory_reset(), "FRESET"),
    (c.unlog_all(), "UNLOGALL"), (c.serial_config(115200), "SERIALCONFIG 115200"),
    (c.attitude_mode(AttitudeMode.SIX_AXIS), "CONFIG ATT MODE 0"),
    (c.attitude_mode(AttitudeMode.NINE_AXIS), "CONFIG ATT MODE 1"),
    (c.level_reset(LevelReset.RELATIVE), "CONFIG ATT RST 2"),
    (c.level_reset(LevelReset.AUTOMATIC), "CONFIG ATT RST 3"), (c.level_reset(LevelReset.CANCEL), "CONFIG ATT RST 5"),
    (c.yaw(c.YawMode.ABSOLUTE, 16), "CONFIG YAW 1 16"), (c.yaw(c.YawMode.RELATIVE, 1.5), "CONFIG YAW 0 1.5"),
    (c.yaw(c.YawMode.ABSOLUTE, -0.0), "CONFIG YAW 1 0"), (c.yaw(c.YawMode.RELATIVE, 1e-5), "CONFIG YAW 0 0.00001"),
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
        assert runner.on_message(end, 7) == outcome((*part, end))
        assert ledger.replies_unsolicited == 2


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
    (lambda: c.require_room({H91: 10}, 4800), "one of 9600"),
]


@pytest.mark.parametrize(("make", "message"), REFUSED)
def test_invalid_arguments_are_rejected_with_the_expected_values(make: Callable[[], object], message: str) -> None:
    with pytest.raises(BadArgument, match=message) as caught:
        make()
    assert "expected" in str(caught.value)


@pytest.mark.manual("B 3.7 rates by baud rate", "B 2.2.1 REBOOT")
def test_table_3_7_and_the_silent_command() -> None:
    for baud, message, frame_bytes in [(baud, *one) for baud in c.BAUD_RATES for one in ((H91, 82), (H92, 54))]:
        rate = c.max_rate_hz(message, baud)
        assert rate in c.RATES_HZ
        assert rate * frame_bytes * 10 <= baud
    assert (c.max_rate_hz(H91, 115200), c.max_rate_hz(H92, 115200)) == (100, 200)
    assert [text for request, text in PRINTED if request.silent] == ["REBOOT"]
