"""CAN buses shared by the devices of one daemon: the owner of each frame, and the sender of each cyclic frame.

    driver of the device   joins with the frames of …             when
    named                  the node in its options                before its bus is waited for, until it is closed
    auto                   the node that was found by listening   from then until it is searched again

    claimed(name, bus)     what a search must leave alone
    conflict(name)         why a device may not start

A device that searches must not choose one that is configured by another name, and two devices must not have the same
frame sent: receivers would get it twice per period. What the file alone shows of this, `imud check` refuses already
(`imud.config.claims`, by the same `CanUse`); here it is also known of devices that were found, and of a reload.
"""

from collections.abc import Callable, Sequence

from imud.contracts.claims import CanUse
from imud.formats.can import CanFilter, CyclicFrame


class CanBuses:
    """Members of all buses by the name of the device. Synchronization: one thread."""

    def __init__(self) -> None:
        self._members: dict[str, CanUse] = {}
        self._loads: dict[str, Callable[[], float]] = {}

    def join(
        self,
        name: str,
        bus: str,
        filters: Sequence[CanFilter],
        cyclic: Sequence[CyclicFrame],
        bits_per_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Add a device to a bus: the frames it receives, those that it needs to be sent, and how much it sends now."""
        self._members[name] = CanUse(bus, filters, cyclic)
        self._loads[name] = bits_per_s

    def leave(self, name: str) -> None:
        """Remove the device; no-op if absent."""
        self._members.pop(name, None)
        self._loads.pop(name, None)

    def bits_per_s(self, name: str, bus: str) -> float:
        """Return what the other devices of a bus send, in bit/s without stuff bits."""
        others = [other for other, member in self._members.items() if other != name and member.bus == bus]
        return sum(self._loads[other]() for other in others)

    def claimed(self, name: str, bus: str) -> Callable[[int, bool], bool]:
        """Return a test of an identifier (and 29 bits or not): whether another device of the bus receives it."""

        def is_claimed(can_id: int, extended: bool) -> bool:
            return any(
                other != name and member.bus == bus and member.receives(can_id, extended)
                for other, member in self._members.items()
            )

        return is_claimed

    def conflict(self, name: str) -> str:
        """Return which other device takes the frames of this one, or has a frame sent that it needs, one sentence.

        Empty if there is none. Of two, the one that joined first may go on: one that was found by listening is not
        stopped by a device that a reload adds.
        """
        mine = self._members.get(name)
        for other, member in self._members.items():
            if other == name or mine is None:
                break
            if both := mine.both_send(member):
                return f"{other} and {name} would both send {both} on {mine.bus}: let one of them do it"
            if both := mine.both_receive(member):
                return f"{other} and {name} would be the same device on {mine.bus}, the one that sends {both}"
        return ""
