"""The row a device file ends with: everything the rest of imud needs to know about one wire protocol."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from random import Random
from typing import Any

from imud.kit.codec import StreamCodec
from imud.kit.session import Conversation
from imud.kit.settings import Settings
from imud.ledger import Ledger


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device says it is. Empty strings where it does not say."""

    product: str = ""
    serial_number: str = ""
    firmware: str = ""
    details: Mapping[str, str] | None = None
    """Everything else it said, by the device's own names."""


@dataclass(frozen=True, slots=True)
class StreamDriver:
    """A device that sends a byte stream by itself (UART, RS-232, USB serial)."""

    name: str
    """Family and link, for example `hipnuc-uart`."""
    title: str
    """Vendor and products, for people."""
    baud_rates: tuple[int, ...]
    """Rates the device knows, in bit/s, most likely first: detection tries them in this order."""
    settings: type[Settings]
    """What can be configured of the codec (`options` of a device)."""
    make_codec: Callable[[Ledger, Any], StreamCodec]
    """Makes a codec that counts into the ledger, from an instance of `settings`."""
    tick_ns: int
    """Length of one device tick in ns."""
    tick_modulus: int
    """Device time counts 0 … tick_modulus - 1."""
    euler_convention: str
    """Order, axes and signs of `euler_rad`, in words."""
    navigation_frame: str
    """The frame that `quat_wxyz` turns into, for example `ENU`."""
    identify: Callable[[], Conversation[Identity]]
    """Asks the device what it is. Sends only queries."""
    read_settings: Callable[[], Conversation[Mapping[str, str]]]
    """Reads back the device's own settings, by the device's own names. Sends only queries."""
    apply_identity: Callable[[StreamCodec, Identity], None]
    """Tells the codec what is known of the device (the meaning of a field can depend on the firmware)."""
    example_frame: Callable[[Random], bytes]
    """One valid frame with random values, for the shared property tests and for fault injection."""
