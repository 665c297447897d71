"""`imud probe`: list what is attached to serial ports and CAN buses.

Listens only; sends a query only to ports and buses named with `--active`.
"""

import argparse
import asyncio
import contextlib
from time import monotonic_ns

import msgspec

from imud.cli.arguments import CliCommand
from imud.cli.output import table
from imud.cli.probe.can import examine_bus
from imud.cli.probe.report import HEAD, ProbeReport, row
from imud.config import DeviceConfig
from imud.contracts.codec import message_of
from imud.contracts.driver import Identity
from imud.contracts.link import StreamLink
from imud.errors import CommandError, ImudError
from imud.ledger import Ledger
from imud.links import LINKS
from imud.links.can.netlink import can_interfaces
from imud.links.uart.port_list import list_ports
from imud.runtime.detection import StreamFound
from imud.runtime.detection.rounds import StreamRound
from imud.runtime.exchange import Exchange
from imud.runtime.identity import identity_words, printable_identity


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud probe`."""
    parser.add_argument("port", nargs="*", metavar="PORT", help="ports and CAN interfaces to listen on (default: all)")
    parser.add_argument("--active", action="append", default=[], metavar="PORT", help="one that may be sent queries")
    parser.add_argument("--json", action="store_true", help="one JSON object per port, or per device of a bus")


def run(args: argparse.Namespace) -> int:
    """Print one line per port, or per device of a bus; 1 when no device was found."""
    titles = {port.path: port.title for port in list_ports()}
    chosen = [*args.port, *args.active] or [*titles, *can_interfaces(down=True)]
    reports = asyncio.run(examine_all(list(dict.fromkeys(chosen)), set(args.active), titles))
    if args.json:
        for report in reports:
            print(msgspec.json.encode(report).decode())
    elif reports:
        print(table(HEAD, [row(report) for report in reports]))
    else:
        print("no serial port and no CAN interface here: is the adapter plugged in, is the UART switched on?")
    return 0 if any(report.driver for report in reports) else 1


async def examine_all(ports: list[str], active: set[str], titles: dict[str, str]) -> list[ProbeReport]:
    """Probe all ports at the same time."""
    found = await asyncio.gather(
        *(
            examine(port, port in active, titles.get(port, "")) if "/" in port else examine_bus(port, port in active)
            for port in ports
        )
    )
    return [report for reports in found for report in reports]


async def examine(port: str, may_ask: bool, title: str) -> list[ProbeReport]:
    """Open a serial port, find what talks there, ask for its identity if that is permitted."""
    settings = msgspec.convert({"port": port, "baud": "auto"}, LINKS["uart"].settings)
    config = DeviceConfig("probe", "auto", None, may_ask, "uart", settings)
    link = LINKS["uart"].make(settings)
    try:
        link.open()
        found = await find(config, link)
        identity = await identity_of_device(found, link) if may_ask else Identity()
        words = identity_words(printable_identity(identity))
        return [ProbeReport(port, title, found.driver.name, baud=link.baud, identity=words)]
    except ImudError as error:
        return [ProbeReport(port, title, problem=str(error))]
    finally:
        link.close()


async def find(config: DeviceConfig, link: StreamLink) -> StreamFound:
    """Run one round of detection. Raises NothingHeard and LinkError."""
    findings: list[StreamFound] = []
    finder = StreamRound(config, link, Ledger(), None, findings.append, monotonic_ns, may_ask=config.identify)
    ended = asyncio.get_running_loop().create_future()
    link.start(finder.on_data, ended.set_result)
    finder.start()
    searching = asyncio.ensure_future(finder.finished())
    await asyncio.wait({searching, ended}, return_when=asyncio.FIRST_COMPLETED)
    if not searching.done():
        searching.cancel()
        error = ended.result()
        raise error if error is not None else ImudError(f"{link.title} ended")
    await searching
    return findings[0]


async def identity_of_device(found: StreamFound, link: StreamLink) -> Identity:
    """Ask a device for its identity; empty when it does not answer."""
    ledger = Ledger()
    codec = found.driver.make_codec(ledger, found.driver.settings())
    exchange = Exchange(ledger, link.write, monotonic_ns, link.set_baud)

    def on_data(data: bytes, t_rx_ns: int) -> None:
        for event in codec.feed(data):
            if (message := message_of(event)) is not None:
                exchange.on_message(message, t_rx_ns)

    link.start(on_data, lambda error: None)
    with contextlib.suppress(CommandError):
        return await exchange.run(found.driver.identify())
    return Identity()


PROBE = CliCommand(add_arguments, run)
