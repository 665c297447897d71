"""The life of a device on a CAN bus inside the process: streams, loses frames by cause, bus down and up."""

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from random import Random
from time import monotonic_ns
from typing import Any

import pytest

from imud.config import DeviceConfig
from imud.contracts.can import CanDriver
from imud.contracts.publisher import Batch
from imud.contracts.settings import Settings
from imud.contracts.status import DeviceState, KernelCounters
from imud.devices import DRIVERS
from imud.devices.hipnuc.canopen.codec import HipnucCanopenSettings
from imud.devices.hipnuc.j1939.codec import HipnucJ1939Settings
from imud.devices.imu61x.can.codec import Imu61xCanSettings, encode_set
from imud.event import Event, EventKind
from imud.formats.can import CanFrame
from imud.links.memory import MemoryCanLink, MemorySettings
from imud.runtime.can.runner import CanRunner
from imud.sample import Sample

MS = 1_000_000
LIMIT_S = 5.0


class Bench:
    """One runner on a bus of memory, and everything it tells."""

    def __init__(self, *, base_id: int = 101, bitrate: int = 0) -> None:
        settings = MemorySettings(baud=bitrate, name="can0")
        config = DeviceConfig("mast", "imu61x-can", Imu61xCanSettings(base_id=base_id), True, "memory", settings)
        self.samples: list[Sample] = []
        self.batches = 0
        self.events: list[Event] = []
        self.runner = CanRunner(config, 7, self._publish, self.events.append)
        assert isinstance(self.runner.link, MemoryCanLink)
        self.link = self.runner.link
        self.now_ns = monotonic_ns()

    def _publish(self, batch: Batch) -> None:
        assert (batch.device, batch.device_id) == ("mast", 7)
        self.batches += 1
        self.samples += batch.samples

    def frames(self, index: int, *, base_id: int = 101, lost: Sequence[int] = ()) -> list[CanFrame]:
        """A sample's frames, 1 ms apart."""
        self.now_ns = max(self.now_ns, monotonic_ns() - 10 * MS)
        made = []
        for place, (can_id, data) in enumerate(
            encode_set(
                index=index, accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0), euler_rad=(0, 0, 0), temperature_c=20,
                base_id=base_id,
            )
        ):  # fmt: skip
            self.now_ns += MS
            if place not in lost:
                made.append(CanFrame(can_id, False, data, self.now_ns))
        return made

    def feed(self, *indices: int) -> None:
        assert self.link.feed([frame for index in indices for frame in self.frames(index)])

    def tick(self, ahead_ns: int = 0) -> None:
        self.runner.tick(monotonic_ns() + ahead_ns)

    def state(self) -> DeviceState:
        """The state now; a call, so that the type checker does not take it for constant."""
        return self.runner.state

    async def until(self, condition: Callable[[], object]) -> None:
        end = asyncio.get_running_loop().time() + LIMIT_S
        while not condition():
            assert asyncio.get_running_loop().time() < end, "condition does not come true"
            await asyncio.sleep(0)


def play(bench: Bench, story: Callable[[Bench], Coroutine[Any, Any, None]]) -> None:
    """Run the runner while the story is told; at the end the ledger closes and the link is released."""

    async def both() -> None:
        task = asyncio.create_task(bench.runner.run())
        try:
            await bench.until(lambda: bench.link.listening)
            await story(bench)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            bench.runner.close()
        assert bench.runner.ledger.closes()
        assert bench.runner.ledger.frames_pending == 0
        assert not bench.link.is_open

    asyncio.run(both())


def test_samples_of_one_read_are_one_batch_with_their_own_times() -> None:
    bench = Bench(bitrate=500_000)

    async def story(bench: Bench) -> None:
        bench.feed(1, 2, 3)
        bench.tick()
        assert bench.state() is DeviceState.RUNNING

    play(bench, story)
    assert bench.batches == 1
    assert [s.seq for s in bench.samples] == [1, 2, 3]
    # measured before its first frame was complete (111 bits at 500 kbit/s), known when the fifth was
    assert all(4 * MS + 222_000 <= s.t_rx_ns - s.t_ns < 4 * MS + 500_000 for s in bench.samples)
    assert [b.t_rx_ns - a.t_rx_ns for a, b in zip(bench.samples, bench.samples[1:], strict=False)] == [5 * MS] * 2
    assert bench.runner.status().link == "can0 at 500 kbit/s"
    assert bench.events[0].kind is EventKind.UP
    assert bench.link.written == []


def delay_ns(name: str, settings: Settings, bitrate: int) -> int:
    """From the time of a sample to its arrival; four frames, 0.3 ms apart, every 10 ms."""
    bench = Bench()
    config = DeviceConfig("mast", name, settings, True, "memory", MemorySettings(baud=bitrate, name="can0"))
    bench.runner = CanRunner(config, 7, bench._publish, bench.events.append)
    assert isinstance(bench.runner.link, MemoryCanLink)
    bench.link = bench.runner.link
    driver = DRIVERS[name]
    assert isinstance(driver, CanDriver)
    burst = driver.example_frames(Random(1))

    async def story(bench: Bench) -> None:
        begin_ns = monotonic_ns() - 300 * MS
        for number in range(20):
            t_ns = begin_ns + number * 10 * MS
            assert bench.link.feed([f._replace(t_rx_ns=t_ns + place * 300_000) for place, f in enumerate(burst)])

    play(bench, story)
    assert len(bench.samples) > 10
    return bench.samples[-1].t_rx_ns - bench.samples[-1].t_ns


@pytest.mark.parametrize(
    ("name", "settings", "bits"),
    [("hipnuc-canopen", HipnucCanopenSettings(), 95), ("hipnuc-j1939", HipnucJ1939Settings(), 131)],
)
def test_the_length_of_the_first_frame_is_taken_off(name: str, settings: Settings, bits: int) -> None:
    """TPDO1 has six bytes; a 29-bit identifier makes a frame 20 bits longer."""
    taken_ns = delay_ns(name, settings, 500_000) - delay_ns(name, settings, 0)
    assert taken_ns == pytest.approx(bits * 2000, abs=2000)


def test_only_own_identifiers_pass() -> None:
    bench = Bench(base_id=300)

    async def story(bench: Bench) -> None:
        bench.link.feed(bench.frames(1) + bench.frames(1, base_id=300))

    play(bench, story)
    assert len(bench.samples) == 1
    assert bench.runner.ledger.bytes_in == 40


def test_losses_by_cause() -> None:
    bench = Bench()

    async def story(bench: Bench) -> None:
        bench.feed(1, 2)
        bench.link.feed(bench.frames(3, lost=[2]))  # nobody says why
        bench.feed(4)
        bench.link.counters = KernelCounters(overrun=7)
        after = bench.frames(6)
        bench.link.feed([after[0]._replace(after_loss=True), *after[1:]])  # 5 is the kernel's
        damaged = bench.frames(7)
        bench.link.feed([*damaged[:4], damaged[4]._replace(data=b"\0" * 7)])
        bench.feed(8)
        bench.tick()

    play(bench, story)
    ledger = bench.runner.ledger
    assert (ledger.lost_gap_device, ledger.lost_overrun, ledger.lost_crc) == (1, 1, 1)
    assert (ledger.frames_bad_length, ledger.frames_ignored) == (1, 4 + 4)
    assert ledger.samples == 5
    assert EventKind.LOSS in [event.kind for event in bench.events]


def test_frames_from_before_a_loss_are_not_mixed_with_those_after() -> None:
    bench = Bench()

    async def story(bench: Bench) -> None:
        first, second = bench.frames(1), bench.frames(2)
        second[2] = second[2]._replace(after_loss=True)
        bench.link.feed(first[:2] + second[2:])

    play(bench, story)
    assert bench.samples == []


def test_bus_down_and_up() -> None:
    bench = Bench()

    async def story(bench: Bench) -> None:
        bench.feed(1, 2)
        bench.link.feed(bench.frames(3)[:3])
        bench.tick()
        bench.link.disappear()
        await bench.until(lambda: bench.state() is DeviceState.MISSING)
        await bench.until(lambda: "is down" in bench.runner.status().problem)
        assert bench.runner.ledger.frames_pending == 0
        bench.link.appear()
        await bench.until(lambda: bench.link.listening)
        bench.feed(10)
        bench.tick()
        assert bench.state() is DeviceState.RUNNING

    play(bench, story)
    assert [event.kind for event in bench.events] == [EventKind.UP, EventKind.DOWN, EventKind.UP]
    assert bench.runner.ledger.lost() == 0
    assert bench.runner.status().connects == 2


def test_trouble_of_the_bus_is_shown_while_it_lasts() -> None:
    bench = Bench()

    async def story(bench: Bench) -> None:
        bench.link.news("can0 is error-passive: x", "can0 is error-passive: x")
        bench.feed(1)
        bench.tick()
        assert bench.state() is DeviceState.RUNNING
        assert bench.runner.status().problem == "can0 is error-passive: x"
        bench.link.news("can0 is bus-off: y", "can0 is bus-off: y")
        bench.tick(ahead_ns=3000 * MS)
        assert bench.state() is DeviceState.SILENT
        assert bench.runner.status().problem == "can0 is bus-off: y"
        bench.link.news("can0 is error-active again", "")
        assert bench.runner.status().problem == ""

    play(bench, story)
    assert [e.message for e in bench.events if e.kind is EventKind.LINK][-1] == "can0 is error-active again"


@pytest.mark.parametrize(("lost", "words"), [([], "nothing of imu61x-can is heard"), ([4], "no whole sample")])
def test_silence_says_what_is_heard(lost: list[int], words: str) -> None:
    bench = Bench()

    async def story(bench: Bench) -> None:
        if lost:
            bench.link.feed(bench.frames(1, lost=lost))
        bench.tick(ahead_ns=3000 * MS)
        assert words in bench.runner.status().problem

    play(bench, story)
