"""Reference of yaw from the settings that a device reported."""

import pytest

from imud.attitude.conventions import Heading
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.common import heading_by_mode
from imud.drivers.hipnuc.nmea2000 import HipnucNmea2000Options


@pytest.mark.parametrize(
    ("values", "heading"),
    [({"mode": "6-axis"}, Heading.RELATIVE), ({"mode": "9-axis"}, Heading.MAGNETIC), ({}, Heading.UNKNOWN)],
)
def test_by_mode(values: dict[str, str], heading: Heading) -> None:
    assert heading_by_mode(None, values) is heading


def test_drivers_that_read_it_back_and_that_know_it_beforehand() -> None:
    for name in ("hipnuc-uart", "hipnuc-modbus"):
        assert DRIVERS[name].heading(None, {"mode": "9-axis"}) is Heading.MAGNETIC
    for name in ("imu61x-uart", "imu61x-can", "imu61x-i2c", "imu61x-spi"):
        assert DRIVERS[name].heading(None, {}) is Heading.RELATIVE
    nmea = DRIVERS["hipnuc-nmea2000"].heading
    assert nmea(HipnucNmea2000Options(heading="true"), {}) is Heading.TRUE
    assert nmea(HipnucNmea2000Options(heading="magnetic"), {}) is Heading.MAGNETIC
    assert nmea(HipnucNmea2000Options(), {}) is Heading.UNKNOWN
    assert nmea(None, {}) is Heading.UNKNOWN
    assert DRIVERS["hipnuc-canopen"].heading(None, {}) is Heading.UNKNOWN
