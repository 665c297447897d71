"""The real `Finders`: detection as `imud probe` and `imud modbus scan` have it, and questions on I2C and SPI."""

import asyncio
from collections.abc import Sequence
from typing import Final

import msgspec

from imud.cli.modbus.line import opened, scan
from imud.cli.probe.command import examine_all
from imud.cli.probe.report import ProbeReport
from imud.cli.setup.attached import Attached, Finders
from imud.contracts.driver import of_kind
from imud.contracts.link import PolledLink
from imud.contracts.polling import PolledDriver, run_transfer_script
from imud.contracts.settings import wrong_values
from imud.devices import DRIVERS
from imud.devices.hipnuc.modbus.frames import FACTORY_ID
from imud.devices.hipnuc.modbus.registers import FACTORY_BAUD
from imud.errors import DeviceRefused, LinkError, TransferError
from imud.formats.modbus import SLAVES
from imud.links import LINKS
from imud.runtime.identity import printable_identity

MODBUS: Final = "hipnuc-modbus"
REPLY_MS: Final = 20
"""Longest time to the reply of a module."""


def listen(places: Sequence[str], active: set[str]) -> list[ProbeReport]:
    """Listen on all ports and interfaces at the same time; those of `active` may be sent queries."""
    return asyncio.run(examine_all(list(places), active, {}))


def scan_rs485(path: str, baud: int) -> list[Attached]:
    """Ask at every address of a line; 0 is the rate of the factory."""
    rate = baud or FACTORY_BAUD
    order = list(dict.fromkeys([FACTORY_ID, *SLAVES]))
    try:
        with opened(path, rate, REPLY_MS) as link:
            modules = scan(link, rate, order)
    except LinkError as error:
        return [Attached(path, path, problem=str(error))]
    found = []
    for module in modules:
        keys = {"driver": MODBUS, "rs485": {"line": path, "baud": rate, "address": module.address}}
        where = f"address {module.address}"
        one = Attached(path, path, module.product, MODBUS, where, rate, keys)
        found.append(Attached(path, path, device=where, problem=module.problem) if module.problem else one)
    return found or [
        Attached(path, path, baud=rate, problem="no module answers: wiring, termination, or another rate?")
    ]


def ask_bus(kind: str, bus: str) -> list[Attached]:
    """Ask every driver of an I2C or SPI bus at every address or in every mode that it knows."""
    try:
        row = LINKS[kind]
        given = {"bus": int(bus)} if kind == "i2c" else {"port": bus}
        if wrong := wrong_values(row.settings, given):
            return [Attached(bus, bus, problem="; ".join(map(str, wrong)))]
        link = row.make_polled(msgspec.convert(given, row.settings))
        link.open()
    except (LinkError, ValueError) as error:
        return [Attached(bus, bus, problem=str(error))]
    try:
        return _answers(kind, bus, link)
    except LinkError as error:
        return [Attached(link.title, link.title, problem=str(error))]
    finally:
        link.close()


def _answers(kind: str, bus: str, link: PolledLink) -> list[Attached]:
    found, problems = [], []
    for driver in of_kind(DRIVERS.values(), PolledDriver):
        for target in driver.targets if driver.link == kind else ():
            try:
                link.select(target)
                who = printable_identity(run_transfer_script(driver.probe(driver.settings()), link.transfer))
            except (TransferError, DeviceRefused) as error:
                problems.append(f"{link.place(target)}: {error}")
                continue
            place = {"bus": int(bus), "address": target} if kind == "i2c" else {"port": bus}
            keys = {"driver": driver.name, kind: place}
            found.append(Attached(link.title, link.title, who.product, driver.name, link.place(target), keys=keys))
            if kind == "spi":  # a chip select has one device; the other mode is none
                return found
    return found or [Attached(link.title, link.title, problem="; ".join(dict.fromkeys(problems)))]


FINDERS = Finders(listen, scan_rs485, ask_bus)
