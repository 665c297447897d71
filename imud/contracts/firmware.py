"""Contract of a firmware update: the image, the limits, and the part of a driver that writes the image."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import msgspec

from imud.contracts.codec import CodecEvent
from imud.contracts.command import Target
from imud.contracts.script import Request, RequestScript
from imud.model.errors import BadArgument, CommandError, Rejected
from imud.model.ledger import Ledger

IMAGE_BYTES_MAX: Final = 1 << 20  # Maximum length of an image, bytes. The microcontrollers have at most 1 MiB of flash.
TRIES: Final = 3  # Maximum number of times that imud sends the complete image
ENTER_TRIES: Final = 20  # Maximum number of requests to the boot loader until its first reply
TOTAL_S: Final = 1800.0
"""Maximum time of an update, s. 512 KiB take about 600 s at 9600 baud and about 300 s on CAN at 125 kbit/s."""
PRODUCT_MAX: Final = 64  # maximum length of the name of a product, and of a version

# Names of HiPNUC products in an image. The name must not be a part of a longer word.
_PRODUCT: Final = re.compile(rb"(?<![0-9A-Za-z])(?:HI\d\d|CH0\d\d|CH10\d)(?:[A-Z]\d?)?(?![0-9A-Za-z])")
_FAMILY: Final = re.compile(r"(?:HI\d\d|CH0\d\d|CH10\d)")


class FirmwareImage(msgspec.Struct, frozen=True):
    """Bytes for the flash memory of a device."""

    address: int  # address of the first byte
    data: bytes

    @property
    def end(self) -> int:
        """Address after the last byte."""
        return self.address + len(self.data)

    def products(self) -> list[str]:
        """Return the names of HiPNUC products in the image, each name once, in alphabetical order."""
        return sorted({found.decode() for found in _PRODUCT.findall(self.data)})


class FirmwareResult(msgspec.Struct, frozen=True):
    """Result of a complete transfer of an image."""

    product: str  # product that the device reports; empty if it does not report one
    before: str  # version before the update; empty if the device did not report it
    after: str  # version after the update; empty if the device did not report it
    size_bytes: int  # length of the image
    verified: bool  # whether the device reports the expected version
    evidence: str  # evidence for the version, or the reason why imud could not verify it
    duration_s: float


class FirmwareControl(Protocol):
    """Firmware update of one device, for clients with permission. `imud.device` implements it, and outputs may not
    import that part."""

    async def update(self, image: FirmwareImage, product: str, version: str) -> FirmwareResult:
        """Write an image and verify the version. `product`: product of the image according to the user; `version`:
        expected version; both can be empty. Raises ImudError."""
        ...


class LostContact(CommandError):
    """The boot loader did not reply, or replied with damaged frames. A new transfer of the image can succeed."""


class EraseRefused(Rejected):
    """The boot loader refused the first erase of an update, and imud requested the start of the old application. Only a
    reply of the application shows that the flash memory is unchanged."""


Report = Callable[[str, int, int], None]
"""Reports the progress: the phase, and the number of bytes of all bytes that the device confirmed."""


class BootLoaderCodec(Protocol):
    """Decoder of the replies of a boot loader on a byte link."""

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        """Decode the next bytes of the stream. Return the completed events. Never raises an exception."""
        ...

    def flush(self) -> Sequence[CodecEvent]:
        """Drop an incomplete reply. Return the complete replies inside it."""
        ...

    def reset(self) -> None:
        """Count the pending bytes as skipped."""
        ...


@dataclass(frozen=True, slots=True)
class Firmware:
    """Update of the firmware by one driver."""

    # Returns the script that writes the image and starts the new firmware. Before it erases the flash memory, the
    # script reports the phase ERASE. Raises BadArgument, EraseRefused, Rejected, LostContact.
    update: Callable[[Target, FirmwareImage, Report], RequestScript[None]]
    # Request that only the boot loader answers, for the options of the driver
    ping: Callable[[Any], Request]
    # Makes the decoder of the replies; None if the codec of the driver returns the replies
    make_codec: Callable[[Ledger], BootLoaderCodec] | None = None
    # Returns the script that searches for the application at all baud rates, keeps its baud rate, and returns the
    # necessary change of the configuration, empty if none is necessary. None: the link has no baud rate
    find: Callable[[Target], RequestScript[str]] | None = None


FLASH_STARTS: Final = (0x0000_0000, 0x0800_0000)
"""First addresses of flash memory in microcontrollers: NXP Kinetis, ST STM32. Some boot loaders do not report it."""

ENTER, ERASE, WRITE, START = "enter the boot loader", "erase", "write", "start the new firmware"


def check_product(image: FirmwareImage, device: str, stated: str) -> None:
    """Check that an image is for a product. `device`: product that the device reports; empty if it is not known.
    `stated`: product of the image according to the user; empty without a statement.

    An Intel HEX file has no field for the product. The evidence is a product name in the image, or the statement.
    Raises BadArgument.
    """
    named = image.products()
    wanted = device or stated
    if not wanted:
        raise BadArgument(
            f"expected the product of the device, got none: the device cannot report it now; "
            f"state it with --product{f', for example --product {named[0]}' if named else ''}"
        )
    if device and stated and not _same(device, stated):
        raise BadArgument(f"expected an image for {device}, got an image for {stated} according to --product")
    fits = any(_same(wanted, name) for name in named)
    if named and not fits:
        raise BadArgument(f"expected an image for {wanted}, got an image that names {', '.join(named)}")
    if not named and not stated:
        raise BadArgument(
            f"expected an image for {wanted}, got an image that names no product; if the vendor supplied it for this "
            f"product, add --product {wanted}"
        )


def check_range(image: FirmwareImage, start: int | None, flash_bytes: int = IMAGE_BYTES_MAX) -> None:
    """Raise BadArgument for an image outside the flash memory. `start`: None if the boot loader does not report it."""
    starts = FLASH_STARTS if start is None else (start,)
    if not any(one <= image.address and image.end <= one + flash_bytes for one in starts):
        ranges = " or ".join(f"{one:#010x} … {one + flash_bytes - 1:#010x}" for one in starts)
        raise BadArgument(
            f"expected addresses in the flash memory {ranges}, got {image.address:#010x} … {image.end - 1:#010x}"
        )


def _same(one: str, other: str) -> bool:
    """Return whether two names belong to one product: HI14R3 and HI14 do, HI14R3 and HI14R2 do not.

    A suffix of the order code (HI14R3-URT-000) must be equal only if both names have one. The vendor's own programs
    show the names HI14 and HI14R3 without a suffix, and their update compares no names.
    """
    one, _, suffix = one.upper().partition("-")
    other, _, other_suffix = other.upper().partition("-")
    if suffix and other_suffix and suffix != other_suffix:
        return False
    begin, begin_other = _FAMILY.match(one), _FAMILY.match(other)
    if begin is None or begin_other is None:
        return one == other
    return one == other or (begin[0] == begin_other[0] and begin[0] in (one, other))
