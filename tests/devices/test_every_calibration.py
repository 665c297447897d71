"""Every calibration of every driver: complete, and put together so that the guide can run it."""

import msgspec
import pytest

from imud.contracts.control.calibration import Calibration, CalibrationInfo, Handling, Kept, infos
from imud.devices import DRIVERS

EVERY = [
    pytest.param(driver.name, kind, one, id=f"{driver.name} {kind}")
    for driver in DRIVERS.values()
    for kind, one in driver.calibrations.items()
]


def test_there_are_some() -> None:
    assert {name for name, driver in DRIVERS.items() if driver.calibrations} == {
        "hipnuc-uart", "hipnuc-modbus", "hipnuc-canopen", "hipnuc-j1939", "imu61x-uart",
    }  # fmt: skip


@pytest.mark.parametrize(("_driver", "kind", "calibration"), EVERY)
def test_complete(_driver: str, kind: str, calibration: Calibration) -> None:
    assert kind.isidentifier()
    assert calibration.help[0].islower()
    assert not calibration.help.endswith(".")
    assert calibration.section
    assert calibration.instructions
    assert all(sentence.endswith(".") for sentence in calibration.instructions)
    assert (calibration.save is not None) == (calibration.kept is Kept.BY_SAVE)
    if calibration.handling is Handling.TURN:
        assert calibration.verdict is not None
        assert not calibration.expected
    assert all(expectation.limit > 0 for expectation in calibration.expected)


@pytest.mark.parametrize("driver", [d.name for d in DRIVERS.values()])
def test_described_for_clients(driver: str) -> None:
    described = infos(DRIVERS[driver].calibrations)
    assert msgspec.json.decode(msgspec.json.encode(described), type=list[CalibrationInfo]) == described
