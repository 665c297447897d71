"""Actions of an IMU61x on a UART, against the simulated device."""

from math import inf, nan
from typing import Any

import pytest

from imud.contracts.action import Target
from imud.devices.imu61x.uart.actions import ACTIONS
from imud.devices.imu61x.uart.session import BaudChange
from imud.errors import BadArgument
from tests.support.simulated_modules import Imu61xBench, imu61x_bench


def act(far: Imu61xBench, name: str, **arguments: Any) -> object:
    """Have the device do it."""
    action = ACTIONS[name]
    return far.run(action.script(Target(None, far.line_baud), action.arguments(arguments)))


def test_stop_and_start() -> None:
    far = imu61x_bench()
    act(far, "stop_streaming")
    assert not far.samples(50)
    assert act(far, "start_streaming") is True
    assert far.samples(50)


def test_parameters_are_set_and_stay() -> None:
    far = imu61x_bench()
    act(far, "rate", rate_hz=200)
    act(far, "filter", accel_filter=3, gyro_filter=5)
    act(far, "i2c_address", address=0x19)
    act(far, "bus", bus="i2c")
    assert act(far, "save") is True
    far.restart()
    settings = far.module.settings
    assert (settings.rate_hz, settings.filter_control, settings.i2c_address) == (200, 0x35, 0x19)


def test_baud_is_followed() -> None:
    far = imu61x_bench()
    assert act(far, "baud", baud=460800) == BaudChange(460800, saved=True)
    assert far.line_baud == far.module.baud == 460800


def test_calibrations_answer_three_numbers() -> None:
    far = imu61x_bench()
    for name in ("calibrate_gyro", "calibrate_installation"):
        answer = act(far, name)
        assert isinstance(answer, tuple)
        assert len(answer) == 3
    act(far, "installation_status")
    act(far, "heading", heading_deg=90)


def test_restart_and_factory_reset_keep_contact() -> None:
    far = imu61x_bench()
    act(far, "baud", baud=921600)
    assert getattr(act(far, "restart"), "product", "") == "IMU61x"
    act(far, "factory_reset")
    assert far.line_baud == far.module.baud == 115200


@pytest.mark.parametrize(
    ("name", "arguments", "named"),
    [
        ("baud", {"baud": 9600}, "one of 115200, 230400, 460800, 921600, 1500000"),
        ("baud", {"baud": True}, "baud"),
        ("rate", {"rate_hz": 0}, "one of 1, 10, 50, 100, 200, 400"),
        ("rate", {"rate_hz": 33}, "rate_hz"),
        ("rate", {"rate_hz": 99}, "rate_hz"),
        ("rate", {"rate_hz": 100.5}, "rate_hz"),
        ("bus", {"bus": 1}, '"spi"'),
        ("bus", {"bus": "can"}, '"spi"'),
        ("i2c_address", {"address": 0x1C}, "address"),
        ("i2c_address", {"address": 0x20}, "one of 24, 25, 26, 27"),
        ("i2c_address", {"address": 0x50}, "address"),
        ("i2c_address", {"address": "0x18"}, "address"),
        ("filter", {"accel_filter": 16, "gyro_filter": 0}, "accel_filter"),
        ("filter", {"accel_filter": 0, "gyro_filter": 16}, "gyro_filter"),
        ("filter", {"accel_filter": -1, "gyro_filter": 0}, "accel_filter"),
        ("filter", {"accel_filter": 0, "gyro_filter": True}, "gyro_filter"),
        ("heading", {"heading_deg": -0.1}, "from 0 to 360"),
        ("heading", {"heading_deg": 360.1}, "from 0 to 360"),
        ("heading", {"heading_deg": 361}, "from 0 to 360"),
        ("heading", {"heading_deg": nan}, "from 0 to 360"),
        ("heading", {"heading_deg": inf}, "from 0 to 360"),
        ("heading", {"heading_deg": True}, "from 0 to 360"),
        ("heading", {"heading_deg": "90"}, "from 0 to 360"),
    ],
)
def test_what_the_device_would_not_take_is_refused(name: str, arguments: dict[str, Any], named: str) -> None:
    far = imu61x_bench()
    with pytest.raises(BadArgument, match=named):
        act(far, name, **arguments)
    assert not far.asked
