"""Events have a limited rate and contain their causes."""

import msgspec
import pytest

from imud.contracts.codec import BadFrame, BadReason
from imud.device.health import DeviceEvents
from imud.host.log import RepeatFilter
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger
from imud.model.sample import Sync

S = 1_000_000_000


def make() -> tuple[DeviceEvents, Ledger, list[Event]]:
    events: list[Event] = []
    ledger = Ledger()
    return DeviceEvents("bow", ledger, events.append), ledger, events


def test_a_change_of_sync_losses_and_bad_frames_raise_limited_events() -> None:
    device_events, _, events = make()
    for t in range(5):
        device_events.tick(t * S, Sync.ARRIVAL)
    assert events == []
    device_events, _, events = make()
    device_events.tick(0, Sync.ARRIVAL)
    device_events.tick(1, Sync.ARRIVAL)
    device_events.tick(2, Sync.REGRESSION)
    assert [(e.kind, e.detail) for e in events] == [(EventKind.SYNC, {"sync": "regression", "before": "arrival"})]
    device_events, ledger, events = make()
    ledger.lost_crc = 2
    device_events.tick(10 * S, None)
    ledger.lost_gap_device = 5
    device_events.tick(10 * S + S // 2, None)
    assert [e.message for e in events] == ["2 samples lost"]
    device_events.tick(11 * S, None)
    assert [e.message for e in events] == ["2 samples lost", "5 samples lost"]
    assert events[1].kind is EventKind.LOSS
    assert events[1].detail == {"gap_device": 5, "crc": 2, "overrun": 0, "queue": 0}
    device_events, ledger, events = make()
    ledger.frames_bad_crc = 3
    device_events.bad_frame(BadFrame(BadReason.CRC, b"\x5a\xa5" + bytes(31), 0x188))
    device_events.tick(S, None)
    assert events[0].kind is EventKind.BAD_FRAME
    assert events[0].message == "3 bad frames, the last by crc of CAN identifier 188: 5a a5" + 30 * " 00"  # 32 bytes


def test_texts_of_an_event_are_printable_and_bounded() -> None:
    device_events, _, events = make()
    hostile = "a\n\x1b[31m\udc80" + "x" * 10_000
    device_events.raise_event(S, EventKind.LINK, hostile, message=hostile, kind=hostile, number=1)
    assert events[0].message.isprintable()
    assert len(events[0].message) <= 2000
    assert events[0].message.startswith(r"a\n\x1b[31m\udc80")
    assert isinstance(events[0].detail["kind"], str)
    assert events[0].detail["kind"].isprintable()
    assert events[0].detail["number"] == 1
    msgspec.json.encode(events[0])


def test_an_event_of_another_kind_is_logged_immediately(caplog: pytest.LogCaptureFixture) -> None:
    device_events, ledger, _ = make()
    repeats = RepeatFilter()
    for t, lost in enumerate((2, 3)):
        ledger.lost_crc += lost
        ledger.frames_bad_crc += 1
        device_events.bad_frame(BadFrame(BadReason.CRC, bytes((0x5A, 0xA5, 0xAB + t))))
        device_events.tick(t * S, None)
    device_events.raise_event(2 * S, EventKind.CONFIGURATION, "settings differ from the declared settings")
    for record in caplog.records:
        record.created = 1000.0
    told = [record.getMessage() for record in caplog.records if repeats.filter(record)]
    assert told == [
        "bow: 2 samples lost",
        "bow: 1 bad frame, the last by crc: 5a a5 ab",
        "bow: settings differ from the declared settings",
    ]
