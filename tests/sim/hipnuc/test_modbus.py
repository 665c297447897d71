"""Simulated devices on one bus: time of a byte, replies, saved settings. No clock, no waiting."""

import struct
from math import dist, radians
from typing import Any

import pytest

from imud.drivers.hipnuc.modbus.codec import HipnucModbusCodec, HipnucModbusOptions
from imud.drivers.hipnuc.modbus.registers import (
    BY_NAME,
    randomise_ids,
    read_registers,
    set_id_by_serial,
    write_register,
)
from imud.formats.modbus import framed, is_exception, is_whole
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.modbus import SLAVE_VARIANTS, ModbusLine, Slave, incli_counts, make
from imud.sim.physics import swing
from imud.sim.sensor import Burst, SimulatorOptions
from tests.support.pty_port import serial_of, slave

BEGIN_NS = 5 * NS_PER_S
BAUD = 115200
BYTE_NS = 10 * NS_PER_S // BAUD  # 10 bits per byte
GAP_NS = 1_750_000  # silence between frames above 19200 baud


class ModbusMaster:
    """A bus with a master that is never late."""

    def __init__(self, *slaves: Slave, **more: bool | int) -> None:
        self.line = ModbusLine(BEGIN_NS, slaves, **more)  # type: ignore[arg-type]  # passed on
        self.now_ns = BEGIN_NS

    def bursts(self, frame: bytes) -> list[Burst]:
        self.line.receive(frame, self.now_ns)
        found: list[Burst] = []
        while (next_ns := self.line.next_ns()) is not None:
            self.now_ns = max(next_ns, self.now_ns)
            found += self.line.advance(self.now_ns)
        self.now_ns += GAP_NS
        return found

    def ask(self, address: int, request: bytes) -> bytes:
        return b"".join(burst.data for burst in self.bursts(framed(address, request)))


STILL = swing().at(0.0)
READ_BLOCK, READ_SHORT = (read_registers(0x34, count).sends[0] for count in (26, 4))


def here(address: int, **more: Any) -> Slave:
    return slave(address, baud=BAUD, **more)


@pytest.mark.parametrize(("firmware", "wave_m"), [(169, 2.0), (170, 0.0), (170, 2.0)])
def test_heave_of_newer_firmware(firmware: int, wave_m: float) -> None:
    """After 2.5 s, a wave of 2 m and 0.1 Hz is at its maximum."""
    rig = ModbusMaster(here(1, firmware=firmware, wave_m=wave_m))
    rig.now_ns += 2_500_000_000
    reply = rig.ask(1, read_registers(0x4E, 6).sends[0])
    assert is_exception(reply) == (firmware == 169)
    if firmware > 169:
        heave, _, _, hz, _, _ = struct.unpack(">3h3H", reply[3:-2])
        assert (heave, hz) == (pytest.approx(100 * wave_m, abs=1), 10 * bool(wave_m))


def test_time_of_bytes_pieces_echo_and_a_request_after_a_silence() -> None:
    rig = ModbusMaster(here(1, processing_ns=100_000))
    (burst,) = rig.bursts(framed(1, READ_BLOCK))
    assert burst.due_ns == BEGIN_NS + 8 * BYTE_NS + GAP_NS + 100_000 + 57 * BYTE_NS
    assert burst.sample_ns == BEGIN_NS + 8 * BYTE_NS + GAP_NS + 100_000
    rig = ModbusMaster(here(1, processing_ns=0), chunk_bytes=1)
    bursts = rig.bursts(framed(1, READ_BLOCK))
    assert [len(burst.data) for burst in bursts] == [1] * 57
    begin_ns = BEGIN_NS + 8 * BYTE_NS + GAP_NS
    assert [burst.due_ns for burst in bursts] == [begin_ns + n * BYTE_NS for n in range(1, 58)]
    assert is_whole(b"".join(burst.data for burst in bursts))
    rig, frame = ModbusMaster(here(1), echo=True), framed(1, READ_BLOCK)
    echo, reply = rig.bursts(frame)
    assert (echo.data, echo.due_ns) == (frame, BEGIN_NS + 8 * BYTE_NS)
    assert is_whole(reply.data)
    line = ModbusMaster(here(1)).line
    for later_ns in (0, NS_PER_S):
        line.receive(framed(1, READ_BLOCK), BEGIN_NS + later_ns)
    assert [is_whole(burst.data) for burst in line.advance(BEGIN_NS + 2 * NS_PER_S)] == [True, True]


def test_values_are_the_truth_of_that_instant_and_counts_of_an_inclinometer() -> None:
    for firmware, resolution in ((152, 2**-15), (169, 1e-4)):
        rig = ModbusMaster(here(1, firmware=firmware, inclinometer="dual"))
        codec = HipnucModbusCodec(Ledger(), HipnucModbusOptions())
        request = READ_BLOCK if firmware == 169 else read_registers(0x34, 24).sends[0]
        if firmware == 152:
            assert is_exception(rig.ask(1, READ_BLOCK))
            codec.decode(0, rig.ask(1, READ_BLOCK))
        (burst,) = rig.bursts(framed(1, request))
        assert burst.sample_ns is not None
        truth = rig.line.slaves[0].motion.at((burst.sample_ns - BEGIN_NS) / NS_PER_S)
        (m,) = codec.decode(0, burst.data)
        assert isinstance(m, Measurement)
        assert m.accel_m_s2 is not None
        assert m.gyro_rad_s is not None
        assert m.incli_rad is not None
        assert dist(m.accel_m_s2, truth.accel_m_s2) < 0.005
        assert dist(m.gyro_rad_s, truth.gyro_rad_s) < 0.001
        assert m.quat_wxyz == pytest.approx(truth.quat_wxyz, abs=resolution)
        assert m.euler_rad == pytest.approx(truth.euler_rad, abs=1e-5)
        assert m.incli_rad[0] == pytest.approx(truth.euler_rad[0], abs=1e-4)
        assert m.dev_ticks == (None if firmware == 152 else (burst.sample_ns - BEGIN_NS) // NS_PER_MS)
    # One count of 360°/32768 for X from 0 to 360°, of 180°/32768 for ±180°. Y is 67.8° at pitch 60° and roll -45°
    for kind, roll_deg, pitch_deg, counts in (
        ("single", 90, 0, (8192, 0)), ("single", -90, 0, (24576, 0)), ("single", 360, 0, (0, 0)),
        ("dual", 90, 0, (16384, 0)), ("dual", -45, 60, (-8192, 12341)), ("", 90, 45, (0, 0)),
    ):  # fmt: skip
        truth = STILL._replace(euler_rad=(radians(roll_deg), radians(pitch_deg), 0.3))
        assert incli_counts(truth, kind) == pytest.approx(counts, abs=1)


def test_who_answers_and_which_replies_are_whole() -> None:
    rig = ModbusMaster(here(1), here(2), here(3, dead=True))
    assert rig.ask(2, READ_BLOCK)[0] == 2
    assert rig.ask(3, READ_BLOCK) == rig.ask(4, READ_BLOCK) == rig.ask(0, READ_BLOCK) == b""
    assert rig.bursts(framed(1, READ_BLOCK)[:-1] + b"\x00") == []
    assert rig.line.counters() == {"requests": 4, "damaged": 1, "answered": 1}
    rig = ModbusMaster(slave(1, baud=BAUD, serial=0x0F), slave(1, baud=BAUD, serial=0xF0))
    reply = rig.ask(1, read_registers(0x7F, 4).sends[0])
    assert len(reply) == 13
    assert not is_whole(reply)
    rig = ModbusMaster(here(1, bad_crc=1, mute=1))
    assert rig.ask(1, READ_BLOCK) == b""
    damaged = rig.ask(1, READ_BLOCK)
    assert (len(damaged), is_whole(damaged)) == (57, False)
    assert is_whole(rig.ask(1, READ_BLOCK))
    rig = ModbusMaster(here(1), slave(2, baud=9600))
    assert not is_whole(rig.ask(2, READ_BLOCK))
    assert is_whole(rig.ask(1, READ_BLOCK))


@pytest.mark.parametrize("name", SLAVE_VARIANTS)
def test_what_a_variant_confirms_and_when_it_applies(name: str) -> None:
    rig = ModbusMaster(here(1, variant=SLAVE_VARIANTS[name]))
    reply = rig.ask(1, write_register(BY_NAME["MD_ID"].address, 99).sends[0])
    sources = {"confirms from the new address": [99], "does not confirm an address": []}
    assert list(reply[:1]) == sources.get(name, [1])
    used = 1 if name == "address after restart" else 99
    assert [address for address in (1, 99) if rig.ask(address, READ_SHORT)] == [used]
    rig.ask(used, write_register(BY_NAME["UART1_BAUD"].address, 0).sends[0])
    assert rig.line.baud == (4800 if name == "rate at once" else BAUD)
    rig.line.reboot(rig.now_ns)
    assert rig.line.baud == BAUD
    rig = ModbusMaster(here(1, variant=SLAVE_VARIANTS[name]))
    reply = rig.ask(1, write_register(BY_NAME["CTRL"].address, 0xFF).sends[0])
    assert bool(reply) == (name != "restarts without a reply")
    boot_ms, begin_ns = {"restarts without a reply": 800, "slow to boot": 1500}.get(name, 0), rig.now_ns
    for wait_ms, is_ready in ((boot_ms - 20, not boot_ms), (boot_ms, True)):
        rig.now_ns = begin_ns + wait_ms * NS_PER_MS
        assert bool(rig.ask(1, READ_SHORT)) == is_ready


def test_ids_exceptions_and_common_options() -> None:
    rig = ModbusMaster(slave(80, baud=BAUD, serial=1), slave(80, baud=BAUD, serial=2))
    assert rig.ask(0, set_id_by_serial(serial_of(2).hex(), 99).sends[0]) == b""
    assert [one.settings.slave for one in rig.line.slaves] == [80, 99]
    rig.ask(0, randomise_ids(10, 12).sends[0])
    assert {one.settings.slave for one in rig.line.slaves} <= {10, 11, 12}
    rig.line.reboot(rig.now_ns)
    assert [one.settings.slave for one in rig.line.slaves] == [80, 80]
    rig = ModbusMaster(here(1))
    for request, code in (
        (read_registers(0x34, 27).sends[0], 2), (read_registers(0x33, 1).sends[0], 2),
        (write_register(0x34, 0).sends[0], 2), (write_register(6, 2).sends[0], 3), (b"\x04\x00\x34\x00\x01", 1),
    ):  # fmt: skip
        reply = rig.ask(1, request)
        assert reply == framed(1, bytes([request[0] | 0x80, code]))
    line = make(SimulatorOptions(message="1,22,247", baud=9600, noise="none"), BEGIN_NS)
    assert [one.settings.slave for one in line.slaves] == [1, 22, 247]
    assert (len({one.serial for one in line.slaves}), line.baud) == (3, 9600)
    assert [one.settings.slave for one in make(SimulatorOptions(), BEGIN_NS).slaves] == [80]
    for wrong in ({"message": "1,x"}, {"message": "0"}, {"message": "248"}, {"baud": 12345}, {"motion": "none"}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            make(SimulatorOptions(**wrong), BEGIN_NS)
