"""Identity and settings of a device, and events about changes."""

from collections.abc import Mapping
from unittest.mock import Mock

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.driver import Identity
from imud.contracts.setting import DeviceReport
from imud.device.flash import SettingsFiles
from imud.device.health import DeviceEvents
from imud.device.settings import DeviceSettings, identity_words
from imud.host.clock import HostClock
from imud.links.memory import MemoryOptions
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger


def known_by(events: list[Event]) -> DeviceSettings:
    """Return the settings of a device without a driver."""
    host = HostClock(lambda: 5)
    config = DeviceConfig("bow", "auto", None, True, "memory", MemoryOptions(name="/dev/fake", baud=115200))
    told = DeviceEvents("bow", Ledger(), events.append)
    return DeviceSettings(config, Mock(driver=None), told, Mock(), host, SettingsFiles(None, host))


def update(known: DeviceSettings, identity: Identity, settings: Mapping[str, str]) -> None:
    known.update_identity(identity)
    known.update({"": DeviceReport(settings)})


def test_only_differences_to_a_known_device_are_reported() -> None:
    events: list[Event] = []
    known = known_by(events)
    update(known, Identity("HI14", "A1"), {"ATT_MODE": "0", "BAUD": "115200"})
    update(known, Identity("HI14", "A1"), {"ATT_MODE": "0", "BAUD": "115200", "NEW": "1"})
    assert not events
    update(known, Identity("HI14", "A1"), {"ATT_MODE": "1"})
    update(known, Identity("HI14", "B2"), {"ATT_MODE": "1"})
    assert [(event.kind, event.message) for event in events] == [
        (EventKind.CONFIGURATION, "settings of the device changed: ATT_MODE is 1, was 0"),
        (EventKind.CONFIGURATION, "another device: serial number B2, was A1"),
    ]
    assert (known.identity.serial_number, known.shown) == ("B2", {"ATT_MODE": "1"})
    events = []
    known = known_by(events)
    update(known, Identity("HI14"), {})
    update(known, Identity("HI14", "B2"), {})
    assert not events


def test_lost_members_of_an_identity_are_kept_and_its_words_have_no_empty_member() -> None:
    """A new adapter can lose bytes of the first replies."""
    events: list[Event] = []
    known = known_by(events)
    whole = Identity("HI14", "A1", "1.5.6", {"BUILD": "x"})
    update(known, whole, {})
    for damaged in (Identity("HI14"), Identity("", "A1", "1.5.6"), Identity()):
        update(known, damaged, {})
        assert known.identity == whole
    assert not events
    update(known, Identity("HI14", "A1", "1.6.9", {"BUILD": "y"}), {})
    assert known.identity == Identity("HI14", "A1", "1.6.9", {"BUILD": "y"})
    events = []
    known = known_by(events)
    update(known, Identity("HI14", "A1", "1.5.6"), {})
    update(known, Identity("", "B2"), {})
    assert known.identity == Identity("", "B2")
    assert [event.message for event in events] == ["another device: serial number B2, was A1"]
    update(known, Identity("CH0"), {})
    assert known.identity == Identity("CH0", "B2")
    update(known, Identity("HI14"), {})
    assert known.identity == Identity("HI14")
    assert identity_words(Identity("HI14", details={"BUILD": "x", "EMPTY": ""})) == {"product": "HI14", "BUILD": "x"}


HOSTILE = "\x1b[2J\n\udc80\ud800\u202e" + "x" * 10_000


def test_texts_of_a_device_have_limited_printable_characters() -> None:
    """Long, unprintable, not UTF-8, and with the names of parameters of imud."""
    events: list[Event] = []
    known = known_by(events)
    names = ("message", "kind", "now_ns", "self", "device", HOSTILE)
    many = {f"n{number}": HOSTILE for number in range(10_000)}
    update(known, Identity(HOSTILE, HOSTILE, HOSTILE, many), dict.fromkeys(names, "old"))
    update(known, Identity("HI14", "B2"), dict.fromkeys(names, HOSTILE))
    update(known, Identity(HOSTILE, HOSTILE, HOSTILE, many), {})
    # the settings of another device are not a change
    assert [event.message[:15] for event in events] == ["another device:"] * 2
    update(known, Identity(HOSTILE, HOSTILE, HOSTILE, many), dict.fromkeys(names, "old"))
    update(known, Identity(HOSTILE, HOSTILE, HOSTILE, many), dict.fromkeys(names, HOSTILE))
    assert set(names[:-1]) <= set(events[2].detail)
    shown = [known.identity, known.shown, identity_words(known.identity), *events]
    for one in shown:
        assert len(msgspec.json.encode(one)) < 100_000
    texts = [text for event in events for text in (event.message, *event.detail, *event.detail.values())]
    texts += [text for pair in identity_words(known.identity).items() for text in pair]
    assert all(isinstance(text, str) and text.isprintable() for text in texts)
