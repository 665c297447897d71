"""The source of RMC sentences in the configuration: what is read, and every refusal with its place."""

import pytest

from imud import config
from imud.errors import ConfigError
from imud.utc import RMC_SOURCES
from imud.utc.source import RmcSettings


def device(rmc: str, keys: str = "driver: hipnuc-uart, uart: {port: x}") -> str:
    return f"devices:\n  bow: {{{keys}, rmc: {rmc}}}\n"


def read(text: str) -> RmcSettings | None:
    return config.parse(text, "f").devices[0].rmc


def errors(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        config.parse(text, "f")
    return str(caught.value)


def test_each_source() -> None:
    assert read(device("{source: gpsd}")) == RmcSettings(source="gpsd")
    assert read(device("{source: system, rate_hz: 5, error_ms: 10}")) == RmcSettings(
        source="system", rate_hz=5, error_ms=10.0
    )
    nmea = RmcSettings(source="nmea", port="/dev/ttyUSB1", baud=38400)
    assert read(device("{source: nmea, port: /dev/ttyUSB1, baud: 38400}")) == nmea
    assert read("devices:\n  bow: {driver: hipnuc-uart, uart: {port: x}}\n") is None


@pytest.mark.parametrize(
    ("rmc", "said"),
    [
        ("{}", "expected the key source"),
        ("{source: ntp}", 'expected one of "gpsd", "nmea", "system"'),
        ("{source: nmea}", "needs the path of its serial port"),
        ("{source: gpsd, rate_hz: 11}", "f:2:"),
        ("{source: gpsd, rate_hz: 0}", "rate_hz"),
        ("{source: gpsd, tcp_port: 0}", "tcp_port"),
        ("{source: gpsd, error_ms: .nan}", "error_ms"),
        ("{source: gpsd, speed: 1}", "speed"),
    ],
)
def test_what_is_wrong_is_said(rmc: str, said: str) -> None:
    assert said in errors(device(rmc))


@pytest.mark.parametrize(
    "keys",
    [
        "driver: imu61x-uart, uart: {port: x}",
        "driver: hipnuc-uart, replay: {path: x}",
        "uart: {port: x}",
    ],
)
def test_devices_that_take_no_sentences(keys: str) -> None:
    assert "expected rmc only beside" in errors(device("{source: gpsd}", keys))


def test_a_device_that_imud_triggers_has_no_pulse_per_second() -> None:
    text = """devices:
  bow:
    driver: hipnuc-uart
    uart: {port: x}
    lines:
      sin: {line: GPIO17}
    rmc: {source: gpsd}
"""
    said = errors(text)
    assert "f:7:" in said
    assert "by lines.sin (line 6): leave one of them out" in said
    assert read(text.replace("sin:", "pps:")) == RmcSettings(source="gpsd")


def test_every_source_has_its_row() -> None:
    assert set(RMC_SOURCES) == set(RmcSettings.__annotations__["source"].__args__)
    for name in RMC_SOURCES:
        assert callable(RMC_SOURCES[name])
