"""Rules for every codec after each input: the ledger balances, the memory is limited, all events are counted."""

from collections.abc import Iterable, Sequence
from math import isnan, pi
from random import Random
from typing import Final

import msgspec

from imud.contracts.codec import BadFrame, BadReason, CanCodec, CodecEvent, PolledCodec, PolledEvent, StreamCodec
from imud.contracts.script import ReplyFrame, TextLine
from imud.formats.can import CanFrame
from imud.model.ledger import Ledger
from imud.model.sample import Measurement

PENDING_BYTES_MAX: Final = 2048
"""Maximum number of pending bytes. Protocols have frames up to 1 KiB and lines up to 256 characters."""
PENDING_FRAMES_MAX: Final = 16  # Maximum number of pending CAN frames. No sample needs more frames.


def untimed(events: Iterable[CodecEvent]) -> list[CodecEvent]:
    """Return events without the number of the following bytes in the same read, which depends on the split."""
    return [
        msgspec.structs.replace(event, trailing_bytes=0) if isinstance(event, Measurement) else event
        for event in events
    ]


def cut(data: bytes, random: Random) -> list[bytes]:
    """Return `data` in parts of random sizes, from single bytes to all bytes."""
    longest = random.choice((1, 3, 20, 100, 1000, len(data) + 1))
    parts: list[bytes] = []
    while data:
        size = random.randint(1, longest)
        parts.append(data[:size])
        data = data[size:]
    return parts


def feed_stream(codec: StreamCodec, parts: Iterable[bytes]) -> list[CodecEvent]:
    """Feed `parts`. After each part, check that the ledger balances and that the memory is limited."""
    events: list[CodecEvent] = []
    fed = 0
    for part in parts:
        ledger = codec.ledger
        there = ledger.bytes_pending + len(part)
        new = codec.feed(part)
        events += new
        fed += len(part)
        assert ledger.bytes_in == fed
        check_closed(ledger)
        assert 0 <= ledger.bytes_pending <= PENDING_BYTES_MAX
        taken = [event for event in new if isinstance(event, Measurement)]
        assert all(event.trailing_bytes >= 0 and event.size_bytes + event.trailing_bytes <= there for event in taken)
    check_counted(codec.ledger, events)
    return events


def feed_frames(codec: CanCodec, frames: Iterable[CanFrame]) -> list[CodecEvent]:
    """Feed frames. After each frame, check that the ledger balances and that the memory is limited."""
    events: list[CodecEvent] = []
    fed = 0
    for frame in frames:
        events += codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns)
        fed += len(frame.data)
        ledger = codec.ledger
        assert ledger.bytes_in == fed
        check_closed(ledger)
        assert ledger.frames_pending <= PENDING_FRAMES_MAX
    check_counted(codec.ledger, events)
    return events


def decode_polled(codec: PolledCodec, poll: int, data: bytes) -> Sequence[PolledEvent]:
    """Decode one transfer. Check that the ledger counts every byte and balances."""
    ledger = codec.ledger
    before, bad = ledger.bytes_in, ledger.frames_bad()
    events = codec.decode(poll, data)
    assert before <= ledger.bytes_in <= before + len(data)
    check_closed(ledger)
    damaged = [e for e in events if isinstance(e, BadFrame) and e.reason is not BadReason.NOT_FINITE]
    assert ledger.frames_bad() - bad == len(damaged)
    return events


def check_closed(ledger: Ledger) -> None:
    """Fail if the ledger does not count every byte and frame, or if a counter is negative."""
    book = ledger
    bytes_known = book.bytes_in_good_frames + book.bytes_in_bad_frames + book.bytes_skipped + book.bytes_pending
    frames_known = book.frames_in_samples + book.frames_in_replies + book.frames_ignored + book.frames_pending
    assert book.bytes_in == bytes_known, book.snapshot()
    assert book.frames_good == frames_known, book.snapshot()
    assert min(book.values()) >= 0, book.snapshot()


def check_counted(ledger: Ledger, events: Sequence[CodecEvent]) -> None:
    """Fail unless the ledger counts `events`, which are all events since its start."""
    bad = [event for event in events if isinstance(event, BadFrame)]
    assert ledger.frames_bad() == sum(event.reason is not BadReason.NOT_FINITE for event in bad)
    assert ledger.frames_not_finite == sum(event.reason is BadReason.NOT_FINITE for event in bad)
    assert ledger.frames_in_replies == sum(isinstance(event, TextLine | ReplyFrame) for event in events)


def finite(measurement: Measurement, partial: bool) -> bool:
    """Return whether all numbers are finite. `partial`: a vector can contain non-finite numbers."""
    m, place = measurement, measurement.position
    values = (m.accel_m_s2, m.gyro_rad_s, m.euler_rad, m.quat_wxyz, m.velocity_enu_m_s)
    if place is not None and not (abs(place.latitude_rad) <= pi / 2 + 1e-9 and abs(place.longitude_rad) <= pi + 1e-9):
        return False
    for vector in values:
        if vector is None:
            continue
        known = [number for number in vector if not isnan(number)] if partial else vector
        if not known or not all(-1e40 < number < 1e40 for number in known):
            return False
    return True
