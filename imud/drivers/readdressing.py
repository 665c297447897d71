"""Follow a device on CAN to another place, its node number or address, after a write or a restart.

The scripts of a UART and of Modbus follow a device without this module: adapters for it need more lines than they save.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from msgspec.structs import replace as with_fields

from imud.contracts.command import VerbResult
from imud.contracts.script import Message, Rejection, Reply, ReplyFrame, Request, RequestScript, never
from imud.contracts.setting import Written
from imud.formats.can import CanFilter
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.model.units import NS_PER_MS, NS_PER_S

# Time to listen for a device, ns: it sends each message at least once per second (sections 5.1 and 6.2.2)
LISTEN_NS: Final = 1100 * NS_PER_MS
BOOT_NS: Final = 3 * NS_PER_S  # maximum time to the first frame after a restart, ns; the manual states none


@dataclass(frozen=True, slots=True, kw_only=True)
class Readdressing:
    """A device with the requests and words of its protocol. All scripts raise the errors of the protocol."""

    options: Any  # options of the driver
    present: int  # place in `options`
    noun: str  # noun of a place and its key in `options`
    number: str  # noun of a place after "another" and "the factory"
    words: str  # words before a place in a report
    lost: str  # error if no place has a reply; contains {confirmed}, {new} and {present}
    factory: int  # place after a factory reset
    valid: range  # places that a device can have
    registers: tuple[Hashable, Hashable]  # registers that store the place, and the code of the bit rate
    bit_rates: Mapping[int, int]  # bit rates by their code, bit/s
    boot: CanFilter  # frames that a device sends once after a restart
    boot_data: bytes | None  # data of these frames; None: any data
    sender_mask: int  # bits of an identifier that contain the place of the sender
    frames: Callable[[int], tuple[CanFilter, ...]]  # filters for all frames of a device at a place
    describe: Callable[[int], str]  # words for a frame by its identifier
    query: Callable[[int], bytes]  # frame that a device at a place answers
    # Writes a new place (second argument) to the device at a place. Returns whether the device confirmed the write.
    write: Callable[[int, int], RequestScript[bool]]
    verify: Callable[[int, int], RequestScript[Written]]  # reads back the new place; the same arguments
    read_saved: Callable[[], RequestScript[Mapping[Any, int]]]  # reads `registers`, without unreadable registers

    def change(self, new: int) -> RequestScript[Written]:
        """Write another place, and follow a device that uses it immediately.

        Raises BadArgument if another device uses the place, and NoReply if the device replies neither at the new nor at
        the present place (imud then commands it back).
        """
        if heard := (yield from self.heard(new)):
            words = f"received its {self.describe(heard)}"
            raise BadArgument(f"{self.noun} {new} is in use: {words}; try another {self.number}")
        confirmed = "confirmed the write and then " if (yield from self.write(self.present, new)) else ""
        # a device that uses the new place immediately may confirm one write at the present place, but not two
        for place in (self.present, new):
            if (yield from self.write(place, new)):
                if place == self.present:
                    return (yield from self.verify(place, new))
                yield self.move(place)
                written = yield from self.verify(place, new)
                # the device replies at a place at which no device replied before: it needs no readable register
                return Written.VERIFIED if written is Written.UNVERIFIED else written
        # the device may use the new place and not reply: command it back without waiting for a reply
        yield replace(next(self.write(new, self.present)), also=(), silent=True)
        raise NoReply(self.lost.format(confirmed=confirmed, new=new, present=self.present))

    def restart(self, request: Request, bus_bit_s: int) -> RequestScript[str | VerbResult]:
        """Restart the device by `request`, follow it to its place, and return a report, with evidence if there is any.

        A new place shows the restart, and so does a boot frame that a device sends only then. `bus_bit_s` is the bit
        rate of the bus; 0 if it is not known. Raises NoReply if the device does not reply afterwards.
        """
        saved = yield from self.read_saved()
        place, code = (saved.get(register, -1) for register in self.registers)
        bit_s = self.bit_rates.get(code, bus_bit_s)
        # a device without a valid saved place keeps its present place
        places = tuple(dict.fromkeys((self.present, place if place in self.valid else self.present)))
        booted = found = yield from self._boot(request, (*places, self.factory) if saved else None)
        for place in places:
            if found is None and (yield from self.heard(place)):
                found = place
        if found is None:
            if bus_bit_s and bit_s != bus_bit_s:
                rate = f"{bit_s} bit/s"
                return f"the device now uses {rate} and the bus does not; set the bus to {rate}"
            words = " or ".join(map(str, places))
            raise NoReply(f"no frame of {self.noun} {words} after the restart; does it use another bit rate now?")
        report = f"found {self.words} {found}"
        if found != self.present:
            yield self.move(found)
            return VerbResult(True, f"the device moved from {self.noun} {self.present} to {found}", report)
        if booted is not None and self.boot_data is not None:
            return VerbResult(True, "the device sent its boot message", report)
        return report

    def check_factory(self) -> RequestScript[None]:
        """Raise BadArgument if another device uses the factory place."""
        if self.present != self.factory and (yield from self.heard(self.factory)):
            place = f"{self.noun} {self.factory}, the factory {self.number}"
            raise BadArgument(f"{place}, is in use by another node; change that node first")

    def heard(self, place: int) -> RequestScript[int]:
        """Send a query to a place. Return the identifier of the first frame from there; 0 without a frame."""
        filters = self.frames(place)

        def ends(message: Message) -> bool:
            return isinstance(message, ReplyFrame) and any(
                one.matches(message.frame_id, one.extended) for one in filters
            )

        name = f"{self.noun} {place}, present?"
        outcome = yield Request(self.query(place), name, ends, never, never, LISTEN_NS, also=filters)
        return outcome.frames[-1].frame_id if isinstance(outcome, Reply) else 0

    def move(self, place: int) -> Request:
        """Return a request that makes imud use another place."""
        options = with_fields(self.options, **{self.noun: place})
        return Request(b"", f"now {self.words} {place}", never, never, never, silent=True, settings=options)

    def _boot(self, request: Request, places: Sequence[int] | None) -> RequestScript[int | None]:
        """Send a request for a restart. Return the place in the boot frame. `places`: None for any place."""

        def ends(message: Message) -> bool:
            if not isinstance(message, ReplyFrame) or not self.boot.matches(message.frame_id, self.boot.extended):
                return False
            is_place = places is None or message.frame_id & self.sender_mask in places
            return is_place and self.boot_data in (None, message.payload)

        refuses = request.is_rejection
        outcome = yield Request(request.payload, request.name, ends, refuses, never, BOOT_NS, also=(self.boot,))
        if isinstance(outcome, Rejection):
            raise Rejected(f"{request.name}: the device rejected the request")
        return outcome.frames[-1].frame_id & self.sender_mask if isinstance(outcome, Reply) else None
