"""WebSocket client (RFC 6455): frames, and an open connection.

imud sends text, and ignores the messages of the server. It therefore does not store them: the reader of frames skips
their bytes and returns only ping, pong and close.
"""

import asyncio
import base64
import hashlib
import os
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from imud.host.peer_stream import PeerStream
from imud.model.work_budget import WorkBudget

REPLY_S: Final = 10.0  # maximum time from the connection to the complete reply of the server, s
CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0x0, 0x1, 0x2, 0x8, 0x9, 0xA
OPCODE: Final = 0x0F
CONTROL: Final = 0x08  # flag of the opcodes of control frames
FINAL: Final = 0x80  # flag of the first byte: the last frame of a message
RESERVED: Final = 0x70  # flags of extensions, which imud does not request
MASKED: Final = 0x80  # flag of the second byte. Only clients mask their frames.
LENGTH_16: Final = 126
LENGTH_64: Final = 127
CONTROL_BYTES_MAX: Final = 125
FRAME_BYTES_MAX: Final = 65_536  # maximum length of a frame of the server, bytes. Its greeting has 200 bytes.
UINT16: Final = struct.Struct(">H")
UINT64: Final = struct.Struct(">Q")
ACCEPT_SUFFIX: Final = "258EAFA5-E914-47DA-95CA-C5AB0DC85B11"  # RFC 6455, section 1.3
KEY_BYTES: Final = 16
MASK_BYTES: Final = 4


class UnusableServer(Exception):
    """The server does not reply as specified."""


class InvalidFrame(Exception):
    """The bytes are not a valid frame of a server."""


class ControlFrame(NamedTuple):
    """Ping, pong or close."""

    opcode: int
    payload: bytes


class WebSocketReader:
    """Reader of the frames of a server. Synchronization: one thread."""

    def __init__(self) -> None:
        self._rest = b""  # start of an incomplete head or control frame
        self._skip_bytes = 0  # rest of the present message frame
        self._is_in_message = False  # whether the last message frame was not final

    def feed(self, data: bytes) -> list[ControlFrame]:
        """Add bytes. Return the complete control frames. Raises InvalidFrame."""
        if self._rest:
            data = self._rest + data
        frames: list[ControlFrame] = []
        position = min(self._skip_bytes, len(data))
        self._skip_bytes -= position
        end = len(data)
        while end - position >= 2:
            first, second = data[position], data[position + 1]
            if second & MASKED or first & RESERVED:
                raise InvalidFrame("expected a frame without a mask and without extensions")
            is_control = bool(first & CONTROL)
            frame_bytes = _control_bytes(first, second) if is_control else self._message_bytes(data, position)
            if frame_bytes is None:  # an incomplete head
                break
            frame_end = position + frame_bytes
            if is_control:
                if frame_end > end:
                    break
                frames.append(ControlFrame(first & OPCODE, data[position + 2 : frame_end]))
            else:
                self._is_in_message = not first & FINAL
                self._skip_bytes = max(0, frame_end - end)
            position = min(frame_end, end)
        self._rest = data[position:]
        return frames

    def _message_bytes(self, data: bytes, position: int) -> int | None:
        """Return the length of a message frame with its head; None if the head is incomplete."""
        opcode = data[position] & OPCODE
        if opcode > BINARY or (opcode == CONTINUATION) != self._is_in_message:
            raise InvalidFrame("expected the next frame of a message")
        length = data[position + 1]
        if length < LENGTH_16:
            return 2 + length
        layout = UINT16 if length == LENGTH_16 else UINT64
        if len(data) - position < 2 + layout.size:
            return None
        (payload_bytes,) = layout.unpack_from(data, position + 2)
        if payload_bytes > FRAME_BYTES_MAX:
            raise InvalidFrame(f"expected a frame of at most {FRAME_BYTES_MAX} bytes, got a longer frame")
        return 2 + layout.size + int(payload_bytes)


def _control_bytes(first: int, second: int) -> int:
    """Return the length of a control frame with its head."""
    if first & OPCODE > PONG or not first & FINAL or second > CONTROL_BYTES_MAX:
        raise InvalidFrame("expected a ping, pong or close of at most 125 bytes")
    return 2 + second


def encode_frame(opcode: int, payload: bytes) -> bytes:
    """Return a frame of a client, with a random mask."""
    mask = os.urandom(MASK_BYTES)
    length = len(payload)
    if length <= CONTROL_BYTES_MAX:
        head = bytes((FINAL | opcode, MASKED | length))
    elif length < 1 << 16:
        head = bytes((FINAL | opcode, MASKED | LENGTH_16)) + UINT16.pack(length)
    else:
        head = bytes((FINAL | opcode, MASKED | LENGTH_64)) + UINT64.pack(length)
    repeated_mask = (mask * (length // MASK_BYTES + 1))[:length]
    masked = int.from_bytes(payload, "big") ^ int.from_bytes(repeated_mask, "big")
    return head + mask + masked.to_bytes(length, "big")


def new_key() -> str:
    """Return a random `Sec-WebSocket-Key`."""
    return base64.b64encode(os.urandom(KEY_BYTES)).decode()


def accept_of(key: str) -> str:
    """Return the `Sec-WebSocket-Accept` that a server must reply to a key."""
    digest = hashlib.sha1((key + ACCEPT_SUFFIX).encode(), usedforsecurity=False).digest()
    return base64.b64encode(digest).decode()


class WebSocket:
    """Open WebSocket. Synchronization: the event loop's thread only."""

    def __init__(self, stream: PeerStream, data: bytes, peer: str, budget: WorkBudget) -> None:
        """`data` are the bytes after the head of the reply."""
        self._stream = stream
        self._data = data
        self._peer = peer
        self._budget = budget
        self._frames = WebSocketReader()
        self._pong = asyncio.Event()

    async def send(self, text: str) -> None:
        """Send a text. Raises UnusableServer if the server accepts no more bytes for REPLY_S, and OSError."""
        self._stream.write(encode_frame(TEXT, text.encode()))
        try:
            async with asyncio.timeout(REPLY_S):
                await self._stream.drain()
        except TimeoutError:
            raise UnusableServer(f"{self._peer} has not read the values of imud for {REPLY_S:.0f} s") from None

    async def ping(self, wait_s: float) -> None:
        """Send a ping and wait for a pong. Raises UnusableServer after `wait_s`."""
        self._pong.clear()
        self._stream.write(encode_frame(PING, b""))
        try:
            async with asyncio.timeout(wait_s):
                await self._pong.wait()
        except TimeoutError:
            raise UnusableServer(f"{self._peer} has not replied to a ping for {wait_s:.0f} s") from None

    async def receive(self) -> None:
        """Reply to pings and ignore all messages until the end of the connection. Raises UnusableServer at the end."""
        data = self._data
        try:
            while self._process(self._frames.feed(data)):
                data = await self._stream.read()
                if not data:
                    break
        except InvalidFrame as error:
            raise UnusableServer(f"{self._peer} sent an invalid WebSocket frame: {error}") from None
        finally:
            self._stream.end_turn()
        raise UnusableServer(f"{self._peer} closed the connection")

    async def close(self) -> None:
        """Send a close frame and disconnect."""
        self._stream.write(encode_frame(CLOSE, b""))
        await self._stream.close()

    def _process(self, frames: Sequence[ControlFrame]) -> bool:
        """Process control frames. Return whether the connection continues."""
        ping: bytes | None = None
        for opcode, payload in frames:
            if opcode == CLOSE:
                return False
            if opcode == PONG:
                self._pong.set()
            else:
                ping = payload
        if ping is not None and self._budget.take_reply(self._peer):  # RFC 6455 permits a reply to the last ping only
            self._stream.write(encode_frame(PONG, ping))
        return True
