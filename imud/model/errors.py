"""Errors that imud raises on purpose. Each message names what was expected, what came, and what to look at.

ImudError
 ├─ ConfigError          the configuration file cannot be used
 ├─ LinkError            a port, bus or file cannot be used
 │   ├─ LinkMissing      it is not there (unplugged, misspelt); it may come back
 │   ├─ LinkDenied       it is there, but this user may not open it
 │   └─ LinkBusy         another program holds it
 ├─ CommandError         a command to a device
 │   ├─ BadArgument      cannot be sent: an argument is out of range
 │   ├─ NoReply          no reply came in time
 │   └─ Rejected         the device answered that it will not
 ├─ TransferError        one transfer on a bus failed; the next may go through
 ├─ DeviceRefused        another device answers on a bus, or it refuses a setting
 ├─ NothingHeard         detection found no device
 └─ ServerError          the daemon's own interfaces: socket in use, shared memory not writable, protocol violated
"""

import os
import re
from enum import StrEnum

_NUMBER = re.compile(r"\[Errno (\d+)\]|\((\d+), ['\"]")
"""An error number inside the text of a library's error."""


class ImudError(Exception):
    """Root of all errors that imud raises on purpose."""


class ConfigError(ImudError):
    """The configuration file cannot be used. Example: an unknown key, a rate of NaN, a device without a link."""


class LinkError(ImudError):
    """A port, bus or file cannot be used. Example: the adapter was pulled out while reading."""


class LinkMissing(LinkError):
    """The port is absent, and may appear again. Example: /dev/ttyUSB0 after the cable moved."""


class LinkDenied(LinkError):
    """The port is there but may not be opened. Example: the user is not in group dialout."""


class LinkBusy(LinkError):
    """Another program holds the port. Example: a terminal program is still open on it."""


class CommandError(ImudError):
    """A command could not be carried out by a device."""


class BadArgument(CommandError, ValueError):
    """A command cannot be encoded. Example: a baud rate that the device does not have."""


class NoReply(CommandError):
    """No reply within the time-out. Example: the device is in another mode, or its receive line is not connected."""


class Rejected(CommandError):
    """The device refused a command. Example: `ERR` after a command with a value outside its range."""


class Trouble(StrEnum):
    """Kinds of failure of a transfer."""

    ABSENT = "absent"
    """Nobody acknowledges the address: not powered, not wired, another address."""
    STUCK = "stuck"
    """The bus did not come free in time: a line held low, a short circuit."""
    DISTURBED = "disturbed"
    """The controller saw an error on the bus, or another controller was quicker."""


class TransferError(ImudError):
    """A transfer on a bus failed; the next may succeed. Example: no acknowledgement from address 0x18."""

    def __init__(self, trouble: Trouble, message: str) -> None:
        super().__init__(message)
        self.trouble = trouble


class DeviceRefused(ImudError):
    """The device that answers is not the expected one, or refused a setting. Example: a wrong product id."""


class NothingHeard(ImudError):
    """Detection found no device on a link. Example: nothing valid at any of the six baud rates."""


class ServerError(ImudError):
    """One of the daemon's own interfaces cannot be used. Example: the socket belongs to another running daemon."""


def reason_of(error: BaseException) -> str:
    """Describe an error of the operating system or of a library in its words, without numbers, types and tuples.

    Also where a library has put the system's error into a text of its own, as pyserial and asyncio do.
    """
    number = next((argument for argument in error.args if isinstance(argument, int)), None)
    found = _NUMBER.search(str(error))
    if number is None and found is not None:
        number = int(found[1] or found[2])
    if number is not None and number > 0:
        return os.strerror(number)
    strerror = getattr(error, "strerror", None)
    return strerror or str(error) or type(error).__doc__ or "unknown"
