"""What an IMU61x can be told by name, against the simulated device."""

from typing import Any

import pytest

from imud.contracts.action import Target
from imud.devices.imu61x.uart.actions import ACTIONS
from imud.devices.imu61x.uart.session import BaudChange
from imud.errors import BadArgument
from tests.support.imu61x_bench import Bench, bench


def tell(far: Bench, name: str, **arguments: Any) -> object:
    """Have the device do it."""
    action = ACTIONS[name]
    return far.hold(action.script(Target(None, far.line_baud), action.arguments(arguments)))


def test_stop_and_start() -> None:
    far = bench()
    tell(far, "stop_streaming")
    assert not far.samples(50)
    assert tell(far, "start_streaming") is True
    assert far.samples(50)


def test_parameters_are_set_and_stay() -> None:
    far = bench()
    tell(far, "rate", rate_hz=200)
    tell(far, "filter", accel_filter=3, gyro_filter=5)
    tell(far, "i2c_address", address=0x19)
    tell(far, "bus", bus="i2c")
    assert tell(far, "save") is True
    far.restart()
    settings = far.module.settings
    assert (settings.rate_hz, settings.filter_control, settings.i2c_address) == (200, 0x35, 0x19)


def test_baud_is_followed() -> None:
    far = bench()
    assert tell(far, "baud", baud=460800) == BaudChange(460800, saved=True)
    assert far.line_baud == far.module.baud == 460800


def test_calibrations_answer_three_numbers() -> None:
    far = bench()
    for name in ("calibrate_gyro", "calibrate_installation"):
        answer = tell(far, name)
        assert isinstance(answer, tuple)
        assert len(answer) == 3
    tell(far, "installation_status")
    tell(far, "heading", heading_deg=90)


def test_restart_and_factory_reset_keep_contact() -> None:
    far = bench()
    tell(far, "baud", baud=921600)
    assert getattr(tell(far, "restart"), "product", "") == "IMU61x"
    tell(far, "factory_reset")
    assert far.line_baud == far.module.baud == 115200


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("rate", {"rate_hz": 33}),
        ("filter", {"accel_filter": 16, "gyro_filter": 0}),
        ("i2c_address", {"address": 0x50}),
        ("bus", {"bus": "can"}),
        ("baud", {"baud": 9600}),
        ("heading", {"heading_deg": 361}),
    ],
)
def test_bad_arguments(name: str, arguments: dict[str, Any]) -> None:
    far = bench()
    with pytest.raises(BadArgument):
        tell(far, name, **arguments)
    assert not far.asked
