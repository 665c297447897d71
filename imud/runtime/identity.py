"""Identity and settings of a device: requested, kept, and compared with those of before.

A device that was unplugged and connected again may be another one, or have other settings.
"""

import logging
from collections.abc import Callable, Iterator, Mapping
from itertools import chain, islice, repeat

from imud.contracts.driver import Identity
from imud.contracts.session import RequestScript
from imud.errors import CommandError
from imud.event import EventKind
from imud.log import printable
from imud.runtime.exchange import Exchange
from imud.runtime.notices import Notices

log = logging.getLogger(__name__)

IDENTIFY_TRIES = 3
IDENTIFY_AGAIN_S = (5, 30, 120, 300)
"""Pauses before a device that has not answered is asked again, the last of them for ever: right after a plug requests
and replies can be lost, and a line that is wired later, or a host that is busy for minutes, must not cost the identity
until the next plug. One whose RX is not wired gets one request in five minutes for nothing."""
WORDS_MAX = 200
"""Settings or details of one device; the HI14 has the most, some 60."""


def pauses_s() -> Iterator[int]:
    """Return the pauses before the further requests to a device that has not answered, without an end."""
    return chain(IDENTIFY_AGAIN_S, repeat(IDENTIFY_AGAIN_S[-1]))


def ignore_settings(_settings: Mapping[str, str]) -> None:
    """Ignore the settings: the version for devices on which nothing depends on them."""


class KnownIdentity:
    """Identity and settings of one device as read back last. Synchronization: the loop's thread only."""

    def __init__(
        self,
        notices: Notices,
        now_ns: Callable[[], int],
        on_settings: Callable[[Mapping[str, str]], None] = ignore_settings,
        describe: Callable[[Mapping[str, str]], Mapping[str, str]] = dict,
    ) -> None:
        """`on_settings` is called with settings as they are read back, `describe` makes them readable for people."""
        self.identity = Identity()
        self.settings: Mapping[str, str] = {}
        """By the device's own names."""
        self.shown_settings: Mapping[str, str] = {}
        """The same for people."""
        self.answered = False
        """Whether the device answered every question about it when it was asked last."""
        self._notices = notices
        self._now_ns = now_ns
        self._on_settings = on_settings
        self._describe = describe

    async def ask(
        self,
        exchange: Exchange,
        identify: Callable[[], RequestScript[Identity]],
        read_settings: Callable[[], RequestScript[Mapping[str, str]]],
        apply: Callable[[Identity], None],
        tries: int = IDENTIFY_TRIES,
    ) -> bool:
        """Ask for identity and settings; `apply` gets the identity. Return whether the device answered both.

        What is known of a device that does not answer is left as it is; one that tells its identity only has that.
        """
        self.answered = False
        for attempt in range(1, tries + 1):
            try:
                identity = await exchange.run(identify())
                apply(identity)
                self._keep_identity(identity)
                self._keep_settings(await exchange.run(read_settings()))
                self.answered = True
                return True
            except CommandError as error:
                log.info("%s: %s (try %d of %d)", self._notices.device, error, attempt, tries)
        return False

    def update(self, identity: Identity, settings: Mapping[str, str]) -> None:
        """Keep what the device said; raise an event for what differs from before."""
        self._keep_identity(identity)
        self._keep_settings(settings)

    def _keep_identity(self, identity: Identity) -> None:
        """Keep who the device says it is; raise an event when it is another one than before."""
        before = self.identity
        self.identity = identity = completed(printable_identity(identity), before)
        if before.serial_number and identity.serial_number != before.serial_number:
            message = f"another device: serial number {identity.serial_number}, was {before.serial_number}"
            serial_number = identity.serial_number
            self._notices.raise_event(self._now_ns(), EventKind.CONFIGURATION, message, serial_number=serial_number)

    def _keep_settings(self, settings: Mapping[str, str]) -> None:
        """Keep the settings that the device said; raise an event for those that differ from before."""
        settings, known = printable_words(settings), self.shown_settings
        shown = printable_words(self._describe(settings))
        changed = {name: value for name, value in shown.items() if known.get(name, value) != value}
        if changed:
            words = ", ".join(f"{name} is {value}, was {known[name]}" for name, value in changed.items())
            message = f"settings of the device changed: {words}"
            self._notices.raise_event(self._now_ns(), EventKind.CONFIGURATION, message, **changed)
        self.settings, self.shown_settings = settings, shown
        self._on_settings(settings)


def completed(identity: Identity, before: Identity) -> Identity:
    """Return an identity with what its answer lost taken from the one before, if both can be of the same device.

    An adapter that was just plugged in can lose bytes of the first answers.
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
    """Return an identity as every output can have it: each text bounded, in printable characters."""
    product, serial, firmware = map(printable, (identity.product, identity.serial_number, identity.firmware))
    return Identity(product, serial, firmware, None if identity.details is None else printable_words(identity.details))


def printable_words(words: Mapping[str, str]) -> dict[str, str]:
    """Return names and texts of a device, WORDS_MAX at most, each bounded, in printable characters."""
    return {printable(name): printable(text) for name, text in islice(words.items(), WORDS_MAX)}


def identity_words(identity: Identity) -> dict[str, str]:
    """Return an identity as the flat mapping of `DeviceStatus`, empty members left out."""
    words = {
        "product": identity.product,
        "serial_number": identity.serial_number,
        "firmware": identity.firmware,
        **(identity.details or {}),
    }
    return {name: value for name, value in words.items() if value}
