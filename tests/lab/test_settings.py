"""Declared settings of devices on CAN, applied by a device of the daemon on the kernel's virtual bus.

The test runs with every kind of simulated device. It writes each setting, reads it back and saves it. Then the device
restarts, and imud continues at its new node number.
"""

from collections.abc import Mapping
from time import monotonic_ns

import pytest

from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from imud.sim.hipnuc.canopen import NODE_VARIANTS, HipnucCanopenHardware, HipnucCanopenModule, NodeSettings
from imud.sim.hipnuc.j1939 import J1939_VARIANTS, HipnucJ1939Module, J1939Hardware, J1939Settings
from tests.lab.can_device import BusRig
from tests.lab.can_interface import CanInterface
from tests.lab.short_form import cases


async def made_so(rig: BusRig, wanted: Mapping[str, object], *, verified: bool) -> None:
    applied = await rig.done(rig.device.settings_apply(wanted, save=True))
    assert applied.problem == "", applied
    assert {step.name for step in applied.steps} == set(wanted)
    outcomes = {str(step.outcome) for step in applied.steps}
    assert ("not verified" in " ".join(outcomes)) is not verified, applied
    assert applied.saved
    count = len(rig.samples)
    await rig.until(lambda: len(rig.samples) > count + 5, "samples afterwards")
    messages = " ".join(event.message for event in rig.events)
    assert "in the configuration" in messages  # the message names the node number to change in the configuration


@pytest.mark.timeout(300)
@pytest.mark.parametrize("variant", cases(NODE_VARIANTS, "manual"))
async def test_a_canopen_node_is_made_as_declared(vcan: CanInterface, variant: str) -> None:
    now_ns, kind = monotonic_ns(), NODE_VARIANTS[variant]
    slow = NodeSettings(bit_rate=0, periods_ms={1: 100, 2: 100, 3: 100, 4: 100, 6: 0, 7: 0})
    rare = NodeSettings(node=12, bit_rate=0, periods_ms={1: 500, 2: 0, 3: 0, 4: 0, 6: 0, 7: 0})
    module = HipnucCanopenModule(now_ns, HipnucCanopenHardware(factory=slow, boot_ms=200, variant=kind))
    beside = HipnucCanopenModule(now_ns, HipnucCanopenHardware(factory=rare, boot_ms=0))
    rig = BusRig(vcan.name, "hipnuc-canopen", HipnucCanopenOptions(), module, beside)
    async with rig.played():
        taken = await rig.done(rig.device.settings_apply({"node": 12}, save=True))
        assert "node 12 is in use" in taken.problem
        assert module.objects.writes_to_flash == 0
        wanted = {"tpdo2_interval_ms": 200, "incli_x_reversed": True, "node": 9}
        await made_so(rig, wanted, verified=kind.reads == "answered")
    saved = module.objects.saved
    assert (saved.periods_ms[2], saved.invert_x, saved.node, module.node) == (200, 1, 9, 9)
    assert module.objects.writes_to_flash == 1
    assert beside.objects.settings == rare


@pytest.mark.timeout(300)
@pytest.mark.parametrize("variant", cases(J1939_VARIANTS, "real"))
async def test_a_j1939_module_is_made_as_declared(vcan: CanInterface, variant: str) -> None:
    now_ns, kind = monotonic_ns(), J1939_VARIANTS[variant]
    module = HipnucJ1939Module(now_ns, J1939Settings(), J1939Hardware(bitrate=0, boot_ms=200, variant=kind))
    beside = HipnucJ1939Module(now_ns, J1939Settings(address=12), J1939Hardware(bitrate=0, boot_ms=0))
    rig = BusRig(vcan.name, "hipnuc-j1939", HipnucJ1939Options(), module, beside)
    async with rig.played():
        taken = await rig.done(rig.device.settings_apply({"address": 12}, save=True))
        assert "address 12 is in use" in taken.problem
        assert module.writes_to_flash == 0
        wanted = {"ff37_interval_ms": 50, "y_reversed": True, "address": 9}
        await made_so(rig, wanted, verified=kind.reads != "ignored")
    saved = module.flash
    assert (saved.intervals_ms[0xFF37], saved.y_reversed, saved.address) == (50, 1, 9)
    assert module.writes_to_flash == 1
    assert beside.settings == J1939Settings(address=12)
