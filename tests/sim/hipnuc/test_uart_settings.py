"""Commands that change settings: examples of the manual, encoders of the host, and refused commands."""

from dataclasses import replace

import pytest

from imud.drivers.hipnuc.uart import commands
from imud.drivers.hipnuc.uart.commands import BAUD_RATES, RATES_HZ, Mounting, OutputMessage
from imud.sim.hipnuc.uart_settings import AlarmSetting, CommandRefused, ModuleSettings, Output, changed

FACTORY = ModuleSettings()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("SERIALCONFIG 115200", FACTORY),
        ("SERIALCONFIG 9600", replace(FACTORY, baud=9600)),
        ("CONFIG ATT MODE 1", replace(FACTORY, att_mode=1)),
        ("CONFIG IMU URFR 1,0,0,0,0,1,0,-1,0", replace(FACTORY, urfr=(1, 0, 0, 0, 0, 1, 0, -1, 0))),
        ("CONFIG IMU EN_MCAL 0", replace(FACTORY, mag_calibration=False)),
        ("CONFIG PMUX3 IO2", replace(FACTORY, pins=(1, 2, 2, 6, 9))),
        ("CONFIG PMUX4 IO9", replace(FACTORY, pins=(1, 2, 5, 9, 9))),
        ("CONFIG PMUX4 DIV4", replace(FACTORY, sout_div=4)),
        ("CONFIG PMUX5 Y,-5,5,0,1", replace(FACTORY, alarm_y=AlarmSetting(-5, 5, True))),
        ("CONFIG PMUX5 X,-7.5,2,0,0", replace(FACTORY, alarm_x=AlarmSetting(-7.5, 2, False))),
        ("LOG IMU91 ONTIME 0.01", FACTORY),
        ("LOG HI91 ONTIME 0.002", replace(FACTORY, hi91=Output(2))),
        ("LOG HI92 ONTIME 0.05", replace(FACTORY, hi92=Output(50))),
        ("LOG IMU91 ONTIME 0", replace(FACTORY, hi91=Output())),
        ("LOG IMU91 ONMARK 1", replace(FACTORY, hi91=Output(on_mark=True))),
        ("UNLOGALL", replace(FACTORY, hi91=Output())),
    ],
)
@pytest.mark.manual("B 2.2.5 names")
def test_examples_of_the_manual(line: str, expected: ModuleSettings) -> None:
    assert changed(FACTORY, line, 156) == expected


@pytest.mark.parametrize("mounting", Mounting)
@pytest.mark.manual("B 2.2.4 URFR presets")
def test_every_mounting_of_the_host_is_understood(mounting: Mounting) -> None:
    settings = changed(FACTORY, commands.mounting(mounting).name, 156)
    assert settings
    assert settings.urfr == tuple(float(value) for row in mounting.value for value in row)


@pytest.mark.manual("B 2.2.4 pins by firmware", "B 1.2.2 timed output off")
def test_rates_pins_unlogall_and_reports() -> None:
    for message in OutputMessage:
        for rate_hz in (0, *RATES_HZ):
            settings = changed(FACTORY, commands.log_ontime(message, rate_hz).name, 156)
            assert settings
            output = settings.hi92 if message is OutputMessage.HI92 else settings.hi91
            assert output.period_ms == (1000 // rate_hz if rate_hz else 0)
    for baud in BAUD_RATES:
        settings = changed(FACTORY, commands.serial_config(baud).name, 156)
        assert settings
        assert settings.baud == baud

    assert changed(FACTORY, "CONFIG PMUX3 IO2", 154) is None
    assert changed(FACTORY, "CONFIG PMUX3 IO2", 155) is not None

    settings = replace(FACTORY, hi92=Output(on_mark=True))
    assert changed(settings, "UNLOGALL", 156) == replace(settings, hi91=Output())

    settings = replace(FACTORY, hi92=Output(on_mark=True))
    assert settings.port_lines() == ["BAUD: 115200", "LOG HI91 ONTIME 0.01", "LOG HI92 ONMARK 1"]
    lines = settings.user_lines()
    assert lines[:3] == ["ATT_MODE: 0", "URFR: 1,0,0,0,1,0,0,0,1", "EN_MCAL: 1"]
    assert "ALARM_Y: -5,5,0,0" in lines


@pytest.mark.parametrize(
    "line",
    [
        "SERIALCONFIG 57600", "SERIALCONFIG fast", "SERIALCONFIG 115200.0", "CONFIG ATT MODE 2",
        "CONFIG IMU URFR 1,0,0,0,1,0,0,0,-1", "CONFIG IMU URFR 1,0,0,0,1,0,0,0", "CONFIG IMU URFR 1,0,0,0,1,0,0,0,nan",
        "CONFIG IMU URFR 1,0,0,1,0,0,0,0,1", "CONFIG IMU EN_MCAL 2", "CONFIG PMUX1 IO0", "CONFIG PMUX4 DIV0",
        "CONFIG PMUX4 DIV65", "CONFIG PMUX5 X,5,-5,0,1", "CONFIG PMUX5 X,-5,5,1,1", "CONFIG PMUX5 X,-5,5,0,2",
        "CONFIG PMUX5 X,-5,inf,0,1", "LOG HI91 ONTIME 2", "LOG HI91 ONTIME -0.01", "LOG HI91 ONTIME 0.0005",
        "LOG HI91 ONMARK 2", "CONFIG PMUX3 IO10",
    ],
)  # fmt: skip
def test_bad_values_are_refused(line: str) -> None:
    with pytest.raises(CommandRefused):
        changed(FACTORY, line, 156)


@pytest.mark.parametrize("line", ["LOG HI91 ONMARK ONCE", "LOG VERSION", "CONFIG PMUX6 IO1", "CONFIG PMUX5 Z,0,1,0,1"])
def test_other_commands_are_not_for_it(line: str) -> None:
    assert changed(FACTORY, line, 156) is None
