"""Complete output: choice of the device, times of sentences, axes, and a real gpsd as reader.
Ports: accepted sentences arrive complete, other sentences are dropped and counted, and no port waits."""

import asyncio
import json
import os
import shutil
import socket
import struct
import subprocess
import tty
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from math import nan, radians
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import msgspec
import pynmea2
import pytest
from pynmea2.types.proprietary.ash import ASHRATT

from imud.attitude.conventions import Convention, Heading
from imud.attitude.published import PublishedAxes, published_frame
from imud.contracts.publisher import AS_SENT, Batch
from imud.contracts.status import FrameStatus, OutputStatus
from imud.model.errors import ServerError
from imud.model.options import wrong_values
from imud.model.sample import Sample, Sync, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers import nmea0183, sentence_ports, vessel
from imud.publishers.sentence_ports import open_serial as open_real_port
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.publisher_context import FakeLatencies, publisher_context
from tests.support.socket_rig import device_status, in_context
from tests.support.surroundings import free_port

REFERENCE_NS = NS_PER_S
LIMIT_S = 60.0
NO_GPSD = "" if shutil.which("gpsd") else "gpsd is not installed (make bench-deps)"
GPSD_VERSION = "" if NO_GPSD else subprocess.check_output(["gpsd", "-V"], text=True).split()[1]
# Attitude in the axes of HiPNUC: right side down by 10°, bow up by 5°, heading 45°
LEFT_45: Vector3 = (radians(10), radians(5), radians(-45))


class OutputBench:
    def __init__(
        self, *, heading: Heading = Heading.TRUE, declination_deg: float | None = 3.0, **settings: object
    ) -> None:
        self.clock, self.asked = VirtualClock(), FakeLatencies()
        frame = FrameStatus("", "device", "", "", heading, declination_deg, {})
        statuses = [
            msgspec.structs.replace(device_status(name, n), frame=frame) for n, name in enumerate(("bow", "mast"))
        ]
        self.context = publisher_context(lambda: statuses, 1, self.clock.now_ns, latencies=self.asked)
        made = msgspec.convert({"tcp_port": 0, **settings}, nmea0183.Nmea0183Options)
        self.output = nmea0183.Nmea0183(made, self.context)
        self.output.start()
        self.output.add_device("bow", 0)
        self.seq = 0
        self.tick()

    def tick(self) -> None:
        self.clock.advance(REFERENCE_NS)
        self.output.tick(self.clock.now_ns())

    @property
    def port(self) -> int:
        return int(self.output.status()[0].name.rpartition(":")[2])

    def publish(
        self, count: int = 1, device: str = "bow", euler: Vector3 | None = LEFT_45, frame: PublishedAxes = AS_SENT,
        gyro_z: float = 0.0,
    ) -> None:  # fmt: skip
        """Publish samples at 1 kHz."""
        samples = []
        for _ in range(count):
            self.seq += 1
            t_ns = self.seq * NS_PER_MS
            samples.append(
                Sample(
                    device, self.seq, t_ns, 0, Sync.ARRIVAL, t_ns, NS_PER_S + t_ns, euler_rad=euler,
                    gyro_rad_s=(0.0, 0.0, gyro_z),
                )
            )  # fmt: skip
        self.output.publish(Batch(device, 0, samples, frame))

    async def connect(self) -> None:
        self.reader = socket.create_connection(("127.0.0.1", self.port), timeout=LIMIT_S)
        async with asyncio.timeout(LIMIT_S):
            while not self.output.status()[0].readers:
                await asyncio.sleep(0)

    def received(self) -> list[str]:
        """Return the sentences that the client received, without their checksums. The checksums are checked."""
        sentences = self.reader.recv(65536).decode().splitlines()
        for one in sentences:
            pynmea2.parse(one, check=True)
        return [one.partition("*")[0].removeprefix("$") for one in sentences]


@asynccontextmanager
async def sending(**settings: Any) -> AsyncIterator[OutputBench]:
    bench = OutputBench(**settings)
    await bench.connect()
    yield bench
    bench.reader.close()
    bench.output.close()


def in_output(**settings: Any) -> Callable[[Callable[..., Awaitable[None]]], Callable[..., None]]:
    """Run a test in its own event loop. Its argument `bench` is an output with these options and one client."""
    return in_context("bench", lambda _folder: sending(**settings))


@in_output(sentences={"HDT": 10.0, "ROT": 4.0})
async def test_each_sentence_has_its_own_rate(bench: OutputBench) -> None:
    for _ in range(100):
        bench.publish(10)
    got = bench.received()
    assert (got.count("HCHDT,45.0,T"), got.count("TIROT,0.0,A"), len(got)) == (10, 4, 14)


@in_loop
async def test_each_udp_address_gets_the_sentences() -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as one, socket.socket(type=socket.SOCK_DGRAM) as two:
        for receiver in (one, two):
            receiver.bind(("127.0.0.1", 0))
            receiver.settimeout(LIMIT_S)
        ports = [receiver.getsockname()[1] for receiver in (one, two)]
        udp = [f"127.0.0.1:{port}" for port in ports]
        bench = OutputBench(sentences={"HDT": 1.0}, udp=udp, serial_port="/dev/none")
        assert bench.output.status()[-1].name == "serial /dev/none"
        bench.publish()
        assert [receiver.recv(100)[:14] for receiver in (one, two)] == [b"$HCHDT,45.0,T*"] * 2
        bench.output.close()


@pytest.mark.parametrize("convention", [None, *Convention])
@in_output(sentences={"PASHR": 1.0, "HDG": 1.0, "XDR": 1.0, "ROT": 1.0})
async def test_values_use_ship_axes_for_all_device_axes(bench: OutputBench, convention: Convention | None) -> None:
    frame = published_frame(None, convention, None, AS_SENT.device)
    euler, gyro_z = LEFT_45, radians(-2.0)
    if frame.rotation is not None:
        as_sent = Sample("bow", 1, 0, 0, Sync.ARRIVAL, 0, 0, euler_rad=euler, gyro_rad_s=(0.0, 0.0, gyro_z))
        turned = frame.rotation.sample(as_sent)
        assert turned.euler_rad is not None
        assert turned.gyro_rad_s is not None
        euler, gyro_z = turned.euler_rad, turned.gyro_rad_s[2]
    bench.publish(euler=euler, frame=frame, gyro_z=gyro_z)
    got = bench.received()
    assert got[:2] == ["PASHR,000001.001,45.00,T,+10.00,+5.00,,,,,0,0", "HCHDG,42.0,,,3.0,E"]
    rate_deg_min = float(got[3].split(",")[1])
    assert 115 < rate_deg_min < 122  # 2° per second to starboard about the body's z axis


@in_output(sentences={"PASHR": 1.0})
async def test_pynmea2_reads_the_attitude_of_pashr(bench: OutputBench) -> None:
    bench.publish()
    bench.publish(1000, euler=(radians(-20.5), radians(-7.25), radians(100.0)))
    first, second = (pynmea2.parse(line, check=True) for line in bench.reader.recv(65536).decode().splitlines())
    for found, heading, roll, pitch in ((first, 45.0, 10.0, 5.0), (second, 260.0, -20.5, -7.25)):
        assert isinstance(found, ASHRATT)
        assert (found.true_heading, found.is_true_heading) == (heading, "T")
        assert (found.roll, found.pitch) == (roll, pitch)


@in_output(sentences={"HDT": 1.0, "PASHR": 1.0, "ROT": 1.0, "XDR": 1.0})
async def test_values_that_do_not_fit_are_counted(bench: OutputBench, caplog: pytest.LogCaptureFixture) -> None:
    bench.publish(gyro_z=-1e90)
    assert (len(bench.received()), [status.dropped for status in bench.output.status()]) == (3, [1])
    assert "cannot make a ROT sentence: expected a sentence of at most 82 bytes" in caplog.text
    bench.publish(1000)
    assert len(bench.received()) == 4


@in_output(sentences={"ROT": 10.0})
async def test_the_rate_of_turn_is_the_mean_since_the_previous_sentence(bench: OutputBench) -> None:
    bench.publish(1, euler=(0.0, 0.0, 0.0))
    for number in range(100):  # vibration of 500 Hz and a turn of 1° per second to starboard
        bench.publish(1, euler=(0.0, 0.0, 0.0), gyro_z=radians(-1.0 + (20.0 if number % 2 else -20.0)))
    assert bench.received() == ["TIROT,0.0,A", "TIROT,60.0,A"]


@in_output(heading=Heading.RELATIVE, declination_deg=None, sentences={"HDT": 100.0})
async def test_the_heading_reference_is_read_again(bench: OutputBench) -> None:
    bench.publish()
    statuses = bench.context.devices.status()
    known = FrameStatus("", "device", "", "", Heading.TRUE, None, {})
    statuses[0] = msgspec.structs.replace(statuses[0], frame=known)  # type: ignore[index]  # it is a list
    bench.output.tick(bench.clock.now_ns())  # the next read is not due
    bench.publish(20)
    bench.tick()
    bench.publish(20)
    statuses[0] = msgspec.structs.replace(statuses[0], frame=None)  # type: ignore[index]
    bench.tick()
    bench.publish(20)
    assert bench.received() == ["HCHDT,45.0,T"] * 2


@in_loop
async def test_the_only_device_or_the_configured_device_is_used(caplog: pytest.LogCaptureFixture) -> None:
    bench = OutputBench(sentences={"HDT": 100.0})
    assert bench.asked.asked == {nmea0183.WHO: (10 * NS_PER_MS, ("bow",))}
    bench.output.add_device("mast", 1)
    assert (bench.asked.asked, [*bench.context.outputs.ports]) == ({}, ["nmea0183"])
    assert "nmea0183.device: expected the name of one device (bow, mast), got none" in caplog.text
    bench.output.remove_device("bow")
    assert bench.asked.asked == {nmea0183.WHO: (10 * NS_PER_MS, ("mast",))}
    bench.output.close()
    assert (bench.asked.asked, bench.context.outputs.ports) == ({}, {})
    named = OutputBench(device="mast", sentences={"HDT": 100.0})
    assert named.asked.asked == {}
    named.output.add_device("mast", 1)
    named.tick()
    await named.connect()
    named.publish(euler=(0.0, 0.0, 0.0))
    named.publish(device="mast")
    assert named.received() == ["HCHDT,45.0,T"]
    named.reader.close()
    named.output.close()


# --- settings -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"udp": ["plotter:10110"]}, "expected IP address and port such as"),
        ({"udp": ["192.168.1.255"]}, "expected IP address and port such as"),
        ({"udp": ["192.168.1.255:0"]}, "expected IP address and port such as"),
        ({"udp": ["192.168.1.255:65536"]}, "expected IP address and port such as"),
        ({"udp": ["fe80::1:10110"]}, "expected IP address and port such as"),
        ({"tcp_address": "boat"}, "expected an IP address"), ({"sentences": {}}, "expected at least one sentence"),
        ({"sentences": {"GGA": 1}}, "keys HDG, HDM, HDT, PASHR, ROT, XDR"),
        ({"sentences": {"HDT": 0}}, "a number from 0.01 to 100"), ({"talker": "ii"}, "two capital letters"),
        ({"serial_port": "/dev/ttyS0", "serial_baud": 4800}, "480 bytes per second at 4800 bit/s, got 844"),
    ],
)  # fmt: skip
def test_invalid_options_are_rejected(given: dict[str, object], words: str) -> None:
    assert words in "; ".join(map(str, wrong_values(nmea0183.Nmea0183Options, given)))


def test_addresses_and_a_full_serial_port() -> None:
    assert nmea0183.address_of("192.168.1.255:65535") == ("192.168.1.255", 65535)
    assert nmea0183.address_of("[fe80::1]:2000") == ("fe80::1", 2000)
    full = {"serial_port": "/dev/ttyS0", "serial_baud": 4800, "sentences": {"HDT": 21, "HDG": 3}}  # 19 and 27 bytes
    assert not wrong_values(nmea0183.Nmea0183Options, full)


@pytest.mark.parametrize("kind", nmea0183.Formatter)
def test_usual_bytes_covers_full_sentences_and_empty_samples_make_none(kind: nmea0183.Formatter) -> None:
    full = Sample(
        "bow", 1, 0, 0, Sync.ARRIVAL, 0, NS_PER_S, euler_rad=(radians(-80), radians(-80), radians(211.5)),
        gyro_rad_s=(0.0, 0.0, radians(-0.3)), temperature_c=23.4, pressure_pa=101_325.0,
    )  # fmt: skip
    made = nmea0183.make(kind, full, vessel.HeadingReference(Heading.TRUE, 12.6))
    assert made is not None
    assert 0 <= nmea0183.USUAL_BYTES[kind] - len(made) <= 8
    assert nmea0183.make(kind, sample(euler_deg=None), CORRECTED) is None


# --- independent reader -----------------------------------------------------------------------------------------------


@contextmanager
def gpsd(port: int, source: str) -> Iterator[None]:
    process = subprocess.Popen(["gpsd", "-N", "-n", "-b", "-S", str(port), source], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait(timeout=LIMIT_S)


async def reports(port: int, bench: OutputBench, enough: int) -> tuple[list[dict[str, object]], set[str]]:
    """Return the attitude reports of gpsd, and the sentences that its parser accepted, including the checksum."""
    async with asyncio.timeout(LIMIT_S):
        while True:
            try:
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                break
            except ConnectionRefusedError:
                await asyncio.sleep(0.05)
        writer.write(b'?WATCH={"enable":true,"json":true,"raw":1};\n')
        found: list[dict[str, object]] = []
        taken: set[str] = set()
        line = asyncio.ensure_future(reader.readline())
        while len(found) < enough:
            bench.publish(100, gyro_z=radians(-2.0))
            done, _ = await asyncio.wait([line], timeout=0.05)
            if done:
                text = line.result().decode()
                if text.startswith("$"):
                    taken.add(text.partition(",")[0])
                elif (report := json.loads(text))["class"] == "ATT":
                    found.append(report)
                line = asyncio.ensure_future(reader.readline())
        line.cancel()
        writer.close()
        await writer.wait_closed()
    return found, taken


@pytest.mark.live
@pytest.mark.skipif(bool(NO_GPSD), reason=NO_GPSD)
@in_loop
async def test_gpsd_accepts_all_sentences_and_reports_their_values() -> None:
    """The bow turns to starboard at 2° per second, right side down by 10°, bow up by 5°.

    gpsd 3.22 reports only the heading. The test checks signs and units of all other values that a newer gpsd reports.
    """
    bench = OutputBench(sentences={"HDT": 10.0, "HDG": 10.0, "ROT": 10.0, "XDR": 2.0, "PASHR": 10.0})
    port = free_port()
    with gpsd(port, f"tcp://127.0.0.1:{bench.port}"):
        found, taken = await reports(port, bench, 8)
    bench.output.close()
    assert taken == {"$HCHDT", "$HCHDG", "$TIROT", "$YXXDR", "$PASHR"}
    for report in found:
        assert (report["heading"], report.get("roll", 10.0), report.get("pitch", 5.0)) == (45.0, 10.0, 5.0)
        assert report.get("rot", 118.6) == pytest.approx(118.6, abs=0.1)
    if GPSD_VERSION == "3.22":
        assert {name for report in found for name in report} == {"class", "device", "heading"}


MAGNETIC = vessel.HeadingReference(Heading.MAGNETIC)
CORRECTED = vessel.HeadingReference(Heading.TRUE, 3.0)
TRUE = vessel.HeadingReference(Heading.TRUE)


def sample(
    euler_deg: Vector3 | None = (1.0, -2.0, 45.0), gyro_deg_s: Vector3 | None = None,
    temperature_c: float | None = None, pressure_pa: float | None = None,
) -> Sample:  # fmt: skip
    euler = None if euler_deg is None else (radians(euler_deg[0]), radians(euler_deg[1]), radians(euler_deg[2]))
    gyro = None if gyro_deg_s is None else (radians(gyro_deg_s[0]), radians(gyro_deg_s[1]), radians(gyro_deg_s[2]))
    return Sample(
        "bow", 1, 0, 0, Sync.ARRIVAL, 0, 0, euler_rad=euler, gyro_rad_s=gyro, temperature_c=temperature_c,
        pressure_pa=pressure_pa,
    )  # fmt: skip


def body(kind: nmea0183.Formatter, one: Sample, reference: vessel.HeadingReference, talker: str = "") -> str | None:
    """Return the text between `$` and `*`."""
    made = nmea0183.make(kind, one, reference, talker)
    return None if made is None else made.decode().removeprefix("$").partition("*")[0]


@pytest.mark.parametrize(
    ("reference", "sentences"),
    [
        (MAGNETIC, (None, "HCHDG,45.0,,,,", "HCHDM,45.0,M")),
        (CORRECTED, ("HCHDT,45.0,T", "HCHDG,42.0,,,3.0,E", "HCHDM,42.0,M")),
        (TRUE, ("HCHDT,45.0,T", None, None)),  # a true heading from the device has no magnetic heading
        (vessel.HeadingReference(Heading.RELATIVE), (None, None, None)),  # relative to the direction at power-on
        (vessel.HeadingReference(Heading.UNKNOWN), (None, None, None)),
    ],
)
def test_a_heading_has_its_reference(reference: vessel.HeadingReference, sentences: tuple[str | None, ...]) -> None:
    kinds = (nmea0183.Formatter.HDT, nmea0183.Formatter.HDG, nmea0183.Formatter.HDM)
    assert tuple(body(kind, sample(), reference) for kind in kinds) == sentences
    if sentences == (None, None, None):
        assert body(nmea0183.Formatter.PASHR, sample(), reference) == "PASHR,000000.000,,T,+1.00,-2.00,,,,,0,0"


def test_roll_pitch_temperature_pressure_and_the_talker() -> None:
    one = sample(temperature_c=23.44, pressure_pa=101_325.0)
    assert (
        body(nmea0183.Formatter.XDR, one, MAGNETIC)
        == "YXXDR,A,-2.00,D,PTCH,A,1.00,D,ROLL,C,23.4,C,TEMP,P,1.01325,B,BARO"
    )
    assert body(nmea0183.Formatter.XDR, sample(euler_deg=(nan, 1, 2), temperature_c=nan), MAGNETIC) is None
    assert body(nmea0183.Formatter.XDR, sample(euler_deg=None), MAGNETIC) is None
    assert body(nmea0183.Formatter.HDT, sample(), TRUE, "II") == "IIHDT,45.0,T"
    assert str(body(nmea0183.Formatter.PASHR, sample(), TRUE, "II")).startswith("PASHR,")


def test_the_rate_of_turn_in_a_sentence() -> None:
    assert body(nmea0183.Formatter.ROT, sample((0, 0, 0), (0, 0, 1.5)), MAGNETIC) == "TIROT,90.0,A"


CLIENTS_MAX, RETRY_FIRST_NS, STUCK_NS = 32, NS_PER_S, 30 * NS_PER_S
ONE = b"$HEHDT,98.3,T*2F\r\n"
BUSY = b"$" + b"x" * 60_000 + b"\r\n"


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(LIMIT_S):
        while not condition():
            await asyncio.sleep(0)


class Server(sentence_ports.TcpOutput):
    def __init__(self) -> None:
        self.clock, self.clients = VirtualClock(), list[socket.socket]()
        super().__init__("127.0.0.1", 0, self.clock.now_ns)
        self.open()

    def connect(self) -> socket.socket:
        self.clients.append(socket.create_connection(("127.0.0.1", self.port), timeout=LIMIT_S))
        return self.clients[-1]

    async def connected(self) -> socket.socket:
        before, sock = self.status().readers, self.connect()
        await until(lambda: self.status().readers == before + 1)
        return sock


@asynccontextmanager
async def serving(_folder: Path) -> AsyncIterator[Server]:
    made = Server()
    yield made
    for client in made.clients:
        client.close()
    made.close()
    made.close()


@in_context("made", serving)
async def test_every_client_gets_every_sentence(made: Server) -> None:
    first, second = await made.connected(), await made.connected()
    made.put(ONE * 2)
    assert first.recv(100) == second.recv(100) == ONE * 2
    assert (made.status().sent, made.status().dropped) == (4, 0)
    (number, client), *_ = made._clients.items()
    first.shutdown(socket.SHUT_WR)  # kplex direction=in, ncat </dev/null
    await until(lambda: client.is_half_closed)
    assert not asyncio.get_running_loop().remove_reader(number), "imud does not watch the readable socket"
    second.close()

    def is_alone() -> bool:
        made.put(ONE)
        return made.status().readers == 1

    await until(is_alone)
    first.recv(10_000)
    for _ in range(5):
        made.put(ONE)
        assert first.recv(100) == ONE
    assert made.status().readers == 1
    with pytest.raises(ServerError, match=r"nmea0183\.tcp_port"):
        sentence_ports.TcpOutput("127.0.0.1", made.port, VirtualClock().now_ns).open()


@in_context("made", serving)
async def test_data_from_a_client_is_ignored_and_an_idle_client_stays_connected(made: Server) -> None:
    client = await made.connected()
    client.sendall(b"?WATCH={}\r\n" * 1000)
    for _ in range(20):
        await asyncio.sleep(0)
    made.put(ONE)
    assert client.recv(100) == ONE
    made.clock.advance(100 * STUCK_NS)  # a missing device, or a sentence with 0.01 Hz
    made.tick(made.clock.now_ns())
    assert made.status().readers == 1
    made.put(ONE)
    assert client.recv(100) == ONE
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()  # a reset
    await until(lambda: made.status().readers == 0)


@in_context("made", serving)
async def test_without_descriptors_the_server_pauses(made: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    assert made._listener is not None
    full, later, loop = Mock(wraps=made._listener), Mock(), asyncio.get_running_loop()
    full.accept = Mock(side_effect=OSError(24, "Too many open files"))
    with monkeypatch.context() as patch:
        patch.setattr(loop, "call_later", later)
        made._accept(full)
    later.assert_called_once_with(1.0, made._listen_again)
    assert not loop.remove_reader(made._listener), "a full server does not watch the listener"
    made._listen_again()
    await made.connected()
    made.close()
    made._listen_again()


@in_context("made", serving)
async def test_a_client_that_does_not_read_loses_complete_sentences_and_is_disconnected(made: Server) -> None:
    client = await made.connected()
    for _ in range(200):
        made.put(BUSY)
    status = made.status()
    assert status.dropped > 100
    assert status.sent + status.dropped == 200
    got = bytearray()
    client.settimeout(0)
    while len(got) < status.sent * len(BUSY):  # the rest of a partly sent sentence precedes the next sentence
        made.put(b"")
        try:
            got += client.recv(1 << 20)
        except BlockingIOError:
            await asyncio.sleep(0)
    assert bytes(got) == BUSY * status.sent
    for _ in range(200):
        made.put(BUSY)
    made.clock.advance(10 * NS_PER_S - 1)
    assert (made.status().readers, made.status().problem) == (1, "")
    made.clock.advance(1)
    status = made.status()
    assert status.readers == 0
    assert "has not read for 10 s" in status.problem
    made.clock.advance(STUCK_NS - 10 * NS_PER_S)
    made.tick(made.clock.now_ns())
    assert "has not read for 30 s" in made.status().problem
    made.clock.advance(1)
    made.tick(made.clock.now_ns())
    assert (made.status().readers, made.status().problem) == (0, "")


def test_the_rest_of_a_sentence_precedes_the_next_sentence() -> None:
    send = Mock(side_effect=lambda data: min(len(data), 5))
    client = sentence_ports.TcpClient(Mock(send=send), "")
    assert [client.put(ONE, 0) for _ in range(8)] == [True, False, False, True, False, False, True, False]
    assert b"".join(one.args[0][:5] for one in send.mock_calls).startswith(ONE * 2)


@in_context("made", serving)
async def test_clients_above_the_limit_are_rejected(made: Server) -> None:
    for _ in range(CLIENTS_MAX):
        await made.connected()
    one_more = made.connect()
    one_more.setblocking(False)
    closed: list[bytes] = []

    def is_closed() -> bool:
        try:
            closed.append(one_more.recv(1))
        except BlockingIOError:
            return False
        return True

    await until(is_closed)
    assert (closed, made.status().readers) == ([b""], CLIENTS_MAX)
    made.clients[3].shutdown(socket.SHUT_WR)
    for _ in range(10):
        await asyncio.sleep(0)
    made.connect()  # in place of the client that can be closed
    made.clients[3].setblocking(False)
    one_more = made.clients[3]
    await until(is_closed)
    assert made.status().readers == CLIENTS_MAX


@pytest.mark.parametrize("address", ["127.0.0.1", "127.255.255.255"])
def test_datagrams_to_a_host_and_to_all(address: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind((address, 0))
        receiver.settimeout(LIMIT_S)
        made = sentence_ports.UdpOutput(address, receiver.getsockname()[1])
        made.put(ONE * 3)
        assert receiver.recv(1000) == ONE * 3
        assert (made.status().sent, made.status().dropped, made.status().readers) == (3, 0, 1)
        made.close()


def test_datagrams_without_a_route_are_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    made = sentence_ports.UdpOutput("127.0.0.1", 9)
    for dropped in (1, 2):
        made.put(ONE + b"x" * 70_000)  # longer than the maximum of a datagram
        assert (made.status().dropped, made.status().readers) == (dropped, 0)
        assert "too long" in made.status().problem
        assert len(caplog.records) == 1
    made.close()


class Port:
    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def close(self) -> None:
        os.close(self.master)
        os.close(self.slave)


@in_loop
async def test_the_pause_between_attempts_to_open_a_port_grows_to_30_s() -> None:
    clock, tried_s = VirtualClock(), list[float]()

    def fail(_port: str, _baud: int) -> int:
        tried_s.append(clock.now_ns() / NS_PER_S)
        raise FileNotFoundError(2, "No such file or directory")

    made = sentence_ports.SerialOutput("/dev/ttyUSB9", 38400, clock.now_ns, fail)
    begin_s = clock.now_ns() / NS_PER_S
    for _ in range(100):
        made.tick(clock.now_ns())
        await until(lambda: made._opening is None)
        clock.advance(NS_PER_S)
    assert [t_s - begin_s for t_s in tried_s] == [0, 1, 3, 7, 15, 31, 61, 91]


@in_loop
async def test_a_lost_serial_port_is_opened_again() -> None:
    clock, ports = VirtualClock(), [Port(), Port()]
    tried: list[int] = []

    def open_port(_port: str, baud: int) -> int:
        tried.append(baud)
        if len(tried) == 1:
            raise FileNotFoundError(2, "No such file or directory")
        return open_real_port(ports[0].path, baud)

    made = sentence_ports.SerialOutput("/dev/ttyUSB9", 38400, clock.now_ns, open_port)
    made.put(ONE)
    made.tick(clock.now_ns())
    await until(lambda: made.status().problem == "No such file or directory")
    made.tick(clock.now_ns())
    assert len(tried) == 1  # the attempt is not due
    clock.advance(RETRY_FIRST_NS)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    made.put(ONE)
    assert os.read(ports[0].master, 100) == ONE
    ports[0].close()
    made.put(ONE)
    assert made.status().readers == 0
    ports.pop(0)
    clock.advance(2 * RETRY_FIRST_NS)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    made.put(ONE)
    assert os.read(ports[0].master, 100) == ONE
    assert made.status() == OutputStatus("serial /dev/ttyUSB9", 2, 2, 1, "")
    assert tried == [38400] * 3
    made.close()
    made.close()
    ports[0].close()


@in_loop
async def test_a_serial_port_finishes_a_sentence_before_the_next() -> None:
    clock, (reader, writer) = VirtualClock(), os.pipe2(os.O_NONBLOCK)
    made = sentence_ports.SerialOutput("/dev/ttyUSB9", 4800, clock.now_ns, lambda *_: writer)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    made.put(2 * BUSY)  # a pipe has room for 65,536 bytes
    data, written, puts = b"", 2, 0
    while len(data) < len(2 * BUSY):
        data += os.read(reader, 4096)
        made.put(ONE)
        puts += 1
    with suppress(BlockingIOError):
        data += os.read(reader, 65_536)
    written += data.count(ONE)
    assert data == 2 * BUSY + data.count(ONE) * ONE
    assert (made.status().sent, made.status().dropped) == (written, puts - data.count(ONE))
    made.close()
    os.close(reader)


@in_loop
async def test_a_full_serial_port_drops_complete_sentences() -> None:
    clock, port = VirtualClock(), Port()
    made = sentence_ports.SerialOutput(port.path, 4800, clock.now_ns)
    made.tick(clock.now_ns())
    await until(lambda: made.status().readers == 1)
    sentence = b"$" + b"y" * 60 + b"\r\n"
    for _ in range(5000):
        made.put(sentence)
    status = made.status()
    assert status.dropped > 0
    got = bytearray()
    while len(got) < status.sent * len(sentence):
        got += os.read(port.master, 1 << 16)
        made.put(b"")
    assert bytes(got) == sentence * status.sent
    made.close()
    port.close()


@in_loop
async def test_a_port_opened_after_the_end_is_closed() -> None:
    clock, port = VirtualClock(), Port()
    fds: list[int] = []

    def open_port(path: str, baud: int) -> int:
        fds.append(open_real_port(path, baud))
        return fds[0]

    made = sentence_ports.SerialOutput(port.path, 4800, clock.now_ns, open_port)
    made.tick(clock.now_ns())
    made.close()

    def is_closed() -> bool:
        if not fds:
            return False
        try:
            os.fstat(fds[0])
        except OSError:
            return True
        return False

    await until(is_closed)
    port.close()
