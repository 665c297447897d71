"""Modbus RTU frames for a master: address, function, data, CRC, and the search for the reply to a request.

    request   address | function | data … | CRC low | CRC high
    reply     address | function | data … | CRC low | CRC high        exception  address | function + 0x80 | code | CRC

Source: "MODBUS over Serial Line" V1.02, chapter 2.5, and "MODBUS Application Protocol" V1.1b3, chapters 6 and 7. A
frame has no sync word and no end mark. Its meaning follows from the request and from the silence before and after it.
"""

from collections.abc import Collection
from typing import Final

from imud.model.units import NS_PER_US, uart_byte_ns

READ_HOLDING: Final = 0x03
WRITE_SINGLE: Final = 0x06
EXCEPTION_BIT: Final = 0x80
CRC_BYTES: Final = 2
EXCEPTION_BYTES: Final = 5
READ_OVERHEAD_BYTES: Final = 5  # bytes around the registers of a reply to 0x03: address, function, number of bytes, CRC
ADU_BYTES_MAX: Final = 256  # maximum size of a frame on a serial port
REGISTERS_MAX: Final = 125  # maximum number of registers in one read: 250 bytes
BROADCAST: Final = 0  # address of all slaves; no slave replies
SLAVES: Final = range(1, 248)  # addresses of slaves

FRAME_GAP_CHARACTERS: Final = 3.5
# Silence between two frames above 19200 baud, ns. 3.5 characters would be too short to detect.
FAST_GAP_NS: Final = 1_750 * NS_PER_US
FAST_BAUD: Final = 19200

ILLEGAL_ADDRESS: Final = 2
# Meaning of the exception codes ("MODBUS Application Protocol" V1.1b3, chapter 7)
EXCEPTIONS: Final = {
    1: "the function is not supported",
    ILLEGAL_ADDRESS: "the register does not exist",
    3: "the value is not allowed",
    4: "the device failed",
    5: "the device accepted the request and needs more time",
    6: "the device is busy",
    8: "the memory of the device has a parity error",
}


def crc16_modbus(data: bytes) -> int:
    """Return the CRC-16/MODBUS: reflected polynomial 0xA001, start value 0xFFFF, no final XOR. "123456789" gives
    0x4B37. The check value follows the data, low byte first. The CRC of data and check value is 0."""
    # the table needs 60 ns per byte; a frame of 57 bytes needs 5 ms on the wire
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def _crc_of(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


_CRC_TABLE: Final = tuple(map(_crc_of, range(256)))


def framed(address: int, request: bytes) -> bytes:
    """Return the complete frame of a request: address, function and data, CRC."""
    frame = bytes([address]) + request
    return frame + crc16_modbus(frame).to_bytes(CRC_BYTES, "little")


def is_whole(frame: bytes) -> bool:
    """Return whether the CRC at the end is correct."""
    return len(frame) > CRC_BYTES and crc16_modbus(frame) == 0


def is_exception(frame: bytes) -> bool:
    """Return whether a frame is an exception reply with a correct CRC; its code is `frame[2]`."""
    return len(frame) == EXCEPTION_BYTES and frame[1] & EXCEPTION_BIT != 0 and is_whole(frame)


def exception_text(code: int) -> str:
    """Return the meaning of an exception code."""
    return f"exception {code}: {EXCEPTIONS.get(code, 'unknown code')}"


def frame_gap_ns(baud: int) -> int:
    """Return the silence that ends a frame, ns ("MODBUS over Serial Line" V1.02, 2.5.1.1)."""
    return FAST_GAP_NS if baud > FAST_BAUD else round(FRAME_GAP_CHARACTERS * uart_byte_ns(baud))


def late_sender(data: bytes, owing: Collection[int]) -> int | None:
    """Return the address of the first complete reply to a read in `data` from one of the addresses `owing`."""
    for at in range(len(data) - READ_OVERHEAD_BYTES):
        if data[at] in owing and data[at + 1] == READ_HOLDING:
            size = READ_OVERHEAD_BYTES + data[at + 2]
            if len(data) - at >= size and is_whole(data[at : at + size]):
                return data[at]
    return None


class ReplyFinder:
    """Search for the reply to one request in the received bytes, without I/O.

    The first bytes are the reply if they have the head of the reply, damaged or not: the caller counts damage. After
    other bytes, only a frame with a correct CRC is a reply. `feed` all received bytes. `rest` returns the remaining
    bytes after the timeout.
    """

    def __init__(self, request: bytes, reply_bytes: int, *, echoes: bool | None) -> None:
        """`request` is the complete frame. `echoes`: whether the port receives its own output; None if it is not known.
        If it is not known, the request must not be WRITE_SINGLE: its reply is equal to its echo."""
        # Whether the port received the echo of the request; None before the decision
        self.echo_seen: bool | None = None
        self.strange = 0  # number of bytes outside echo and reply
        self._request = request
        self._size = reply_bytes
        self._expects_echo = echoes
        self._data = b""

    @property
    def missing(self) -> int:
        """Minimum number of missing bytes."""
        may_be_echo = self.echo_seen is None and self._expects_echo is not False
        may_be_short = may_be_echo or self._data[1:2] in (b"", self._error_function)
        size = min(EXCEPTION_BYTES, self._size) if may_be_short else self._size
        if may_be_echo and self._expects_echo:
            size += len(self._request)
        return max(1, size - len(self._data))

    def feed(self, data: bytes) -> bytes | None:
        """Add received bytes. Return the reply when it is complete."""
        self._data += data
        if self.echo_seen is None and self._expects_echo is not False and not self._skip_echo():
            return None
        return self._find()

    def rest(self) -> bytes:
        """Return the bytes after the last reply. With the size of a reply, they may be a damaged reply."""
        return self._data

    @property
    def looks_damaged(self) -> bool:
        """Whether `rest` has the size of a reply and a wrong CRC."""
        return len(self._data) == self._size and not self.strange and not is_whole(self._data)

    @property
    def _error_function(self) -> bytes:
        return bytes([self._request[1] | EXCEPTION_BIT])

    def _skip_echo(self) -> bool:
        """Skip the echo. Return False while the echo may be incomplete."""
        request, data = self._request, self._data
        if data.startswith(request):
            self.echo_seen, self._data = True, data[len(request) :]
        elif request.startswith(data):
            return False
        else:
            self.echo_seen = False
        return True

    def _find(self) -> bytes | None:
        data = self._data
        for at in range(len(data)):
            size = self._size_at(at)
            if size and len(data) - at >= size and (at + self.strange == 0 or is_whole(data[at : at + size])):
                self.strange += at
                self._data = data[at + size :]
                return data[at : at + size]
            if size and at == 0 and len(data) < size:  # a valid head: wait for the rest
                return None
        kept = max(0, len(data) - ADU_BYTES_MAX)
        self.strange, self._data = self.strange + kept, data[kept:]
        return None

    def _size_at(self, at: int) -> int:
        """Return the size of the reply that starts at `at`; 0 if there is none."""
        data, request = self._data, self._request
        head = data[at : at + 4]
        if head[:1] != request[:1]:
            return 0
        if head[1:2] == self._error_function:
            return EXCEPTION_BYTES
        if request[1] == READ_HOLDING:
            good = request[:2] + bytes([self._size - READ_OVERHEAD_BYTES])
        else:  # the confirmation of a write contains the register, which shows a copy of an earlier confirmation
            good = request[: 4 if request[1] == WRITE_SINGLE else 3]
        return self._size if good.startswith(head[: len(good)]) else 0
