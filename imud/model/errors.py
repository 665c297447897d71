"""Errors that imud raises on purpose. Each message contains the expected value, the received value and the next step.

ImudError
 ├─ ConfigError          invalid configuration file
 ├─ LinkError            unusable port, bus or file
 │   ├─ LinkMissing      absent (unplugged, misspelt); it may appear again
 │   ├─ LinkDenied       present; the user lacks the permission to open it
 │   └─ LinkBusy         in use by another program
 ├─ CommandError         failed command to a device
 │   ├─ BadArgument      imud cannot send it: an argument is out of range
 │   │   └─ IsSetting    the command was removed: a setting replaces it
 │   ├─ DriverFailed     error in the code of a driver of another package
 │   ├─ NoReply          no reply before the timeout
 │   └─ Rejected         the device rejected the command
 ├─ TransferError        one failed transfer on a bus; the next transfer may succeed
 ├─ DeviceRefused        another device replies on a bus, or the device rejects a setting
 ├─ NothingHeard         detection found no device
 └─ ServerError          interfaces of the daemon: socket in use, shared memory not writable, protocol violated
"""

import os
import re
from collections.abc import Mapping
from enum import StrEnum
from typing import Any

_NUMBER = re.compile(r"\[Errno (\d+)\]|\((\d+), ['\"]")  # error number in the text of a library's error


class ImudError(Exception):
    """Base class of all errors that imud raises on purpose."""

    data: Mapping[str, Any] | None = None  # values for programs, which JSON can represent; None if there are none


class ConfigError(ImudError):
    """Invalid configuration file. Example: an unknown key, a rate of NaN, a device without a link."""


class LinkError(ImudError):
    """Unusable port, bus or file. Example: a replugged adapter during a read."""


class LinkMissing(LinkError):
    """Absent port, which may appear again. Example: /dev/ttyUSB0 after the cable was moved."""


class LinkDenied(LinkError):
    """Missing permission for a port. Example: the user is not in the group dialout."""


class LinkBusy(LinkError):
    """Port in use by another program. Example: a terminal program still has it open."""


class CommandError(ImudError):
    """Command that a device could not execute."""


class BadArgument(CommandError, ValueError):
    """Command that imud cannot encode. Example: a baud rate that the device does not support."""


class IsSetting(BadArgument):
    """Removed command. Example: `mode` is a setting. `data` contains `settings` and `save` for `settings.apply`."""

    def __init__(self, message: str, settings: Mapping[str, Any], *, save: bool) -> None:
        super().__init__(message)
        self.data: Mapping[str, Any] = {"settings": settings, "save": save}


class DriverFailed(CommandError):
    """Error in a driver of another package. Example: an exception in its decoder, or a vector of two values."""

    def __init__(self, driver: str, message: str) -> None:
        super().__init__(f"the driver {driver} of another package failed: {message}")
        self.driver = driver


class NoReply(CommandError):
    """No reply before the timeout. Example: the device is in another mode, or its receive line is not connected."""


class Rejected(CommandError):
    """Command that the device rejected. Example: `ERR` after a command with a value out of range."""


class Trouble(StrEnum):
    """Kinds of transfer failures."""

    ABSENT = "absent"  # no device acknowledges the address: no power, no wire, or another address
    STUCK = "stuck"  # the bus did not become free in time: a line held low, or a short circuit
    DISTURBED = "disturbed"  # the controller detected an error on the bus, or lost the arbitration


class TransferError(ImudError):
    """Failed transfer on a bus; the next transfer may succeed. Example: no acknowledgement from address 0x18."""

    def __init__(self, trouble: Trouble, message: str) -> None:
        super().__init__(message)
        self.trouble = trouble


class DeviceRefused(ImudError):
    """Reply from an unexpected device, or a rejected setting. Example: a wrong product id."""


class NotApplied(Rejected, DeviceRefused):
    """Write that the device confirmed, but does not report. The effect can follow later."""


class NothingHeard(ImudError):
    """Detection without a device on the link. Example: no valid frame at any of the six baud rates."""


class ServerError(ImudError):
    """Failure of an interface of the daemon. Example: another running daemon uses the socket."""


def reason_of(error: BaseException) -> str:
    """Return the reason of a system or library error as text, without numbers, types and tuples."""
    number = next((argument for argument in error.args if isinstance(argument, int)), None)
    # pyserial and asyncio put the number of the system error into their own text
    found = _NUMBER.search(str(error))
    if number is None and found is not None:
        number = int(found[1] or found[2])
    if number is not None and number > 0:
        return os.strerror(number)
    strerror = getattr(error, "strerror", None)
    return strerror or str(error) or type(error).__doc__ or "unknown"
