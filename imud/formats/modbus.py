"""Modbus RTU framing for a master: address, function, data, CRC, and the search for the reply to a request.

    request   address | function | data … | CRC low | CRC high
    reply     address | function | data … | CRC low | CRC high        exception  address | function + 0x80 | code | CRC

Source: "MODBUS over Serial Line" V1.02, chapter 2.5, and "MODBUS Application Protocol" V1.1b3, chapters 6 and 7. A
frame has no sync word and no end mark: its meaning follows from the request, and from the silence around it.
"""

from typing import Final

from imud.model.units import NS_PER_US, uart_byte_ns

READ_HOLDING: Final = 0x03
WRITE_SINGLE: Final = 0x06
EXCEPTION_BIT: Final = 0x80
CRC_BYTES: Final = 2
EXCEPTION_BYTES: Final = 5
READ_OVERHEAD_BYTES: Final = 5
"""Address, function, count of bytes, CRC around the registers of a reply to 0x03."""
ADU_BYTES_MAX: Final = 256
"""Longest frame on a serial line."""
REGISTERS_MAX: Final = 125
"""Most registers in one read: 250 bytes."""
BROADCAST: Final = 0
"""Address of all slaves; none replies."""
SLAVES: Final = range(1, 248)
"""Addresses of slaves."""

FRAME_GAP_CHARACTERS: Final = 3.5
FAST_GAP_NS: Final = 1_750 * NS_PER_US
"""Silence between frames above 19200 baud, where 3.5 characters would be too short to see."""
FAST_BAUD: Final = 19200

ILLEGAL_ADDRESS: Final = 2
EXCEPTIONS: Final = {
    1: "the function is not known",
    ILLEGAL_ADDRESS: "there is no such register",
    3: "the value is not allowed",
    4: "the device failed",
    5: "accepted, and takes longer",
    6: "the device is busy",
    8: "its memory has a parity error",
}
"""Meaning of the exception codes ("MODBUS Application Protocol" V1.1b3, chapter 7)."""


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS: reflected polynomial 0xA001, start value 0xFFFF, no final XOR. "123456789" gives 0x4B37.

    The check value follows what it covers, low byte first; over both together the result is 0. The standard library
    has none; a table takes 60 ns a byte, where a frame of 57 bytes takes 5 ms on its wire.
    """
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
    """The whole frame for a request: address, function and data, CRC."""
    frame = bytes([address]) + request
    return frame + crc16_modbus(frame).to_bytes(CRC_BYTES, "little")


def is_whole(frame: bytes) -> bool:
    """Whether the CRC at the end matches what comes before."""
    return len(frame) > CRC_BYTES and crc16_modbus(frame) == 0


def is_exception(frame: bytes) -> bool:
    """Whether a frame is an exception response with a correct CRC; its code is `frame[2]`."""
    return len(frame) == EXCEPTION_BYTES and frame[1] & EXCEPTION_BIT != 0 and is_whole(frame)


def exception_text(code: int) -> str:
    """Text of an exception code."""
    return f"exception {code}: {EXCEPTIONS.get(code, 'no meaning known')}"


def frame_gap_ns(baud: int) -> int:
    """Silence that ends a frame, ns ("MODBUS over Serial Line" V1.02, 2.5.1.1)."""
    return FAST_GAP_NS if baud > FAST_BAUD else round(FRAME_GAP_CHARACTERS * uart_byte_ns(baud))


class ReplyFinder:
    """Finder of the reply to one request among the received bytes, without I/O.

    A frame at the beginning with the head of the reply is the reply, damaged or not: the caller counts damage. After
    other bytes only a frame with a matching CRC is accepted. `feed` all that is read; `rest` has what is left when the
    time is over.
    """

    def __init__(self, request: bytes, reply_bytes: int, *, echoes: bool | None) -> None:
        """`request` is the whole frame; `echoes`: whether the port receives what it sends, None if unknown.

        Where it is not known, the request must be no WRITE_SINGLE, whose reply is the same as an echo.
        """
        self.echo_seen: bool | None = None
        """Whether the echo of the request was received; None while that is undecided."""
        self.strange = 0
        """Number of bytes that were neither echo nor reply."""
        self._request = request
        self._size = reply_bytes
        self._expects_echo = echoes
        self._data = b""

    @property
    def missing(self) -> int:
        """Least number of bytes that are still to come."""
        may_be_echo = self.echo_seen is None and self._expects_echo is not False
        may_be_short = may_be_echo or self._data[1:2] in (b"", self._error_function)
        size = min(EXCEPTION_BYTES, self._size) if may_be_short else self._size
        if may_be_echo and self._expects_echo:
            size += len(self._request)
        return max(1, size - len(self._data))

    def feed(self, data: bytes) -> bytes | None:
        """Add received bytes; return the reply once it is complete."""
        self._data += data
        if self.echo_seen is None and self._expects_echo is not False and not self._skip_echo():
            return None
        return self._find()

    def rest(self) -> bytes:
        """The bytes after the last reply; of the size of a reply they may be one that was damaged."""
        return self._data

    @property
    def looks_damaged(self) -> bool:
        """Whether `rest` has the size of a reply, and a wrong CRC."""
        return len(self._data) == self._size and not self.strange and not is_whole(self._data)

    @property
    def _error_function(self) -> bytes:
        return bytes([self._request[1] | EXCEPTION_BIT])

    def _skip_echo(self) -> bool:
        """Skip the echo; False while it may still be coming."""
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
            if size and at == 0 and len(data) < size:  # it begins well: wait for the rest of it
                return None
        kept = max(0, len(data) - ADU_BYTES_MAX)
        self.strange, self._data = self.strange + kept, data[kept:]
        return None

    def _size_at(self, at: int) -> int:
        """Size of the reply that begins at `at`, 0 if none does."""
        data, request = self._data, self._request
        head = data[at : at + 3]
        if head[:1] != request[:1]:
            return 0
        if head[1:2] == self._error_function:
            return EXCEPTION_BYTES
        good = request[:2] + (bytes([self._size - READ_OVERHEAD_BYTES]) if request[1] == READ_HOLDING else request[2:3])
        return self._size if good.startswith(head) else 0
