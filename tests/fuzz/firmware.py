"""Firmware updates: any bytes as replies of both boot loaders, and any file.

An update ends after a limited number of requests and raises only the documented exceptions.
"""

import zlib
from binascii import crc_hqx
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from random import Random

from imud.cli.firmware import parse_image
from imud.contracts.command import Target as ActionTarget
from imud.contracts.driver import CanDriver
from imud.contracts.firmware import IMAGE_BYTES_MAX, FirmwareImage
from imud.contracts.script import Message
from imud.drivers.hipnuc.canopen import firmware as canopen
from imud.drivers.hipnuc.canopen.cia301 import SDO_REPLY
from imud.drivers.hipnuc.uart import kboot
from imud.formats.can import CanFrame
from imud.model.errors import BadArgument
from imud.model.ledger import Ledger
from imud.sim.hipnuc.boot_loader import APPLICATION
from imud.testing.invariants import check_closed, cut
from tests.fuzz import can
from tests.fuzz.drivers import row
from tests.fuzz.scripts import BAUD, answer, can_messages, messages_of
from tests.fuzz.target import Target

IMAGE = FirmwareImage(APPLICATION, bytes(64))
NODE = 8


def names() -> Sequence[str]:
    return ["kboot", "canopen", "hex"]


def make(name: str) -> Target:
    return {"kboot": _kboot, "canopen": _canopen, "hex": _hex}[name]()


def _no_report(_phase: str, done: int, total: int) -> None:
    assert 0 <= done <= total


# --- UART -------------------------------------------------------------------------------------------------------------


def _kboot() -> Target:
    target = ActionTarget(None, BAUD)

    def run(data: bytes) -> None:
        whole, parts = kboot.KbootCodec(Ledger()), kboot.KbootCodec(Ledger())
        expected = [*whole.feed(data), *whole.flush()]
        found = [event for part in cut(data, Random(zlib.crc32(data))) for event in parts.feed(part)]
        assert [*found, *parts.flush()] == expected
        assert parts.ledger.values() == whole.ledger.values()
        check_closed(whole.ledger)
        assert whole.ledger.bytes_pending == 0
        answer(lambda: kboot.update(target, IMAGE, _no_report), messages_of(expected))

    return Target(run, _kboot_seeds, _mend_kboot)


def _kboot_seeds() -> list[bytes]:
    ack, nak, abort = (bytes([kboot.START_BYTE, kind]) for kind in (kboot.ACK, kboot.NAK, kboot.ABORT))
    properties = [ack + kboot.command(0xA7, status, value) for status, value in ((0, 256), (0, 1 << 19), (0, 2048))]
    ready = kboot.ping_reply() + b"".join(properties) + ack + kboot.command(0xA7, 0, 0x0800_0000)
    done = [ack + kboot.command(0xA0, 0, tag) for tag in (2, 4, 4, 11)]
    return [
        ready + done[0] + done[1] + ack + done[2] + done[3],
        ready + nak * 7 + done[0],
        ready + done[0] + done[1] + nak + abort,
        ready + ack + kboot.command(0xA0, 10200, 2),
        kboot.ping_reply()[:-1] + b"\0" + ready,
        kboot.packet(kboot.DATA, bytes(20)) + ready[:40],
    ]


def _mend_kboot(data: bytes, random: Random) -> bytes:
    """Correct the CRC of one packet."""
    at = data.find(bytes([kboot.START_BYTE, kboot.COMMAND]), random.randrange(len(data) + 1))
    length = int.from_bytes(data[at + 2 : at + 4], "little")
    if at < 0 or at + 6 + length > len(data):
        return data
    crc = crc_hqx(data[at + 6 : at + 6 + length], crc_hqx(data[at : at + 4], 0))
    return data[: at + 4] + crc.to_bytes(2, "little") + data[at + 6 :]


# --- CANopen ----------------------------------------------------------------------------------------------------------


def _canopen() -> Target:
    driver = row("hipnuc-canopen", CanDriver)
    messages = can_messages(driver)
    target = ActionTarget(driver.settings(), 500_000)
    begin = partial(canopen.update, target, IMAGE, _no_report)

    def run(data: bytes) -> None:
        replies: Iterator[Message] = messages(data)
        answer(begin, replies)

    own = can.own_identifiers(driver)
    return Target(run, lambda: [can.encoded([(1, frame) for frame in one], own)[1:] for one in _sdo_replies()])


def _sdo_replies() -> list[list[CanFrame]]:
    def reply(command: int, sub: int = 0) -> CanFrame:
        index = canopen.PROGRAM.to_bytes(2, "little") if sub else bytes(2)
        return CanFrame(SDO_REPLY + NODE, False, bytes([command, *index, sub, 0, 0, 0, 0]), 0)

    entered = [reply(0, 5), reply(0x60, 6), reply(0x60, 1)]
    return [
        [*entered, *[reply(0x20), reply(0x30)] * 5, reply(0x60, 9)],
        [*entered, *[reply(0x20)] * 2],
        [reply(0x80, 5)] * 3,
    ]


# --- files ------------------------------------------------------------------------------------------------------------


def _hex() -> Target:
    def run(data: bytes) -> None:
        try:
            image = parse_image(data, Path("new.hex"))
        except BadArgument as error:
            assert str(error).startswith("new.hex: ")  # noqa: PT017 - the fuzzer has no pytest
            return
        assert 0 < len(image.data) <= IMAGE_BYTES_MAX
        assert 0 <= image.address < image.end

    return Target(run, _hex_seeds, _mend_hex)


def _hex_seeds() -> list[bytes]:
    end, data = b":00000001FF\r\n", b":0200000041427B\r\n"
    return [
        b":020000040801F1\r\n" + data + end,
        data + b":010004004FAC\n" + end,
        b":020000021000EC\n" + data + b":0400000508010000EE\n" + end,
        data,
        data + data + end,
        b"\x7fELF" + end,
    ]


def _mend_hex(data: bytes, random: Random) -> bytes:
    """Correct the checksum of one record."""
    lines = data.split(b"\n")
    number = random.randrange(len(lines))
    try:
        content = bytes.fromhex(lines[number].strip()[1:-2].decode("ascii"))
    except ValueError:
        return data
    lines[number] = b":" + content.hex().upper().encode() + f"{-sum(content) & 0xFF:02X}".encode()
    return b"\n".join(lines)
