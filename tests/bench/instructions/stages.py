"""The counted stages: parts of the path of a sample with fixed input, and the whole daemon.

A stage creates the function `run`. `run(n)` executes the next n operations. The difference between the counts of 2 n
and n operations is the count of n operations without the overhead of the measurement.
"""

import asyncio
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice, pairwise
from random import Random
from typing import Final

import msgspec

from imud.contracts.codec import StreamCodec
from imud.contracts.publisher import Batch, PublisherContext
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenCodec, HipnucCanopenOptions, encode_tpdos
from imud.drivers.hipnuc.uart.codec import HipnucCodec, HipnucOptions
from imud.drivers.imu61x.can import BASE_ID, INDEX_MODULUS, Imu61xCanCodec, Imu61xCanOptions, encode_set
from imud.drivers.imu61x.uart.codec import Imu61xCodec, encode_ahrs
from imud.fleet.writer import WriterQueue
from imud.formats.can import pack_frame
from imud.formats.jsonrpc import encode_request, line_of
from imud.formats.slot import encode_slot, encode_slots
from imud.host.clock import HostClock
from imud.links.socketcan import BusState, FrameReader
from imud.model.ledger import Ledger
from imud.model.sample import Measurement, Sample
from imud.model.units import NS_PER_MS, uart_byte_ns
from imud.publishers import PUBLISHERS
from imud.publishers.rules.publisher import Rules
from imud.publishers.rules.settings import RulesOptions
from imud.publishers.shm import ShmOptions, ShmPublisher
from imud.publishers.socket.server import SocketOptions, SocketServer
from imud.sampling.clock import SampleClock
from imud.sampling.path import CanPath, PathContext, StreamPath
from tests.bench.instructions import virtual_time
from tests.bench.instructions.daemon import BUFFER, DRAIN_EVERY, QUIET_PERIOD_TICKS, VirtualDaemon, own_group
from tests.bench.instructions.measured import INTERPRETER
from tests.bench.instructions.module import BAUD, SETTLE_READS, Module, Read
from tests.support.publisher_context import publisher_context

Run = Callable[[int], None]

WARM: Final = 200  # operations before the count, for one frame per operation
WARM_LEAST: Final = 20  # minimum for several frames per operation


@dataclass(frozen=True, slots=True)
class CountedStage:
    name: str
    make: Callable[[int, str], Run]
    """Function that creates `run` for a total number of operations. It stores files in the directory."""
    count: int
    per: int = 1

    @property
    def total(self) -> int:
        return self.warm + 3 * self.count

    @property
    def warm(self) -> int:
        """Return the number of operations before the count, in which the interpreter specializes its instructions."""
        return max(WARM // self.per, WARM_LEAST)


def _taking(operations: Sequence[Callable[[], object]]) -> Run:
    left = iter(operations)

    def run(count: int) -> None:
        for operation in islice(left, count):
            operation()

    return run


def _interpreter(total: int, _directory: str) -> Run:
    def loop(count: int) -> float:
        seen: dict[int, float] = {}
        for number in range(count):
            seen[number & 15] = seen.get(number & 7, 0.5) * 0.75 + number
        return sum(seen.values())

    return _taking([partial(loop, 100)] * total)


# --- decoding -------------------------------------------------------------------------------------------------------


Encode = Callable[[int], list[bytes]]  # returns a number of frames


def _single(codec: Callable[[], StreamCodec], encode: Encode, total: int, _directory: str) -> Run:
    feed = codec().feed
    return _taking([partial(feed, frame) for frame in encode(total)])


def _bulk(codec: Callable[[], StreamCodec], encode: Encode, block: int, total: int, _directory: str) -> Run:
    feed, stream = codec().feed, b"".join(encode(total * block + 1))
    size = len(stream) // (total * block + 1) * block
    # 30 bytes more in the first read: each following read starts inside a frame
    cuts = [0, *range(size + 30, len(stream), size), len(stream)]
    return _taking([partial(feed, stream[begin:end]) for begin, end in pairwise(cuts)])


HI91_BLOCK: Final = 50  # HI91 frames in 4100 bytes. Such reads have an incomplete frame at each end.
AHRS_BLOCK: Final = 75  # AHRS frames in about 4096 bytes


def _hi91_codec() -> StreamCodec:
    return HipnucCodec(Ledger(), HipnucOptions())


def _ahrs_codec() -> StreamCodec:
    return Imu61xCodec(Ledger())


def _hi91_frames(count: int) -> list[bytes]:
    return [read.data for read in Module().reads(count)]


def _ahrs_frames(count: int) -> list[bytes]:
    random = Random(7)
    values = [random.gauss(0, 1) for _ in range(100)]
    return [
        encode_ahrs(
            timer_us=5000 * n, accel_m_s2=(values[n % 97], values[n % 89], 9.8),
            gyro_rad_s=(values[n % 83], values[n % 79], values[n % 73]),
            euler_rad=(values[n % 71] / 2, values[n % 67] / 2, values[n % 61]), temperature_c=31.5,
        )
        for n in range(count)
    ]  # fmt: skip


VECTOR: Final = (0.125, -0.25, 0.5)
TPDO_IDS: Final = {1: 0x180, 2: 0x280, 3: 0x380, 4: 0x480, 6: 0x680, 7: 0x780}  # COB-IDs of node 0 by TPDO number


def _imu61x_can(total: int, _directory: str) -> Run:
    codec = Imu61xCanCodec(Ledger(), Imu61xCanOptions())
    sets = _imu61x_sets(total // 5 + 1)
    return _taking([partial(codec.feed_frame, can_id, False, data, t_ns) for one in sets for can_id, data, t_ns in one])


def _imu61x_sets(count: int) -> list[list[tuple[int, bytes, int]]]:
    """Return the frames of samples at intervals of 5 ms: identifier, data and arrival in ns."""
    return [
        [
            (can_id, data, virtual_time.BEGIN_NS + index * 5 * NS_PER_MS + place * 200_000)
            for place, (can_id, data) in enumerate(
                encode_set(index=index, accel_m_s2=VECTOR, gyro_rad_s=VECTOR, euler_rad=VECTOR, temperature_c=31.5)
            )
        ]
        for index in range(count)
    ]


def _canopen(total: int, _directory: str) -> Run:
    codec = HipnucCanopenCodec(Ledger(), HipnucCanopenOptions())
    tpdos = encode_tpdos(
        accel_m_s2=VECTOR, gyro_rad_s=VECTOR, euler_rad=VECTOR, quat_wxyz=(1.0, 0.0, 0.0, 0.0), pressure_pa=101_325.0,
        incli_rad=VECTOR[:2],
    )  # fmt: skip
    frames = [
        (TPDO_IDS[number] + 8, data, sample * 10 * NS_PER_MS + place * 250_000)
        for sample in range(total // len(tpdos) + 1)
        for place, (number, data) in enumerate(tpdos.items())
    ]
    return _taking([partial(codec.feed_frame, can_id, False, data, t_ns) for can_id, data, t_ns in frames])


KEPT_OPEN: Final[list[socket.socket]] = []


def _can_read(frames: int, total: int, _directory: str) -> Run:
    """Return a function that reads `frames` CAN frames. Datagrams on the loopback interface replace the CAN bus."""
    sender, reader = _can_bus()
    raw = pack_frame(BASE_ID, False, bytes(8))

    def read() -> None:
        for _ in range(frames):
            sender.send(raw)
        assert len(reader.read()) == frames

    return _taking([read] * total)


def _can_bus() -> tuple[socket.socket, FrameReader]:
    sender, receiver = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    receiver.bind(("127.0.0.1", 0))
    receiver.setblocking(False)
    sender.connect(receiver.getsockname())
    KEPT_OPEN.append(receiver)
    return sender, FrameReader(receiver, BusState("can0"))


# --- clock, slot, ring ----------------------------------------------------------------------------------------------


def _measured(reads: Sequence[Read]) -> list[tuple[Measurement, int]]:
    codec = HipnucCodec(Ledger(), HipnucOptions())
    return [(event, read.t_rx_ns) for read in reads for event in codec.feed(read.data) if type(event) is Measurement]


def _clock_of_module() -> SampleClock:
    return SampleClock("d0", tick_ns=NS_PER_MS, tick_modulus=1 << 32, byte_ns=uart_byte_ns(BAUD), hold_ns=0)


def _clock(total: int, _directory: str) -> Run:
    module, clock = Module(), _clock_of_module()
    for m, t_rx_ns in _measured(module.first_minute()):
        clock.sample(m, t_rx_ns, 0)
    calls = _measured(module.reads(total))
    return _taking([partial(clock.sample, m, t_rx_ns, virtual_time.UTC_AHEAD_NS) for m, t_rx_ns in calls])


def _samples(count: int) -> list[Sample]:
    """Return samples at intervals of 1 ms with the values of a complete HI91 measurement."""
    module, clock = Module(), _clock_of_module()
    reads = module.reads(SETTLE_READS + count)
    return [clock.sample(m, t_rx_ns, virtual_time.UTC_AHEAD_NS) for m, t_rx_ns in _measured(reads)][-count:]


def _slot(total: int, _directory: str) -> Run:
    return _taking([partial(encode_slot, sample, 1) for sample in _samples(total)])


def _slots(frames: int, total: int, _directory: str) -> Run:
    samples = _samples(total * frames)
    return _taking([partial(encode_slots, samples[at : at + frames], 1) for at in range(0, len(samples), frames)])


def _context() -> PublisherContext:
    return publisher_context(list, 1, virtual_time.now_ns, cpu_ns=virtual_time.now_ns)


def _ring_publisher(directory: str) -> ShmPublisher:
    publisher = ShmPublisher(ShmOptions(directory=directory, group=own_group()), _context())
    publisher.add_device("d0", 0)
    return publisher


def _ring(frames: int, total: int, directory: str) -> Run:
    publisher = _ring_publisher(directory)
    samples = _samples(total * frames)
    batches = [Batch("d0", 0, samples[at : at + frames]) for at in range(0, len(samples), frames)]
    # encode the slots before the count: the outputs share the encoded slots of a batch
    for batch in batches:
        assert batch.packed
    return _taking([partial(publisher.publish, batch) for batch in batches])


# --- socket ---------------------------------------------------------------------------------------------------------


async def _serve(directory: str, clients: int, encoding: str) -> tuple[SocketServer, list[socket.socket]]:
    path = f"{directory}/s"
    server = SocketServer(SocketOptions(path=path, group=own_group()), _context())
    server.start()
    server.add_device("d0", 0)
    socks = []
    for _ in range(clients):
        sock = socket.socket(socket.AF_UNIX)
        sock.connect(path)
        sock.sendall(line_of(encode_request("watch", {"encoding": encoding}, 1)))
        sock.setblocking(False)
        socks.append(sock)
    while sum(bool(status.encoding) for status in server.hub.clients()) < clients:
        await asyncio.sleep(0)
    for sock in socks:
        sock.recv_into(BUFFER)
    return server, socks


def _socket(clients: int, encoding: str, frames: int, total: int, directory: str) -> Run:
    loop = asyncio.new_event_loop()
    server, socks = loop.run_until_complete(_serve(directory, clients, encoding))
    samples = _samples(total * frames)
    made = [Batch("d0", 0, samples[at : at + frames]) for at in range(0, len(samples), frames)]
    if encoding == "binary":
        for batch in made:
            assert batch.packed
    batches = iter(made)

    async def publish(count: int) -> None:
        for number, batch in enumerate(islice(batches, count)):
            server.publish(batch)
            if number % DRAIN_EVERY == DRAIN_EVERY - 1:
                for sock in socks:
                    sock.recv_into(BUFFER)

    def run(count: int) -> None:
        loop.run_until_complete(publish(count))
        assert not any(status.dropped or status.queue_samples for status in server.hub.clients())

    return run


# --- output mqtt ----------------------------------------------------------------------------------------------------


def _mqtt_queue(total: int, _directory: str) -> Run:
    """Queue a batch for the output `mqtt`, the only work in the event loop. Threads of the output do the rest."""
    queue = WriterQueue()
    return _taking([partial(queue.put_batch, Batch("d0", 0, [sample])) for sample in _samples(total)])


# --- output rules ---------------------------------------------------------------------------------------------------


RULES: Final = {
    "tilt": {"measure": "tilt_deg", "above": 80},
    "shock": {"measure": "peak_accel_m_s2", "above": 500},
    "vibration": {"measure": "rms_accel_m_s2", "above": 500},
    "turn": {"measure": "angular_rate_deg_s", "above": 5000},
}


def _rules(count: int, total: int, _directory: str) -> Run:
    """Evaluate `count` rules. No rule begins."""
    chosen = dict(islice(RULES.items(), count))
    rules = Rules(msgspec.convert({"enabled": True, "rules": chosen}, RulesOptions), _context())
    rules.start()
    rules.add_device("d0", 0)
    batches = [Batch("d0", 0, [sample]) for sample in _samples(total)]
    for batch in batches:
        assert batch.packed
    return _taking([partial(rules.publish, batch) for batch in batches])


# --- all of it ------------------------------------------------------------------------------------------------------


def _path(frames: int, total: int, directory: str) -> Run:
    """Process the bytes of a read up to shared memory and one binary client, without the event loop."""
    context, sock = _path_context(directory)
    path, module = StreamPath(HipnucCodec(context.ledger, HipnucOptions()), _clock_of_module(), context), Module()

    def process(reads: Sequence[Read]) -> None:
        for number, (data, t_rx_ns) in enumerate(reads):
            virtual_time.set_now(t_rx_ns)
            path.on_data(data, t_rx_ns)
            if number % DRAIN_EVERY == DRAIN_EVERY - 1:
                sock.recv_into(BUFFER)

    first = module.first_minute()
    # the first counted read must be the first after a drain
    process([*first, *module.reads(-len(first) % DRAIN_EVERY)])
    reads = iter(module.reads(total, frames))
    return lambda count: process(list(islice(reads, count)))


def _can_path(total: int, directory: str) -> Run:
    """Process the frames of IMU61x samples, a frame per read, from the CAN link up to the outputs of `_path`."""
    context, sock = _path_context(directory)
    clock = SampleClock("d0", tick_ns=5 * NS_PER_MS, tick_modulus=INDEX_MODULUS, byte_ns=0, hold_ns=0)
    path = CanPath(Imu61xCanCodec(context.ledger, Imu61xCanOptions()), clock, context)
    (sender, reader), sets = _can_bus(), iter(_imu61x_sets(total))

    def process(count: int) -> None:
        for number, one in enumerate(islice(sets, count)):
            for can_id, data, t_ns in one:
                sender.send(pack_frame(can_id, False, data))
                virtual_time.set_now(t_ns)
                path.on_frames(reader.read())
            if number % DRAIN_EVERY == DRAIN_EVERY - 1:
                sock.recv_into(BUFFER)

    return process


def _path_context(directory: str) -> tuple[PathContext, socket.socket]:
    """Return the context of a path with a ring and one binary client, and the socket of the client."""
    server, (sock,) = asyncio.new_event_loop().run_until_complete(_serve(directory, 1, "binary"))
    publishers = (_ring_publisher(directory), server)

    def publish(batch: Batch) -> None:
        for publisher in publishers:
            publisher.publish(batch)

    return PathContext("d0", 0, Ledger(), publish, _ignore, _ignore, int, HostClock()), sock


def _ignore(*_arguments: object) -> None: ...


def _daemon(clients: int, encoding: str, frames: int, latency_ms: int, total: int, directory: str) -> Run:
    daemon = VirtualDaemon(directory, latency_ms)
    daemon.connect(clients, encoding)
    reads = iter(daemon.prepare(total, frames))
    return lambda count: daemon.process(list(islice(reads, count)))


def _disabled(total: int, directory: str) -> Run:
    """Run a daemon with the sections of all disabled outputs. The count must be equal to the count without them."""
    disabled = {name: {"enabled": False} for name, one in PUBLISHERS.items() if not one.wanted(one.settings())}
    daemon = VirtualDaemon(directory, outputs={**disabled, "rules": {"enabled": False, "rules": RULES}})
    daemon.connect(1, "binary")
    reads = iter(daemon.prepare(total, 1))
    return lambda count: daemon.process(list(islice(reads, count)))


def _tick(total: int, directory: str) -> Run:
    daemon = VirtualDaemon(directory)
    daemon.connect(1, "binary")
    return _taking(daemon.quiet_ticks(total))


STAGES: Final = (
    CountedStage(INTERPRETER, _interpreter, 10, 100),
    CountedStage(
        "decode HI91, reads of 4096 bytes", partial(_bulk, _hi91_codec, _hi91_frames, HI91_BLOCK), 4, HI91_BLOCK
    ),
    CountedStage("decode HI91, a frame per read", partial(_single, _hi91_codec, _hi91_frames), 200),
    CountedStage(
        "decode AHRS, reads of 4096 bytes", partial(_bulk, _ahrs_codec, _ahrs_frames, AHRS_BLOCK), 3, AHRS_BLOCK
    ),
    CountedStage("decode AHRS, a frame per read", partial(_single, _ahrs_codec, _ahrs_frames), 200),
    CountedStage("CAN link, a frame per read", partial(_can_read, 1), 200),
    CountedStage("CAN link, 10 frames per read", partial(_can_read, 10), 20, 10),
    CountedStage("decode IMU61x CAN, a frame", _imu61x_can, 250),
    CountedStage("decode CANopen, a frame", _canopen, 240),
    CountedStage("clock, a sample", _clock, 1000),
    CountedStage("slot, a sample", _slot, 200),
    CountedStage("slot, 20 samples in a batch", partial(_slots, 20), 20, 20),
    CountedStage("ring, a sample", partial(_ring, 1), 200),
    CountedStage("ring, 20 samples in a batch", partial(_ring, 20), 20, 20),
    CountedStage("socket, 1 binary client", partial(_socket, 1, "binary", 1), 160),
    CountedStage("socket, 10 binary clients", partial(_socket, 10, "binary", 1), 96),
    CountedStage("socket, 10 JSON clients", partial(_socket, 10, "json", 1), 96),
    CountedStage("socket, 10 binary clients, 20 samples in a batch", partial(_socket, 10, "binary", 20), 16, 20),
    CountedStage("queue of the output mqtt, a sample", _mqtt_queue, 200),
    CountedStage("rules, 1 rule, a sample", partial(_rules, 1), 200),
    CountedStage("rules, 4 rules, a sample", partial(_rules, 4), 200),
    CountedStage("bytes to publishers, a sample per read", partial(_path, 1), 1000),
    CountedStage("bytes to publishers, 20 samples per read", partial(_path, 20), 50, 20),
    CountedStage("CAN link to publishers, an IMU61x sample of 5 reads", _can_path, 100),
    CountedStage("daemon, 1 client, a sample per wake-up", partial(_daemon, 1, "binary", 1, 0), 1000),
    CountedStage("daemon, 1 client, disabled outputs, a sample per wake-up", _disabled, 1000),
    CountedStage("daemon, 10 binary clients, a sample per wake-up", partial(_daemon, 10, "binary", 1, 0), 200),
    CountedStage("daemon, 10 JSON clients, a sample per wake-up", partial(_daemon, 10, "json", 1, 0), 200),
    CountedStage("tick, 1 device, 1 client", _tick, QUIET_PERIOD_TICKS, 1),
    CountedStage("daemon, 1 client, 20 samples per wake-up", partial(_daemon, 1, "binary", 20, 0), 50, 20),
    CountedStage("daemon, 1 client, latency 10 ms", partial(_daemon, 1, "binary", 1, 10), 1000),
    CountedStage("daemon, 10 binary clients, latency 10 ms", partial(_daemon, 10, "binary", 1, 10), 1000),
)
