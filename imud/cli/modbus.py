"""`imud modbus`: find the devices on an RS-485 bus and set their addresses.

The command sends requests, and an RS-485 bus has one master: stop the daemon first, or remove the bus from the
configuration.
"""

import argparse
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from time import sleep
from typing import Final, TypeVar

import msgspec

from imud.cli.arguments import CliCommand
from imud.cli.output import table
from imud.contracts.driver import Identity
from imud.contracts.script import Transfer, TransferScript, run_transfer_script
from imud.device.settings import printable_identity
from imud.drivers.hipnuc.modbus.codec import HipnucModbusOptions
from imud.drivers.hipnuc.modbus.commands import probe, save, set_id
from imud.drivers.hipnuc.modbus.registers import (
    BAUD_RATES,
    FACTORY_BAUD,
    FACTORY_ID,
    check_id,
    randomise_ids,
    serial_bytes,
    set_id_by_serial,
)
from imud.formats.modbus import BROADCAST, SLAVES
from imud.host.log import printable_json
from imud.links.rs485 import Rs485Link, Rs485Options
from imud.model.errors import BadArgument, CommandError, DeviceRefused, TransferError

T = TypeVar("T")

TRIES: Final = 3
SETTLE_S: Final = 0.3  # Time for devices to apply new addresses, s. The manual does not specify this time.


class FoundModule(msgspec.Struct, frozen=True, omit_defaults=True):
    """Device that replied at an address."""

    baud: int
    address: int
    product: str = ""
    serial_number: str = ""
    firmware: str = ""
    problem: str = ""  # fault at this address; the other fields are then empty


@contextmanager
def opened(port: str, baud: int, reply_ms: int) -> Iterator[Rs485Link]:
    """Open the RS-485 bus exclusively during the context. Raises LinkError."""
    link = Rs485Link(Rs485Options(line=port, baud=baud, reply_ms=reply_ms))
    link.open()
    try:
        yield link
    finally:
        link.close()


def scan(link: Rs485Link, baud: int, addresses: Iterable[int]) -> list[FoundModule]:
    """Request the identity at each address. Return the devices. Raises LinkError.

    Addresses without a valid reply get a second request, because noise or a busy device costs single replies. If at
    least one device replied, they also get a third request.
    """
    asked = list(addresses)
    found: dict[int, FoundModule | None] = dict.fromkeys(asked)
    for number in range(TRIES):
        # a silent bus does not need a third request per address
        if number == TRIES - 1 and not any(found.values()):
            break
        for address in asked:
            before = found[address]
            if before is None or before.problem:
                # keep an earlier problem if the device is silent now
                found[address] = _look(link, baud, address) or before
    return [one for one in found.values() if one is not None]


def assign_by_serial(link: Rs485Link, baud: int, serial_number: str, new_id: int) -> FoundModule:
    """Set the address of the device with this serial number. Raises CommandError, LinkError."""
    # the form in which devices report their serial number
    wanted = serial_bytes(serial_number).hex().upper()
    order = set_id_by_serial(serial_number, new_id)
    _check_free(link, new_id, wanted)
    _broadcast(link, order)
    return _expect(link, baud, new_id, wanted)


def assign_by_address(link: Rs485Link, baud: int, address: int, new_id: int) -> FoundModule:
    """Change the address of the device at an address. Raises CommandError, LinkError."""
    check_id("address", address)
    script = set_id(new_id)
    before = _identity(link, address)
    if before is None:
        raise CommandError(f"no device replies at address {address}")
    _check_free(link, new_id, before.serial_number)
    try:
        _run(link, address, script)
    except DeviceRefused as error:
        raise CommandError(f"address {address}: {error}") from error
    return _expect(link, baud, new_id, before.serial_number)


def randomise(link: Rs485Link, lowest: int, highest: int) -> None:
    """Command every device to choose a random address in a range. Raises BadArgument, LinkError."""
    _broadcast(link, randomise_ids(lowest, highest))


def keep(link: Rs485Link, found: FoundModule) -> None:
    """Command a device to save its settings. Raises CommandError, LinkError."""
    try:
        _run(link, found.address, save())
    except (TransferError, DeviceRefused) as error:
        raise CommandError(f"cannot save the settings of the device at address {found.address}: {error}") from error


def _look(link: Rs485Link, baud: int, address: int) -> FoundModule | None:
    # counts invalid bytes: they show a device that replies at a wrong baud rate
    strange = link.heard.strange
    try:
        who = printable_identity(_run(link, address, probe(HipnucModbusOptions())))
    except DeviceRefused as error:
        return FoundModule(baud, address, problem=f"{error}; do two devices have this address?")
    except TransferError as error:
        return FoundModule(baud, address, problem=str(error)) if link.heard.strange > strange else None
    return FoundModule(baud, address, who.product, who.serial_number, who.firmware)


def _identity(link: Rs485Link, address: int) -> Identity | None:
    """Read the identity at an address; None if no device replies. Raises CommandError for invalid replies."""
    problem: Exception | None = None
    for _ in range(TRIES):
        try:
            return printable_identity(_run(link, address, probe(HipnucModbusOptions())))
        except TransferError:
            continue
        except DeviceRefused as error:
            problem = error
    if problem is not None:
        raise CommandError(f"address {address}: {problem}; do two devices have this address?")
    return None


def _check_free(link: Rs485Link, address: int, serial_number: str) -> None:
    there = _identity(link, address)
    if there is not None and there.serial_number != serial_number:
        raise CommandError(f"address {address} is used by {there.product}, serial number {there.serial_number}")


def _expect(link: Rs485Link, baud: int, address: int, serial_number: str) -> FoundModule:
    there = _identity(link, address)
    if there is None:
        raise CommandError(
            f"no device replies at the new address {address}: is the device with serial number {serial_number} on this "
            f"bus, does it use {baud} baud, does its firmware support function 0x50?"
        )
    if there.serial_number != serial_number:
        raise CommandError(f"expected serial number {serial_number} at address {address}, got {there.serial_number}")
    return FoundModule(baud, address, there.product, there.serial_number, there.firmware)


def _broadcast(link: Rs485Link, order: Transfer) -> None:
    # all devices execute a broadcast, and no device replies
    link.select(BROADCAST)
    link.transfer(order)
    sleep(SETTLE_S)


def _run(link: Rs485Link, address: int, script: TransferScript[T]) -> T:
    link.select(address)
    return run_transfer_script(script, link.transfer)


HEAD = ("BAUD", "ADDRESS", "PRODUCT", "SERIAL NUMBER", "FIRMWARE", "")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    scanning = actions.add_parser("scan", help="list the device at each address")
    scanning.add_argument("port", metavar="PORT", help="port of the RS-485 bus, for example /dev/ttyUSB0")
    scanning.add_argument(
        "--baud", default=str(FACTORY_BAUD), help="baud rate, or all for all baud rates (default: %(default)s)"
    )
    scanning.add_argument(
        "--addresses", type=addresses, default=SLAVES, metavar="FIRST-LAST", help="addresses to scan (default: 1-247)"
    )
    _common(scanning)
    giving = actions.add_parser("assign", help="set the address of one device, or random addresses of all devices")
    giving.add_argument("port", metavar="PORT", help="port of the RS-485 bus")
    giving.add_argument("--baud", type=int, default=FACTORY_BAUD, help="baud rate (default: %(default)s)")
    which = giving.add_mutually_exclusive_group(required=True)
    which.add_argument("--serial", metavar="SN", help="device with this serial number (16 hexadecimal digits)")
    which.add_argument("--from", type=int, metavar="ADDRESS", dest="address", help="device at this address")
    which.add_argument(
        "--random",
        type=addresses,
        metavar="FIRST-LAST",
        help="all devices; each chooses a random address",
    )
    giving.add_argument("--id", type=int, metavar="ADDRESS", help="new address, with --serial or --from")
    giving.add_argument(
        "--no-save", action="store_true", help="do not save the new address in the device; it lasts until power-off"
    )
    _common(giving)


def _common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--reply-ms", type=int, default=20, metavar="MS", help="maximum wait for a reply (default: %(default)s)"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per device")


def addresses(text: str) -> range:
    """Parse a range of addresses: `5` or `5-20`. Raises ArgumentTypeError."""
    first, _, last = text.partition("-")
    if not first.isdecimal() or not (last or first).isdecimal():
        raise argparse.ArgumentTypeError(f"expected FIRST-LAST, got {text!r}")
    found = range(int(first), int(last or first) + 1)
    if not found or found[0] not in SLAVES or found[-1] not in SLAVES:
        raise argparse.ArgumentTypeError(f"expected addresses from 1 to 247, lowest first, got {text!r}")
    return found


def run(args: argparse.Namespace) -> int:
    """Scan or assign. Return 1 if no device was found or a device has a fault, otherwise 0."""
    if not 1 <= args.reply_ms <= 1000:
        raise BadArgument(f"--reply-ms: expected 1 to 1000, got {args.reply_ms}")
    found = _scan(args) if args.action == "scan" else _assign(args)
    _show(found, as_json=args.json)
    return 0 if found and not any(one.problem for one in found) else 1


def _scan(args: argparse.Namespace) -> list[FoundModule]:
    found: list[FoundModule] = []
    first = [address for address in (FACTORY_ID,) if address in args.addresses]  # most devices have this address
    order = list(dict.fromkeys([*first, *args.addresses]))
    for baud in BAUD_RATES if args.baud == "all" else (_baud(args.baud),):
        with opened(args.port, baud, args.reply_ms) as link:
            found += scan(link, baud, order)
    return sorted(found, key=lambda one: (one.baud, one.address))


def _assign(args: argparse.Namespace) -> list[FoundModule]:
    baud = _baud(str(args.baud))
    if (args.random is None) == (args.id is None):
        raise BadArgument("--id: expected the new address with --serial or --from; omit --id with --random")
    with opened(args.port, baud, args.reply_ms) as link:
        if args.random is not None:
            randomise(link, args.random[0], args.random[-1])
            found = scan(link, baud, args.random)
        else:
            give = (
                partial(assign_by_serial, serial_number=args.serial)
                if args.serial is not None
                else partial(assign_by_address, address=args.address)
            )
            found = [give(link, baud, new_id=args.id)]
        if not args.no_save:
            for one in found:
                if not one.problem:
                    keep(link, one)
    return found


def _baud(text: str) -> int:
    if not text.isdecimal() or int(text) not in BAUD_RATES:
        raise BadArgument(f"--baud: expected one of {', '.join(map(str, BAUD_RATES))}, got {text!r}")
    return int(text)


def _show(found: list[FoundModule], *, as_json: bool) -> None:
    if as_json:
        for one in found:
            print(printable_json(one))
    elif found:
        rows = [
            (one.baud, one.address, one.product or "-", one.serial_number or "-", one.firmware or "-", one.problem)
            for one in found
        ]
        print(table(HEAD, rows))
    else:
        print("no device replies: check the wires A and B, the termination, the power supply and --baud")


MODBUS = CliCommand(add_arguments, run)
