"""Every request in the manual, byte by byte, and rejected requests."""

import pytest

from imud.contracts.script import Transfer
from imud.drivers.hipnuc.common import AttitudeMode, LevelReset
from imud.drivers.hipnuc.modbus import commands, registers
from imud.formats.modbus import framed
from imud.model.errors import BadArgument, DeviceRefused

PRINTED = [  # sections 4.3.1 to 4.5, in their order
    ("50 06 00 00 00 00 84 4B", commands.save()),
    ("50 06 00 00 00 01 45 8B", commands.send_control(commands.FACTORY_RESET)),
    ("50 06 00 00 00 FF C4 0B", commands.send_control(commands.RESTART)),
    ("50 06 00 04 00 00 C5 8A", commands.set_baud(4800)),
    ("50 06 00 04 00 01 04 4A", commands.set_baud(9600)), ("50 06 00 04 00 02 44 4B", commands.set_baud(19200)),
    ("50 06 00 04 00 03 85 8B", commands.set_baud(38400)), ("50 06 00 04 00 04 C4 49", commands.set_baud(57600)),
    ("50 06 00 04 00 05 05 89", commands.set_baud(115200)), ("50 06 00 04 00 06 45 88", commands.set_baud(230400)),
    ("50 06 00 04 00 07 84 48", commands.set_baud(460800)), ("50 06 00 04 00 08 C4 4C", commands.set_baud(921600)),
    ("50 06 00 05 00 50 94 76", commands.set_id(0x50)), ("50 06 00 05 00 51 55 B6", commands.set_id(0x51)),
    ("50 06 00 05 00 52 15 B7", commands.set_id(0x52)), ("50 06 00 05 00 53 D4 77", commands.set_id(0x53)),
    ("50 06 00 A6 00 00 64 68", commands.set_mounting(commands.LineMounting.LEVEL)),
    ("50 06 00 A6 00 01 A5 A8", commands.set_mounting(commands.LineMounting.Y_DOWN)),
    ("50 06 00 A6 00 02 E5 A9", commands.set_mounting(commands.LineMounting.Y_UP)),
    ("50 06 00 A6 00 03 24 69", commands.set_mounting(commands.LineMounting.X_UP)),
    ("50 06 00 A6 00 04 65 AB", commands.set_mounting(commands.LineMounting.X_DOWN)),
    ("50 06 00 A5 00 02 15 A9", commands.auto_level(LevelReset.RELATIVE)),
    ("50 06 00 A5 00 05 54 6B", commands.auto_level(LevelReset.CANCEL)),
    ("50 06 00 06 00 00 64 4A", commands.set_heading_mode(AttitudeMode.SIX_AXIS)),
    ("50 06 00 06 00 01 A5 8A", commands.set_heading_mode(AttitudeMode.NINE_AXIS)),
    ("50 03 00 70 00 14 49 9F", registers.read_registers(0x70, 0x14)),
    ("50 03 00 34 00 18 09 8F", registers.read_registers(0x34, 0x18)),
]  # fmt: skip


@pytest.mark.parametrize(("printed", "asked"), PRINTED, ids=[row[0] for row in PRINTED])
@pytest.mark.manual("B 4 byte order", "B 4.1.1 read", "B 4.1.2 write", "B 4.3.2 baud rate")
def test_printed_requests(printed: str, asked: object) -> None:
    transfer = asked if isinstance(asked, Transfer) else next(asked)  # type: ignore[call-overload]  # a generator
    assert framed(0x50, transfer.sends[0]) == bytes.fromhex(printed)
    assert transfer.read_bytes == {3: 5 + 2 * transfer.sends[0][-1], 6: 8}[transfer.sends[0][0]]


@pytest.mark.manual("B 4.6 address by serial number", "B 4.6 random addresses", "B 4.1.1 read")
def test_requests_to_all() -> None:
    """Section 4.6: sub-command, length of the data, then the data. No reply is expected."""
    by_serial = registers.set_id_by_serial("047D955F8D2A1708", 0x22)
    assert by_serial == Transfer((bytes.fromhex("50 0031 000A 047D955F8D2A1708 0022"),), 0)
    assert registers.randomise_ids(1, 247) == Transfer((bytes.fromhex("50 0030 0006 0001 00F7 FFFF"),), 0)

    good = framed(7, registers.registers_reply(b"\x00\x01\xff\xfe"))
    assert registers.registers_of(good, 2) == (1, 0xFFFE)
    write = registers.write_register(6, 1)
    registers.check_written(framed(7, write.sends[0]), write)
    for reply, why in (
        (framed(7, b"\x83\x02"), "exception 2: the register does not exist"),
        (good[:-1], "damaged"),
        (good[:-1] + b"\x00", "damaged"),
        (framed(7, b"\x04\x04\x00\x01\xff\xfe"), "function 0x03"),
        (framed(7, b"\x03\x05\x00\x01\xff\xfe"), "got a reply of 5"),
        (b"", "damaged"),
    ):
        with pytest.raises(DeviceRefused, match=why):
            registers.registers_of(reply, 2)
    with pytest.raises(DeviceRefused, match="expected the confirmation"):
        registers.check_written(framed(7, registers.write_register(6, 0).sends[0]), write)


@pytest.mark.parametrize(
    ("begin", "names"),
    [
        (lambda: registers.set_id_by_serial("047D955F8D2A17", 1), "16 hexadecimal digits"),
        (lambda: registers.serial_bytes("what is this one"), "16 hexadecimal digits"),
        (lambda: registers.set_id_by_serial("047D955F8D2A1708", 0), "1 … 247"),
        (lambda: registers.set_id_by_serial("047D955F8D2A1708", 248), "1 … 247"),
        (lambda: registers.randomise_ids(9, 9), "below the highest"),
        (lambda: registers.randomise_ids(0, 9), "1 … 247"),
        (lambda: registers.randomise_ids(True, 9), "1 … 247"), (lambda: next(commands.set_id(129)), "1 … 128"),
        (lambda: next(commands.set_id(0)), "1 … 128"), (lambda: registers.read_registers(0, 126), "1 … 125"),
        (lambda: registers.read_registers(0xFFFF, 2), "0xFFFF"),
        (lambda: registers.write_register(0, 0x10000), "0xFFFF"),
    ],
)  # fmt: skip
def test_invalid_requests(begin: object, names: str) -> None:
    assert callable(begin)
    with pytest.raises(BadArgument) as refused:
        begin()
    assert names in str(refused.value)


@pytest.mark.manual("B 4.2 registers")
def test_table_of_registers() -> None:
    """Section 4.2 and newer firmware: no gap in the block, no duplicate, limits for writable registers."""
    taken = [
        address
        for register in registers.REGISTERS
        for address in range(register.address, register.address + register.count)
    ]
    assert sorted(taken) == taken == list(dict.fromkeys(taken))
    assert set(range(0x34, 0x4E)) <= set(taken)
    assert {0x00, 0x04, 0x05, 0x06, 0x09, 0x0A, 0x0B, 0x70, 0x78, 0x79, 0x7F, 0x82, 0xA5, 0xA6} <= set(taken)
    assert all(register.values for register in registers.REGISTERS if register.access is not registers.Access.READ)
    assert all(register.meaning for register in registers.REGISTERS)
    assert registers.BAUD_RATES[5] == 115200
    assert len({row[0] for row in PRINTED}) == 27
    assert registers.BAUD_RATES[8:] == (921600, 256000)
    assert registers.BY_NAME["CTRL"].values == (0, 1, 255)
