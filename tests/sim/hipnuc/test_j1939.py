"""The simulated J1939 device compared with its true values and the manual. imud's codec decodes its frames."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import pytest

from imud.contracts.command import Target, VerbResult
from imud.contracts.script import Outcome, Rejection, Reply, ReplyFrame, Request, RequestScript, Silence
from imud.contracts.setting import combined
from imud.drivers.hipnuc.j1939 import codec, commands
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Codec, HipnucJ1939Options, J1939Node
from imud.drivers.hipnuc.j1939.driver import SETTINGS
from imud.formats.can import EXTENDED_ID_MAX, RAW_FRAME
from imud.formats.j1939 import CLAIMED, split
from imud.model.errors import NoReply, Rejected
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.can_module import CanModules, SentFrame
from imud.sim.hipnuc import j1939
from imud.sim.hipnuc.j1939 import (
    J1939_VARIANTS,
    SIMULATOR,
    HipnucJ1939Module,
    J1939Hardware,
    J1939Settings,
    J1939Variant,
)
from imud.sim.physics import Still
from imud.sim.sensor import SimulatorOptions
from tests.support.simulated_modules import run_script

BEGIN_NS = 5_000_000_000
SECOND_NS = 1_000_000_000
MS = 1_000_000


def made(**options: object) -> HipnucJ1939Module:
    given = {"rate_hz": 100.0, "noise": "none", "boot_ms": 0, **options}
    module = SIMULATOR.make(SimulatorOptions(**given), BEGIN_NS)  # type: ignore[arg-type]  # a mapping of options
    assert isinstance(module, HipnucJ1939Module)
    return module


def samples_of(frames: Sequence[SentFrame], address: int) -> int:
    codec = HipnucJ1939Codec(Ledger(), HipnucJ1939Options(address=address))
    events = [event for f in frames for event in codec.feed_frame(f.can_id, f.extended, f.data, f.due_ns)]
    return sum(isinstance(event, Measurement) for event in events)


def pgns(frames: Sequence[SentFrame]) -> Counter[int]:
    return Counter(split(frame.can_id).pgn for frame in frames)


class J1939Host:
    def __init__(self, module: HipnucJ1939Module, host: int = 0x55) -> None:
        self.module = module
        self.host = host
        self.now_ns = BEGIN_NS
        self.heard: list[SentFrame] = []

    def wait(self, duration_ns: int) -> list[SentFrame]:
        self.now_ns += duration_ns
        new = self.module.advance(self.now_ns)
        self.heard += new
        return new

    def talk(self, begin: Callable[[J1939Node], RequestScript[object]], address: int = 8) -> object:
        codec = HipnucJ1939Codec(Ledger(), HipnucJ1939Options(address=address, host_address=self.host))

        def ask(request: Request) -> Outcome:
            if request.payload:
                can_id, size, data = RAW_FRAME.unpack(request.payload)
                self.module.receive(can_id & EXTENDED_ID_MAX, True, data[:size], self.now_ns)
            # a request without a payload only listens, for its complete time
            frames = self.wait(5 * MS if request.payload else request.timeout_ns)
            events = [e for f in frames for e in codec.feed_frame(f.can_id, f.extended, f.data, f.due_ns)]
            also = [f for f in frames if any(wanted.matches(f.can_id, f.extended) for wanted in request.also)]
            messages = [e for e in events if isinstance(e, ReplyFrame)] + [ReplyFrame(f.can_id, f.data) for f in also]
            for message in messages:
                if request.is_rejection(message):
                    return Rejection((message,))
                if request.is_end(message):
                    return Reply((message,))
            return Silence(())

        return run_script(begin(J1939Node(address, self.host)), ask)


def restarted(peer: J1939Node) -> RequestScript[None]:
    yield commands.restart_request(peer)


def test_four_modules_crystal_wire_and_the_next_frame() -> None:
    modules = [made(node=node, rate_hz=100.0) for node in (1, 8, 9, 128)]
    frames = CanModules(modules).advance(BEGIN_NS + SECOND_NS)
    for module in modules:
        assert samples_of(frames, module.settings.address) >= 94
    module = made(skew_ppm=1000.0)
    frames = [f for f in module.advance(BEGIN_NS + SECOND_NS) if split(f.can_id).pgn != CLAIMED]
    assert [split(frame.can_id).pgn for frame in frames[:4]] == [0xFF34, 0xFF37, 0xFF3D, 0xFF41]
    assert module.counters() == {"samples_sent": 101, "frames_sent": 405, "requests": 0}
    for at_once in (False, True):
        hardware = J1939Hardware(boot_ms=0, bitrate=0, processing_ns=0) if at_once else J1939Hardware()
        module = HipnucJ1939Module(BEGIN_NS, hardware=hardware)
        for _ in range(10):
            next_ns = module.next_ns()
            assert next_ns is not None
            assert module.advance(next_ns - 1) == []
            assert {frame.due_ns for frame in module.advance(next_ns)} == {next_ns}
    assert J1939Settings().intervals_ms == dict.fromkeys((0xFF34, 0xFF37, 0xFF3D, 0xFF41), 100)
    slow = {pgn: ms for pgn, ms in made(message="all", rate_hz=30.0).settings.intervals_ms.items() if ms != 33}
    newer = (codec.PLACE, codec.HEIGHT, codec.GNSS, codec.VELOCITY)
    assert slow == dict.fromkeys((codec.TEMPERATURE, codec.UTC, *newer), 990)  # ms, a multiple of 33


@pytest.mark.manual("B 6.2.2 intervals", "B 6.2.2 bit rate", "B 6.2.2 address")
def test_what_is_set_read_back_saved_and_lost_at_a_restart() -> None:
    bench = J1939Host(made())
    bench.talk(lambda peer: commands.set_interval(peer, 0xFF37, 20))
    bench.talk(lambda peer: commands.set_interval(peer, 0xFF4A, 500))  # this request enables the message
    counts = pgns(bench.wait(SECOND_NS))
    assert counts[0xFF34] == pytest.approx(100, abs=1)
    assert counts[0xFF37] == pytest.approx(50, abs=1)
    assert counts[0xFF4A] == 2
    reports: Any = bench.talk(lambda peer: SETTINGS.read(Target(HipnucJ1939Options(), 0), None))
    settings = combined(reports).words
    assert (settings["interval_ms_FF37"], settings["address"], settings["bitrate"]) == ("20", "8", "500000")
    bench = J1939Host(made(boot_ms=200))
    bench.wait(300 * MS)
    bench.talk(lambda peer: commands.set_interval(peer, 0xFF34, 50))
    bench.talk(restarted)
    assert bench.module.settings.intervals_ms[0xFF34] == 10
    assert pgns(bench.wait(190 * MS)) == {}
    bench.wait(100 * MS)
    bench.talk(lambda peer: commands.set_interval(peer, 0xFF34, 50))
    bench.talk(commands.save)
    bench.talk(restarted)
    assert bench.module.settings.intervals_ms[0xFF34] == 50
    bench.wait(300 * MS)
    bench.talk(commands.factory_reset)
    bench.talk(restarted)
    assert (bench.module.settings, bench.module.writes_to_flash) == (J1939Settings(), 1)
    bench = J1939Host(HipnucJ1939Module(BEGIN_NS, hardware=J1939Hardware(boot_ms=0)))
    bench.talk(lambda peer: commands.set_address(peer, 20))
    bench.talk(lambda peer: commands.set_bitrate(peer, 125_000))
    assert {split(f.can_id).source for f in bench.wait(SECOND_NS)} == {8}
    bench.talk(commands.save)
    bench.talk(restarted)
    bench.wait(100 * MS)
    frames = bench.wait(SECOND_NS)
    assert ({split(f.can_id).source for f in frames}, frames[1].due_ns - frames[0].due_ns) == ({20}, 1_120_000)
    assert bench.talk(commands.identify, address=20) is not None


def written_and_read(peer: J1939Node, register: int, value: int) -> RequestScript[int]:
    """Write a register, wait for the acknowledgement, and read the register."""
    acknowledged = yield commands.exchange(peer, register, commands.WRITE, value, "write")
    assert isinstance(acknowledged, Reply)
    return (yield from commands.read(peer, register))


def test_values_out_of_range_do_not_take() -> None:
    bench = J1939Host(made())
    for register, value in ((0x0134, 4), (0x009A, 5), (0x009C, 129), (0x009E, 2)):
        assert bench.talk(partial(written_and_read, register=register, value=value)) != value
    with pytest.raises(Rejected):
        bench.talk(lambda peer: commands.set_interval(peer, 0xFF34, 4))
    with pytest.raises(Rejected):
        bench.talk(lambda peer: commands.set_address(peer, 129))
    assert bench.module.settings == bench.module.flash
    for value in (5, 1000):  # the limits
        assert bench.talk(partial(written_and_read, register=0x0134, value=value)) == value
    with pytest.raises(NoReply):
        bench.talk(lambda peer: commands.read(peer, 0x0042))
    with pytest.raises(NoReply):
        bench.talk(lambda peer: commands.read(peer, 0x009C), address=9)
    before = bench.module.requests
    bench.module.receive(0x0CEF0955, True, bytes.fromhex("3401060064000000"), bench.now_ns)
    bench.module.receive(0x0CEF0855, True, bytes.fromhex("34010600640000"), bench.now_ns)
    bench.module.receive(0x0CFF3408, True, bytes.fromhex("3401060064000000"), bench.now_ns)
    assert bench.module.requests == before


READ_0, READ_1, WRITE_20 = (
    bytes.fromhex(text) for text in ("9C00030000000000", "9C00030001000000", "9C00060014000000")
)


@pytest.mark.parametrize(
    ("name", "request_data", "sources"),
    [
        ("real", READ_0, [8]), ("reads need the value 1", READ_0, []), ("reads need the value 1", READ_1, [8]),
        ("ignores reads", READ_1, []), ("real", WRITE_20, [8]), ("address at once", WRITE_20, [8, 20]),
        ("address at once, confirmed from there", WRITE_20, [20, 20]),
    ],
)  # fmt: skip
def test_which_variant_replies_and_from_which_address(name: str, request_data: bytes, sources: list[int]) -> None:
    hardware = J1939Hardware(boot_ms=0, variant=j1939.J1939_VARIANTS[name])
    module = HipnucJ1939Module(BEGIN_NS, J1939Settings({}), hardware)
    module.advance(BEGIN_NS + MS)
    module.receive(0x0CEF0855, True, request_data, BEGIN_NS + MS)
    frames = module.advance(BEGIN_NS + 2 * MS)
    module.receive(0x0CEF1455, True, READ_1, BEGIN_NS + 2 * MS)  # to address 20
    frames += module.advance(BEGIN_NS + 3 * MS)
    assert [split(frame.can_id).source for frame in frames] == sources
    assert [frame.due_ns for frame in frames[:1]] == [BEGIN_NS + MS + 200_000 + 280_000] * bool(sources)


@pytest.mark.manual("B 6.2.2 restart")
@pytest.mark.parametrize("confirms", [False, True])
def test_a_restart_is_answered_before_it_happens_or_not_at_all(confirms: bool) -> None:
    hardware = J1939Hardware(boot_ms=0, variant=J1939Variant(confirms_restart=confirms))
    module = HipnucJ1939Module(BEGIN_NS, hardware=hardware)
    module.advance(BEGIN_NS + 50 * MS)
    for data in (READ_1, bytes.fromhex("00000600FF000000")):
        module.receive(0x0CEF0855, True, data, BEGIN_NS + 50 * MS)
    sent = [f for now_us in (50_500, 60_000) for f in module.advance(BEGIN_NS + now_us * 1000)]
    expected = [bytes.fromhex("9C00030008000000"), bytes.fromhex("00000600FF000000")][: 1 + confirms]
    assert [f.data for f in sent if f.can_id == 0x0CEF5508] == expected


def test_the_output_can_be_off_and_a_message_alone_too() -> None:
    module = HipnucJ1939Module(BEGIN_NS, hardware=J1939Hardware(boot_ms=0, variant=J1939_VARIANTS["claims no address"]))
    now_ns = BEGIN_NS
    for request, pgns in (
        ("370106000000 0000", {codec.ACCEL, codec.ROLL_PITCH, codec.HEADING}), ("9D00060000000000", set()),
        ("9D00060001000000", {codec.ACCEL, codec.ROLL_PITCH, codec.HEADING}),
    ):  # fmt: skip
        module.receive(0x0CEF0855, True, bytes.fromhex(request), now_ns)
        module.advance(now_ns + 5 * MS)
        now_ns += 1000 * MS
        assert {split(f.can_id).pgn for f in module.advance(now_ns)} == pgns


def test_an_address_is_claimed_after_power_on_and_when_asked() -> None:
    """The request for PGN 0xEE00 has the format of J1939-21, low byte first, to the device and to all nodes."""
    module = HipnucJ1939Module(BEGIN_NS, hardware=J1939Hardware(boot_ms=0))
    claims = [f for f in module.advance(BEGIN_NS + 10 * MS) if f.can_id == 0x18EEFF08]
    assert len(claims) == 1
    for number, can_id in enumerate((0x18EA0855, 0x18EAFF55), 1):
        now_ns = BEGIN_NS + number * 20 * MS
        module.advance(now_ns)
        module.receive(can_id, True, bytes.fromhex("00EE000000000000"), now_ns)
        (claim,) = [f for f in module.advance(now_ns + 10 * MS) if f.can_id == 0x18EEFF08]
        assert claim.data == claims[0].data
    module.receive(0x18EA0955, True, bytes.fromhex("00EE000000000000"), BEGIN_NS + 70 * MS)
    assert not [f for f in module.advance(BEGIN_NS + 80 * MS) if f.can_id == 0x18EEFF08]


def test_registers_replies_and_a_single_message() -> None:
    bench = J1939Host(made())
    assert bench.talk(lambda peer: commands.read(peer, 0x78)) == 169
    assert bench.talk(lambda peer: commands.read(peer, 0x70)) == 0x4849  # "HI"
    bench = J1939Host(made(), host=0x20)
    assert bench.talk(lambda peer: commands.read(peer, commands.ADDRESS)) == 8
    replies = [f for f in bench.heard if split(f.can_id).pgn == codec.CONFIGURE]
    assert {split(f.can_id).destination for f in replies} == {0x55}
    bench = J1939Host(made())
    result = bench.talk(lambda peer: commands.send_once(peer, 0xFF46))
    assert isinstance(result, VerbResult)
    assert result.verified
    assert pgns(bench.heard)[0xFF46] == 1
    assert pgns(bench.wait(SECOND_NS))[0xFF46] == 0
    result = bench.talk(lambda peer: commands.send_once(peer, 0xFF34))
    assert isinstance(result, VerbResult)
    assert not result.verified  # FF34 also arrives without the request


@pytest.mark.manual("B 6.2.2 zero", "B 6.2.2 directions")
def test_zero_and_directions_of_the_inclinometer() -> None:
    still = Still(roll_rad=math.radians(10), pitch_rad=math.radians(20))
    settings = J1939Settings(intervals_ms={codec.INCLINOMETER: 10})
    bench = J1939Host(HipnucJ1939Module(BEGIN_NS, settings, J1939Hardware(boot_ms=0, motion=still)))

    def shown() -> tuple[float, float]:
        last = codec.measurement_of([(0xFF4A, bench.wait(50 * MS)[-1].data)]).incli_rad
        assert last is not None
        return round(math.degrees(last[0]), 2), round(math.degrees(last[1]), 2)

    # X is the roll; Y = atan2(sin 20°, cos 20° · cos 10°) = atan2(0.342020, 0.925417) = 20.28°
    assert shown() == (10.0, 20.28)
    bench.talk(lambda peer: commands.set_direction(peer, "Y", True))
    assert shown() == (10.0, -20.28)
    bench.talk(lambda peer: commands.set_direction(peer, "X", True))
    assert shown() == (-10.0, -20.28)
    bench.talk(lambda peer: commands.zero(peer, commands.Zero.HERE))
    assert shown() == (0.0, 0.0)
    bench.talk(lambda peer: commands.zero(peer, commands.Zero.CANCEL))
    assert shown() == (-10.0, -20.28)
    assert [math.degrees(j1939._within_pi(math.radians(angle))) for angle in (350, -190)] == pytest.approx([-10, 170])


def test_the_time_of_day_starts_again_after_a_day() -> None:
    """The device runs for a day and 5 s. It sends UTC each second of its own crystal."""
    hardware = J1939Hardware(boot_ms=86_405_000, skew_ppm=0)
    module = HipnucJ1939Module(BEGIN_NS, J1939Settings(intervals_ms={codec.UTC: 1000}), hardware)
    frames = [f for f in module.advance(BEGIN_NS + 86_407 * SECOND_NS) if split(f.can_id).pgn == codec.UTC]
    assert [tuple(frame.data[3:6]) for frame in frames][:1] == [(0, 0, 5)]  # hour, minute, second
