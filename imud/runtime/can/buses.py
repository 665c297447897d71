"""CAN buses shared by the devices of one daemon: the owner of each frame, and the sender of each cyclic frame.

A device that searches must not choose one that is configured by another name, and two devices must not have the same
frame sent: receivers would get it twice per period.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from imud.formats.can import CanFilter, CyclicFrame


class _Member(NamedTuple):
    bus: str
    filters: Sequence[CanFilter]
    cyclic: Sequence[CyclicFrame]


class CanBuses:
    """Members of all buses by the name of the device. Synchronization: one thread."""

    def __init__(self) -> None:
        self._members: dict[str, _Member] = {}

    def join(self, name: str, bus: str, filters: Sequence[CanFilter], cyclic: Sequence[CyclicFrame]) -> None:
        """Add a device to a bus: the frames it receives, and those that it needs to be sent."""
        self._members[name] = _Member(bus, filters, cyclic)

    def leave(self, name: str) -> None:
        """Remove the device; no-op if absent."""
        self._members.pop(name, None)

    def claimed(self, name: str, bus: str) -> Callable[[int, bool], bool]:
        """Return a test of an identifier (and 29 bits or not): whether another device of the bus receives it."""

        def is_claimed(can_id: int, extended: bool) -> bool:
            return any(
                wanted.matches(can_id, extended)
                for other, member in self._members.items()
                if other != name and member.bus == bus
                for wanted in member.filters
            )

        return is_claimed

    def conflict(self, name: str) -> str:
        """Return which other device has a frame sent that this one needs, one sentence; empty if none has.

        Of two, the one that joined first may send.
        """
        mine = self._members.get(name)
        wanted = {(frame.can_id, frame.extended) for frame in mine.cyclic} if mine else set()
        for other, member in self._members.items():
            if other == name or mine is None:
                break
            for frame in member.cyclic if member.bus == mine.bus else ():
                if (frame.can_id, frame.extended) in wanted:
                    frame_id = f"0x{frame.can_id:08X}" if frame.extended else f"0x{frame.can_id:03X}"
                    return f"{other} and {name} would both send {frame_id} on {mine.bus}: let one of them do it"
        return ""
