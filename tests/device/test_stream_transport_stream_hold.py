"""Held samples of a stream: times of reads, size of batches, and cases without a hold.

The module sends a frame every ms. imud uses its fit after 100 ms. All tests use virtual time.
"""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.script import Request, RequestScript, never
from imud.contracts.status import DeviceState
from imud.device.latency import Need
from imud.links.memory import MemoryLink, MemoryOptions
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_US
from tests.support.device_rig import DeviceRigs
from tests.support.event_loops import VirtualClock, run_virtually
from tests.support.files import hi91
from tests.support.script_runners import of_text
from tests.support.stories import played

MOST_NS = 50 * 10**6

WIRE_NS = 890 * NS_PER_US  # duration of a frame, ns: 82 bytes at 921600 baud
FIT_MS = 400  # time after which imud uses the fit and the maximum hold, ns


class Takes(MemoryLink):
    """A link that notes time and size of each read after a hold."""

    def __init__(self, settings: MemoryOptions, clock: VirtualClock) -> None:
        super().__init__(settings)
        self.taken: list[tuple[int, int]] = []
        self.resumed: list[int] = []  # times of `resume`
        self._clock = clock

    def take(self) -> bytes:
        data = super().take()
        self.taken.append((self._clock.now_ns(), len(data)))
        return data

    def resume(self) -> None:
        super().resume()
        self.resumed.append(self._clock.now_ns())


class HoldBench:
    """A module at 1 kHz and its device."""

    def __init__(
        self, latency_ms: float, *, period_ms: int = 1, waiting_bytes: int = 2048, hold_ns: int = 0, anew: bool = False
    ) -> None:
        """`anew`: the story restarts the device time, or leaves out samples."""
        self.clock = VirtualClock()
        settings = MemoryOptions(baud=921_600, waiting_bytes=waiting_bytes, hold_ns=hold_ns)
        self.link = Takes(settings, self.clock)
        rigs = self.rigs = DeviceRigs(self.clock.host)
        self.rig = rigs.add(DeviceConfig("bow", "hipnuc-uart", None, False, "memory", settings), self.link)
        self.device = self.rig.device
        self.latency_ms = latency_ms
        self.anew = anew
        self.sent = 0
        self._period_ms = period_ms

    def frame(self, number: int) -> bytes:
        return hi91(1000 + number * self._period_ms)

    async def send(self, count: int, make: Callable[[int], bytes] | None = None) -> None:
        """Send frames, and tick the device as the daemon does."""
        for _ in range(count):
            self.sent += 1
            await asyncio.sleep(self._period_ms / 1000)
            self.link.feed((make or self.frame)(self.sent), self.clock.now_ns())
            if self.sent % 100 == 0:
                self.rig.tick()

    def want(self, latency_ms: float, who: str = "client 1") -> None:
        self.device.set_need(Need(round(latency_ms * NS_PER_MS), who))

    def sizes(self, since: int) -> list[int]:
        """Return the samples of each batch from a sequence number."""
        return [len(samples) for _, samples in self.rig.published[since:]]

    def waits_ns(self, since: int) -> list[int]:
        """Return the hold of each batch from a sequence number: arrival of its oldest sample to publication."""
        return [at_ns - samples[0].t_rx_ns for at_ns, samples in self.rig.published[since:]]

    def play(self, story: Callable[[], Awaitable[None]]) -> None:
        """Run the device until imud uses the fit, then the story. At the end no sample is lost."""

        async def whole() -> None:
            async with self.rigs.at_work():
                await asyncio.sleep(0.01)
                self.want(self.latency_ms)
                await self.send(FIT_MS)
                await story()

        run_virtually(self.clock, whole())
        samples = self.rig.samples
        assert [s.seq for s in samples] == list(range(1, self.sent + 1))
        assert self.anew or [s.t_dev_ns for s in samples] == [
            (1000 + number * self._period_ms) * NS_PER_MS for number in range(1, self.sent + 1)
        ]
        assert not self.link.paused


@pytest.mark.parametrize(("latency_ms", "rounds"), [(5, 10), (10, 5), (20, 2), (30, 1), (50, 1)])
@played(lambda latency_ms: HoldBench(latency_ms, waiting_bytes=1 << 16))
async def test_one_frame_per_50_ms_is_read_on_arrival(bench: HoldBench, latency_ms: int, rounds: int) -> None:
    await bench.send(200)
    resumed, taken = len(bench.link.resumed), len(bench.link.taken)
    await bench.send(rounds * latency_ms * 10 + 10)
    assert len(bench.link.resumed) - resumed == pytest.approx(10, abs=1)
    assert len(bench.link.taken) - taken == pytest.approx(10 * rounds, abs=rounds)
    assert max(bench.waits_ns(-20)) <= latency_ms * NS_PER_MS


@pytest.mark.parametrize(("period_ms", "needed"), [(1, False), (100, True)])
@played(lambda period_ms: HoldBench(10, period_ms=period_ms))
async def test_a_device_needs_ten_ticks_per_second_if_it_is_slow_or_busy(
    bench: HoldBench, period_ms: int, needed: bool
) -> None:
    device, asked = bench.device, list[int]()
    bench.rig.tick()
    device._shared.owner.tick_soon = lambda: asked.append(1)  # type: ignore[method-assign]
    bench.rig.tick()  # in the same second
    assert device._transport.path is not None
    device._transport.path.last_sample_ns -= 501 * NS_PER_MS
    bench.rig.tick()  # it can become silent before the next tick of quiet devices
    async with device.settings.lock.hold("the command save"):
        bench.rig.tick()
    device._health.state = DeviceState.SILENT
    bench.rig.tick()
    assert len(asked) == 3 + needed, period_ms


@played(lambda: HoldBench(10, hold_ns=NS_PER_MS))
async def test_behind_a_latency_timer_one_frame_per_hold_is_read_on_arrival(bench: HoldBench) -> None:
    await bench.send(200)
    resumed, taken = len(bench.link.resumed), len(bench.link.taken)
    await bench.send(210)
    assert len(bench.link.resumed) - resumed == len(bench.link.taken) - taken == pytest.approx(20, abs=1)


@pytest.mark.parametrize("before", [80, 90, 100, 110, 120])
@played(lambda: HoldBench(10))
async def test_a_request_withdrawn_during_publishing_ends_the_hold(bench: HoldBench, before: int) -> None:
    class Leaving(list[tuple[int, list[Sample]]]):
        """The client with the latency request disconnects when it receives samples."""

        def append(self, item: tuple[int, list[Sample]]) -> None:
            super().append(item)
            bench.want(0, "client 2")

    await bench.send(before)
    bench.rig.published = Leaving(bench.rig.published)
    await bench.send(20)
    assert not bench.link.paused
    assert (bench.sizes(-5), bench.device.status().hold_ns) == ([1] * 5, 0)


@played(lambda: HoldBench(10))
async def test_the_samples_of_a_hold_are_published_together(bench: HoldBench) -> None:
    since, taken = len(bench.rig.published), len(bench.link.taken)
    await bench.send(220)
    sizes = bench.sizes(since)
    assert set(sizes[:-1]) <= {10, 11}
    assert max(bench.waits_ns(since)) <= 10 * NS_PER_MS
    assert (len(bench.link.taken) - taken, bench.device.status().hold_ns) == (len(sizes), 10 * NS_PER_MS)
    assert bench.device.status().hold_by == "client 1"


@pytest.mark.parametrize("latency_ms", [5, 10, 20])
def test_a_hold_does_not_change_the_time_stamps(latency_ms: float) -> None:
    def stamps(latency_ms: float) -> list[Sample]:
        bench = HoldBench(latency_ms)
        bench.play(lambda: bench.send(1000))
        assert (len(bench.rig.published) < 1000) is (latency_ms > 0)
        return bench.rig.samples

    held, plain = stamps(latency_ms), stamps(0)
    for a, b in zip(held, plain, strict=True):
        assert abs(a.t_ns - b.t_ns) < 20 * NS_PER_US, a
        assert a.t_err_ns <= b.t_err_ns + 20 * NS_PER_US
        assert a.sync is b.sync
        assert a.t_rx_ns >= b.t_rx_ns
    assert held[-1].sync is Sync.REGRESSION


@played(lambda: HoldBench(10, anew=True))
async def test_no_hold_before_the_fit_and_after_a_restart(bench: HoldBench) -> None:
    assert [len(samples) for _, samples in bench.rig.published[:100]] == [1] * 100
    assert bench.rig.samples[99].sync is Sync.ARRIVAL
    since, begun = len(bench.rig.samples), bench.sent
    await bench.send(1000, lambda number: bench.frame(number - begun))  # the device time restarts
    anew = [s for s in bench.rig.samples[since:] if s.sync is Sync.ARRIVAL]
    assert len(anew) > 50
    late = [s.t_rx_ns - s.t_ns - 2 * s.t_err_ns for s in anew]
    assert max(late) < WIRE_NS + 10 * NS_PER_MS
    assert sum(len(samples) == 1 for _, samples in bench.rig.published[-900:]) > 50
    assert [s.seq for s in bench.rig.samples[since:]] == list(range(since + 1, len(bench.rig.samples) + 1))


@played(lambda: HoldBench(10, period_ms=6))
async def test_no_hold_with_fewer_than_two_samples(bench: HoldBench) -> None:
    since = len(bench.rig.published)
    await bench.send(50)
    assert (bench.sizes(since), bench.waits_ns(since)) == ([1] * 50, [0] * 50)
    assert (bench.device.status().hold_ns, bench.device.status().hold_wanted_ns) == (0, 10 * NS_PER_MS)


@played(lambda: HoldBench(20))
async def test_a_latency_of_0_releases_held_samples(bench: HoldBench) -> None:
    await bench.send(5)
    count = len(bench.rig.samples)
    assert bench.link.paused
    assert count < bench.sent
    bench.want(0)
    assert len(bench.rig.samples) == bench.sent
    since = len(bench.rig.published)
    await bench.send(10)
    assert (bench.sizes(since), bench.waits_ns(since)) == ([1] * 10, [0] * 10)
    assert bench.device.status().hold_ns == 0
    bench.want(20)
    since = len(bench.rig.published)
    await bench.send(100)
    assert min(bench.sizes(since)[2:]) >= 19


@played(lambda: HoldBench(50, waiting_bytes=820))
async def test_a_hold_does_not_exceed_the_buffer(bench: HoldBench) -> None:
    since = len(bench.link.taken)
    await bench.send(300)
    assert max(size for _, size in bench.link.taken[since:]) <= 820 + 82
    assert bench.device.status().hold_ns <= 11 * NS_PER_MS
    begun = bench.sent
    await bench.send(300, lambda number: bench.frame(number) + bytes(200))  # the data rate is much higher now
    assert max(size for _, size in bench.link.taken[-10:]) <= 820 + 282
    assert begun + 300 == bench.sent


@played(lambda: HoldBench(50, waiting_bytes=0))
async def test_a_link_without_pause_has_no_hold(bench: HoldBench) -> None:
    await bench.send(100)
    assert (bench.link.taken, len(bench.rig.published)) == ([], bench.sent)


@played(lambda: HoldBench(20, anew=True))
async def test_the_first_sample_after_a_silence_has_the_normal_hold(bench: HoldBench) -> None:
    await bench.send(30)
    await asyncio.sleep(0.5)
    bench.rig.tick()
    assert len(bench.rig.samples) == bench.sent
    assert not bench.link.paused
    since, before_ns = len(bench.rig.published), bench.clock.now_ns()
    bench.link.feed(hi91(1501 + bench.sent), before_ns)
    await asyncio.sleep(0.1)
    ((at_ns, (only,)),) = bench.rig.published[since:]
    assert 19 * NS_PER_MS < at_ns - before_ns <= 20 * NS_PER_MS
    assert only.t_rx_ns == before_ns
    bench.sent += 1


@played(lambda: HoldBench(MOST_NS / NS_PER_MS))
async def test_a_held_incomplete_frame_is_not_discarded(bench: HoldBench) -> None:
    """At the tick the last read is long ago, but the rest of the frame is in the kernel."""
    for _ in range(40):
        bench.sent += 2
        first, second = bench.frame(bench.sent - 1), bench.frame(bench.sent)
        await asyncio.sleep(0.001)
        bench.link.feed(first + second[:40], bench.clock.now_ns())
        await asyncio.sleep(0.001)
        bench.link.feed(second[40:], bench.clock.now_ns())
        bench.rig.tick()
    await asyncio.sleep(0.1)
    for _ in range(5):  # only a part of a frame arrives
        bench.sent += 1
        frame = bench.frame(bench.sent)
        bench.link.feed(frame[:40], bench.clock.now_ns())
        assert not bench.link.paused
        bench.link.feed(frame[40:], bench.clock.now_ns())
        await asyncio.sleep(0.1)
    assert bench.rig.ledger.bytes_skipped == bench.rig.ledger.frames_bad_crc == 0


@played(lambda: HoldBench(50))
async def test_a_hold_does_not_delay_a_reply(bench: HoldBench) -> None:
    """imud processes held samples at the start of a script, receives the reply without a hold, then holds again."""

    def asking() -> RequestScript[int]:
        asked = Request(b"WHO\r\n", "who", of_text("OK".__eq__), never, never, 1_000 * NS_PER_MS)
        yield asked
        return bench.clock.now_ns()

    await bench.send(10)
    assert bench.link.paused
    running = asyncio.create_task(bench.device._transport.run_script(lambda _target: asking()))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert (len(bench.rig.samples), bench.link.written) == (bench.sent, [b"WHO\r\n"])
    await bench.send(5)
    assert len(bench.rig.samples) == bench.sent
    bench.link.feed(b"OK\r\n", bench.clock.now_ns())
    answered_ns = bench.clock.now_ns()
    assert await running == answered_ns
    since = len(bench.rig.published)
    await bench.send(120)
    assert max(bench.sizes(since)) >= 20


@pytest.mark.parametrize("how", ["closed", "unplugged"])
@played(lambda: HoldBench(50))
async def test_held_samples_are_published_at_the_end(bench: HoldBench, how: str) -> None:
    await asyncio.sleep(0.1)
    assert not bench.link.paused
    await bench.send(1)
    assert bench.link.paused
    if how == "unplugged":
        bench.link.disappear()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    else:
        await bench.send(7)  # these samples are in the kernel
