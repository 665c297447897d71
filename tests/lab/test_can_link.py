"""The CAN link on a bus of the kernel: cyclic sending, changing filters, and detection of a device by listening."""

import asyncio
import socket
from collections.abc import Callable
from itertools import pairwise
from time import monotonic, monotonic_ns

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.status import DeviceState
from imud.device.can_search import EVERYTHING
from imud.device.factory import DeviceFactory
from imud.formats.can import CanFilter, CanFrame, CyclicFrame, pack_frame
from imud.host.clock import HostClock
from imud.links.cyclic_sender import KernelSender, LoopSender
from imud.links.socketcan import BusState, FrameReader, SocketCanLink, SocketCanOptions
from imud.model.errors import LinkMissing
from imud.sim.can_module import CanModules
from imud.sim.imu61x.can import Imu61xCanHardware, Imu61xCanModule
from imud.sim.ports.can_port import CanPort
from tests.lab.can_interface import CanInterface
from tests.support.device_rig import DeviceOutput

LIMIT_S = 30.0
MS = 1_000_000
SYNC = CyclicFrame(0x80, False, b"", 10 * MS)


async def until(condition: Callable[[], object], what: str) -> None:
    end = monotonic() + LIMIT_S
    while not condition():
        assert monotonic() < end, f"not within {LIMIT_S} s: {what}"
        await asyncio.sleep(0.005)


async def test_the_kernel_sends_cyclically_and_stops_with_the_link(vcan: CanInterface) -> None:
    heard: list[CanFrame] = []
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW) as far:
        far.bind((vcan.name,))
        reader = FrameReader(far, BusState("can0"))
        link = SocketCanLink(SocketCanOptions(interface=vcan.name))
        link.open()
        link.start(lambda frames: None, lambda news, problem: None, lambda error: None)
        link.send_cyclic([SYNC, CyclicFrame(0x18FEE9AA, True, b"\1\2", 50 * MS)])
        end = monotonic() + 3
        while monotonic() < end:
            await asyncio.sleep(0.1)  # the kernel sends the frames without the event loop
            heard.extend(reader.read())
        link.send_cyclic([CyclicFrame(0x81, False, b"", 10 * MS)])
        heard.extend(reader.read())
        await asyncio.sleep(0.1)
        assert {frame.can_id for frame in reader.read()} == {0x81}
        link.close()
        reader.read()
        await asyncio.sleep(0.1)
        assert reader.read() == []
    times = [frame.t_rx_ns for frame in heard if frame.can_id == 0x80]
    others = [frame for frame in heard if frame.extended]
    gaps = sorted(after - before for before, after in pairwise(times))
    mean_ns = (times[-1] - times[0]) / (len(times) - 1)
    words = f"mean {mean_ns / 1e6:.4f} ms, shortest {gaps[0] / 1e6:.2f} ms, longest {gaps[-1] / 1e6:.2f} ms"
    print(f"\nSYNC every 10 ms by the kernel: {len(times)} sent, {words}")
    assert mean_ns >= 10 * MS - 1  # longer due to the latency of the timer interrupt and stalls of a busy host
    assert gaps[len(gaps) // 2] < 11 * MS
    assert len(others) == pytest.approx(len(times) / 5, abs=6)
    assert others[0][:3] == (0x18FEE9AA, True, b"\1\2")


async def test_an_interface_that_is_gone_is_told(vcan: CanInterface) -> None:
    link = SocketCanLink(SocketCanOptions(interface="vcan9"))
    with pytest.raises(LinkMissing):
        link.send_cyclic([SYNC])
    link.close()


async def test_a_kernel_without_the_manager_is_helped_by_the_loop(
    vcan: CanInterface, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(interface: str, frames: object) -> KernelSender:
        raise OSError(93, "Protocol not supported")

    monkeypatch.setattr("imud.links.socketcan.KernelSender", without)
    link = SocketCanLink(SocketCanOptions(interface=vcan.name))
    link.open()
    heard: list[CanFrame] = []
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK, socket.CAN_RAW) as far:
        far.bind((vcan.name,))
        reader = FrameReader(far, BusState("can0"))
        link.start(lambda frames: None, lambda news, problem: None, lambda error: None)
        link.send_cyclic([SYNC])
        assert isinstance(link._sender, LoopSender)  # the tested case

        def five() -> bool:
            heard.extend(reader.read())
            return len(heard) >= 5

        await until(five, "five frames")
        link.close()


async def test_filters_hold_from_the_moment_they_are_set(vcan: CanInterface) -> None:
    link = SocketCanLink(SocketCanOptions(interface=vcan.name))
    link.filters = EVERYTHING
    link.open()
    heard: list[CanFrame] = []
    link.start(heard.extend, lambda news, problem: None, lambda error: None)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as far:
        far.bind((vcan.name,))
        far.send(pack_frame(0x123, False, b""))
        far.send(pack_frame(0x123, True, b""))
        await until(lambda: len(heard) == 2, "both")
        link.filters = [CanFilter(0x124, 0x7FF, False)]
        far.send(pack_frame(0x123, False, b""))
        far.send(pack_frame(0x124, False, b""))
        await until(lambda: len(heard) == 3, "the one that passes")
        assert heard[-1].can_id == 0x124
    link.close()


async def test_a_device_is_found_by_listening_and_again_after_the_bus_was_down(vcan: CanInterface) -> None:
    config = DeviceConfig("mast", "auto", None, True, "socketcan", SocketCanOptions(interface=vcan.name))
    runner = DeviceFactory(DeviceOutput(), HostClock()).make(config, 1)
    now_ns = monotonic_ns()
    modules = [Imu61xCanModule(now_ns, Imu61xCanHardware(rate_hz=50, boot_ms=0, base_id=n)) for n in (101, 900)]
    port = CanPort(CanModules(modules), vcan.name)  # no driver knows the frames of the second device
    task = asyncio.create_task(runner.run())

    def running() -> bool:
        port.step(monotonic_ns(), True)
        runner.tick(monotonic_ns())
        return runner.state is DeviceState.RUNNING

    await until(running, "found")
    status = runner.status()
    assert (status.driver, status.state) == ("imu61x-can", DeviceState.RUNNING)
    skipped = runner.ledger.bytes_skipped
    assert skipped > 0
    samples = runner.ledger.samples
    await until(lambda: running() and runner.ledger.samples > samples + 50, "a second of samples")
    # frames that were in the queue of the socket before the filters were set
    assert runner.ledger.bytes_skipped - skipped <= 64 * 8
    vcan.down()
    await until(lambda: runner.state is DeviceState.MISSING, "missing")
    vcan.up()
    await until(running, "found again")
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    runner.close()
    port.close()
    assert runner.ledger.closes()
