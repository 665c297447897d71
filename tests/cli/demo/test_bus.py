"""`imud demo` of devices that only hardware can be; with a bus it runs in the lab."""

import pytest

from imud.cli import main


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--device", "imu61x-i2c"], "imu61x-i2c is not simulated: say where a real one is, for example --bus 1"),
        (
            ["--device", "imu61x-spi", "--bus", "1"],
            "imu61x-spi is not simulated: say where a real one is, for example --port /dev/spidev0.0",
        ),
        (["--device", "imu61x-i2c", "--device", "imu61x-uart"], "expected imu61x-i2c alone, got 2 devices"),
    ],
)
def test_a_bus_must_be_named(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", *words]) == 2
    assert capsys.readouterr().err == f"imud demo: {said}\n"
