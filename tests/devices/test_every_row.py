"""Every driver by its row in DRIVERS alone: the row is complete, and its examples follow from the seed."""

from collections.abc import Callable
from random import Random

import pytest

from imud.contracts.can import CanDriver
from imud.contracts.driver import Driver, StreamDriver
from imud.contracts.polling import PolledDriver
from imud.devices import DRIVERS

every_driver = pytest.mark.parametrize("name", DRIVERS)


def example_of(driver: Driver) -> Callable[[Random], object]:
    """The maker of examples, whatever they are: a frame, the frames of a sample, or the bytes of a poll."""
    if isinstance(driver, StreamDriver):
        return driver.example_frame
    if isinstance(driver, CanDriver):
        return driver.example_frames
    assert isinstance(driver, PolledDriver)
    return driver.example_reading


@every_driver
def test_rows_are_complete(name: str) -> None:
    driver = DRIVERS[name]
    assert driver.name == name
    assert driver.title
    assert driver.navigation_frame
    assert driver.euler_convention
    assert driver.tick_ns >= 0
    assert driver.tick_modulus > 1
    example = example_of(DRIVERS[name])
    assert example(Random(5)) == example(Random(5)) != example(Random(6))
