"""What a UART hears when the other end sends at another rate: the bits are really drawn and really sampled."""

from imud.units import BITS_PER_UART_BYTE

TOLERANCE = 0.03
"""Rates closer than this read alike: at ±5 % the last of 10 bits is sampled half a bit off, and edges are not ideal."""


def heard(data: bytes, sent_baud: int, listening_baud: int) -> bytes:
    """The bytes that a receiver at `listening_baud` makes of 8N1 `data` sent at `sent_baud` (0 bit/s: none).

    The line is idle before and after. A byte without a valid stop bit is delivered as sampled, as a Linux tty does
    without INPCK; the receiver then waits for the line to go idle.
    """
    if not sent_baud or not listening_baud:
        return b""
    if abs(sent_baud - listening_baud) <= TOLERANCE * listening_baud:
        return data
    return _sampled(_line(data), sent_baud / listening_baud)


def _line(data: bytes) -> bytes:
    """One 0 or 1 per bit time: start bit, eight data bits from the lowest, stop bit."""
    return b"".join(_SYMBOLS[byte] for byte in data)


def _sampled(line: bytes, ratio: float) -> bytes:
    """`line` read with a bit time of `ratio` of its own bits."""
    end, found, at = len(line), bytearray(), 0
    while (start := line.find(0, at)) >= 0:
        bits = [line[i] if (i := int(start + (n + 0.5) * ratio)) < end else 1 for n in range(BITS_PER_UART_BYTE)]
        if bits[0]:  # shorter than half a bit: a glitch, no start bit
            at = line.find(1, start)
            continue
        found.append(sum(bit << n for n, bit in enumerate(bits[1:9])))
        at = int(start + 9.5 * ratio)
        if not bits[9] and (at := line.find(1, at)) < 0:
            break
    return bytes(found)


_SYMBOLS = tuple(bytes([0, *(byte >> n & 1 for n in range(8)), 1]) for byte in range(256))
