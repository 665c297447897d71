"""Every polled driver, from its row in DRIVERS: the requirements of `imud.testing`, intervals, addresses."""

import msgspec
import pytest

from imud import drivers as devices
from imud.contracts.driver import PolledDriver, of_kind
from imud.links import LINKS
from imud.testing import driver_tests
from imud.testing.polled import make

DRIVERS = {driver.name: driver for driver in of_kind(devices.DRIVERS.values(), PolledDriver)}

test_polled_drivers = driver_tests(*DRIVERS.values())


@pytest.mark.parametrize("name", list(DRIVERS))
@pytest.mark.manual("A 3.1 address")
def test_intervals_of_the_row_and_an_address_outside_the_targets(name: str) -> None:
    driver = DRIVERS[name]
    intervals_s = {"imu61x-i2c": [0, 10, 10], "imu61x-spi": [0, 10, 1], "hipnuc-modbus": [0, 10, 1, 10]}[name]
    assert [poll.every_ns for poll in make(driver).polls] == [interval_s * 10**9 for interval_s in intervals_s]
    assert driver.update_ns(driver.settings()) == 0  # not known
    assert driver.update_ns(msgspec.convert({"update_hz": 200}, driver.settings)) == 5_000_000
    assert msgspec.structs.fields(driver.settings)
    addresses = (driver.targets[0], driver.targets[-1], "auto", 0x77)
    links = [object(), *(type("Link", (), {"address": address})() for address in addresses)]
    expected = [0, 0, 0, 0, int(name.startswith("imu61x"))]  # 0x77 is a valid address of Modbus
    found = [list(driver.problems(driver.settings(), link)) for link in links]
    assert [len(problems) for problems in found] == expected
    assert all("got 0x77" in problem.message for problem in found[-1])


READ_NS: list[tuple[str, object, object, int]] = [
    # 16 words of 16 bits at 1 µs: the burst command, two cycles of the pipeline and 13 values
    ("imu61x-spi", {}, {"port": "x", "speed_hz": 1_000_000}, 256_000),
    ("imu61x-spi", {}, {"port": "x", "speed_hz": 2_000_000}, 128_000),
    # 35 bytes of 9 bits at 400 kHz (two addresses, the register, 32 bytes of data), start, repeated start and stop
    ("imu61x-i2c", {}, {}, (35 * 9 + 3) * 2_500),
]


def test_the_time_of_a_read_on_the_bus() -> None:
    for name, options, link, expected_ns in READ_NS:
        driver = DRIVERS[name]
        made = msgspec.convert(options, driver.settings), msgspec.convert(link, LINKS[driver.link].settings)
        assert driver.read_ns(*made) == expected_ns
