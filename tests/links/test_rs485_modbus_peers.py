"""The Modbus code with pymodbus: pymodbus as devices for imud's driver, and as master of imud's simulator.

A pymodbus server has its own pseudo-terminal. A thread moves bytes between this terminal and the terminal of imud.
"""

import asyncio
import os
import select
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from pymodbus.client import ModbusSerialClient
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice

from imud.contracts.codec import Vanished
from imud.contracts.script import run_transfer_script
from imud.contracts.setting import words_of
from imud.drivers.hipnuc.common import AttitudeMode
from imud.drivers.hipnuc.modbus.codec import READ_BLOCK, READ_SHORT_BLOCK, HipnucModbusCodec, HipnucModbusOptions
from imud.drivers.hipnuc.modbus.commands import LineMounting, set_heading_mode, set_mounting
from imud.drivers.hipnuc.modbus.driver import DRIVER
from imud.drivers.hipnuc.modbus.registers import pack_identity
from imud.links.rs485 import Rs485Link, Rs485Options, SharedPorts
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.drivers.hipnuc.modbus.test_codec import SENSORS
from tests.support.daemon_process import LIMIT_S
from tests.support.pty_port import BAUD, PtyPort, serial_of, slave, wired

UPTIME = (0x0001, 0x2345)

pytestmark = pytest.mark.live


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


@contextmanager
def linked(path: str) -> Iterator[Rs485Link]:
    link = Rs485Link(Rs485Options(line=path, baud=BAUD, reply_ms=1000), ports=SharedPorts())
    link.open()
    try:
        yield link
    finally:
        link.close()


def test_pymodbus_server_as_modules_under_our_driver() -> None:
    settings = HipnucModbusOptions()
    with served(device(1, new=False), device(80, new=True)) as path, linked(path) as link:
        for address, firmware in ((80, "1.6.9"), (1, "1.5.2")):
            link.select(address)
            identity = run_transfer_script(DRIVER.probe(settings), link.transfer)
            assert (identity.product, identity.firmware) == ("HI14R2N-485-000", firmware)
            assert identity.serial_number == serial_of(address).hex().upper()
            found = words_of(run_transfer_script(DRIVER.set_up(settings), link.transfer))
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
            assert words_of(run_transfer_script(DRIVER.set_up(settings), link.transfer))["heading_mode"] == "nine axes"
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
