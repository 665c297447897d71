"""Guided calibrations of inclinometers on CAN, by a device of the daemon on the kernel's virtual bus."""

from collections.abc import Callable
from time import monotonic_ns

import pytest

from imud.contracts.command import CalibrationResult
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from imud.model.errors import CommandError
from imud.model.event import EventKind
from imud.sim.hipnuc.canopen import HipnucCanopenHardware, HipnucCanopenModule, NodeSettings
from imud.sim.hipnuc.j1939 import HipnucJ1939Module, J1939Hardware, J1939Settings
from imud.sim.physics import Motion, Still, swing
from tests.lab.can_device import BusRig
from tests.lab.can_interface import CanInterface

TILTED = Still(0.2, -0.1, 0.5)
SLOW = NodeSettings(bit_rate=0, periods_ms={1: 50, 2: 50, 3: 50, 4: 0, 6: 0, 7: 50})


def canopen(interface: str, motion: Motion) -> BusRig:
    hardware = HipnucCanopenHardware(factory=SLOW, boot_ms=0, motion=motion)
    return BusRig(interface, "hipnuc-canopen", HipnucCanopenOptions(), HipnucCanopenModule(monotonic_ns(), hardware))


def j1939(interface: str, motion: Motion) -> BusRig:
    hardware = J1939Hardware(bitrate=0, boot_ms=0, motion=motion)
    settings = J1939Settings(intervals_ms={**J1939Settings().intervals_ms, 0xFF4A: 100})
    module = HipnucJ1939Module(monotonic_ns(), settings, hardware)
    return BusRig(interface, "hipnuc-j1939", HipnucJ1939Options(), module)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("make", [canopen, j1939])
async def test_the_zero_of_an_inclinometer(vcan: CanInterface, make: Callable[[str, Motion], BusRig]) -> None:
    rig = make(vcan.name, TILTED)
    async with rig.played():
        await rig.until(lambda: any(sample.incli_rad is not None for sample in rig.samples), "inclinations")
        before = next(sample.incli_rad for sample in reversed(rig.samples) if sample.incli_rad is not None)
        assert max(map(abs, before)) > 0.05
        result: CalibrationResult = await rig.done(rig.device.calibrate("zero", save=True))
        assert result.verified, result
        assert result.saved
        assert [check.name for check in result.checks] == ["inclination"]
    assert any(event.kind is EventKind.CALIBRATION for event in rig.events)


@pytest.mark.thorough
@pytest.mark.timeout(300)
async def test_a_node_that_moves_gets_no_zero(vcan: CanInterface) -> None:
    rig = canopen(vcan.name, swing())
    async with rig.played():
        with pytest.raises(CommandError, match="expected the device at rest"):
            await rig.done(rig.device.calibrate("zero", save=True))
