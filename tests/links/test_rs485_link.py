"""An RS-485 bus on a real pty: a shared port, echoes, silence, late and foreign replies, and an unplugged cable.
The Modbus code with pymodbus: pymodbus as devices for imud's driver, and as master of imud's simulator.

A pymodbus server has its own pseudo-terminal. A thread moves bytes between this terminal and the terminal of imud.
"""

import asyncio
import errno
import fcntl
import os
import select
import struct
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock

import msgspec
import pytest
from pymodbus.client import ModbusSerialClient
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice

from imud.contracts.codec import Vanished
from imud.contracts.script import Transfer, run_transfer_script
from imud.contracts.setting import combined
from imud.contracts.status import KernelCounters, SerialLineCounters
from imud.drivers.hipnuc.common import AttitudeMode
from imud.drivers.hipnuc.modbus.codec import READ_BLOCK, READ_SHORT_BLOCK, HipnucModbusCodec, HipnucModbusOptions
from imud.drivers.hipnuc.modbus.commands import LineMounting, set_heading_mode, set_mounting
from imud.drivers.hipnuc.modbus.driver import DRIVER
from imud.drivers.hipnuc.modbus.registers import pack_identity, read_registers, set_id_by_serial, write_register
from imud.formats.modbus import framed, is_exception, is_whole
from imud.links import rs485
from imud.links.device_node import DeviceNode
from imud.links.serial_port import TtyCounters, open_port
from imud.model.errors import LinkBusy, LinkError, LinkMissing, TransferError, Trouble
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import uart_byte_ns
from tests.drivers.hipnuc.modbus.test_codec import SENSORS
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.pty_port import BAUD, PtyPort, serial_of, slave, waiting_bytes, wired

SETTINGS = read_registers(4, 3)
SERIAL = read_registers(0x7F, 4)
PROC = Path("/proc")
TRIES = 2000

pytestmark = pytest.mark.live


@contextmanager
def opened(
    path: Path | str, ports: rs485.SharedPorts | None = None, address: int = 1, **more: Any
) -> Iterator[rs485.Rs485Link]:
    settings = {"line": str(path), "baud": BAUD, "reply_ms": 1000, **more}
    link = rs485.Rs485Link(msgspec.convert(settings, rs485.Rs485Options), ports=ports or rs485.SharedPorts())
    link.open()
    link.select(address)
    try:
        yield link
    finally:
        link.close()
        link.close()


def sure(link: rs485.Rs485Link, transfer: Transfer) -> bytes:
    for _ in range(TRIES):
        try:
            return link.transfer(transfer)
        except TransferError:
            pass
    raise AssertionError(f"no reply in {TRIES} tries")


def time_out(link: rs485.Rs485Link, transfer: Transfer) -> None:
    """Send requests until a reply arrives after its timeout. This thread may also be late."""
    for _ in range(TRIES):
        try:
            link.transfer(transfer)
        except TransferError:
            return
    raise AssertionError(f"no time-out in {TRIES} tries")


@pytest.fixture
def pty() -> Iterator[PtyPort]:
    port = PtyPort()
    yield port
    port.unplug()


@pytest.mark.parametrize("chunk_bytes", [0, 1])
def test_modules_of_a_line_share_its_port(tmp_path: Path, chunk_bytes: int) -> None:
    ports = rs485.SharedPorts()
    with (
        wired(tmp_path, slave(1), slave(2), chunk_bytes=chunk_bytes) as (path, _),
        opened(path, ports, 1) as one,
        opened(path, ports, 2) as two,
    ):
        assert one.bus == two.bus == str(path)
        assert one.transfer(SERIAL)[3:11] == serial_of(1)
        assert two.transfer(SERIAL)[3:11] == serial_of(2)
        assert one.transfer(write_register(6, 1))[1] == 6
        assert one.heard.echoed == 0, "an echo that does not arrive is not awaited"
        one.close()
        assert two.transfer(SERIAL)[3:11] == serial_of(2)
        with pytest.raises(LinkError, match="not open"):
            one.transfer(SERIAL)
        with pytest.raises(LinkBusy):
            open_port(str(path), BAUD, PROC)
        other: list[dict[str, Any]] = [{"baud": 9600}, {"echo": True}, {"direction": "none"}]
        for more, got in zip(other, (", got 921600 and 9600", "", ""), strict=True):
            with (
                pytest.raises(LinkError, match=f"the same {next(iter(more))} for all its devices{got}"),
                ExitStack() as s,
            ):
                s.enter_context(opened(path, ports, 3, **more))
        with opened(path, ports, 3):
            pass
        two.close()
        open_port(str(path), BAUD, PROC).close()


@pytest.mark.parametrize("setting", ["auto", True])
@pytest.mark.parametrize("chunk_bytes", [0, 3])
def test_adapter_that_echoes(tmp_path: Path, setting: str | bool, chunk_bytes: int) -> None:
    write = write_register(6, 1)
    with wired(tmp_path, slave(1), slave(2), echo=True, chunk_bytes=chunk_bytes) as (path, line):
        with opened(path, echo=setting) as link:
            assert link.transfer(write) == framed(1, write.sends[0])
            assert line.slaves[0].settings.heading_mode == 1
            assert link.transfer(SERIAL)[3:11] == serial_of(1)
            assert link.heard.strange == link.heard.late == 0
            assert link.serial_line().echoes == link.heard.echoed >= 2
        line.slaves[0].dead = True
        with opened(path, echo=setting, reply_ms=30) as link:
            link.select(2)
            assert sure(link, SERIAL)
            link.select(1)
            with pytest.raises(TransferError):
                link.transfer(write)  # the port receives only the echo


@contextmanager
def answered(pty: PtyPort, *replies: bytes) -> Iterator[list[bytes]]:
    """Send one of the replies after each request. Yield the received requests."""
    heard: list[bytes] = []

    def answer() -> None:
        for reply in replies:
            select.select([pty.master], [], [], LIMIT_S)
            heard.append(pty.received())
            pty.send(reply)

    far = threading.Thread(target=answer)
    far.start()
    try:
        yield heard
    finally:
        far.join(LIMIT_S)


def test_noise_before_the_first_echo_does_not_hide_that_there_are_echoes(pty: PtyPort) -> None:
    request, reply = framed(1, SERIAL.sends[0]), framed(1, b"\x03\x08" + serial_of(1))
    with answered(pty, b"\0" + request + reply, request + reply) as heard, opened(pty.path) as link:
        for number in range(2):
            assert link.transfer(SERIAL) == reply
            assert (link.heard.strange, link.heard.echoed) == (1 + len(request), number)
    assert heard == [request] * 2


def test_a_reply_can_be_an_exception_or_damaged(tmp_path: Path) -> None:
    twins = slave(2, serial=0x0F), slave(2, serial=0xF0)
    with wired(tmp_path, slave(1, bad_crc=1), *twins) as (path, _), opened(path) as link:
        damaged = link.transfer(SERIAL)
        assert len(damaged) == SERIAL.read_bytes
        assert not is_whole(damaged)
        assert is_whole(link.transfer(SERIAL))
        assert is_exception(link.transfer(read_registers(0x33, 4)))
        assert link.heard.timeouts == 0
        link.select(2)
        assert not is_whole(link.transfer(SERIAL)), "two devices of one address reply together"


def test_silent_module_costs_its_time_out_and_comes_back(tmp_path: Path) -> None:
    with wired(tmp_path, slave(1), slave(2, dead=True)) as (path, line), opened(path, reply_ms=5) as link:
        link.select(2)
        with pytest.raises(TransferError, match="no reply from address 2") as silent:
            link.transfer(SERIAL)
        assert silent.value.trouble is Trouble.DISTURBED
        link.select(1)
        assert sure(link, SERIAL)[3:11] == serial_of(1)
        line.slaves[1].dead = False
        link.select(2)
        assert sure(link, SERIAL)[3:11] == serial_of(2)
        assert link.heard.timeouts >= 1


def test_late_reply_is_never_taken_for_the_next(tmp_path: Path) -> None:
    """The late reply has the value 0. It arrives 100 ms after its timeout, during a request with the value 1."""
    late = slave(1)
    with wired(tmp_path, late, slave(2)) as (path, line), opened(path, reply_ms=1) as link:
        sure(link, SERIAL)
        late.processing_ns, line.requests = 100_000_000, 0
        time_out(link, SETTINGS)
        wait_until(lambda: line.requests, "the request is received")
        late.processing_ns, late.settings = 0, replace(late.settings, heading_mode=1)
        assert sure(link, SETTINGS)[3:9] == bytes.fromhex("0008 0001 0001")
        assert link.heard.strange + link.heard.late >= SETTINGS.read_bytes


def test_slow_devices_of_a_bus_reply_in_time(tmp_path: Path) -> None:
    """The first device gets 3 s. All devices then get twice the slowest reply."""
    slow = [slave(number, processing_ns=400_000_000) for number in (1, 2)]
    with wired(tmp_path, *slow) as (path, _), opened(path, reply_ms=20) as link:
        for number in (1, 2):
            link.select(number)
            assert link.transfer(SERIAL)[3:11] == serial_of(number)
        assert link.heard.timeouts == 0


def test_the_time_for_a_reply_follows_the_slowest_reply_and_the_round_of_a_search() -> None:
    times, ms = rs485.ReplyTimes(), 1_000_000
    assert [times.wait_ns(target, 20 * ms) for target in (80, 1, 80, 2)] == [3000 * ms, 20 * ms, 3000 * ms, 20 * ms]
    times.add_late(2)
    assert [times.wait_ns(target, 20 * ms) for target in (80, 1, 2)] == [3000 * ms, 20 * ms, 3000 * ms]
    times.add(80, 700 * ms)
    assert [times.wait_ns(target, 20 * ms) for target in (80, 1, 2)] == [1400 * ms, 1400 * ms, 3000 * ms]
    times.add(2, 2000 * ms)
    assert [times.wait_ns(target, 20 * ms) for target in (80, 1, 2)] == [1400 * ms, 3000 * ms, 3000 * ms]
    assert times.wait_ns(1, 5000 * ms) == 5000 * ms  # a request that writes the flash
    for fast, second_ms in ((80, 3000), (2, 20)):
        for _ in range(60):  # a stall of the host has a short effect
            times.add(fast, -ms)
        assert [times.wait_ns(target, 20 * ms) for target in (80, 2)] == [20 * ms, second_ms * ms]
    times = rs485.ReplyTimes()  # a fast round, then in each of 16 rounds one of 16 addresses gets 0.5 s
    rounds = [[times.wait_ns(target, 20 * ms) for target in (80, *range(1, 80))][1:] for _ in range(17)]
    assert set(rounds[0]) == {20 * ms}
    assert [sorted({one[at] for one in rounds}) for at in range(79)] == [[20 * ms, 500 * ms]] * 79
    assert max(sum(one) for one in rounds) <= 79 * 20 * ms + 5 * 480 * ms


def test_a_search_finds_a_device_by_its_late_reply(tmp_path: Path) -> None:
    """The device needs 0.7 s. The search asks the other addresses in the meantime."""
    with wired(tmp_path, slave(7, processing_ns=700_000_000)) as (path, _), opened(path, reply_ms=20) as link:
        found = []
        link.select(247)
        for target in (*range(1, 60), 7):
            link.select(target)
            with suppress(TransferError):
                found.append((target, link.transfer(SERIAL)[3:11]))
        assert found == [(7, serial_of(7))]
        assert link.heard.late + link.heard.strange >= SERIAL.read_bytes


def test_after_a_time_out_one_register_is_read_first_and_then_no_more(pty: PtyPort) -> None:
    """The reply to the single-register request has another length than the late reply, which has two registers."""
    one, value = read_registers(4, 1).sends[0], bytes.fromhex("03 02 0008")
    long, serial = SERIAL.sends[0], b"\x03\x08" + serial_of(1)
    script = [
        (long, b""), (bytes.fromhex("03 007f 0001"), bytes.fromhex("03 02 a000")), (long, serial), (long, serial),
        (one, b""), (bytes.fromhex("03 0004 0002"), bytes.fromhex("03 04 0008 0001")), (one, value), (one, value),
    ]  # fmt: skip
    replies = [reply and framed(1, reply) for _, reply in script]
    with answered(pty, *replies) as heard, opened(pty.path, reply_ms=500, echo=False) as link:
        for transfer, reply in ((SERIAL, serial), (read_registers(4, 1), value)):
            with pytest.raises(TransferError):
                link.transfer(transfer)
            for _ in range(2):
                assert link.transfer(transfer) == framed(1, reply)
    assert heard == [framed(1, request) for request, _ in script]


def test_unrequested_bytes_are_discarded_and_counted(pty: PtyPort) -> None:
    with opened(pty.path, reply_ms=1) as link:
        pty.send(framed(1, b"\x03\x08" + bytes(8)))
        wait_until(lambda: waiting_bytes(pty.slave) == 13, "the pty handed the bytes over")
        with pytest.raises(TransferError):
            link.transfer(SERIAL)
        assert link.serial_line() == SerialLineCounters(timeouts=1, late_bytes=13)
        select.select([pty.master], [], [], LIMIT_S)
        assert pty.received() == framed(1, SERIAL.sends[0])


def test_garbage_instead_of_a_reply_is_reported(pty: PtyPort) -> None:
    with answered(pty, b"\x81\x00\xfe" * 7), opened(pty.path) as link:
        with pytest.raises(TransferError, match=r"other bytes: 81 00 fe .* check the baud rate"):
            link.transfer(SERIAL)
        assert link.serial_line() == SerialLineCounters(timeouts=1, strange_bytes=21)


def test_request_to_all_expects_no_reply(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After it, imud waits for 100 ms ("MODBUS over Serial Line" 2.4.1) and the time of the request."""
    sleep, pauses_s = time.sleep, list[float]()

    def noted_sleep(seconds: float) -> None:
        pauses_s.append(seconds)
        sleep(seconds)

    monkeypatch.setattr(time, "sleep", noted_sleep)
    with wired(tmp_path, slave(1), slave(2), echo=True) as (path, line), opened(path) as link:
        link.select(0)
        request, begin_s = set_id_by_serial(serial_of(2).hex(), 33), time.monotonic()
        assert link.transfer(request) == b""
        pause_s = 0.1 + (len(request.sends[0]) + 3) * uart_byte_ns(BAUD) / 1e9
        assert max(pauses_s) <= pause_s <= time.monotonic() - begin_s
        wait_until(lambda: line.slaves[1].settings.slave == 33, "the module has its address")
        link.select(33)
        assert link.transfer(SERIAL)[3:11] == serial_of(2)


def test_cable_pulled_and_back(pty: PtyPort) -> None:
    ports, options = rs485.SharedPorts(), rs485.Rs485Options(line=pty.path, baud=BAUD, reply_ms=1)
    link_a, link_b = rs485.Rs485Link(options, ports=ports), rs485.Rs485Link(options, ports=ports)
    link_a.open()
    link_b.open()
    pty.unplug()
    for link in (link_a, link_b):
        link.select(1)
        with pytest.raises(LinkMissing):
            link.transfer(SERIAL)
    link_a.close()
    with pytest.raises(LinkError):  # the node does not exist: the link opens a new port instead of the shared old port
        link_a.open()
    link_b.close()


def test_missing_port_and_what_a_link_cannot_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = rs485.Rs485Link(rs485.Rs485Options(line=str(tmp_path / "none")))
    with pytest.raises(LinkMissing):
        link.open()
    with pytest.raises(LinkError):
        link.write(b"x")
    with pytest.raises(LinkError):
        link.transfer(SERIAL)
    assert (link.kernel_counters().overrun, link.place(80), link.target) == (0, "address 80", None)
    numbered = rs485.Rs485Link(rs485.Rs485Options(line="a", address=7))
    assert (numbered.target, numbered.bit_rate, numbered.rate_hz) == (7, 115_200, 0.0)
    assert rs485.Rs485Options(line="a") == rs485.Rs485Options(line="a", reply_ms=20)
    (tmp_path / "none").touch()
    asyncio.run(asyncio.wait_for(link.wait_present(), LIMIT_S))
    monkeypatch.setattr(DeviceNode, "wait_present", waits := AsyncMock())
    asyncio.run(link.wait_present())
    waits.assert_awaited_once_with()


def test_the_line_gets_the_longer_time_for_a_reply_and_has_the_counters_of_the_kernel(
    pty: PtyPort, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[int] = []
    monkeypatch.setattr(rs485.Rs485Line, "transfer", lambda *args: waits.append(args[-1]) or b"")  # type: ignore[func-returns-value]
    monkeypatch.setattr(TtyCounters, "read", lambda _counters: KernelCounters(overrun=3))
    with opened(pty.path, reply_ms=30) as link:
        for reply_ms in (29, 31):
            link.transfer(replace(SERIAL, reply_ms=reply_ms))
        assert waits == [30_000_000, 31_000_000]
        assert link.kernel_counters() == KernelCounters(overrun=3)


class Driver:
    """The RS-485 ioctls of a serial driver."""

    def __init__(self, flags: int, error: int = 0) -> None:
        self.flags, self.error = flags, error
        self.set: list[int] = []

    def ioctl(self, _fd: int, request: int, data: bytes) -> bytes:
        if self.error:
            raise OSError(self.error, os.strerror(self.error))
        if request == rs485.TIOCSRS485:
            self.flags = struct.unpack("8I", data)[0]
            self.set.append(self.flags)
        else:
            assert request == rs485.TIOCGRS485
        return struct.pack("8I", self.flags, *[0] * 7)


def test_direction_by_the_kernel(monkeypatch: pytest.MonkeyPatch, pty: PtyPort) -> None:
    driver, real, requests = Driver(0), fcntl.ioctl, (rs485.TIOCGRS485, rs485.TIOCSRS485)
    monkeypatch.setattr(fcntl, "ioctl", driver.ioctl)
    direction = rs485.Direction(3, "x", required=True)
    assert direction.by_kernel
    direction.restore()
    direction.restore()
    assert driver.set == [rs485.ENABLED | rs485.RTS_ON_SEND, 0]
    monkeypatch.setattr(fcntl, "ioctl", lambda *a: driver.ioctl(*a) if a[1] in requests else real(*a))
    with opened(pty.path):
        assert driver.set[2:] == [rs485.ENABLED | rs485.RTS_ON_SEND]
    assert driver.set[3:] == [0], "the link leaves the port as it was"
    driver = Driver(rs485.ENABLED)
    monkeypatch.setattr(fcntl, "ioctl", driver.ioctl)
    direction = rs485.Direction(3, "x", required=False)
    direction.restore()
    assert direction.by_kernel
    assert driver.set == []


def test_direction_that_the_kernel_cannot_switch(monkeypatch: pytest.MonkeyPatch, pty: PtyPort) -> None:
    for number in (errno.ENOTTY, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
        monkeypatch.setattr(fcntl, "ioctl", Driver(0, number).ioctl)
        assert not rs485.Direction(3, "x", required=False).by_kernel
        with pytest.raises(LinkError, match="direction: none"):
            rs485.Direction(3, "x", required=True)
    monkeypatch.setattr(fcntl, "ioctl", Driver(0, errno.EIO).ioctl)
    with pytest.raises(LinkError):
        rs485.Direction(3, "x", required=False)
    monkeypatch.undo()
    before, ports = len(os.listdir("/proc/self/fd")), rs485.SharedPorts()
    link = rs485.Rs485Link(rs485.Rs485Options(line=pty.path, baud=BAUD, direction="kernel"), ports=ports)
    with pytest.raises(LinkError, match="direction: none") as caught:
        link.open()
    assert len(os.listdir("/proc/self/fd")) == before, f"{caught} keeps the port object: only close() releases it"
    with opened(pty.path, ports, direction="none"):
        pass


UPTIME = (0x0001, 0x2345)


def words(data: bytes) -> list[int]:
    return [int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2)]


def registers(start: int, values: Sequence[int], *, readonly: bool = False) -> SimData:
    return SimData(start, values=list(values), datatype=DataType.REGISTERS, readonly=readonly)


def device(address: int, *, new: bool) -> SimDevice:
    block = [*words(SENSORS[3:-2]), *(UPTIME if new else ())]
    identity = words(pack_identity("HI14R2N-485-000", 169 if new else 152, 107, serial_of(address)))
    return SimDevice(
        address,
        [
            registers(0, [0, 0, 0, 0, 8, address, 0]), registers(0x34, block, readonly=True),
            registers(0x70, identity, readonly=True), registers(0xA5, [0, 0]),
        ],
    )  # fmt: skip


@contextmanager
def carried(one: PtyPort, other: PtyPort) -> Iterator[None]:
    ended = threading.Event()

    def carry() -> None:
        while not ended.is_set():
            for fd in select.select([one.master, other.master], [], [], 0.02)[0]:
                with suppress(OSError):
                    os.write(other.master if fd == one.master else one.master, os.read(fd, 4096))

    thread = threading.Thread(target=carry)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(LIMIT_S)


@contextmanager
def served(*devices: SimDevice) -> Iterator[str]:
    """Yield the path of a bus. A pymodbus server simulates these devices on it."""
    ours, theirs = PtyPort(), PtyPort()
    ready, loop = threading.Event(), asyncio.new_event_loop()
    servers: list[Any] = []

    async def serve() -> None:
        server = ModbusSerialServer(
            list(devices), port=theirs.path, baudrate=BAUD, timeout=1, ignore_missing_devices=True
        )
        servers.append(server)
        await server.serve_forever(background=True)
        ready.set()
        await server.serving

    def run() -> None:
        with suppress(asyncio.CancelledError):
            loop.run_until_complete(serve())
        loop.run_until_complete(loop.shutdown_asyncgens())
        loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert ready.wait(LIMIT_S)
        with carried(ours, theirs):
            yield ours.path
    finally:
        asyncio.run_coroutine_threadsafe(servers[0].shutdown(), loop)
        thread.join(LIMIT_S)
        ours.unplug()
        theirs.unplug()


def test_pymodbus_server_as_modules_under_our_driver() -> None:
    settings = HipnucModbusOptions()
    with served(device(1, new=False), device(80, new=True)) as path, opened(path) as link:
        for address, firmware in ((80, "1.6.9"), (1, "1.5.2")):
            link.select(address)
            identity = run_transfer_script(DRIVER.probe(settings), link.transfer)
            assert (identity.product, identity.firmware) == ("HI14R2N-485-000", firmware)
            assert identity.serial_number == serial_of(address).hex().upper()
            found = combined(run_transfer_script(DRIVER.set_up(settings), link.transfer)).words
            assert found == {"baud": "921600", "id": str(address), "heading_mode": "six axes"}
            codec = HipnucModbusCodec(Ledger(), settings)
            if address == 1:
                (event,) = codec.decode(0, link.transfer(codec.polls[0].transfer))
                assert isinstance(event, Vanished)
            assert codec.polls[0].transfer == (READ_SHORT_BLOCK if address == 1 else READ_BLOCK)
            (event,) = codec.decode(0, link.transfer(codec.polls[0].transfer))
            assert isinstance(event, Measurement)
            assert event.euler_rad == pytest.approx((0.151896, 0.571735, -2.913600), abs=1e-6)
            assert event.dev_ticks == (None if address == 1 else 74_565)
            assert codec.decode(1, link.transfer(codec.polls[1].transfer)) == ()
            run_transfer_script(set_heading_mode(AttitudeMode.NINE_AXIS), link.transfer)
            run_transfer_script(set_mounting(LineMounting.Y_UP), link.transfer)
            words = combined(run_transfer_script(DRIVER.set_up(settings), link.transfer)).words
            assert words["heading_mode"] == "nine axes"
            assert link.heard.strange == link.heard.late == link.heard.timeouts == 0


def test_pymodbus_client_on_our_simulator(tmp_path: Path) -> None:
    with wired(tmp_path, slave(1), slave(2, firmware=152)) as (path, line):
        client = ModbusSerialClient(str(path), baudrate=BAUD, timeout=LIMIT_S, retries=0)
        assert client.connect()
        try:
            block = client.read_holding_registers(0x34, count=26, device_id=1)
            assert not block.isError()
            assert len(block.registers) == 26
            assert 700 < block.registers[2] < 2700  # about 1 G on the upward axis, 2048 counts
            refused = client.read_holding_registers(0x34, count=26, device_id=2)
            assert refused.isError()
            assert refused.exception_code == 2
            assert len(client.read_holding_registers(0x34, count=24, device_id=2).registers) == 24
            name = client.read_holding_registers(0x70, count=8, device_id=2).registers
            assert b"".join(word.to_bytes(2, "big") for word in name).rstrip(b"\0") == b"HI14R2N-485-000"
            assert not client.write_register(6, 1, device_id=1).isError()
            assert client.read_holding_registers(6, device_id=1).registers == [1]
            assert client.write_register(6, 7, device_id=1).exception_code == 3
            assert not client.write_register(5, 9, device_id=1).isError()
            assert client.read_holding_registers(5, device_id=9).registers == [9]
            assert line.slaves[0].settings.slave == 9
        finally:
            client.close()  # type: ignore[no-untyped-call]  # of pymodbus
