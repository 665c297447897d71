"""`imud modbus`: find the modules of an RS-485 line and set their addresses. It sends, so the port must be named.

Stop the daemon first, or take the line out of its configuration: a line has one master.
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
from imud.device.identity import printable_identity
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
from imud.links.rs485 import Rs485Link, Rs485Options
from imud.model.errors import BadArgument, CommandError, DeviceRefused, TransferError

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
    link = Rs485Link(Rs485Options(line=port, baud=baud, reply_ms=reply_ms))
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
        who = printable_identity(_run(link, address, probe(HipnucModbusOptions())))
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
            return printable_identity(_run(link, address, probe(HipnucModbusOptions())))
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


HEAD = ("BAUD", "ADDRESS", "PRODUCT", "SERIAL NUMBER", "FIRMWARE", "")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud modbus`."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    scanning = actions.add_parser("scan", help="list the module at every address")
    scanning.add_argument("port", metavar="PORT", help="port of the line, for example /dev/ttyUSB0")
    scanning.add_argument("--baud", default=str(FACTORY_BAUD), help="bit/s, or all for every rate (%(default)s)")
    scanning.add_argument(
        "--addresses", type=addresses, default=SLAVES, metavar="FIRST-LAST", help="addresses to ask (1-247)"
    )
    _common(scanning)
    giving = actions.add_parser("assign", help="set the address of a module, or random ones of all modules")
    giving.add_argument("port", metavar="PORT", help="port of the line")
    giving.add_argument("--baud", type=int, default=FACTORY_BAUD, help="bit/s (%(default)s)")
    which = giving.add_mutually_exclusive_group(required=True)
    which.add_argument("--serial", metavar="SN", help="the module with this serial number (16 hexadecimal digits)")
    which.add_argument("--from", type=int, metavar="ADDRESS", dest="address", help="the module at this address")
    which.add_argument(
        "--random", type=addresses, metavar="FIRST-LAST", help="every module chooses a random address of this range"
    )
    giving.add_argument("--id", type=int, metavar="ADDRESS", help="the new address, with --serial and --from")
    giving.add_argument("--no-save", action="store_true", help="until power-off only")
    _common(giving)


def _common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--reply-ms", type=int, default=20, metavar="MS", help="longest time to a reply (%(default)s)")
    parser.add_argument("--json", action="store_true", help="one JSON object per module")


def addresses(text: str) -> range:
    """Parse a range of addresses: `5` or `5-20`. Raises ArgumentTypeError."""
    first, _, last = text.partition("-")
    if not first.isdecimal() or not (last or first).isdecimal():
        raise argparse.ArgumentTypeError(f"expected FIRST-LAST, got {text!r}")
    found = range(int(first), int(last or first) + 1)
    if not found or found[0] not in SLAVES or found[-1] not in SLAVES:
        raise argparse.ArgumentTypeError(f"expected addresses of 1-247, lowest first, got {text!r}")
    return found


def run(args: argparse.Namespace) -> int:
    """Scan or assign; return 0 when modules were found or numbered, 1 for none or a faulty one."""
    if not 1 <= args.reply_ms <= 1000:
        raise BadArgument(f"--reply-ms: expected 1 to 1000, got {args.reply_ms}")
    found = _scan(args) if args.action == "scan" else _assign(args)
    _show(found, as_json=args.json)
    return 0 if found and not any(one.problem for one in found) else 1


def _scan(args: argparse.Namespace) -> list[FoundModule]:
    found: list[FoundModule] = []
    first = [address for address in (FACTORY_ID,) if address in args.addresses]
    order = list(dict.fromkeys([*first, *args.addresses]))
    for baud in BAUD_RATES if args.baud == "all" else (_baud(args.baud),):
        with opened(args.port, baud, args.reply_ms) as link:
            found += scan(link, baud, order)
    return sorted(found, key=lambda one: (one.baud, one.address))


def _assign(args: argparse.Namespace) -> list[FoundModule]:
    baud = _baud(str(args.baud))
    if (args.random is None) == (args.id is None):
        raise BadArgument("--id: expected the new address with --serial or --from, and none with --random")
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
            print(msgspec.json.encode(one).decode())
    elif found:
        rows = [
            (one.baud, one.address, one.product or "-", one.serial_number or "-", one.firmware or "-", one.problem)
            for one in found
        ]
        print(table(HEAD, rows))
    else:
        print("no module answers: is the line wired and terminated, are A and B right, is the baud rate another one?")


MODBUS = CliCommand(add_arguments, run)
