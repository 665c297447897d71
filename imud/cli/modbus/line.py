"""Search for the modules of an RS-485 line, and assignment of their addresses."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from time import sleep
from typing import Final, TypeVar

import msgspec

from imud.contracts.driver import Identity
from imud.contracts.polling import Transfer, TransferScript, run_transfer_script
from imud.devices.hipnuc.modbus.codec import HipnucModbusSettings
from imud.devices.hipnuc.modbus.frames import check_id, randomise_ids, serial_bytes, set_id_by_serial
from imud.devices.hipnuc.modbus.session import probe, save, set_id
from imud.errors import CommandError, DeviceRefused, TransferError
from imud.formats.modbus import BROADCAST
from imud.links.rs485.link import Rs485Link, Rs485Settings
from imud.runtime.identity import printable_identity

T = TypeVar("T")

TRIES: Final = 3
SETTLE_S: Final = 0.3
"""Time for modules to apply new addresses; the manual gives none."""


class FoundModule(msgspec.Struct, frozen=True, omit_defaults=True):
    """A module that answered at one address."""

    baud: int
    address: int
    product: str = ""
    serial_number: str = ""
    firmware: str = ""
    problem: str = ""
    """The fault at this address; the other fields are then unknown."""


@contextmanager
def opened(port: str, baud: int, reply_ms: int) -> Iterator[Rs485Link]:
    """Open the line for this program alone. Raises LinkError."""
    link = Rs485Link(Rs485Settings(line=port, baud=baud, reply_ms=reply_ms))
    link.open()
    try:
        yield link
    finally:
        link.close()


def scan(link: Rs485Link, baud: int, addresses: Iterable[int]) -> list[FoundModule]:
    """Ask at every address which module is there. Raises LinkError.

    Where none answers, or not clearly, it is asked once more after all others; and a third time on a line on which
    something was heard. Noise, or a module that is just busy, costs single answers.
    """
    asked = list(addresses)
    found: dict[int, FoundModule | None] = dict.fromkeys(asked)
    for number in range(TRIES):
        if number == TRIES - 1 and not any(found.values()):
            break
        for address in asked:
            before = found[address]
            if before is None or before.problem:
                found[address] = _look(link, baud, address) or before
    return [one for one in found.values() if one is not None]


def assign_by_serial(link: Rs485Link, baud: int, serial_number: str, new_id: int) -> FoundModule:
    """Set the address of the module with this serial number. Raises CommandError, LinkError."""
    wanted = serial_bytes(serial_number).hex().upper()
    order = set_id_by_serial(serial_number, new_id)
    _check_free(link, new_id, wanted)
    _broadcast(link, order)
    return _expect(link, baud, new_id, wanted)


def assign_by_address(link: Rs485Link, baud: int, address: int, new_id: int) -> FoundModule:
    """Change the address of the module at one address. Raises CommandError, LinkError."""
    check_id("address", address)
    script = set_id(new_id)
    before = _identity(link, address)
    if before is None:
        raise CommandError(f"no module answers at address {address}")
    _check_free(link, new_id, before.serial_number)
    try:
        _run(link, address, script)
    except DeviceRefused as error:
        raise CommandError(f"address {address}: {error}") from error
    return _expect(link, baud, new_id, before.serial_number)


def randomise(link: Rs485Link, lowest: int, highest: int) -> None:
    """Make every module choose a random address of a range. Raises BadArgument, LinkError."""
    _broadcast(link, randomise_ids(lowest, highest))


def keep(link: Rs485Link, found: FoundModule) -> None:
    """Make a module save its settings. Raises CommandError, LinkError."""
    try:
        _run(link, found.address, save())
    except (TransferError, DeviceRefused) as error:
        raise CommandError(f"address {found.address}: not saved: {error}") from error


def _look(link: Rs485Link, baud: int, address: int) -> FoundModule | None:
    strange = link.heard.strange
    try:
        who = printable_identity(_run(link, address, probe(HipnucModbusSettings())))
    except DeviceRefused as error:
        return FoundModule(baud, address, problem=f"{error}; are there two modules with this address?")
    except TransferError as error:
        return FoundModule(baud, address, problem=str(error)) if link.heard.strange > strange else None
    return FoundModule(baud, address, who.product, who.serial_number, who.firmware)


def _identity(link: Rs485Link, address: int) -> Identity | None:
    """Read the identity of the module at an address; None for no answer. Raises CommandError for invalid replies."""
    problem: Exception | None = None
    for _ in range(TRIES):
        try:
            return printable_identity(_run(link, address, probe(HipnucModbusSettings())))
        except TransferError:
            continue
        except DeviceRefused as error:
            problem = error
    if problem is not None:
        raise CommandError(f"address {address}: {problem}; are there two modules with this address?")
    return None


def _check_free(link: Rs485Link, address: int, serial_number: str) -> None:
    there = _identity(link, address)
    if there is not None and there.serial_number != serial_number:
        raise CommandError(f"address {address} is taken by {there.product}, serial number {there.serial_number}")


def _expect(link: Rs485Link, baud: int, address: int, serial_number: str) -> FoundModule:
    there = _identity(link, address)
    if there is None:
        raise CommandError(
            f"no module answers at address {address}: is a module with serial number {serial_number} on this line, at "
            f"{baud} baud, and does its firmware know function 0x50?"
        )
    if there.serial_number != serial_number:
        raise CommandError(f"expected serial number {serial_number} at address {address}, got {there.serial_number}")
    return FoundModule(baud, address, there.product, there.serial_number, there.firmware)


def _broadcast(link: Rs485Link, order: Transfer) -> None:
    link.select(BROADCAST)
    link.transfer(order)
    sleep(SETTLE_S)


def _run(link: Rs485Link, address: int, script: TransferScript[T]) -> T:
    link.select(address)
    return run_transfer_script(script, link.transfer)
