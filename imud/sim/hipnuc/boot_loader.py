"""Simulated flash memory and boot loaders of a HiPNUC device, on a UART and on CANopen.

The boot loaders implement the facts of `imud/drivers/hipnuc/uart/kboot.py` and `canopen/firmware.py`, without I/O and
without a clock. Assumptions: the flash memory starts at 0x08000000, an image starts at 0x08010000, and the device
starts its application only if the image is complete and for its product. `make_image` makes such images. An erased or
incomplete flash memory keeps the device in its boot loader, also after the power returns. On CANopen, the size at the
start of a download defines the length of the last segment, because its command differs between CiA 301 and the vendor's
tool.
"""

import struct
from binascii import crc32, crc_hqx
from enum import Enum
from typing import Final, NamedTuple

from imud.drivers.hipnuc.canopen.cia301 import ABORT, WRITTEN
from imud.drivers.hipnuc.canopen.firmware import (
    BEGIN_DOWNLOAD,
    CONFIRM,
    ENTER_LOADER,
    ENTERED,
    IMAGE,
    PROGRAM,
    SEGMENT_BYTES,
    SEGMENT_REPLIES,
    START_APPLICATION,
)
from imud.drivers.hipnuc.uart import kboot
from imud.model.units import NS_PER_MS

FLASH_START: Final = 0x0800_0000
FLASH_BYTES: Final = 512 * 1024
SECTOR_BYTES: Final = 2048
APPLICATION: Final = 0x0801_0000  # first address of the application
PACKET_BYTES: Final = 256  # maximum payload of a data packet
WINDOW_NS: Final = 600 * NS_PER_MS  # time after a restart in which a ping stops the start of the application
GAP_NS: Final = 100 * NS_PER_MS  # pause after which the boot loader discards an incomplete packet
OUT_OF_RANGE, WRONG_COMMAND = 10200, 10000  # status of a command (assumption)
CUMULATIVE_WRITE, NO_START = 10203, 10101  # status after data that the flash memory refused, and of a reset
WRONG_STATE: Final = 0x0800_0022  # abort code: not possible in the present state
TOGGLE_ERROR, NO_OBJECT, BAD_COMMAND, TOO_LONG = 0x0503_0000, 0x0602_0000, 0x0504_0001, 0x0607_0012
# Mark, product, version, and length of an image of this simulator. Its CRC-32 follows the last byte.
_HEAD: Final = struct.Struct("<8s16sII")
_MARK: Final = b"SIMIMG\0\0"


class LoaderFault(Enum):
    """Faults of a boot loader that acknowledges every packet."""

    NONE = "none"
    REFUSES_ERASE = "refuses erase"  # UART: status 10200; CANopen: abort 0x06070012. Nothing is erased.
    REFUSES_DATA = "refuses data"  # UART: final status 10203; CANopen: no fault
    REFUSES_START = "refuses start"  # UART: status 10101 of the reset; CANopen: abort 0x08000022


class Application(NamedTuple):
    """Application in the flash memory."""

    product: str
    version: int


def make_image(product: str, version: int, size: int = 4096) -> bytes:
    """Return an image of `size` bytes for the simulated device. Raises ValueError if `size` is too small."""
    body = _HEAD.pack(_MARK, product.encode("ascii"), version, size)
    if size < len(body) + 4:
        raise ValueError(f"size {size}: expected at least {len(body) + 4} bytes")
    body += bytes((7 * at + version) % 251 for at in range(size - len(body) - 4))
    return body + crc32(body).to_bytes(4, "little")


class Flash:
    """Flash memory of a device after the boot loader. Synchronization: one thread."""

    def __init__(self, application: Application) -> None:
        self._application: Application | None = application
        self.fault = LoaderFault.NONE
        self.data = bytearray()  # written bytes, from `APPLICATION`
        self.erased = 0  # number of erase operations

    def erase(self) -> None:
        """Erase the application."""
        self._application = None
        self.data.clear()
        self.erased += 1

    def write(self, data: bytes) -> None:
        """Add bytes, and recognize a complete image."""
        self.data += data
        if len(self.data) < _HEAD.size or not self.data.startswith(_MARK):
            return
        _, product, version, size = _HEAD.unpack_from(self.data)
        body = bytes(self.data[: size - 4])
        if len(self.data) >= size and crc32(body) == int.from_bytes(self.data[size - 4 : size], "little"):
            self._application = Application(product.rstrip(b"\0").decode("ascii", "replace"), version)

    def application(self, product: str) -> Application | None:
        """Return the complete application for `product`; None without one."""
        found = self._application
        return found if found is not None and found.product == product else None


class KbootLoader:
    """Boot loader on a UART. Synchronization: one thread."""

    def __init__(self, flash: Flash, now_ns: int, bootloader: int, version: int) -> None:
        self._flash = flash
        self._properties = {
            kboot.PROPERTY_FLASH_START: FLASH_START,
            kboot.PROPERTY_FLASH_BYTES: FLASH_BYTES,
            kboot.PROPERTY_SECTOR_BYTES: SECTOR_BYTES,
            kboot.PROPERTY_PACKET_BYTES: PACKET_BYTES,
            0x10: bootloader,
            0x39: version,
        }
        self._input = b""
        self._heard_ns = now_ns
        self._left = 0  # number of bytes of the present transfer that the boot loader expects
        self.until_ns: int | None = now_ns + WINDOW_NS  # end of the wait for a ping; None after a ping
        self.wants_reset = False

    def receive(self, data: bytes, now_ns: int) -> list[bytes]:
        """Process bytes of the host. Return the replies."""
        if now_ns - self._heard_ns > GAP_NS:
            self._input = b""
        self._heard_ns, self._input = now_ns, self._input + data
        replies: list[bytes] = []
        while self._input:
            size = self._step(replies)
            if not size:
                break
            self._input = self._input[size:]
        return replies

    def _step(self, replies: list[bytes]) -> int:
        """Process one packet or one byte. Return its length; 0 if it is incomplete."""
        data = self._input
        kind = data[1] if len(data) > 1 else None
        if data[0] != kboot.START_BYTE or kind not in (kboot.PING, kboot.COMMAND, kboot.DATA, None):
            return 1
        if kind == kboot.PING:
            self.until_ns = None
            replies.append(kboot.ping_reply())
            return 2
        length = int.from_bytes(data[2:4], "little")
        end = kboot.HEADER.size + length
        if len(data) < kboot.HEADER.size or (len(data) < end and length <= kboot.PAYLOAD_MAX):
            return 0
        payload = data[kboot.HEADER.size : end]
        if length > kboot.PAYLOAD_MAX:
            return 1
        if crc_hqx(payload, crc_hqx(data[:4], 0)) != int.from_bytes(data[4:6], "little"):
            replies.append(bytes([kboot.START_BYTE, kboot.NAK]))
        elif kind == kboot.DATA:
            self._data(payload, replies)
        else:
            self._command(payload, replies)
        return end

    def _data(self, payload: bytes, replies: list[bytes]) -> None:
        if not 0 < len(payload) <= self._left:
            replies.append(bytes([kboot.START_BYTE, kboot.ABORT]))
            return
        self._flash.write(payload)
        self._left -= len(payload)
        replies.append(bytes([kboot.START_BYTE, kboot.ACK]))
        if not self._left:
            status = CUMULATIVE_WRITE if self._flash.fault is LoaderFault.REFUSES_DATA else 0
            # one write: both replies arrive in the same bytes
            replies[-1] += kboot.command(kboot.TAG_GENERIC, status, kboot.TAG_WRITE)

    def _command(self, payload: bytes, replies: list[bytes]) -> None:
        self._left = 0  # a command ends a transfer of data
        tag, *_ = payload or b"\0"
        values = struct.unpack(f"<{len(payload) // 4 - 1}I", payload[4 : len(payload) // 4 * 4]) if payload else ()
        first, second = (*values, 0, 0)[:2]
        replies.append(bytes([kboot.START_BYTE, kboot.ACK]))
        status = 0
        if tag == kboot.TAG_PROPERTY:
            status = 0 if first in self._properties else kboot.UNKNOWN_PROPERTY
            replies.append(kboot.command(kboot.TAG_PROPERTY_REPLY, status, self._properties.get(first, 0)))
            return
        if tag in (kboot.TAG_ERASE, kboot.TAG_WRITE):
            is_refused = tag == kboot.TAG_ERASE and self._flash.fault is LoaderFault.REFUSES_ERASE
            if is_refused or first != APPLICATION or not 0 < second <= FLASH_START + FLASH_BYTES - APPLICATION:
                status = OUT_OF_RANGE
            elif tag == kboot.TAG_ERASE:
                self._flash.erase()
            else:
                self._left = second
        elif tag == kboot.TAG_RESET:
            if self._flash.fault is LoaderFault.REFUSES_START:
                status = NO_START
            self.wants_reset = not status
        else:
            status = WRONG_COMMAND
        replies.append(kboot.command(kboot.TAG_GENERIC, status, tag))


class SdoLoader:
    """Boot loader on CANopen. Synchronization: one thread."""

    def __init__(self, flash: Flash) -> None:
        self._flash = flash
        self._left = 0  # number of bytes of the present download that the boot loader expects
        self._toggle = 0
        self.wants_reset = False

    def serve(self, data: bytes) -> bytes:  # noqa: PLR0911 - one return for each abort code
        """Process an SDO request of eight bytes. Return the data of the reply; empty without a reply."""
        command, address = data[0], data[1:4]
        if command == ABORT:
            self._left = 0
            return b""
        if self._left and not command & 0xE0:
            return self._segment(data)
        if address[:2] != PROGRAM.to_bytes(2, "little"):
            return _abort(address, NO_OBJECT)
        self._left = 0
        sub = address[2]
        if command == BEGIN_DOWNLOAD and sub == IMAGE:
            size = int.from_bytes(data[4:], "little")
            is_refused = self._flash.fault is LoaderFault.REFUSES_ERASE
            if is_refused or not 0 < size <= FLASH_START + FLASH_BYTES - APPLICATION:
                return _abort(address, TOO_LONG)
            self._flash.erase()
            self._left, self._toggle = size, 0
        elif sub not in (ENTER_LOADER, CONFIRM, START_APPLICATION):
            return _abort(address, BAD_COMMAND)
        if sub == START_APPLICATION and self._flash.fault is LoaderFault.REFUSES_START:
            return _abort(address, WRONG_STATE)
        self.wants_reset = sub == START_APPLICATION
        return bytes([ENTERED if sub == ENTER_LOADER else WRITTEN]) + address + bytes(4)

    def _segment(self, data: bytes) -> bytes:
        if data[0] >> 4 & 1 != self._toggle:
            self._left = 0
            return _abort(PROGRAM.to_bytes(2, "little") + bytes([IMAGE]), TOGGLE_ERROR)
        reply = bytes([SEGMENT_REPLIES[self._toggle]]) + bytes(7)
        size = min(SEGMENT_BYTES, self._left)
        self._flash.write(data[1 : 1 + size])
        self._left = 0 if data[0] & 1 else self._left - size
        self._toggle ^= 1
        return reply


def _abort(address: bytes, code: int) -> bytes:
    return bytes([ABORT]) + address + code.to_bytes(4, "little")
