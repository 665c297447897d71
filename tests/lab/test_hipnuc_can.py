"""The J1939 driver and its simulator with the J1939 sockets of the kernel, in both directions, on a virtual bus.

Declared settings and guided calibrations of devices on CAN: imud writes each setting, reads it back and saves it. Then
the device restarts, and imud continues at its new node number.
"""

import asyncio
import math
import socket
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from itertools import pairwise
from time import monotonic, monotonic_ns

import pytest

from imud.contracts.command import CalibrationResult, VerbResult
from imud.contracts.setting import StepOutcome
from imud.contracts.status import DeviceState
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.j1939 import codec, commands
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from imud.drivers.hipnuc.nmea2000 import HipnucNmea2000Options
from imud.model.errors import NoReply
from imud.model.event import EventKind
from imud.model.sample import Sample
from imud.sim.hipnuc.canopen import NODE_VARIANTS, HipnucCanopenHardware, HipnucCanopenModule, NodeSettings
from imud.sim.hipnuc.j1939 import (
    J1939_VARIANTS,
    PLACE,
    HipnucJ1939Module,
    J1939Hardware,
    J1939Settings,
    make_canfd,
)
from imud.sim.hipnuc.nmea2000 import HipnucNmea2000Module, Nmea2000Hardware
from imud.sim.physics import Still
from imud.sim.ports.can_port import CanPort
from imud.sim.sensor import SimulatorOptions
from tests.lab.can_device import BusRig
from tests.lab.can_interface import CanInterface
from tests.lab.short_form import cases
from tests.lab.tool import tool

LIMIT_S = 30.0
LEVEL = 100 + socket.CAN_J1939
"""SOL_CAN_J1939 of linux/can/j1939.h."""
ALL = socket.J1939_NO_ADDR
RAD_PER_COUNT = math.pi / 180_000  # 0.001 degree per count


@contextmanager
def node(interface: str, address: int) -> Iterator[socket.socket]:
    """Create a node with this address. The kernel runs the node."""
    with socket.socket(socket.AF_CAN, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK, socket.CAN_J1939) as end:
        end.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        end.setsockopt(LEVEL, socket.SO_J1939_SEND_PRIO, 3)
        end.bind((interface, socket.J1939_NO_NAME, socket.J1939_NO_PGN, address))
        yield end


def say(end: socket.socket, interface: str, pgn: int, data: bytes, address: int = ALL) -> None:
    end.sendto(data, (interface, socket.J1939_NO_NAME, pgn, address))


def burst(end: socket.socket, interface: str, number: int) -> None:
    say(end, interface, codec.ACCEL, codec.pack_accel((0.0, 0.0, 9.8)))
    say(end, interface, codec.GYRO, codec.pack_gyro((0.1, 0.2, 0.3)))
    say(end, interface, codec.ROLL_PITCH, codec.TWO_ANGLES.pack(number, 0))
    say(end, interface, codec.HEADING, codec.pack_heading(1.0))


def rolls(samples: list[Sample]) -> list[int]:
    return [round(s.euler_rad[0] / RAD_PER_COUNT) for s in samples if s.euler_rad is not None]


async def test_a_node_of_the_kernel_under_our_driver(vcan: CanInterface) -> None:
    """The node sends samples and replies to requests. Samples of another node are on the same bus."""
    rig = BusRig(vcan.name, "hipnuc-j1939", HipnucJ1939Options())
    requests: list[tuple[int, bytes]] = []
    intervals = {0x0137: 100, commands.ADDRESS: 8}

    def answer(end: socket.socket) -> None:
        data, (_, _, pgn, source) = end.recvfrom(64)
        if pgn != codec.CONFIGURE:
            return
        requests.append((source, data))
        register, command, _, value = commands.LAYOUT.unpack(data)
        if register in intervals:  # the node has no other register
            intervals[register] = value if command == commands.WRITE else intervals[register]
            reply = commands.LAYOUT.pack(register, command, 0, intervals[register])
            say(end, vcan.name, codec.CONFIGURE, reply, 0x55)

    async with rig.played():
        loop = asyncio.get_running_loop()
        with node(vcan.name, 8) as end, node(vcan.name, 9) as other:
            loop.add_reader(end, answer, end)
            try:
                for number in range(40):
                    burst(end, vcan.name, number)
                    burst(other, vcan.name, 1000 + number)
                    await asyncio.sleep(0.05)
                await rig.until(lambda: rolls(rig.samples)[-1:] == [39], "the last sample")
                await rig.until(lambda: rig.device.state is DeviceState.RUNNING, "running")
                applied = await rig.device.settings.apply({"ff37_interval_ms": 50}, save=False)
                assert applied.problem == ""
                assert intervals[0x0137] == 50
                with pytest.raises(NoReply):
                    await rig.device.act("zero", {"zero": "here"})
            finally:
                loop.remove_reader(end)
    found = rolls(rig.samples)
    assert found == list(range(40 - len(found), 40))
    assert len(found) >= 30
    assert rig.device.ledger.lost() == 0
    sample = rig.samples[-1]
    assert sample.accel_m_s2 == pytest.approx((0, 0, 9.8), abs=0.0024)
    assert sample.gyro_rad_s == pytest.approx((0.1, 0.2, 0.3), abs=0.00054)
    assert sample.euler_rad is not None
    assert sample.euler_rad[2] == pytest.approx(1.0, abs=9e-6)
    assert {source for source, _ in requests} == {0x55}
    assert bytes.fromhex("3701060032000000") in [data for _, data in requests]


def test_our_simulator_heard_and_set_by_a_node_of_the_kernel(vcan: CanInterface) -> None:
    """The node does not claim its address. Linux 6.12 keeps a reference to the interface for each claim that a J1939
    socket received. The kernel could then never delete the interface ("waiting for vcan0 to become free")."""
    hardware = J1939Hardware(bitrate=0, boot_ms=0, variant=J1939_VARIANTS["claims no address"])
    module = HipnucJ1939Module(monotonic_ns(), J1939Settings(), hardware)
    port = CanPort(module, vcan.name)
    heard: list[tuple[int, int, bytes]] = []

    def hear(end: socket.socket) -> None:
        while True:
            try:
                data, (_, _, pgn, source) = end.recvfrom(64)
            except BlockingIOError:
                return
            heard.append((pgn, source, data))

    def run_until(end: socket.socket, condition: Callable[[], object]) -> None:
        limit = monotonic() + LIMIT_S
        while not condition():
            assert monotonic() < limit, heard[-8:]
            port.step(monotonic_ns(), True)
            hear(end)

    with closing(port), node(vcan.name, 0x55) as end:
        run_until(end, lambda: len(heard) >= 12)
        assert [pgn for pgn, _, _ in heard[:8]] == [0xFF34, 0xFF37, 0xFF3D, 0xFF41] * 2
        assert {source for _, source, _ in heard} == {8}
        say(end, vcan.name, codec.CONFIGURE, bytes.fromhex("3701060032000000"), 8)
        run_until(end, lambda: heard[-1][0] == codec.CONFIGURE)
        assert heard[-1] == (codec.CONFIGURE, 8, bytes.fromhex("3701060032000000"))
        say(end, vcan.name, codec.CONFIGURE, bytes.fromhex("3701030000000000"), 8)
        run_until(end, lambda: heard[-1][2] == bytes.fromhex("3701030032000000"))
    accel = struct.unpack("<3hH", next(data for pgn, _, data in heard if pgn == 0xFF34))
    assert 1700 < sum(counts * counts for counts in accel[:3]) ** 0.5 < 2400  # 1 G and the motion


async def test_driver_and_simulator_with_every_message_and_changes(vcan: CanInterface) -> None:
    """Two devices on the bus. The test changes settings of one device while both send, and restarts it."""
    fast = dict.fromkeys((codec.UTC, *codec.MEASURED), 100)
    quiet = J1939Hardware(bitrate=0, boot_ms=0)
    module = HipnucJ1939Module(monotonic_ns(), J1939Settings(fast), quiet)
    other = HipnucJ1939Module(monotonic_ns(), J1939Settings(fast, address=9), quiet)
    rig = BusRig(vcan.name, "hipnuc-j1939", HipnucJ1939Options(), module, other)
    results: dict[str, VerbResult] = {}

    async def told(name: str, **arguments: object) -> None:
        answer = await rig.done(rig.device.act(name, arguments))
        assert isinstance(answer, VerbResult)
        results[name] = answer

    async with rig.played():
        await rig.until(lambda: len(rig.samples) >= 20, "twenty samples")
        assert rig.samples[-1].temperature_c is not None
        assert rig.samples[-1].incli_rad is not None
        position = rig.samples[-1].position
        assert position is not None
        assert (position.quality, position.satellites) == (PLACE.quality, PLACE.satellites)
        assert rig.samples[-1].gnss_utc_ns is not None
        assert rig.device.ledger.lost() == 0
        await told("zero", zero="here")
        wanted = {"x_reversed": True, "bit_rate": 250_000, "ff34_interval_ms": 50, "ff37_interval_ms": 50}
        applied = await rig.done(rig.device.settings.apply(wanted, save=True))
        assert (applied.problem, applied.saved, applied.restarted, len(applied.steps)) == ("", True, False, 4)
        assert "restart them" in applied.advice
        await told("save")
        await told("restart")
        found = {name: one.result for name, one in results.items()}
        assert found == {"zero": None, "save": None, "restart": "found at address 8"}
        assert (module.flash.x_reversed, module.settings) == (1, module.flash)
        count = len(rig.samples)
        await rig.until(lambda: len(rig.samples) >= count + 30, "faster samples")
    assert other.requests == 0
    last = rig.samples[-20:]
    assert {sample.accel_m_s2 is not None for sample in last} == {True}
    assert {sample.mag_t is not None for sample in last} == {True, False}


@pytest.mark.parametrize(("message", "name"), [("canfd", "ff5b"), ("canfd_old", "ff5a")])
async def test_can_fd_samples_of_a_found_device_and_a_change(vcan: CanInterface, message: str, name: str) -> None:
    """The interface accepts CAN FD (MTU 72). imud finds the device, and the bus loses no frame of 64 bytes."""
    vcan.down()
    tool("ip", "link", "set", vcan.name, "mtu", "72")
    vcan.up()
    options = SimulatorOptions(message=message, boot_ms=0, noise="none", motion="still")
    module = make_canfd(options, monotonic_ns())
    rig = BusRig(vcan.name, "auto", None, module)
    async with rig.played():
        await rig.until(lambda: len(rig.samples) >= 100, "a second of samples")
        assert rig.device.status().driver == "hipnuc-canfd"
        setting = f"{name}_interval_ms"
        applied = await rig.done(rig.device.settings.apply({setting: 20}, save=False))
        assert (applied.problem, [one.outcome for one in applied.steps]) == ("", [StepOutcome.VERIFIED])
        await rig.until(lambda: len(rig.samples) >= 200, "two seconds of samples")
        assert rig.device.ledger.lost() == rig.device.ledger.frames_bad() == 0
    sample, truth = rig.samples[-1], module.hardware.motion.at(0)
    assert sample.accel_m_s2 == pytest.approx(truth.accel_m_s2, abs=0.01)
    assert sample.quat_wxyz == pytest.approx(truth.quat_wxyz, abs=1e-3)
    assert sample.t_dev_ns is not None
    steps_ms = {(b.t_dev_ns or 0) - (a.t_dev_ns or 0) for a, b in pairwise(rig.samples[-50:])}
    assert steps_ms == {20_000_000}


async def test_nmea_2000_from_the_simulator(vcan: CanInterface) -> None:
    module = HipnucNmea2000Module(monotonic_ns(), Nmea2000Hardware(rate_hz=20, bitrate=0, boot_ms=0))
    rig = BusRig(vcan.name, "hipnuc-nmea2000", HipnucNmea2000Options(), module)
    async with rig.played():
        await rig.until(lambda: len(rig.samples) >= 40, "forty samples")
    assert rig.device.ledger.lost() == 0
    for sample in rig.samples:
        assert sample.euler_rad is not None
        truth = module.hardware.motion.at((sample.t_ns - module.epoch_ns) / 1e9)
        assert sample.euler_rad == pytest.approx(truth.euler_rad, abs=0.1)


async def made_so(rig: BusRig, wanted: Mapping[str, object], *, verified: bool) -> None:
    applied = await rig.done(rig.device.settings.apply(wanted, save=True))
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
        taken = await rig.done(rig.device.settings.apply({"node": 12}, save=True))
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
        taken = await rig.done(rig.device.settings.apply({"address": 12}, save=True))
        assert "address 12 is in use" in taken.problem
        assert module.writes_to_flash == 0
        wanted = {"ff37_interval_ms": 50, "y_reversed": True, "address": 9}
        await made_so(rig, wanted, verified=kind.reads != "ignored")
    saved = module.flash
    assert (saved.intervals_ms[0xFF37], saved.y_reversed, saved.address) == (50, 1, 9)
    assert module.writes_to_flash == 1
    assert beside.settings == J1939Settings(address=12)


TILTED = Still(0.2, -0.1, 0.5)
SLOW = NodeSettings(bit_rate=0, periods_ms={1: 50, 2: 50, 3: 50, 4: 0, 6: 0, 7: 50})


def canopen(interface: str) -> BusRig:
    hardware = HipnucCanopenHardware(factory=SLOW, boot_ms=0, motion=TILTED)
    return BusRig(interface, "hipnuc-canopen", HipnucCanopenOptions(), HipnucCanopenModule(monotonic_ns(), hardware))


def j1939(interface: str) -> BusRig:
    hardware = J1939Hardware(bitrate=0, boot_ms=0, motion=TILTED)
    settings = J1939Settings(intervals_ms={**J1939Settings().intervals_ms, 0xFF4A: 100})
    module = HipnucJ1939Module(monotonic_ns(), settings, hardware)
    return BusRig(interface, "hipnuc-j1939", HipnucJ1939Options(), module)


@pytest.mark.timeout(300)
@pytest.mark.parametrize("make", [canopen, j1939])
async def test_the_zero_of_an_inclinometer(vcan: CanInterface, make: Callable[[str], BusRig]) -> None:
    rig = make(vcan.name)
    async with rig.played():
        await rig.until(lambda: any(sample.incli_rad is not None for sample in rig.samples), "inclinations")
        before = next(sample.incli_rad for sample in reversed(rig.samples) if sample.incli_rad is not None)
        assert max(map(abs, before)) > 0.05
        result: CalibrationResult = await rig.done(rig.device.calibrate("zero", save=True))
        assert result.verified, result
        assert result.saved
        assert [check.name for check in result.checks] == ["inclination"]
    assert any(event.kind is EventKind.CALIBRATION for event in rig.events)
