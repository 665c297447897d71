"""`imud probe`: list the devices on serial ports and CAN buses.

The command only listens. It sends requests only to ports and buses of `--active`.
"""

import argparse
import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

import msgspec

from imud.cli.arguments import CliCommand
from imud.cli.output import paragraph
from imud.config.model import DeviceConfig
from imud.contracts.codec import CodecEvent, message_of
from imud.contracts.driver import CanDriver, Identity, StreamDriver, of_kind
from imud.contracts.link import CanLink, OnData, StreamLink
from imud.contracts.script import Outcome, Reply, Request, RequestScript
from imud.device.can_search import EVERYTHING, CanDevice, CanRound, CanSearch
from imud.device.scripts import RequestPort, ScriptRunner
from imud.device.settings import identity_words, printable_identity
from imud.device.stream_search import StreamFound, StreamRound
from imud.drivers import DRIVERS
from imud.formats.can import CanFrame
from imud.host.clock import HostClock
from imud.host.log import printable_json
from imud.host.netlink import can_details, can_interfaces
from imud.links import LINKS
from imud.links.serial_port import list_ports
from imud.links.socketcan import ControllerState
from imud.model.errors import CommandError, DriverFailed, ImudError, NothingHeard
from imud.model.ledger import Ledger

PINGS: Final = 2  # number of requests to a boot loader at each baud rate


class ProbeReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Result for one port, or for one device of a bus."""

    port: str
    title: str = ""  # product name of the adapter, or the state of the CAN bus
    driver: str = ""
    device: str = ""  # address on a bus, for example `node 8`
    baud: int = 0  # baud rate of the port, or bit rate of the bus, bit/s
    identity: dict[str, str] = {}  # msgspec copies a mutable default
    problem: str = ""


def block(report: ProbeReport) -> str:
    """Format a report in 80 columns: the port, then the device, or why no device was found."""
    identity = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in report.identity.items())
    driver = f"{report.driver} {report.device}".strip()
    rate = f"{report.baud} {'bit/s' if report.device else 'baud'}" if report.baud else ""
    parts = [" at ".join(filter(None, (driver, rate))), identity, report.problem, report.title]
    return "\n".join([*paragraph("", report.port), *(line for part in parts if part for line in paragraph("  ", part))])


class LinkRequestPort(RequestPort):
    """Link that sends the requests of a script."""

    def __init__(self, link: StreamLink | CanLink) -> None:
        self._link = link

    def write(self, data: bytes) -> None:
        self._link.write(data)


class SerialRequestPort(LinkRequestPort):
    """Serial port that follows a device to another baud rate."""

    def __init__(self, link: StreamLink) -> None:
        super().__init__(link)
        self._serial_link = link

    def change_rate(self, request: Request) -> None:
        self._serial_link.set_baud(request.baud)


async def examine_bus(interface: str, may_ask: bool) -> list[ProbeReport]:
    """Return one report per device on a CAN interface. If no device sends, return one report with the reason."""
    row = LINKS["socketcan"]
    link = row.make_can(msgspec.convert({"interface": interface}, row.settings))
    try:
        if reason := link.absence():
            return [ProbeReport(interface, problem=reason)]
        # the detection needs frames of all devices
        link.filters = EVERYTHING
        link.open()
        devices, summary = await listen(link)
        title = state_of(interface)
        if not devices:
            return [ProbeReport(interface, title, baud=link.bitrate, problem=summary)]
        return [await _report(link, title, device, may_ask) for device in devices]
    except ImudError as error:
        return [ProbeReport(interface, problem=str(error))]
    finally:
        link.close()


async def listen(link: CanLink) -> tuple[list[CanDevice], str]:
    """Run one round of the detection. Return the devices, and the reason if there are none. Raises LinkError."""
    search = CanSearch(of_kind(DRIVERS.values(), CanDriver), link.title)
    finder = CanRound(search, Ledger(), HostClock())
    ended = asyncio.get_running_loop().create_future()
    problems = [""]
    link.start(finder.on_frames, lambda news, problem: problems.append(problem), ended.set_result)
    finder.start(lambda found: None)
    searching = asyncio.ensure_future(finder.finished())
    await asyncio.wait({searching, ended}, return_when=asyncio.FIRST_COMPLETED)
    if ended.done():
        searching.cancel()
        raise ended.result() or ImudError(f"{link.title} ended")
    with suppress(NothingHeard):
        await searching
    return search.survey.devices(), problems[-1] or search.summary()


def state_of(interface: str) -> str:
    """Return the state of the CAN controller as text. Raises LinkError."""
    details = can_details(interface)
    if details.bitrate is None or details.state is None or details.state >= len(ControllerState):
        return "bus without a bit rate" if details.bitrate is None else ""
    return f"error-{ControllerState(details.state).name.lower()}".replace("error-bus_off", "bus-off")


async def _report(link: CanLink, title: str, device: CanDevice, may_ask: bool) -> ProbeReport:
    driver, node = device
    identity = await identity_of_node(device, link) if may_ask else Identity()
    words = identity_words(printable_identity(identity))
    return ProbeReport(link.title, title, driver.name, driver.node_title(node), link.bitrate, words)


async def identity_of_node(device: CanDevice, link: CanLink) -> Identity:
    """Request the identity of a CAN device. Return an empty identity if the device does not reply."""
    driver, settings = device.driver, device.driver.node_settings(device.node)
    ledger = Ledger()
    codec = driver.make_codec(ledger, settings)
    runner = ScriptRunner(LinkRequestPort(link), ledger, HostClock())

    def on_frames(frames: Sequence[CanFrame]) -> None:
        for frame in frames:
            for event in codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns):
                if (message := message_of(event)) is not None:
                    runner.on_message(message, frame.t_rx_ns)

    link.filters = driver.filters(settings)
    link.start(on_frames, lambda news, problem: None, lambda error: None)
    return await identity_by(runner, driver.identify(settings))


async def identity_by(runner: ScriptRunner, script: RequestScript[Identity]) -> Identity:
    """Run the script. Return an empty identity if the device does not reply. Raises DriverFailed."""
    try:
        return await runner.run(script)
    except DriverFailed:
        raise
    except CommandError:
        return Identity()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("port", nargs="*", metavar="PORT", help="ports and CAN interfaces to listen on (default: all)")
    parser.add_argument(
        "--active", action="append", default=[], metavar="PORT", help="port or CAN interface to send requests to"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per port, or per device of a bus")


def run(args: argparse.Namespace) -> int:
    """Print a few lines per port, or per device of a CAN bus. Return 1 if no device was found."""
    titles = {port.path: port.title for port in list_ports()}
    chosen = [*args.port, *args.active] or [*titles, *can_interfaces(down=True)]
    reports = asyncio.run(examine_all(list(dict.fromkeys(chosen)), set(args.active), titles))
    if args.json:
        for report in reports:
            print(printable_json(report))
    elif reports:
        print("\n".join(map(block, reports)))
    else:
        print("found no serial port and no CAN interface: is the adapter plugged in, is the UART enabled?")
    return 0 if any(report.driver for report in reports) else 1


async def examine_all(ports: list[str], active: set[str], titles: dict[str, str]) -> list[ProbeReport]:
    """Probe all ports at the same time."""
    found = await asyncio.gather(
        *(
            # a port is a path, an interface is a name
            examine(port, port in active, titles.get(port, "")) if "/" in port else examine_bus(port, port in active)
            for port in ports
        )
    )
    return [report for reports in found for report in reports]


async def examine(port: str, may_ask: bool, title: str) -> list[ProbeReport]:
    """Detect the device on a serial port. Request its identity if `may_ask` is set."""
    settings = msgspec.convert({"port": port, "baud": "auto"}, LINKS["uart"].settings)
    config = DeviceConfig("probe", "auto", None, may_ask, "uart", settings)
    link = LINKS["uart"].make(settings)
    try:
        link.open()
        found = await find(config, link)
        identity = await identity_of_device(found, link) if may_ask else Identity()
        words = identity_words(printable_identity(identity))
        return [ProbeReport(port, title, found.driver.name, baud=link.baud, identity=words, problem=unknown_of(found))]
    except NothingHeard as error:
        if may_ask and (driver := await boot_loader_at(link)) is not None:
            problem = "the device is in its boot loader: it has no complete firmware; run `imud firmware`"
            return [ProbeReport(port, title, driver.name, baud=link.baud, problem=problem)]
        return [ProbeReport(port, title, problem=str(error))]
    except ImudError as error:
        return [ProbeReport(port, title, problem=str(error))]
    finally:
        link.close()


async def boot_loader_at(link: StreamLink) -> StreamDriver | None:
    """Ping boot loaders at each baud rate. Return the driver of the first reply; None without a reply.

    Raises LinkError.
    """
    for driver in of_kind(DRIVERS.values(), StreamDriver):
        if driver.firmware is None or driver.firmware.make_codec is None:
            continue
        for baud in driver.baud_rates:
            link.set_baud(baud)
            codec, ledger = driver.firmware.make_codec(Ledger()), Ledger()
            runner = ScriptRunner(SerialRequestPort(link), ledger, HostClock())
            link.deliver_to(receiver_of(codec.feed, runner))
            if isinstance(await runner.run(repeated(driver.firmware.ping(None))), Reply):
                return driver
    return None


def repeated(request: Request) -> RequestScript[Outcome]:
    """Send a request until its reply arrives, at most PINGS times: bytes of another rate can damage it."""
    for _ in range(PINGS):
        outcome = yield request
        if isinstance(outcome, Reply):
            break
    return outcome


def receiver_of(feed: Callable[[bytes], Sequence[CodecEvent]], runner: ScriptRunner) -> OnData:
    """Return a receiver that passes the messages of a codec to a script runner."""

    def on_data(data: bytes, t_rx_ns: int) -> None:
        for event in feed(data):
            if (message := message_of(event)) is not None:
                runner.on_message(message, t_rx_ns)

    return on_data


def unknown_of(found: StreamFound) -> str:
    """Describe received frames of unknown types with their numbers; return "" without one."""
    ledger = Ledger()
    codec = found.driver.make_codec(ledger, found.driver.settings())
    for data, _ in found.chunks:
        codec.feed(data)
    if not codec.unknown:
        return ""
    if ledger.frames_in_samples:
        return f"also {found.driver.unknown_types(codec.unknown)}"
    return found.driver.unknown_words(codec.unknown, counted=True)


async def find(config: DeviceConfig, link: StreamLink) -> StreamFound:
    """Run one round of the detection. Raises NothingHeard and LinkError."""
    findings: list[StreamFound] = []
    finder = StreamRound(config, link, Ledger(), None, HostClock())
    ended = asyncio.get_running_loop().create_future()
    link.start(finder.on_data, ended.set_result)
    finder.start(findings.append)
    searching = asyncio.ensure_future(finder.finished())
    await asyncio.wait({searching, ended}, return_when=asyncio.FIRST_COMPLETED)
    if not searching.done():
        searching.cancel()
        error = ended.result()
        raise error if error is not None else ImudError(f"{link.title} ended")
    await searching
    return findings[0]


async def identity_of_device(found: StreamFound, link: StreamLink) -> Identity:
    """Request the identity of a serial device. Return an empty identity if the device does not reply."""
    ledger = Ledger()
    codec = found.driver.make_codec(ledger, found.driver.settings())
    runner = ScriptRunner(SerialRequestPort(link), ledger, HostClock())

    link.start(receiver_of(codec.feed, runner), lambda error: None)
    return await identity_by(runner, found.driver.identify())


PROBE = CliCommand(add_arguments, run)
