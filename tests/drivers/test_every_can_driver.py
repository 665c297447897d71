"""Every CAN driver, from its row in DRIVERS: the requirements of `imud.testing`, incomplete samples, other nodes."""

from random import Random

import pytest

from imud import drivers as devices
from imud.contracts.driver import CanDriver, of_kind
from imud.testing import driver_tests
from imud.testing.can import makes_incomplete_samples

DRIVERS = {driver.name: driver for driver in of_kind(devices.DRIVERS.values(), CanDriver)}

test_can_drivers = driver_tests(*DRIVERS.values())


@pytest.mark.parametrize("name", list(DRIVERS))
def test_each_identifier_of_an_imu61x_is_a_setting_and_its_vectors_need_two_frames(name: str) -> None:
    """Frames of an IMU61x can be from any device, and an incomplete set of its frames makes no sample."""
    driver = DRIVERS[name]
    frames = driver.example_frames(Random(1))
    (node,) = {driver.node_of(frame.can_id, frame.extended, frame.data) for frame in frames} - {None}
    assert node is not None
    sent = driver.sent_by(driver.node_settings(node + 1))
    found = {any(one.matches(frame.can_id, frame.extended) for one in sent) for frame in frames}
    assert found == {name == "imu61x-can"}
    assert makes_incomplete_samples(driver) == (name != "imu61x-can")
