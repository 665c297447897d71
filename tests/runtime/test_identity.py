"""What is known of a device, and what is reported when it differs from before."""

from imud.contracts.driver import Identity
from imud.event import Event, EventKind
from imud.ledger import Ledger
from imud.runtime.identity import KnownIdentity, identity_words
from imud.runtime.notices import Notices


def test_only_differences_are_reported() -> None:
    events: list[Event] = []
    times_ns = iter((1, 2, 3, 4))
    known = KnownIdentity(Notices("bow", Ledger(), events.append), lambda: next(times_ns))
    known.update(Identity("HI14", "A1"), {"ATT_MODE": "0", "BAUD": "115200"})
    known.update(Identity("HI14", "A1"), {"ATT_MODE": "0", "BAUD": "115200", "NEW": "1"})
    assert not events
    known.update(Identity("HI14", "A1"), {"ATT_MODE": "1"})
    known.update(Identity("HI14", "B2"), {"ATT_MODE": "1"})
    assert [(event.t_ns, event.kind, event.message) for event in events] == [
        (3, EventKind.CONFIGURATION, "settings of the device changed: ATT_MODE is 1, was 0"),
        (4, EventKind.CONFIGURATION, "another device: serial number B2, was A1"),
    ]
    assert (known.identity.serial_number, known.settings) == ("B2", {"ATT_MODE": "1"})


def test_a_device_that_never_said_its_number_is_no_other() -> None:
    events: list[Event] = []
    known = KnownIdentity(Notices("bow", Ledger(), events.append), lambda: 5)
    known.update(Identity("HI14"), {})
    known.update(Identity("HI14", "B2"), {})
    assert not events


def test_words_leave_out_what_is_empty() -> None:
    assert identity_words(Identity("HI14", details={"BUILD": "x", "EMPTY": ""})) == {"product": "HI14", "BUILD": "x"}
