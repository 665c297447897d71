"""A small driver for tests: frames of `5A A5`, u16 length, u16 CRC (XMODEM over all else) and payload; text lines."""

import binascii
import re
import struct
from collections.abc import Generator, Mapping, Sequence
from typing import Final

from imud.contracts.codec import BadFrame, BadReason, CodecEvent, StreamCodec, TextLine
from imud.contracts.driver import Identity, StreamDriver
from imud.contracts.session import Outcome, Request, of_text
from imud.contracts.settings import NoSettings
from imud.ledger import Ledger
from imud.sample import Measurement

SYNC: Final = b"\x5a\xa5"
PAYLOAD_MAX: Final = 512
QUERY: Final = b"WHO\r\n"
REPLY: Final = b"NAME=FAKE\r\nREV=1\r\nOK\r\n"
BAUD_RATES: Final = (115200, 921600, 460800, 256000, 230400, 9600)

_LINE = re.compile(rb"[\x20-\x7e]{2,60}\r\n")


def fake_frame(payload: bytes) -> bytes:
    """A valid frame."""
    head = SYNC + struct.pack("<H", len(payload))
    return head + struct.pack("<H", binascii.crc_hqx(payload, binascii.crc_hqx(head, 0))) + payload


class FakeCodec:
    """A `StreamCodec` without the accounting of bytes that a real one has."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self._pending = bytearray()

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        """Events in the order of their ends."""
        self.ledger.bytes_in += len(data)
        self._pending += data
        return self._take(flushing=False)

    def flush(self) -> Sequence[CodecEvent]:
        """Frames inside a longer one that never came."""
        return self._take(flushing=True)

    def reset(self) -> None:
        """Forget what is pending."""
        self._pending.clear()

    def _take(self, *, flushing: bool) -> list[CodecEvent]:
        events: list[CodecEvent] = []
        pending = self._pending
        while (at := pending.find(SYNC)) >= 0:
            self._text(bytes(pending[:at]), events)
            del pending[:at]
            length = int.from_bytes(pending[2:4], "little")
            if len(pending) >= 4 and not 1 <= length <= PAYLOAD_MAX:
                self.ledger.frames_bad_length += 1
                del pending[:2]
                continue
            if len(pending) < 6 or len(pending) < 6 + length:
                if flushing and pending.find(SYNC, 2) > 0:
                    del pending[:2]
                    continue
                return events
            frame = bytes(pending[: 6 + length])
            if fake_frame(frame[6:]) == frame:
                self.ledger.frames_good += 1
                self.ledger.frames_in_samples += 1
                events.append(Measurement(len(frame), len(pending) - len(frame), None))
                del pending[: len(frame)]
            else:
                self.ledger.frames_bad_crc += 1
                events.append(BadFrame(BadReason.CRC, frame))
                del pending[:2]
        consumed = self._text(bytes(pending), events)
        del pending[:consumed]
        del pending[:-64]
        return events

    def _text(self, data: bytes, events: list[CodecEvent]) -> int:
        end = 0
        for line in _LINE.finditer(data):
            self.ledger.frames_good += 1
            self.ledger.frames_in_replies += 1
            events.append(TextLine(line[0].decode("ascii").strip()))
            end = line.end()
        return end


def _query(payload: bytes, name: str) -> Request:
    is_end, is_error, is_part = (
        of_text(holds) for holds in (lambda line: line == "OK", lambda line: line == "ERR", lambda line: "=" in line)
    )
    return Request(payload, name, is_end, is_error, is_part, messages_min=2)


def _identify() -> Generator[Request, Outcome, Identity]:
    yield _query(QUERY, "WHO")
    return Identity("FAKE")


def _read_settings() -> Generator[Request, Outcome, Mapping[str, str]]:
    yield _query(b"SET\r\n", "SET")
    return {}


def _apply(codec: StreamCodec, identity: Identity) -> None:
    """Nothing depends on the identity."""


FAKE_DRIVER: Final = StreamDriver(
    name="fake-uart",
    title="a fake",
    baud_rates=BAUD_RATES,
    settings=NoSettings,
    make_codec=lambda ledger, options: FakeCodec(ledger),
    tick_ns=1_000_000,
    tick_modulus=1 << 32,
    euler_convention="",
    navigation_frame="ENU",
    identify=_identify,
    read_settings=_read_settings,
    apply_identity=_apply,
    example_frame=lambda random: fake_frame(b"\x91" + random.randbytes(75)),
)
