"""`imud modbus`: find the modules of an RS-485 line and set their addresses. It sends, so the port must be named.

Stop the daemon first, or take the line out of its configuration: a line has one master.
"""

import argparse
from functools import partial

import msgspec

from imud.cli.arguments import CliCommand
from imud.cli.modbus.line import (
    FoundModule,
    assign_by_address,
    assign_by_serial,
    keep,
    opened,
    randomise,
    scan,
)
from imud.cli.output import table
from imud.devices.hipnuc.modbus.frames import FACTORY_ID
from imud.devices.hipnuc.modbus.registers import BAUD_RATES, FACTORY_BAUD
from imud.errors import BadArgument
from imud.formats.modbus import SLAVES

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
