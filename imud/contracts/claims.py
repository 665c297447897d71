"""Contract of claims: the ports, buses, addresses and identifiers that a device uses, and when those of two conflict.

A link says what its settings claim, and a driver for CAN which frames its device sends and needs. The configuration
compares the claims of all devices before any port is opened, and the runtime compares those of devices that it found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, NamedTuple

from imud.contracts.settings import shown
from imud.formats.can import CanFilter, CyclicFrame

MIXED: Final = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """Use of a port or bus, or of one address on it, by one device."""

    place: str
    """The port or bus: a path, or the name of an interface."""
    key: str
    """Key of the settings that names it."""
    shared: bool = False
    """Whether several devices can use the place, each with a part of its own."""
    part: int | None = None
    """The part of a shared place, for example a Modbus address; None while it is not known (`auto`)."""
    part_key: str = ""
    """Key of the settings that names the part."""
    terms: Mapping[str, object] = field(default_factory=dict)
    """Settings on which all devices of a shared place must agree, by key."""


class Conflict(NamedTuple):
    """Why two devices cannot have what they claim."""

    key: str
    """Key of the settings that has to change."""
    message: str
    """What was expected, what came, and who has it."""


def conflict_of(mine: Claim, other: Claim, owner: str) -> Conflict | None:
    """Return why a device cannot have what `owner` has already, None if it can. Both claim the same place."""
    if not (mine.shared and other.shared):
        return Conflict(mine.key, f"expected a {mine.key} of its own, got {mine.place}, which {owner} has")
    for key in differing_terms(mine.terms, other.terms):
        value, have = shown(mine.terms[key]), shown(other.terms[key])
        message = f"expected the same {key} for all devices of {mine.place}, got {value}; {owner} has {have}"
        return Conflict(key, message)
    if mine.part is not None and mine.part == other.part:
        part = f"{mine.part_key} of its own on {mine.place}, got {mine.part}, which {owner} has"
        return Conflict(mine.part_key, f"expected {'an' if part[0] in 'aeiou' else 'a'} {part}")
    return None


def differing_terms(mine: Mapping[str, object], other: Mapping[str, object]) -> list[str]:
    """List the keys in which two devices of a shared place differ."""
    return [key for key in mine if key in other and mine[key] != other[key]]


@dataclass(frozen=True)
class CanUse:
    """Frames of a CAN bus that one device needs."""

    bus: str
    filters: Sequence[CanFilter]
    """The frames that the device sends."""
    cyclic: Sequence[CyclicFrame]
    """The frames that imud must send for it."""

    @cached_property
    def _exact(self) -> frozenset[tuple[int, bool]]:
        return frozenset((one.can_id & one.mask, one.extended) for one in self.filters)

    @cached_property
    def _mask(self) -> int:
        """Mask of all filters, MIXED for several: filters of the same mask overlap only where they are equal."""
        masks = {one.mask for one in self.filters}
        return masks.pop() if len(masks) == 1 else MIXED

    def receives(self, can_id: int, extended: bool) -> bool:
        """Whether the device sends frames of this identifier (of 29 bits or not)."""
        return any(wanted.matches(can_id, extended) for wanted in self.filters)

    def both_receive(self, other: "CanUse") -> str:
        """Return an identifier whose frames both take for their device's own; empty if there is none."""
        if self.bus != other.bus or (self._mask == other._mask != MIXED and self._exact.isdisjoint(other._exact)):
            return ""
        pairs = ((mine, theirs) for mine in self.filters for theirs in other.filters if mine.overlaps(theirs))
        return next((id_text(mine.can_id | theirs.can_id, mine.extended) for mine, theirs in pairs), "")

    def both_send(self, other: "CanUse") -> str:
        """Return an identifier that imud would send for both; empty if there is none."""
        theirs = {(frame.can_id, frame.extended) for frame in other.cyclic} if self.bus == other.bus else set()
        return next((id_text(*key) for frame in self.cyclic if (key := (frame.can_id, frame.extended)) in theirs), "")


def id_text(can_id: int, extended: bool) -> str:
    """Format an identifier: eight hexadecimal digits where it has 29 bits, three where it has 11."""
    return f"0x{can_id:08X}" if extended else f"0x{can_id:03X}"
