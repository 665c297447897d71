"""IMU61x on the kernel's CAN: stream, several devices, drops, error states, interface down and up."""

import asyncio
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from time import monotonic_ns
from typing import Any

import pytest

from imud.contracts.status import DeviceState
from imud.drivers.imu61x.can import Imu61xCanOptions, encode_set
from imud.formats.can import pack_frame
from imud.links.socketcan import SocketCanOptions
from imud.model.event import EventKind
from imud.sim.imu61x.can import Imu61xCanHardware, Imu61xCanModule
from imud.sim.ports.can_port import CanPort
from tests.lab.can_device import BusRig
from tests.lab.can_interface import CanInterface
from tests.lab.tool import tool

CONTROLLER = 0x2000_0004


class Rig(BusRig):
    def __init__(self, near: str, far: str, *, base_id: int = 101, **link: Any) -> None:
        super().__init__(near, "imu61x-can", Imu61xCanOptions(base_id=base_id), **link)
        self.far = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.far.bind((far,))

    def send(self, *indices: int, base_id: int = 101) -> None:
        for index in indices:
            for can_id, data in encode_set(
                index=index, accel_m_s2=(0, 0, 9.80665), gyro_rad_s=(0, 0, index % 7), euler_rad=(0.1, 0.2, 0.3),
                temperature_c=25, base_id=base_id,
            ):  # fmt: skip
                self.far.send(pack_frame(can_id, False, data))

    def send_part(self, index: int) -> None:
        for can_id, data in encode_set(
            index=index, accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0), euler_rad=(0, 0, 0), temperature_c=25
        )[:3]:
            self.far.send(pack_frame(can_id, False, data))

    def back(self) -> None:
        self.far.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)

    def send_error(self, classes: int, status: int) -> None:
        """Send an error frame as the driver of a controller does. On vcan, it reaches the sockets that subscribed to
        its class."""
        self.far.send(struct.pack("=IB3x8s", classes, 8, bytes([0, status])))

    @asynccontextmanager
    async def played(self, *, waits: bool = True) -> AsyncIterator[None]:
        with self.far:
            async with super().played(waits=waits):
                yield
        assert self.device.ledger.frames_pending == 0


async def test_stream_of_the_simulator_with_its_truth(vcan: CanInterface) -> None:
    rig = Rig(vcan.name, vcan.name)
    async with rig.played():
        hardware = Imu61xCanHardware(rate_hz=50, boot_ms=0, index=65500)
        module = Imu61xCanModule(monotonic_ns(), hardware)
        port = CanPort(module, vcan.name)
        while module.samples_sent < 100:
            port.step(monotonic_ns(), True)
            await asyncio.sleep(0.001)
        await rig.until(lambda: len(rig.samples) >= 99, "99 samples")
        port.close()
        for number, sample in enumerate(rig.samples):
            instant_ns = module.epoch_ns + round(number * 20e6 / 1.00002)  # the device clock is 20 ppm fast
            truth = hardware.motion.at((instant_ns - module.epoch_ns) / 1e9)
            assert sample.gyro_rad_s == pytest.approx(truth.gyro_rad_s, abs=1e-6)
            assert instant_ns - 3 * sample.t_err_ns <= sample.t_ns <= sample.t_rx_ns
        rig.device.tick(monotonic_ns())
        status = rig.device.status()
        assert status.state is DeviceState.RUNNING
        assert status.ledger["lost_gap_device"] == 0
        assert status.expected_rate_hz == pytest.approx(50, rel=0.05)
    assert [s.seq for s in rig.samples] == list(range(1, len(rig.samples) + 1))
    assert rig.events[0].kind is EventKind.UP


async def test_two_devices_share_a_bus_and_see_only_their_own(vcan: CanInterface) -> None:
    first, second = Rig(vcan.name, vcan.name), Rig(vcan.name, vcan.name, base_id=200)
    async with first.played(), second.played():
        rigs = (first, second)
        first.send(1)
        second.send(1, base_id=200)
        for rig in rigs:  # before the first sample, imud receives all frames of 11 bits, to name unknown frames
            await rig.until(lambda: rig.device.ledger.bytes_in == 80, "ten frames")  # noqa: B023
            assert (rig.device.ledger.bytes_skipped, len(rig.samples)) == (40, 1)
            for _ in range(2):  # the first tick makes the device run, the second tick narrows the filters
                rig.device.tick(monotonic_ns())
        tool("cansend", vcan.name, "12345678#DEADBEEF")
        first.send(2, 3, 4)
        second.send(2, 3, base_id=200)
        await first.until(lambda: len(first.samples) == 4, "four of the first")
        await second.until(lambda: len(second.samples) == 3, "three of the second")
    for rig, frames in zip(rigs, (15, 10), strict=True):
        assert (rig.device.ledger.bytes_in, rig.device.ledger.bytes_skipped) == (80 + 8 * frames, 40)


async def test_frames_dropped_by_a_small_buffer_are_overruns(vcan: CanInterface) -> None:
    rig = Rig(vcan.name, vcan.name, receive_buffer_bytes=4096)
    async with rig.played():
        rig.send(*range(10))  # no program reads: the buffer overflows
        await rig.until(lambda: rig.device.ledger.bytes_in, "the first frames")
        rig.send(10)
        await rig.until(lambda: rig.samples and rig.samples[-1].seq, "a sample")
        await rig.until(lambda: rig.device.ledger.lost_overrun, "loss is counted")
        rig.device.tick(monotonic_ns())
    ledger = rig.device.ledger
    assert ledger.samples + ledger.lost_overrun == 11
    assert ledger.lost_gap_device == 0
    assert EventKind.LOSS in [event.kind for event in rig.events]


async def test_a_jump_of_index_without_drops_is_the_devices(vcan: CanInterface) -> None:
    rig = Rig(vcan.name, vcan.name)
    async with rig.played():
        rig.send(65534, 65535, 65536 + 2)
        await rig.until(lambda: len(rig.samples) == 3, "three samples")
    assert (rig.device.ledger.lost_gap_device, rig.device.ledger.lost_overrun) == (2, 0)


async def test_interface_down_and_up_again(vcan: CanInterface) -> None:
    rig = Rig(vcan.name, vcan.name)
    async with rig.played():
        rig.send(1, 2)
        await rig.until(lambda: rig.device.state is DeviceState.RUNNING, "running")
        vcan.down()
        await rig.until(lambda: rig.device.state is DeviceState.MISSING, "missing")
        await rig.until(lambda: "is down" in rig.device.status().problem, "the problem in the status")
        vcan.up()
        await rig.until(lambda: rig.device.state is DeviceState.SEARCHING, "open again")
        rig.back()
        rig.send(500, 501)
        await rig.until(lambda: rig.device.state is DeviceState.RUNNING, "running again")
        await rig.until(lambda: len(rig.samples) == 4, "both")  # the kernel may deliver the second sample later
    assert len(rig.samples) == 4
    assert rig.device.ledger.lost() == 0
    kinds = [event.kind for event in rig.events if event.kind is not EventKind.CONDITION]
    assert kinds == [EventKind.UP, EventKind.DOWN, EventKind.UP]
    assert rig.device.status().connects == 2


async def test_interface_that_is_missing_is_waited_for() -> None:
    config = SocketCanOptions(interface="vcan7")
    tool("ip", "link", "add", "dev", "vcan7", "type", "vcan")
    rig = Rig("vcan7", "vcan7")
    tool("ip", "link", "delete", "vcan7")
    async with rig.played(waits=False):
        await rig.until(lambda: "does not exist" in rig.device.status().problem, "the problem in the status")
        tool("ip", "link", "add", "dev", config.interface, "type", "vcan")
        tool("ip", "link", "set", config.interface, "up")
        await rig.until(lambda: rig.device.state is DeviceState.SEARCHING, "open")
        tool("ip", "link", "delete", config.interface)
        await rig.until(lambda: rig.device.state is DeviceState.MISSING, "gone")


async def test_an_overflow_of_the_receive_buffer_of_a_controller_is_an_overrun(vcan: CanInterface) -> None:
    rig = Rig(vcan.name, vcan.name)
    async with rig.played():
        rig.send(2)
        await rig.until(lambda: rig.device.state is DeviceState.RUNNING, "running")
        rig.send(3)
        rig.send_error(CONTROLLER, 0x01)  # overflow of the controller's receive buffer
        rig.send(5)
        await rig.until(lambda: len(rig.samples) == 3, "three samples")
    assert rig.device.ledger.lost_overrun == 1


@pytest.mark.manual("A 4.1 rate")
async def test_real_controllers_carry_the_stream(can_pair: tuple[CanInterface, CanInterface]) -> None:
    near, far = can_pair
    rig = Rig(near.name, far.name)
    async with rig.played():
        for index in range(20):
            rig.send(index)
            await asyncio.sleep(0.01)
        await rig.until(lambda: len(rig.samples) == 20, "twenty samples")
        assert rig.device.status().link == "can0 at 500 kbit/s"
        near.down()
        await rig.until(lambda: rig.device.state is DeviceState.MISSING, "missing")
        near.up()
        await rig.until(lambda: rig.device.state is DeviceState.SEARCHING, "open again")
        rig.send(90, 91)  # the interface at the far end is still up
        await rig.until(lambda: len(rig.samples) == 22, "two more")
    assert rig.device.ledger.lost() == 0


async def test_error_passive_of_a_real_controller(can_pair: tuple[CanInterface, CanInterface]) -> None:
    near, far = can_pair
    rig = Rig(near.name, far.name)
    async with rig.played():
        rig.send(1, 2)
        await rig.until(lambda: rig.device.state is DeviceState.RUNNING, "running")
        near.enter("error-passive")
        await rig.until(lambda: "error-passive" in rig.device.status().problem, "error-passive is shown")
        rig.send(3, 4)
        await rig.until(lambda: len(rig.samples) == 4, "it still receives")
        assert rig.device.state is DeviceState.RUNNING
        near.enter("error-active")
        await rig.until(lambda: rig.device.status().problem == "", "over")
    assert rig.device.status().kernel.error_passive == 1
    assert rig.device.ledger.lost() == 0
    news = [event.message.partition(":")[0] for event in rig.events if event.kind is EventKind.LINK]
    assert news == ["can0 is error-passive", "can0 is error-active again"]


@pytest.mark.parametrize("restart_ms", [0, 300])
async def test_bus_off_of_a_real_controller_and_its_restart(
    can_pair: tuple[CanInterface, CanInterface], restart_ms: int
) -> None:
    """Restart by an administrator, or by the kernel after `restart-ms`. Frames in between are lost and counted."""
    near, far = can_pair
    near.restart_by_itself(restart_ms)
    rig = Rig(near.name, far.name)
    async with rig.played():
        rig.send(1, 2)
        await rig.until(lambda: rig.device.state is DeviceState.RUNNING, "running")
        rig.send_part(3)
        await rig.until(lambda: rig.device.ledger.frames_pending == 3, "in the middle of a sample")
        near.enter("bus-off")
        rig.send(4, 5)  # the controller is off the bus
        await rig.until(lambda: EventKind.LINK in [event.kind for event in rig.events], "told")
        if not restart_ms:
            assert "bus-off" in rig.device.status().problem
            await rig.until(lambda: rig.device.state is DeviceState.SILENT, "silent")
            assert "bus-off" in rig.device.status().problem
            near.restart()
        await rig.until(lambda: "again" in rig.events[-1].message, "restarted")
        rig.send(6, 7)
        await rig.until(lambda: len(rig.samples) == 4 and rig.device.state is DeviceState.RUNNING, "back")
        assert rig.device.status().problem == ""
    ledger = rig.device.ledger
    assert rig.device.status().kernel.bus_off == 1
    assert rig.device.status().connects == 1
    assert ledger.lost() == 3  # frame 3 was incomplete, frames 4 and 5 were not received
    assert ledger.frames_ignored == 3
    news = [event.message.partition(":")[0] for event in rig.events if event.kind is EventKind.LINK]
    assert news == ["can0 is bus-off", "can0 is error-active again"]
