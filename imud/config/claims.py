"""Comparison of what the devices of one configuration use: ports, addresses on a bus, identifiers of CAN frames.

The rules are those of `imud.contracts.claims`; the runtime asks here as well, for the device that has a port already.
"""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from imud.config.model import DeviceConfig
from imud.config.schema import DriverRow, LinkRow
from imud.config.yaml_tree import Path as KeyPath
from imud.config.yaml_tree import no_pause
from imud.contracts.can import CanDriver
from imud.contracts.claims import CanUse, Claim, conflict_of


class Clash(NamedTuple):
    """A device that cannot have what another one has."""

    path: KeyPath
    """The key that has to change."""
    message: str
    """What was expected, what came, and who has it."""


class _Owned(NamedTuple):
    claim: Claim
    owner: str


def clashes(
    devices: Sequence[DeviceConfig],
    links: Mapping[str, LinkRow],
    drivers: Mapping[str, DriverRow],
    pause: Callable[[], None] = no_pause,
) -> Iterator[Clash]:
    """List what each device claims that one before it has. Symbolic links are followed; no port is opened."""
    places: dict[str, list[_Owned]] = {}
    buses: dict[str, list[tuple[CanUse, str]]] = {}
    for device in devices:
        owner = f"{device.name} (line {device.line})" if device.line else device.name
        for part, claim in _claims(device, links):
            held = places.setdefault(_place(claim), [])
            for other in held:
                if conflict := conflict_of(claim, other.claim, other.owner):
                    yield Clash(("devices", device.name, part, conflict.key), conflict.message)
                    break
            held.append(_Owned(claim, owner))
        use = _can_use(device, links, drivers)
        if use is not None:
            uses = buses.setdefault(use.bus, [])
            yield from _can_clash(device.name, use, uses)
            uses.append((use, owner))
        pause()


def owner_of(device: DeviceConfig, others: Sequence[DeviceConfig], links: Mapping[str, LinkRow]) -> str:
    """Return the name of one of `others` that has the port of `device` for itself, or that cannot share it with it."""
    mine = _claims(device, links)
    for other in others:
        for _, theirs in _claims(other, links) if other.name != device.name else ():
            if any(_place(theirs) == _place(one) and conflict_of(one, theirs, "") for _, one in mine):
                return other.name
    return ""


def _claims(device: DeviceConfig, links: Mapping[str, LinkRow]) -> list[tuple[str, Claim]]:
    """List the claims of a device, each with the part of its configuration that it comes from."""
    found = [(device.link, claim) for claim in links[device.link].claims(device.link_settings)]
    if device.rmc is not None and device.rmc.port:
        found.append(("rmc", Claim(place=device.rmc.port, key="port")))
    return found


def _place(claim: Claim) -> str:
    return os.path.realpath(claim.place) if claim.place.startswith("/") else claim.place


def _can_use(device: DeviceConfig, links: Mapping[str, LinkRow], drivers: Mapping[str, DriverRow]) -> CanUse | None:
    """Return what a device needs of a bus that others can share; None where that is not known before it is found."""
    claims = _claims(device, links)
    if device.options is None or not claims:
        return None
    driver = drivers[device.driver]
    if not isinstance(driver, CanDriver):
        return None
    return CanUse(_place(claims[0][1]), driver.filters(device.options), driver.cyclic(device.options))


def _can_clash(name: str, use: CanUse, uses: Sequence[tuple[CanUse, str]]) -> Iterator[Clash]:
    """List the frames that a device needs and another one has; the first owner is enough."""
    path: KeyPath = ("devices", name, "options")
    for other, owner in uses:
        if both := use.both_receive(other):
            yield Clash(path, f"expected a device of its own on {use.bus}, got one that sends {both}; {owner} has that")
            return
        if both := use.both_send(other):
            message = f"expected one device on {use.bus} for which imud sends {both}, got it here and for {owner}"
            yield Clash(path, f"{message}: leave it out here")
            return
