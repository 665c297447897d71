"""CPU time of nine devices on one CAN bus, from the read to the published sample, and their total share of a CPU.

The devices are four CANopen nodes with six TPDOs, four J1939 nodes with four PGNs, and one IMU61x. They use the codecs,
clocks and paths of the daemon. A datagram socket on the loopback interface replaces the bus of each device. The read
uses the same system call as on a CAN bus.
"""

import socket
from contextlib import ExitStack
from time import monotonic_ns, process_time_ns

from imud.contracts.driver import CanDriver
from imud.contracts.publisher import Batch
from imud.drivers import DRIVERS
from imud.formats.can import RAW_FRAME, CanFilter
from imud.formats.slot import encode_slot
from imud.host.clock import HostClock
from imud.links.socketcan import BusState, FrameReader
from imud.model.ledger import Ledger
from imud.sampling.clock import SampleClock
from imud.sampling.path import CanPath, PathContext
from tests.bench.rows import Row, at_most
from tests.lab.can_player import loop
from tests.lab.can_traffic import Module, fleet

RATE_HZ = 100.0
PERIOD_NS = round(1e9 / RATE_HZ)
WAITING = {"read one by one": 1, "held for 50 ms": 5}  # frames per read, at 100 Hz
LEARNING = 40  # samples before the measurement
CPU_SHARE_MOST = 0.5  # goal: half of a CPU for nine devices


class Device:
    def __init__(self, module: Module, stack: ExitStack) -> None:
        driver = DRIVERS[module.driver]
        assert isinstance(driver, CanDriver)
        options = driver.node_settings(module.node)
        self.filters: list[CanFilter] = list(driver.filters(options))
        self.sender = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        receiver = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        # the buffer must hold all frames of one turn
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self.sender.connect(receiver.getsockname())
        self.reader = FrameReader(receiver, BusState("can0"))
        self.ledger = Ledger()
        clock = SampleClock(module.name, tick_ns=driver.tick_ns, tick_modulus=driver.tick_modulus, byte_ns=0, hold_ns=0)
        codec = driver.make_codec(self.ledger, options)
        context = PathContext(
            module.name, 1, self.ledger, _publish, lambda *_: None, lambda _bad: None, lambda: 0, HostClock()
        )
        self.path = CanPath(codec, clock, context)

    def read_and_decode(self, times_ns: list[int]) -> int:
        """Read and decode the sent frames with these arrival times, ns. Return the CPU time, ns."""
        begin_ns = process_time_ns()
        frames = self.reader.read()
        read_ns = process_time_ns()
        # replace the receive times: the frames of all turns are sent without a pause
        frames = [frame._replace(t_rx_ns=t_ns) for frame, t_ns in zip(frames, times_ns, strict=True)]
        taken_ns = process_time_ns()
        self.path.on_frames(frames)
        return process_time_ns() - taken_ns + read_ns - begin_ns

    def wants(self, raw: bytes) -> bool:
        can_id = RAW_FRAME.unpack(raw)[0] & 0x1FFF_FFFF
        return any(can_id & f.mask == f.can_id & f.mask for f in self.filters)


def _publish(batch: Batch) -> None:
    for sample in batch.samples:
        encode_slot(sample, batch.device_id)


def measure(waiting: int, samples: int) -> float:
    modules = fleet()
    played = loop([f"{module.driver}:{module.node}" for module in modules], RATE_HZ)
    with ExitStack() as stack:
        devices = [Device(module, stack) for module in modules]
        share = [
            [
                # each device receives only the frames that pass its CAN filters
                [raw for at in range(0, len(burst.frames), RAW_FRAME.size)
                 if device.wants(raw := bytes(burst.frames[at : at + RAW_FRAME.size]))]
                for device in devices
            ]
            for burst in played
        ]  # fmt: skip
        taken_ns, made, begun_ns = 0, 0, monotonic_ns()
        for begin in range(0, LEARNING + samples, waiting):
            before = sum(device.ledger.samples for device in devices)
            turn = range(begin, begin + waiting)
            for number in turn:
                for device, frames in zip(devices, share[number % len(share)], strict=True):
                    for raw in frames:
                        device.sender.send(raw)
            for device, each in zip(devices, zip(*(share[n % len(share)] for n in turn), strict=True), strict=True):
                taken_ns += device.read_and_decode(
                    [begun_ns + n * PERIOD_NS for n, some in zip(turn, each, strict=True) for _ in some]
                )
            if begin < LEARNING:
                # do not count the first samples: the clocks still learn the rate
                taken_ns = 0
            else:
                made += sum(device.ledger.samples for device in devices) - before
    assert made == samples * len(devices), made
    return taken_ns / made / 1e3


def rows(*, quick: bool = False) -> list[Row]:
    found: list[Row] = []
    for words, waiting in WAITING.items():
        each_us = measure(waiting, 200 if quick else 1000)
        share = each_us * 1e-6 * RATE_HZ * len(fleet())
        found.append(Row(f"nine CAN devices, {words}: CPU per sample", each_us, "us"))
        found.append(at_most(f"nine CAN devices at {RATE_HZ:g} Hz, {words}: share of a CPU", share, "", CPU_SHARE_MOST))
    return found
