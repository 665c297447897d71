"""Tests for every driver and simulator, of imud and of other packages (docs/drivers.md).

    from imud.testing import driver_tests

    test_driver = driver_tests(DRIVER)

The tests need pytest and Hypothesis. The daemon never imports this package.
"""

from collections.abc import Callable, Sequence
from random import Random
from typing import Any, Final

from imud.contracts.driver import CanDriver, Driver, PolledDriver, StreamDriver
from imud.testing import can, polled, rows, stream

Requirement = Callable[[Any, Random, bytes], None]
"""Function that raises AssertionError if a row does not fulfil a requirement. It receives the row, a source of random
numbers, and random bytes."""
DATA_BYTES_MAX: Final = 600  # maximum number of random bytes
REQUIREMENTS: Final[Sequence[tuple[type[Driver], Sequence[Requirement]]]] = (
    (Driver, rows.DRIVER_REQUIREMENTS),
    (StreamDriver, stream.REQUIREMENTS),
    (CanDriver, can.REQUIREMENTS),
    (PolledDriver, polled.REQUIREMENTS),
)


def driver_tests(*drivers: Driver) -> Callable[..., None]:
    """Return a pytest function that checks all requirements for these drivers with random input."""
    import pytest
    from hypothesis import HealthCheck, given, settings
    from hypothesis import strategies as st

    @pytest.mark.parametrize(
        ("driver", "requirement"),
        [
            pytest.param(driver, requirement, id=f"{driver.name} {requirement.__name__}")
            for driver in drivers
            for kind, found in REQUIREMENTS
            if isinstance(driver, kind)
            for requirement in found
        ],
    )
    @settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # a loaded host is slow
    @given(seed=st.integers(0, 2**32), data=st.binary(max_size=DATA_BYTES_MAX))
    def test(driver: Driver, requirement: Requirement, seed: int, data: bytes) -> None:
        requirement(driver, Random(seed), data)

    made: Callable[..., None] = test
    return made


def simulator_tests(*simulators: rows.AnySimulator) -> Callable[..., None]:
    """Return a pytest function that checks all requirements for these simulators."""
    import pytest

    @pytest.mark.parametrize("requirement", rows.SIMULATOR_REQUIREMENTS, ids=lambda one: one.__name__)
    @pytest.mark.parametrize("simulator", simulators, ids=lambda one: one.name)
    def test(simulator: rows.AnySimulator, requirement: Callable[[rows.AnySimulator], None]) -> None:
        requirement(simulator)

    return test
