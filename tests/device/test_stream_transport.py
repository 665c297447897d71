"""A device on a link in memory: search, query, unplug, replug, silence."""

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import replace
from itertools import pairwise
from time import monotonic_ns
from typing import Any

import msgspec
import pytest

from imud.config.model import DeviceConfig
from imud.contracts.command import Verb
from imud.contracts.link import OnData, OnEnd
from imud.contracts.script import Request, RequestScript, never
from imud.contracts.status import DeviceState, KernelCounters
from imud.device.search import RememberedDevice
from imud.drivers.hipnuc.uart import driver
from imud.drivers.hipnuc.uart.codec import encode_frame
from imud.drivers.imu61x.uart.codec import DEVICE_SYNC, frame_name
from imud.drivers.imu61x.uart.codec import encode_frame as imu61x_frame
from imud.formats.nmea0183 import sentence
from imud.links import LINKS
from imud.links.memory import MemoryLink, MemoryOptions
from imud.model.errors import LinkBusy, LinkError, Rejected
from imud.model.event import EventKind
from tests.support.device_rig import LIMIT_S, DeviceRig, DeviceRigs
from tests.support.device_rig import play as play_rigs
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.files import hi91
from tests.support.stories import played, told

MS = 1_000_000
VERSION = b"PNAME=HI14R3\r\nBUILD=Oct 15 2024\r\nUUID=%s\r\nAPP_VER=156\r\nBL_VER=109\r\nOK\r\n"


Story = Callable[[DeviceRig], Coroutine[Any, Any, None]]


def configured(*, identify: bool = False, baud: Any = 115200, driver: str = "hipnuc-uart", **link: Any) -> DeviceConfig:
    return DeviceConfig("bow", driver, None, identify, "memory", MemoryOptions(baud=baud, **link))


def feed(rig: DeviceRig, data: bytes) -> None:
    assert rig.link.feed(data, rig.now_ns())


def play(story: Story, config: DeviceConfig | None = None, link: MemoryLink | None = None) -> None:
    """Run the device during the story. At the end the ledger balances and the link is closed."""
    clock = VirtualClock()
    rigs = DeviceRigs(clock.host)
    rigs.add(config or configured(), link)

    async def told(made: list[DeviceRig]) -> None:
        await made[0].turn(lambda: made[0].state is not DeviceState.MISSING)
        await story(made[0])

    play_rigs(rigs, told, clock)


@told(play)
async def test_samples_make_the_device_run(rig: DeviceRig) -> None:
    assert rig.is_in(DeviceState.SEARCHING)
    for i in range(5):
        feed(rig, hi91(1000 + 10 * i))
    rig.tick()
    assert rig.is_in(DeviceState.RUNNING)
    assert [s.seq for s in rig.samples] == [1, 2, 3, 4, 5]
    assert [s.t_dev_ns for s in rig.samples] == [(1000 + 10 * i) * MS for i in range(5)]
    assert rig.kinds == [EventKind.UP]
    status = rig.device.status()
    assert (status.newest_seq, status.driver, status.connects) == (5, "hipnuc-uart", 1)
    assert (sum(status.latency_buckets), status.temperature_c) == (5, 20.0)


@told(play)
async def test_after_a_replug_sequence_numbers_and_times_increase(rig: DeviceRig) -> None:
    for i in range(5):
        feed(rig, hi91(5000 + 10 * i))
    feed(rig, hi91(5050)[:40])  # unplugged within a frame
    rig.tick()
    rig.link.disappear()
    await rig.turn(lambda: rig.state is DeviceState.MISSING)
    assert (rig.ledger.bytes_pending, rig.ledger.bytes_skipped) == (0, 40)
    assert "missing" in rig.problem
    rig.link.appear()
    await rig.turn(lambda: rig.state is not DeviceState.MISSING)
    for i in range(3):
        feed(rig, hi91(10 * i))  # power-on: the device counter starts again
    rig.tick()
    assert rig.is_in(DeviceState.RUNNING)
    assert [s.seq for s in rig.samples] == list(range(1, 9))
    times = [s.t_ns for s in rig.samples]
    assert (times, rig.kinds) == (sorted(set(times)), [EventKind.UP, EventKind.DOWN, EventKind.UP])
    assert (rig.device.status().connects, rig.ledger.lost()) == (2, 0)


@told(play)
async def test_a_silent_device_raises_one_event_and_returns(rig: DeviceRig) -> None:
    for i in range(3):
        feed(rig, hi91(10 * i))
    rig.tick()
    for late_ms, state in ((1000, DeviceState.RUNNING), (1001, DeviceState.SILENT), (1600, DeviceState.SILENT)):
        rig.tick(ahead_ns=late_ms * MS)
        assert rig.is_in(state)
    assert rig.kinds == [EventKind.UP, EventKind.DOWN]
    feed(rig, hi91(1_500))
    rig.tick()
    assert rig.is_in(DeviceState.RUNNING)
    assert rig.kinds == [EventKind.UP, EventKind.DOWN, EventKind.UP]


def test_a_link_that_fails_is_reported_closed_and_opened_again() -> None:
    class Faulty(MemoryLink):
        """A port that is busy twice. Then its link fails to start twice. Bytes arrive before the search starts."""

        opens = starts = 0

        def open(self) -> None:
            assert not self.is_open
            self.opens += 1
            if self.opens < 3:
                raise LinkBusy("memory is in use by minicom (pid 4711)")
            super().open()

        def start(self, on_data: OnData, on_end: OnEnd) -> None:
            self.starts += 1
            if self.starts < 3:
                raise LinkError("it does not start")
            super().start(on_data, on_end)
            for size in (3, 5):
                self.feed(bytes(size), monotonic_ns())

    async def story(rig: DeviceRig) -> None:
        await rig.turn(lambda: rig.state is DeviceState.FAILED)
        assert rig.problem == "memory is in use by minicom (pid 4711)"
        for connects in (3, 4):
            await rig.turn(lambda: rig.link.listening and rig.device.status().connects == connects)  # noqa: B023
            feed(rig, hi91(10 * connects))
            rig.tick()
            assert rig.is_in(DeviceState.RUNNING)
            if connects == 3:
                assert (rig.ledger.bytes_in, rig.ledger.bytes_skipped, len(rig.samples)) == (8 + 82, 8, 1)
                rig.link.end(LinkError("input/output error: the adapter stopped answering"))

    play(story, link=Faulty(MemoryOptions(baud=115200)))


@in_loop
async def test_the_end_of_a_replay_finishes_the_device() -> None:
    rig = DeviceRigs().add(configured(writable=False))
    task = asyncio.create_task(rig.device.run())
    await rig.turn(lambda: rig.link.listening)
    feed(rig, hi91(10))
    rig.link.end(None)
    await asyncio.wait_for(task, LIMIT_S)
    assert rig.is_in(DeviceState.FINISHED)
    assert len(rig.samples) == 1


@told(play)
async def test_lost_samples_are_assigned_to_their_causes(rig: DeviceRig) -> None:
    for i in range(20):
        feed(rig, hi91(10 * i))
    damaged = bytearray(hi91(200))
    damaged[50] ^= 1
    feed(rig, bytes(damaged))
    feed(rig, hi91(210))
    assert rig.ledger.lost_crc == 1
    rig.link.counters = KernelCounters(overrun=1)
    feed(rig, hi91(240))  # 220 and 230 are lost
    assert rig.ledger.lost_overrun == 2
    feed(rig, hi91(260))
    assert rig.ledger.lost_gap_device == 1
    rig.tick()
    assert EventKind.LOSS in rig.kinds
    assert EventKind.BAD_FRAME in rig.kinds


@told(play)
async def test_a_frame_behind_a_wrong_length_is_delivered_when_the_link_is_idle(rig: DeviceRig) -> None:
    feed(rig, b"\x5a\xa5\xff\x01" + hi91(10))
    rig.tick(ahead_ns=50 * MS)
    assert rig.samples == []  # the rest of the long frame can still arrive
    rig.tick(ahead_ns=51 * MS)
    assert len(rig.samples) == 1


@told(play, configured(baud="auto", driver="auto"))
async def test_detection_counts_each_byte_and_is_stored(rig: DeviceRig) -> None:
    noise = bytes(range(200, 250))
    feed(rig, noise)
    first = rig.link.baud
    await rig.turn(lambda: rig.link.bauds and rig.link.baud != first)
    right = rig.link.baud
    stream = hi91(10) + hi91(20) + hi91(30)
    feed(rig, stream[:100])
    feed(rig, stream[100:])
    await rig.turn(lambda: rig.ledger.frames_good)
    rig.tick()
    assert rig.is_in(DeviceState.RUNNING)
    assert (len(rig.samples), rig.ledger.bytes_in) == (3, len(noise) + len(stream))
    assert rig.ledger.bytes_skipped == len(noise)
    rig.link.disappear()
    await rig.turn(lambda: rig.state is DeviceState.MISSING)
    rig.link.appear()
    await rig.turn(lambda: rig.state is DeviceState.SEARCHING)
    rig.tick()  # during a search, earlier samples do not change the state to RUNNING
    assert (rig.state, rig.kinds) == (DeviceState.SEARCHING, [EventKind.UP, EventKind.DOWN])
    feed(rig, hi91(1000) + hi91(1010))
    await rig.turn(lambda: len(rig.samples) == 5)
    assert rig.link.baud == right


@told(play)
async def test_a_device_without_samples_reports_what_to_check(rig: DeviceRig) -> None:
    rig.tick()
    assert rig.problem == "no sample has arrived yet; wait for the search"
    rig.tick(ahead_ns=3000 * MS)
    assert rig.problem.startswith("no byte arrives on memory at 115200 baud")
    rig.link.feed(bytes(100), rig.now_ns() + 5500 * MS)
    rig.tick(ahead_ns=5600 * MS)
    assert rig.problem.startswith("bytes arrive on memory at 115200 baud, but no valid frame")
    rig.tick()
    feed(rig, hi91(10))
    rig.tick()
    assert rig.problem == ""


class DeafModule:
    """A module that ignores the first `deaf_to` requests for its version; in virtual time."""

    def __init__(self, deaf_to: int, deaf_to_settings: int = 0) -> None:
        self.clock = VirtualClock()
        self.rigs = DeviceRigs(self.clock.host)
        self.rig = self.rigs.add(configured(identify=True))
        self.asked_ns: list[int] = []  # times of the version requests
        self.paused = False  # whether the module sends no samples, but receives requests
        self._deaf_to, self._deaf_to_settings = deaf_to, deaf_to_settings
        self._ms = self._seen = 0

    def step(self) -> None:
        """Send a frame every 0.25 s, and the replies."""
        self._ms += 250
        if not self.paused:
            assert self.rig.link.feed(hi91(self._ms), self.clock.now_ns())
        for request in self.rig.link.written[self._seen :]:
            self._seen += 1
            if b"VERSION" in request:
                self.asked_ns.append(self.clock.now_ns())
            if len(self.asked_ns) > self._deaf_to + self._deaf_to_settings * (b"VERSION" not in request):
                report = b"%s=115200\r\nOK\r\n" % request.split()[-1]
                reply = VERSION % b"043995698D6E1708" if b"VERSION" in request else report
                assert self.rig.link.feed(reply, self.clock.now_ns())

    async def pass_s(self, duration_s: float) -> None:
        end_ns = self.clock.now_ns() + int(duration_s * 1e9)
        await self.rig.until(lambda: self.clock.now_ns() > end_ns, limit_s=duration_s + 1, step=self.step, step_s=0.25)

    @property
    def product(self) -> str | None:
        return self.rig.device.status().identity.get("product")

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run the device during the story."""

        async def told(_made: list[DeviceRig]) -> None:
            await self.rig.until(lambda: self.rig.link.listening)
            await story()

        play_rigs(self.rigs, told, self.clock)


@pytest.mark.parametrize("deaf_to", [3, 5, 9])
@played(DeafModule)
async def test_a_streaming_device_is_queried_until_it_replies(module: DeafModule, deaf_to: int) -> None:
    """Three queries, further queries after 5, 30 and 120 s, then a query per five minutes."""
    await module.rig.until(lambda: module.product, limit_s=2000, step=module.step, step_s=0.25)
    await module.pass_s(310)
    assert (len(module.asked_ns), module.product) == (deaf_to + 1, "HI14R3")


@played(lambda: DeafModule(1_000_000))
async def test_a_device_without_reply_gets_a_query_per_five_minutes(module: DeafModule) -> None:
    await module.pass_s(1500)
    pauses_s = [(after - before) / 1e9 for before, after in pairwise(module.asked_ns)]
    for pause_s, wanted_s in zip(pauses_s[2:5], (5, 30, 120), strict=True):
        assert wanted_s <= pause_s < wanted_s + 5  # a request waits for its reply before the pause
    assert len(pauses_s[5:]) == 4
    assert all(300 <= pause_s < 305 for pause_s in pauses_s[5:])
    assert module.product is None
    assert module.rig.is_in(DeviceState.RUNNING)  # samples arrive anyway
    assert len(module.rig.samples) > 5000


@played(lambda: DeafModule(5))
async def test_a_short_silence_does_not_stop_the_queries(module: DeafModule) -> None:
    """The request in the silence is lost too, and samples return in the meantime: no search, no further request."""
    await module.pass_s(12)
    assert len(module.asked_ns) == 4  # the next pause is 30 s
    module.paused = True
    await module.rig.until(lambda: len(module.asked_ns) == 5, step=module.step, step_s=0.25)
    assert module.rig.is_in(DeviceState.SILENT)
    module.paused = False
    module.step()  # within the timeout of this request
    await module.pass_s(2)
    assert module.rig.is_in(DeviceState.RUNNING)
    assert module.product is None
    await module.pass_s(200)
    assert module.product == "HI14R3"


@played(lambda: DeafModule(0, deaf_to_settings=4))
async def test_the_identity_is_known_if_the_reply_with_settings_is_lost(module: DeafModule) -> None:
    await module.pass_s(4)
    assert module.product == "HI14R3"
    assert not module.rig.device.status().settings
    await module.pass_s(60)
    assert module.rig.device.status().settings


def test_a_refused_wake_is_repeated_and_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    module, told = DeafModule(0), list[int]()
    module.paused = True

    def wake() -> RequestScript[bool]:
        told.append(module.clock.now_ns())
        yield Request(b"wake", "wake", never, never, never, silent=True)
        if len(told) < 3:
            raise Rejected("not now")
        return True

    monkeypatch.setattr(driver, "DRIVER", replace(driver.DRIVER, wake=wake))

    async def story() -> None:
        await module.pass_s(20)
        assert len(told) >= 5
        assert min(after - before for before, after in pairwise(told)) >= 2e9
        assert sum("started its output" in event.message for event in module.rig.events) == 1

    module.play(story)


@pytest.mark.parametrize("baud", [115200, "auto"])
def test_the_time_unplugged_is_not_silence(baud: Any) -> None:
    """A device that was unplugged for 6 s and boots for 3 s: one UP event, and no silence."""
    clock = VirtualClock()
    rigs = DeviceRigs(clock.host)
    rig = rigs.add(configured(baud=baud))
    ms = 0

    def send() -> None:
        nonlocal ms
        ms += 10
        assert rig.link.feed(hi91(ms), clock.now_ns())

    async def until_after(duration_ms: int, step: Callable[[], object] = lambda: None, step_s: float = 0.1) -> None:
        end_ns = clock.now_ns() + duration_ms * MS
        await rig.until(lambda: clock.now_ns() > end_ns, step=step, step_s=step_s)

    async def story(_made: list[DeviceRig]) -> None:
        await rig.until(lambda: rig.link.listening)
        for _ in range(2):
            await rig.until(lambda: rig.state is DeviceState.RUNNING, step=send, step_s=0.01)
            await until_after(300, send, 0.01)
            rig.link.disappear()
            await until_after(6000)
            assert "missing" in rig.problem
            rig.link.appear()
            await until_after(3000)
        kinds = [kind for kind in rig.kinds if kind in (EventKind.UP, EventKind.DOWN)]
        assert kinds == [EventKind.UP, EventKind.DOWN] * 2
        assert not [event for event in rig.events if "no sample for" in event.message]

    play_rigs(rigs, story, clock)


def test_a_missing_port_reports_what_to_check(caplog: pytest.LogCaptureFixture) -> None:
    clock = VirtualClock()
    rigs = DeviceRigs(clock.host)
    rig = rigs.add(configured())
    rig.link.disappear()

    async def story(_made: list[DeviceRig]) -> None:
        await rig.turn(lambda: rig.problem)
        assert (rig.state, rig.problem) == (DeviceState.MISSING, "memory does not exist: the test unplugged it")
        assert rig.kinds == []
        rig.link.appear()
        await rig.turn(lambda: rig.link.listening)
        assert not rig.is_in(DeviceState.MISSING)

    play_rigs(rigs, story, clock)
    assert caplog.text.count("does not exist") == 1


def test_a_port_of_another_configured_device_reports_its_name() -> None:
    class Busy(MemoryLink):
        def open(self) -> None:
            raise LinkBusy("memory is in use by this imud (pid 4711); stop it first")

    first = DeviceConfig(
        "mast", "auto", None, True, "uart", msgspec.convert({"port": "/dev/x"}, LINKS["uart"].settings)
    )
    clock = VirtualClock()
    rigs = DeviceRigs(clock.host, configured=[first, replace(first, name="bow")])
    rig = rigs.add(replace(first, name="bow"), Busy(MemoryOptions(baud=115200)))

    async def story(_made: list[DeviceRig]) -> None:
        await rig.turn(lambda: rig.state is DeviceState.FAILED)
        assert rig.problem == "memory is in use by mast, another device of this configuration"

    play_rigs(rigs, story, clock)


TAG_85, TAG_84, OTHER = (encode_frame(bytes([tag]) + bytes(size)) for tag, size in ((0x85, 55), (0x84, 103), (0x77, 9)))
RAW = imu61x_frame(DEVICE_SYNC, 0x0666, bytes(28))
HI_NEXT = "imud decodes HI91, HI92, HI81 and HI83: select one with `imud settings bow --set output.hi91=100`"
AHRS_NEXT = "imud decodes the AHRS frame (identifier 0x0002): select this output with the program of the vendor"


@pytest.mark.parametrize("baud", [115200, "auto"])
@pytest.mark.parametrize(
    ("driver", "frames", "types", "next_step"),
    [
        ("hipnuc-uart", TAG_85, "tag 0x85", HI_NEXT),
        (
            "hipnuc-uart",
            TAG_84 + sentence("GPRMC,123519,A") + TAG_85,
            "tag 0x84, NMEA sentence RMC, tag 0x85",
            HI_NEXT,
        ),
        ("hipnuc-uart", OTHER, "tag 0x77", HI_NEXT),
        ("imu61x-uart", RAW, frame_name(0x0666), AHRS_NEXT),
        ("imu61x-uart", imu61x_frame(DEVICE_SYNC, 0x0777, bytes(9)), "identifier 0x0777", AHRS_NEXT),
    ],
    ids=["one tag", "two tags and NMEA", "other tag", "raw data", "other identifier"],
)
def test_valid_frames_of_unknown_types_are_named(
    driver: str, frames: bytes, types: str, next_step: str, baud: Any
) -> None:
    """imud does not search for another rate, does not start the output, and accepts samples later."""

    async def story(rig: DeviceRig) -> None:
        def step() -> None:
            if rig.link.baud == 115200:
                replies = (
                    VERSION % b"1" + b"ATT_MODE: 0\r\nOK\r\n" if rig.link.written and driver == "hipnuc-uart" else b""
                )
                feed(rig, frames + replies)
                rig.link.written.clear()
            rig.tick()

        await rig.until(lambda: "unknown" in rig.problem, step=step, step_s=0.1)
        expected = f"on memory at 115200 baud: valid frames of unknown types ({types}), but no sample; {next_step}"
        assert rig.problem == expected
        for _ in range(200):
            step()
            await asyncio.sleep(0.1)
        assert (rig.problem, rig.link.baud) == (expected, 115200)
        if driver == "hipnuc-uart":
            feed(rig, hi91(10))
            rig.tick()
            assert rig.is_in(DeviceState.RUNNING)
            assert rig.problem == ""

    play(story, configured(driver=driver, baud=baud, identify=True))


def test_an_action_that_changes_the_rate_changes_port_and_stored_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    def at_921600(_target: object) -> RequestScript[None]:
        yield Request(b"?", "?", never, never, never, silent=True, baud=921600)

    monkeypatch.setattr(driver, "DRIVER", replace(driver.DRIVER, verbs={"rate": Verb("set it", at_921600)}))

    async def story(rigs: DeviceRigs, rig: DeviceRig) -> None:
        for ms in range(0, 400, 10):
            feed(rig, hi91(ms))
        rig.tick()
        await rig.device.act("rate", {})
        assert (rig.link.baud, rig.link.written[-1]) == (921600, b"?")
        assert rigs.factory.remembered.get("bow") == RememberedDevice("hipnuc-uart", 921600)
        feed(rig, hi91(400))
        assert len(rig.samples) == 41

    clock = VirtualClock()
    rigs = DeviceRigs(clock.host)
    rigs.add(configured(baud="auto"))

    async def told(made: list[DeviceRig]) -> None:
        await made[0].turn(lambda: made[0].link.listening)
        await story(rigs, made[0])

    play_rigs(rigs, told, clock)
