"""Search for the devices on a CAN interface, for `imud probe`; sends nothing but permitted queries."""

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from time import monotonic_ns

import msgspec

from imud.cli.probe.report import ProbeReport
from imud.contracts.can import CanDriver
from imud.contracts.codec import message_of
from imud.contracts.driver import Identity, of_kind
from imud.contracts.link import CanLink
from imud.devices import DRIVERS
from imud.errors import CommandError, ImudError, NothingHeard
from imud.formats.can import CanFrame
from imud.ledger import Ledger
from imud.links import LINKS
from imud.links.can.bus_state import ControllerState
from imud.links.can.netlink import can_details
from imud.runtime.detection import CanDevice, CanSearch
from imud.runtime.detection.rounds import EVERYTHING, CanRound
from imud.runtime.exchange import Exchange
from imud.runtime.identity import identity_words, printable_identity


async def examine_bus(interface: str, may_ask: bool) -> list[ProbeReport]:
    """List one report per device heard on an interface, or one that gives the reason for none."""
    row = LINKS["socketcan"]
    link = row.make_can(msgspec.convert({"interface": interface}, row.settings))
    try:
        if reason := link.absence():
            return [ProbeReport(interface, problem=reason)]
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
    """Run one round of detection: the devices heard, and the reason for none. Raises LinkError."""
    search = CanSearch(of_kind(DRIVERS.values(), CanDriver), link.title)
    finder = CanRound(search, Ledger(), lambda found: None, monotonic_ns)
    ended = asyncio.get_running_loop().create_future()
    problems = [""]
    link.start(finder.on_frames, lambda news, problem: problems.append(problem), ended.set_result)
    finder.start()
    searching = asyncio.ensure_future(finder.finished())
    await asyncio.wait({searching, ended}, return_when=asyncio.FIRST_COMPLETED)
    if ended.done():
        searching.cancel()
        raise ended.result() or ImudError(f"{link.title} ended")
    with suppress(NothingHeard):
        await searching
    return search.survey.devices(), problems[-1] or search.summary()


def state_of(interface: str) -> str:
    """Describe the state of the controller. Raises LinkError."""
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
    """Ask a device for its identity; empty when it does not answer."""
    driver, settings = device.driver, device.driver.node_settings(device.node)
    ledger = Ledger()
    codec = driver.make_codec(ledger, settings)
    exchange = Exchange(ledger, link.write, monotonic_ns)

    def on_frames(frames: Sequence[CanFrame]) -> None:
        for frame in frames:
            for event in codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns):
                if (message := message_of(event)) is not None:
                    exchange.on_message(message, frame.t_rx_ns)

    link.filters = driver.filters(settings)
    link.start(on_frames, lambda news, problem: None, lambda error: None)
    with suppress(CommandError):
        return await exchange.run(driver.identify(settings))
    return Identity()
