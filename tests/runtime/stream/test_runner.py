"""The life of a device on a link inside the process: found, asked, lost, back, silent, never crashing."""

import asyncio
from collections.abc import Callable, Coroutine
from functools import partial
from time import monotonic_ns
from typing import Any

import pytest

from imud.config import DeviceConfig
from imud.contracts.publisher import Batch
from imud.contracts.session import Request, RequestScript, never
from imud.contracts.status import DeviceState, KernelCounters
from imud.errors import LinkBusy, LinkError
from imud.event import Event, EventKind
from imud.links.memory import MemoryLink, MemorySettings
from imud.runtime import device as device_module
from imud.runtime.detection.remembered import Remembered
from imud.runtime.stream.runner import DeviceRunner
from imud.sample import Sample
from tests.support.hi91 import hi91

MS = 1_000_000
LIMIT_S = 5.0
VERSION = b"PNAME=HI14R3\r\nBUILD=Oct 15 2024\r\nUUID=%s\r\nAPP_VER=156\r\nBL_VER=109\r\nOK\r\n"


class Bench:
    """One runner on a memory link, and everything it tells."""

    def __init__(self, *, identify: bool = False, baud: Any = 115200, driver: str = "hipnuc-uart", **link: Any) -> None:
        settings = MemorySettings(baud=baud, **link)
        config = DeviceConfig("bow", driver, None, identify, "memory", settings)
        self.samples: list[Sample] = []
        self.events: list[Event] = []
        self.runner = DeviceRunner(config, 7, self._publish, self.events.append, Remembered(None))
        assert isinstance(self.runner.link, MemoryLink)
        self.link: MemoryLink = self.runner.link
        self.now_ns = monotonic_ns()

    def _publish(self, batch: Batch) -> None:
        assert (batch.device, batch.device_id) == ("bow", 7)
        self.samples += batch.samples

    def feed(self, data: bytes) -> None:
        self.now_ns = max(self.now_ns + 1, monotonic_ns())
        assert self.link.feed(data, self.now_ns)

    def tick(self, ahead_ns: int = 0) -> None:
        self.runner.tick(monotonic_ns() + ahead_ns)

    async def until(self, condition: Callable[[], object]) -> None:
        """Let the loop turn until the condition holds."""
        end = asyncio.get_running_loop().time() + LIMIT_S
        while not condition():
            assert asyncio.get_running_loop().time() < end, "condition does not come true"
            await asyncio.sleep(0)

    def state(self) -> DeviceState:
        """The state now; a call, so that the type checker does not take it for constant."""
        return self.runner.state

    def kinds(self) -> list[EventKind]:
        return [event.kind for event in self.events]


def play(bench: Bench, story: Callable[[Bench], Coroutine[Any, Any, None]]) -> None:
    """Run the runner while the story is told; at the end the ledger closes and the link is released."""

    async def both() -> None:
        task = asyncio.create_task(bench.runner.run())
        try:
            await bench.until(lambda: bench.runner.state is not DeviceState.MISSING)
            await story(bench)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            bench.runner.close()
        assert bench.runner.ledger.closes()
        assert not bench.link.is_open

    asyncio.run(both())


@pytest.fixture(autouse=True)
def _no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device_module, "RETRY_S", 0.0)


def test_samples_flow_and_the_device_is_up() -> None:
    async def story(bench: Bench) -> None:
        assert bench.state() is DeviceState.SEARCHING
        for i in range(5):
            bench.feed(hi91(1000 + 10 * i))
        bench.tick()
        assert bench.state() is DeviceState.RUNNING
        assert [s.seq for s in bench.samples] == [1, 2, 3, 4, 5]
        assert [s.t_dev_ns for s in bench.samples] == [(1000 + 10 * i) * MS for i in range(5)]
        assert bench.kinds() == [EventKind.UP]
        status = bench.runner.status()
        assert (status.newest_seq, status.driver, status.connects) == (5, "hipnuc-uart", 1)
        assert sum(status.latency_buckets) == 5
        assert status.temperature_c == 20.0

    play(Bench(), story)


def test_unplugged_and_back_the_count_goes_on_and_time_rises() -> None:
    async def story(bench: Bench) -> None:
        for i in range(5):
            bench.feed(hi91(5000 + 10 * i))
        bench.feed(hi91(5050)[:40])  # the cable goes in the middle of a frame
        bench.tick()
        bench.link.disappear()
        await bench.until(lambda: bench.runner.state is DeviceState.MISSING)
        assert bench.runner.ledger.bytes_pending == 0
        assert bench.runner.ledger.bytes_skipped == 40
        assert "gone" in bench.runner.status().problem
        bench.link.appear()
        await bench.until(lambda: bench.runner.state is not DeviceState.MISSING)
        for i in range(3):
            bench.feed(hi91(10 * i))  # the device was without power: its clock starts again
        bench.tick()
        assert bench.state() is DeviceState.RUNNING
        assert [s.seq for s in bench.samples] == list(range(1, 9))
        times = [s.t_ns for s in bench.samples]
        assert times == sorted(set(times))
        assert bench.kinds() == [EventKind.UP, EventKind.DOWN, EventKind.UP]
        assert bench.runner.status().connects == 2
        assert bench.runner.ledger.lost() == 0

    play(Bench(), story)


def test_identity_is_asked_and_a_changed_setting_is_told_after_a_replug() -> None:
    async def answer(bench: Bench, mode: bytes, uuid: bytes = b"043995698D6E1708") -> None:
        done = 0
        while done < 4:
            await bench.until(partial(lambda seen: len(bench.link.written) > seen, done))
            request = bench.link.written[done]
            done += 1
            if b"VERSION" in request:
                bench.feed(VERSION % uuid)
            elif b"USRCONFIG" in request:
                bench.feed(b"ATT_MODE: " + mode + b"\r\nOK\r\n")
            elif b"MAGCONFIG" in request:
                bench.feed(b"MB=14.14, -2.08, -8.75\r\nOK\r\n")
            else:
                bench.feed(b"COM1=115200\r\nOK\r\n")
        bench.link.written.clear()

    async def story(bench: Bench) -> None:
        await answer(bench, b"0")
        await bench.until(lambda: bench.runner.status().settings)
        assert bench.runner.status().identity["product"] == "HI14R3"
        assert bench.runner.status().identity["serial_number"] == "043995698D6E1708"
        bench.link.disappear()
        await bench.until(lambda: bench.runner.state is DeviceState.MISSING)
        bench.link.appear()
        await answer(bench, b"1", b"0000000000000001")
        await bench.until(lambda: EventKind.CONFIGURATION in bench.kinds())
        await bench.until(lambda: len(bench.events) >= 2)
        messages = [event.message for event in bench.events]
        assert any("another device: serial number 0000000000000001" in message for message in messages)
        assert any("is 1, was 0" in message for message in messages)

    play(Bench(identify=True), story)


def test_device_that_does_not_answer_streams_all_the_same(caplog: pytest.LogCaptureFixture) -> None:
    async def story(bench: Bench) -> None:
        await bench.until(lambda: bench.link.written)
        bench.feed(hi91(10) + hi91(20))
        bench.tick()
        assert bench.state() is DeviceState.RUNNING
        assert len(bench.samples) == 2

    play(Bench(identify=True), story)


def test_device_that_falls_silent_is_told_once_and_comes_up_again() -> None:
    async def story(bench: Bench) -> None:
        for i in range(3):
            bench.feed(hi91(10 * i))
        bench.tick()
        bench.tick(ahead_ns=1500 * MS)
        bench.tick(ahead_ns=1600 * MS)
        assert bench.state() is DeviceState.SILENT
        assert bench.kinds() == [EventKind.UP, EventKind.DOWN]
        bench.feed(hi91(1_500))
        bench.tick()
        assert bench.state() is DeviceState.RUNNING
        assert bench.kinds() == [EventKind.UP, EventKind.DOWN, EventKind.UP]

    play(Bench(), story)


def test_port_that_is_busy_is_tried_again_and_says_why() -> None:
    class Busy(MemoryLink):
        def open(self) -> None:
            if len(self.bauds) < 3:
                self.bauds.append(0)
                raise LinkBusy("memory is in use by minicom (pid 4711)")
            super().open()

    bench = Bench()
    bench.runner.link = bench.link = Busy(MemorySettings(baud=115200))

    async def story(bench: Bench) -> None:
        await bench.until(lambda: bench.runner.state is DeviceState.FAILED)
        assert bench.runner.status().problem == "memory is in use by minicom (pid 4711)"
        await bench.until(lambda: bench.link.listening)
        bench.feed(hi91(10))
        bench.tick()
        assert bench.state() is DeviceState.RUNNING

    play(bench, story)


def test_end_of_a_replay_finishes_the_runner() -> None:
    async def story() -> None:
        bench = Bench(writable=False)
        task = asyncio.create_task(bench.runner.run())
        await bench.until(lambda: bench.link.listening)
        bench.feed(hi91(10))
        bench.link.end(None)
        await asyncio.wait_for(task, LIMIT_S)
        assert bench.state() is DeviceState.FINISHED
        assert len(bench.samples) == 1

    asyncio.run(story())


def test_missing_samples_are_put_to_their_cause() -> None:
    async def story(bench: Bench) -> None:
        for i in range(20):
            bench.feed(hi91(10 * i))
        damaged = bytearray(hi91(200))
        damaged[50] ^= 1
        bench.feed(bytes(damaged))
        bench.feed(hi91(210))
        assert bench.runner.ledger.lost_crc == 1
        bench.link.counters = KernelCounters(overrun=1)
        bench.feed(hi91(240))  # 220 and 230 are missing
        assert bench.runner.ledger.lost_overrun == 2
        bench.feed(hi91(260))
        assert bench.runner.ledger.lost_gap_device == 1
        bench.tick()
        assert EventKind.LOSS in bench.kinds()
        assert EventKind.BAD_FRAME in bench.kinds()

    play(Bench(), story)


def test_frame_held_by_a_lying_length_is_delivered_when_the_line_is_idle() -> None:
    async def story(bench: Bench) -> None:
        bench.feed(b"\x5a\xa5\xff\x01" + hi91(10))
        assert bench.samples == []
        bench.tick(ahead_ns=100 * MS)
        assert len(bench.samples) == 1

    play(Bench(), story)


def test_detection_locks_counts_every_byte_and_is_remembered() -> None:
    async def story(bench: Bench) -> None:
        noise = bytes(range(200, 250))
        bench.feed(noise)
        first = bench.link.baud
        await bench.until(lambda: bench.link.bauds and bench.link.baud != first)
        right = bench.link.baud
        stream = hi91(10) + hi91(20) + hi91(30)
        bench.feed(stream[:100])
        bench.feed(stream[100:])
        await bench.until(lambda: bench.runner.ledger.frames_good)
        bench.tick()
        assert bench.state() is DeviceState.RUNNING
        assert len(bench.samples) == 3
        assert bench.runner.ledger.bytes_in == len(noise) + len(stream)
        assert bench.runner.ledger.bytes_skipped == len(noise)
        bench.link.disappear()
        await bench.until(lambda: bench.runner.state is DeviceState.MISSING)
        bench.link.appear()
        await bench.until(lambda: bench.runner.state is not DeviceState.MISSING)
        bench.feed(hi91(1000) + hi91(1010))
        await bench.until(lambda: len(bench.samples) == 5)
        assert bench.link.baud == right

    play(Bench(baud="auto", driver="auto"), story)


def test_nothing_heard_says_what_to_look_at() -> None:
    async def story(bench: Bench) -> None:
        bench.tick(ahead_ns=3000 * MS)
        assert bench.runner.status().problem.startswith("nothing is heard on memory at 115200 baud")
        bench.runner.tick(monotonic_ns())

    play(Bench(), story)


def test_a_device_that_has_just_been_opened_is_given_time() -> None:
    async def story(bench: Bench) -> None:
        bench.tick()
        assert bench.runner.status().problem == ""

    play(Bench(), story)


def test_bytes_without_frames_say_so() -> None:
    async def story(bench: Bench) -> None:
        bench.now_ns = monotonic_ns() + 2500 * MS
        bench.feed(b"\x00" * 100)
        bench.runner.tick(bench.now_ns + 100 * MS)
        assert bench.runner.status().problem.startswith("bytes come on memory at 115200 baud, but no valid frame")

    play(Bench(), story)


def test_error_of_the_link_is_a_failed_device_and_tried_again() -> None:
    async def story(bench: Bench) -> None:
        bench.link.end(LinkError("input/output error: the adapter stopped answering"))
        await bench.until(lambda: bench.runner.status().connects == 2)
        bench.feed(hi91(10))
        bench.tick()
        assert bench.state() is DeviceState.RUNNING

    play(Bench(), story)


def test_a_conversation_that_changes_the_rate_takes_port_and_memory_along() -> None:
    async def story(bench: Bench) -> None:
        device = bench.runner
        for ms in range(0, 400, 10):
            bench.feed(hi91(ms))
        await bench.until(lambda: device._finder is None)
        await device._exchange.run(at_921600())
        assert bench.link.baud == 921600
        assert bench.link.written[-1] == b"?"
        last = device._remembered.get("bow")
        assert last is not None
        assert (last.driver, last.baud) == ("hipnuc-uart", 921600)
        bench.feed(hi91(400))
        assert len(bench.samples) == 41

    play(Bench(baud="auto"), story)


def at_921600() -> RequestScript[None]:
    yield Request(b"?", "?", never, never, never, silent=True, baud=921600)
