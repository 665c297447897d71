"""Who a device is and how it is set, as far as it said. One that comes back may be another, or set otherwise."""

from collections.abc import Mapping

from imud.contracts.driver import Identity
from imud.event import EventKind
from imud.runtime.notices import Notices


class KnownIdentity:
    """What is known of one device. Synchronization: the loop's thread only."""

    def __init__(self, notices: Notices) -> None:
        self.identity = Identity()
        self.settings: Mapping[str, str] = {}
        self._notices = notices

    def learn(self, now_ns: int, identity: Identity, settings: Mapping[str, str]) -> None:
        """It said who it is and how it is set; what differs from before is told."""
        before, known = self.identity, self.settings
        if before.serial_number and identity.serial_number != before.serial_number:
            message = f"another device: serial number {identity.serial_number}, was {before.serial_number}"
            self._notices.tell(now_ns, EventKind.CONFIGURATION, message, serial_number=identity.serial_number)
        changed = {name: value for name, value in settings.items() if known.get(name, value) != value}
        if changed:
            words = ", ".join(f"{name} is {value}, was {known[name]}" for name, value in changed.items())
            self._notices.tell(now_ns, EventKind.CONFIGURATION, f"settings of the device changed: {words}", **changed)
        self.identity, self.settings = identity, settings


def identity_words(identity: Identity) -> dict[str, str]:
    """An identity as the flat mapping of `DeviceStatus`, empty members left out."""
    words = {
        "product": identity.product,
        "serial_number": identity.serial_number,
        "firmware": identity.firmware,
        **(identity.details or {}),
    }
    return {name: value for name, value in words.items() if value}
