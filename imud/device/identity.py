"""Identity and settings that a device reported last, as every output can show them."""

from collections.abc import Mapping
from itertools import islice

from imud.contracts.driver import Driver, Identity
from imud.device.health import DeviceEvents
from imud.host.clock import HostClock
from imud.host.log import printable
from imud.model.event import EventKind

WORDS_MAX = 200  # maximum number of settings or details of one device. The HI14 has the most, about 60.


class KnownIdentity:
    """Identity and settings of one device. Synchronization: the loop's thread only."""

    def __init__(self, events: DeviceEvents, host: HostClock) -> None:
        self.identity = Identity()
        self.settings: Mapping[str, str] = {}  # settings by the names that the device uses
        self.shown_settings: Mapping[str, str] = {}  # settings with readable values
        self.answered = False  # whether the device replied to all requests of the newest query
        self._events = events
        self._host = host

    def update_identity(self, identity: Identity) -> None:
        """Store a new identity. Raise an event if another device has replied."""
        before = self.identity
        self.identity = identity = completed(printable_identity(identity), before)
        if before.serial_number and identity.serial_number != before.serial_number:
            message = f"another device: serial number {identity.serial_number}, was {before.serial_number}"
            serial_number = identity.serial_number
            self._events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message, serial_number=serial_number)

    def update_settings(self, settings: Mapping[str, str], driver: Driver | None) -> None:
        """Store new settings, made readable by `driver`. Raise an event if a known setting has another value."""
        settings, known = printable_words(settings), self.shown_settings
        shown = printable_words(driver.shown_settings(settings)) if driver is not None else settings
        changed = {name: value for name, value in shown.items() if known.get(name, value) != value}
        if changed:
            words = ", ".join(f"{name} is {value}, was {known[name]}" for name, value in changed.items())
            message = f"settings of the device changed: {words}"
            self._events.raise_event(self._host.now_ns(), EventKind.CONFIGURATION, message, **changed)
        self.settings, self.shown_settings = settings, shown


def completed(identity: Identity, before: Identity) -> Identity:
    """Return `identity` with its empty members from `before`, unless both belong to different devices.

    An adapter that was just plugged in can lose bytes of the first replies.
    """
    pairs = ((identity.product, before.product), (identity.serial_number, before.serial_number))
    if any(new and old and new != old for new, old in pairs):
        return identity
    return Identity(
        identity.product or before.product,
        identity.serial_number or before.serial_number,
        identity.firmware or before.firmware,
        before.details if identity.details is None else identity.details,
    )


def printable_identity(identity: Identity) -> Identity:
    """Return an identity with texts of limited length in printable characters."""
    product, serial, firmware = map(printable, (identity.product, identity.serial_number, identity.firmware))
    return Identity(product, serial, firmware, None if identity.details is None else printable_words(identity.details))


def printable_words(words: Mapping[str, str]) -> dict[str, str]:
    """Return the first WORDS_MAX names and texts of a device, in printable characters of limited length."""
    return {printable(name): printable(text) for name, text in islice(words.items(), WORDS_MAX)}


def identity_words(identity: Identity) -> dict[str, str]:
    """Return an identity as the mapping in `DeviceStatus`, without empty members."""
    words = {
        "product": identity.product,
        "serial_number": identity.serial_number,
        "firmware": identity.firmware,
        **(identity.details or {}),
    }
    return {name: value for name, value in words.items() if value}
