"""Two small drivers for tests. `fake-uart`: frames of `5A A5`, u16 length, u16 CRC (XMODEM over all else) and payload,
and text lines. `fake-can`: a device of node n sends 0x180 + n, eight bytes, each frame a sample.
"""

import binascii
import re
import struct
from collections.abc import Generator, Mapping, Sequence
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from imud.contracts.action import Action, Target
from imud.contracts.can import CanDriver
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, StreamCodec, TextLine
from imud.contracts.driver import SAMPLE_COUNTER, Identity, StreamDriver
from imud.contracts.session import Outcome, Request, RequestScript, never, of_text, says_nothing
from imud.contracts.settings import NoSettings, Settings
from imud.formats.can import STANDARD_ID_MAX, CanFilter, CanFrame, CyclicFrame
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
        return self._decode(flushing=False)

    def flush(self) -> Sequence[CodecEvent]:
        """Frames inside a longer one that never came."""
        return self._decode(flushing=True)

    def reset(self) -> None:
        """Forget what is pending."""
        self._pending.clear()

    def _decode(self, *, flushing: bool) -> list[CodecEvent]:
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


BASE: Final = 0x180
SYNC_ID: Final = 0x080


class FakeCanSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which device, and whether it wants a SYNC."""

    node: Annotated[int, Meta(ge=1, le=127)] = 1
    sync_ms: int = 0


class FakeCanCodec:
    """Every own frame is a sample, numbered by its first byte, but for those that begin with 0xFF."""

    def __init__(self, ledger: Ledger, settings: FakeCanSettings) -> None:
        self.ledger = ledger
        self._can_id = BASE + settings.node

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """One frame."""
        self.ledger.bytes_in += len(data)
        if can_id != self._can_id or extended:
            self.ledger.bytes_skipped += len(data)
            return ()
        self.ledger.bytes_in_good_frames += len(data)
        self.ledger.frames_good += 1
        if data[0] == 0xFF:
            self.ledger.frames_ignored += 1
            return ()
        self.ledger.frames_in_samples += 1
        return (Measurement(len(data), 0, data[0], temperature_c=20.0),)

    def flush(self) -> Sequence[CodecEvent]:
        """Nothing waits."""
        return ()

    def reset(self) -> None:
        """Nothing waits."""


def _cyclic(settings: FakeCanSettings) -> Sequence[CyclicFrame]:
    return [CyclicFrame(SYNC_ID, False, b"", settings.sync_ms * 1_000_000)] if settings.sync_ms else []


def _renumber(target: Target, *, node: int) -> RequestScript[None]:
    settings = msgspec.structs.replace(target.settings, node=node)
    yield Request(bytes([node]), "renumber", never, never, never, silent=True, settings=settings)


def fake_can_driver(name: str = "fake-can", base: int = BASE) -> CanDriver:
    """A row; another `base` makes it see devices that its codec does not understand."""
    return CanDriver(
        name=name,
        title="a fake",
        settings=FakeCanSettings,
        make_codec=FakeCanCodec,
        filters=lambda settings: [CanFilter(BASE + settings.node, STANDARD_ID_MAX, False)],
        tick_ns=SAMPLE_COUNTER,
        tick_modulus=0xFF,
        euler_convention="",
        navigation_frame="",
        node_of=lambda can_id, extended, data: (
            can_id - base if base < can_id <= base + 127 and not extended and len(data) == 8 else None
        ),
        node_settings=lambda node: FakeCanSettings(node=node),
        node_title=lambda node: f"node {node}",
        identify=lambda _settings: says_nothing(Identity("FAKE")),
        read_settings=lambda _settings: says_nothing({}),
        apply_identity=lambda _codec, _identity: None,
        sample_frames=1,
        example_frames=lambda _random: [CanFrame(BASE + 1, False, bytes(8), 0)],
        cyclic=_cyclic,
        actions={
            "node": Action("its number", lambda target: says_nothing(target.settings.node)),
            "renumber": Action("give it another number", _renumber),
        },
    )


def fake_can_frame(node: int, number: int = 0, t_ns: int = 0) -> CanFrame:
    """A frame of a device; number 255 is one that is no sample."""
    return CanFrame(BASE + node, False, bytes([number, *bytes(7)]), t_ns)
