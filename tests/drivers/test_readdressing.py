"""Readdressing with a fake protocol: one byte for the operation, one byte for its value."""

from collections.abc import Callable
from dataclasses import dataclass, field

import msgspec
import pytest

from imud.contracts import script
from imud.contracts.command import VerbResult
from imud.contracts.script import Outcome, Rejection, Reply, ReplyFrame, Request, RequestScript, Silence
from imud.contracts.setting import Written
from imud.drivers.readdressing import Readdressing
from imud.formats.can import RAW_FRAME, CanFilter, pack_frame
from imud.model.errors import BadArgument, NoReply, Rejected
from tests.support.script_runners import unanswered_ms
from tests.support.simulated_modules import run_script

QUERY, WRITE, RESTART = 1, 2, 3
REQUESTS, REPLIES, BOOTS = 0x600, 0x580, 0x700
FACTORY = 8
BUS_BIT_S = 500_000


class FakeOptions(msgspec.Struct, frozen=True):
    node: int = 5


@dataclass
class FakeDevice:
    place: int = 5
    saved: dict[str, int] = field(default_factory=dict)
    immediate: bool = False  # uses a written place immediately
    replies: int = 99  # number of replies before the device only receives
    booted: int | None = None  # place after a restart; None: the device is lost
    boots: bool = True  # sends a frame after a restart

    def receive(self, place: int, operation: int, value: int) -> list[ReplyFrame]:
        if place != self.place:
            return []
        if operation == WRITE and self.immediate:
            self.place = value
        if operation == RESTART:
            self.place = -1 if self.booted is None else self.booted
            return [ReplyFrame(BOOTS + self.place, b"\0")] if self.boots and self.booted is not None else []
        self.replies -= 1
        return [ReplyFrame(REPLIES + place, bytes([operation]))] if self.replies >= 0 else []


class Bench:
    def __init__(self, device: FakeDevice, *others: FakeDevice, rejects: bool = False) -> None:
        self.device, self.devices, self.rejects = device, (device, *others), rejects
        self.options = FakeOptions()
        self.sent: list[tuple[int, int, int]] = []
        self.beside: list[ReplyFrame] = []
        """Frames of other devices, which the host receives before a reply."""

    def ask(self, request: Request) -> Outcome:
        if request.settings is not None:
            assert request.silent
            self.options = request.settings
            return Reply(())
        can_id, _, data = RAW_FRAME.unpack(request.payload)
        sent = (can_id - REQUESTS, data[0], data[1])
        self.sent.append(sent)
        frames = [*self.beside, *(frame for device in self.devices for frame in device.receive(*sent))]
        if request.silent:
            return Reply(())
        if self.rejects:
            return Rejection(())
        return next((Reply((frame,)) for frame in frames if request.is_end(frame)), Silence(()))

    def readdressing(self) -> Readdressing:
        present = self.options.node

        def write(at: int, new: int) -> RequestScript[bool]:
            is_reply = is_from(REPLIES + at)
            return isinstance(
                (yield Request(frame(at, WRITE, new), "write", is_reply, script.never, script.never)), Reply
            )

        def verify(at: int, _new: int) -> RequestScript[Written]:
            yield Request(frame(at, QUERY), "read", is_from(REPLIES + at), script.never, script.never)
            return Written.PENDING if at == present else Written.VERIFIED

        return Readdressing(
            options=self.options, present=present, noun="node", number="number", words="as node",
            lost="{confirmed}lost at {new} or {present}", factory=FACTORY, valid=range(1, 128),
            registers=("place", "rate"), bit_rates={0: 250_000, 1: BUS_BIT_S}, boot=CanFilter(BOOTS, 0x780, False),
            boot_data=b"\0", sender_mask=0x7F,
            frames=lambda at: (CanFilter(REPLIES + at, 0x7FF, False), CanFilter(BOOTS + at, 0x7FF, False)),
            describe=hex, query=lambda at: frame(at, QUERY), write=write, verify=verify,
            read_saved=lambda: script.says_nothing(self.device.saved),
        )  # fmt: skip

    def change(self, new: int) -> Written:
        return run_script(self.readdressing().change(new), self.ask)

    def restart(self, bus_bit_s: int = BUS_BIT_S) -> str:
        request = Request(
            frame(self.options.node, RESTART), "restart", script.never, script.never, script.never, silent=True
        )
        found = run_script(self.readdressing().restart(request, bus_bit_s), self.ask)
        self.evidence = found.evidence if isinstance(found, VerbResult) else ""
        return str(found.result) if isinstance(found, VerbResult) else found


def frame(at: int, operation: int, value: int = 0) -> bytes:
    return pack_frame(REQUESTS + at, False, bytes([operation, value]))


def is_from(can_id: int) -> Callable[[object], bool]:
    return lambda message: isinstance(message, ReplyFrame) and message.frame_id == can_id


def test_a_device_stays_is_followed_or_the_place_is_refused() -> None:
    bench = Bench(FakeDevice(), FakeDevice(place=12))
    with pytest.raises(BadArgument, match="node 12 is in use: received its 0x58c; try another number"):
        bench.change(12)
    assert bench.sent == [(12, QUERY, 0)]
    bench = Bench(FakeDevice(immediate=True))
    assert (bench.change(9), bench.options) == (Written.VERIFIED, FakeOptions(9))
    # the device confirms the first write at 5 and then uses 9
    assert bench.sent == [(9, QUERY, 0), (5, WRITE, 9), (5, WRITE, 9), (9, WRITE, 9), (9, QUERY, 0)]
    bench = Bench(FakeDevice())
    bench.beside = [ReplyFrame(REPLIES + 12, b"\0")]
    assert (bench.change(9), bench.options) == (Written.PENDING, FakeOptions(5))
    assert bench.sent == [(9, QUERY, 0), (5, WRITE, 9), (5, WRITE, 9), (5, QUERY, 0)]


@pytest.mark.parametrize(("replies", "words"), [(0, "^lost at 9 or 5"), (1, "^confirmed the write and then lost at 9")])
@pytest.mark.parametrize("immediate", [False, True])
def test_a_silent_device_is_commanded_back(replies: int, words: str, immediate: bool) -> None:
    bench = Bench(FakeDevice(immediate=immediate, replies=replies))
    with pytest.raises(NoReply, match=words):
        bench.change(9)
    assert (bench.options, bench.sent[-1]) == (FakeOptions(5), (9, WRITE, 5))
    assert bench.device.place == 5  # also if the device used the new place in the meantime


def test_the_command_back_does_not_wait() -> None:
    last: list[Request] = []

    def silent(request: Request) -> Outcome:
        last[:] = [request]
        return Silence(())

    with pytest.raises(NoReply):
        run_script(Bench(FakeDevice()).readdressing().change(9), silent)
    assert (last[0].silent, last[0].also) == (True, ())
    restart = Request(b"", "restart", script.never, script.never, script.never)
    assert [*unanswered_ms(Bench(FakeDevice()).readdressing().restart(restart, BUS_BIT_S))] == [3000, 1100]


@pytest.mark.parametrize("boots", [True, False], ids=["with a boot frame", "without"])
@pytest.mark.parametrize(
    ("saved", "place"),
    [
        ({"place": 9}, 9), ({"place": 9}, 5), ({}, 5), ({"rate": 1}, 5), ({"place": 200}, 5),
        ({"place": FACTORY}, FACTORY),
    ],
)  # fmt: skip
def test_a_restarted_device_is_found_at_its_saved_or_present_place(
    saved: dict[str, int], place: int, boots: bool
) -> None:
    bench = Bench(FakeDevice(saved=saved, booted=place, boots=boots))
    assert (bench.restart(), bench.options) == (f"found as node {place}", FakeOptions(place))
    unmoved = "the device sent its boot message" if boots else ""
    assert bench.evidence == (unmoved if place == 5 else f"the device moved from node 5 to {place}")


def test_boot_frames_of_this_device_only_and_a_rejected_restart_or_lost_device_is_reported() -> None:
    bench = Bench(FakeDevice(saved={"place": 9}, booted=FACTORY))
    assert bench.restart() == "found as node 8"
    bench = Bench(FakeDevice(saved={"place": 9}, booted=FACTORY, boots=False))
    with pytest.raises(NoReply, match="no frame of node 5 or 9 after the restart"):
        bench.restart()
    assert bench.options == FakeOptions(5)
    bench = Bench(FakeDevice(saved={"place": 9}, booted=5))
    bench.beside = [ReplyFrame(BOOTS + 12, b"\0"), ReplyFrame(BOOTS + 9, b"\5"), ReplyFrame(REPLIES + 12, b"\0")]
    assert bench.restart() == "found as node 5"
    bench = Bench(FakeDevice(booted=33))
    bench.beside = [ReplyFrame(REPLIES + 12, b"\0")]
    assert (bench.restart(), bench.options) == ("found as node 33", FakeOptions(33))
    with pytest.raises(Rejected, match="restart: the device rejected the request"):
        Bench(FakeDevice(), rejects=True).restart()
    bench = Bench(FakeDevice(saved={"place": 9, "rate": 0}))
    assert bench.restart() == ("the device now uses 250000 bit/s and the bus does not; set the bus to 250000 bit/s")
    assert bench.sent == [(5, RESTART, 0), (5, QUERY, 0), (9, QUERY, 0)]
    for saved, bus_bit_s in (({"rate": 1}, BUS_BIT_S), ({"rate": 7}, BUS_BIT_S), ({}, BUS_BIT_S), ({"rate": 0}, 0)):
        with pytest.raises(NoReply, match="no frame of node 5 after the restart; does it use another bit rate now"):
            Bench(FakeDevice(saved=saved)).restart(bus_bit_s)


def test_the_factory_place_is_checked_before_a_reset() -> None:
    bench = Bench(FakeDevice())
    run_script(bench.readdressing().check_factory(), bench.ask)
    bench = Bench(FakeDevice(), FakeDevice(place=FACTORY))
    with pytest.raises(BadArgument, match="node 8, the factory number, is in use by another node; change that node"):
        run_script(bench.readdressing().check_factory(), bench.ask)
    bench = Bench(FakeDevice(place=FACTORY))
    bench.options = FakeOptions(FACTORY)
    run_script(bench.readdressing().check_factory(), bench.ask)
    assert bench.sent == []
