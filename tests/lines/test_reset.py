"""Reset line: duration and interval of the pulses, the level after a cancellation, and automatic resets."""

import asyncio
from collections.abc import Callable, Coroutine
from itertools import pairwise
from typing import Any

import pytest

from imud.contracts.lines import DeviceLines, ResetOptions
from imud.lines.reset import ResetLine, make_reset, reset
from imud.model.errors import CommandError, LinkBusy, LinkMissing
from imud.model.units import NS_PER_S
from imud.sim.ports.pins import MemoryOutput
from tests.support.event_loops import in_loop, run_virtually
from tests.support.signal_bench import DEVICE, SignalBench
from tests.support.stories import played

AGAIN_NS = 60 * 10**9
RETRY_NS = 5 * 10**9

SETTINGS = ResetOptions(line="RESET", hold_ms=20)


@in_loop
@pytest.mark.manual("A 2.2 reset")
async def test_a_pulse_waits_for_the_start_of_the_device_and_may_be_cancelled() -> None:
    story: list[object] = []
    line = MemoryOutput(on_change=lambda _t_ns, active: story.append(active))
    line.open()

    async def sleep(seconds: float) -> None:
        story.append(seconds)

    await reset(line, SETTINGS, sleep)
    assert story == [True, 0.02, False, 3.0]
    line = MemoryOutput()
    line.open()
    line.set_error = LinkMissing("gone")
    with pytest.raises(LinkMissing):
        await reset(line, SETTINGS)

    line = MemoryOutput()
    line.open()
    held = asyncio.Event()

    async def hold(_seconds: float) -> None:
        held.set()
        await asyncio.Event().wait()

    task = asyncio.create_task(reset(line, SETTINGS, hold))
    await asyncio.wait_for(held.wait(), 10)
    assert line.active
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert [active for _, active in line.history] == [True, False]


class Scene:
    def __init__(self, settings: ResetOptions = SETTINGS) -> None:
        signals = SignalBench()
        self.clock, self.events = signals.clock, signals.events
        self.announced = 0
        self.bit_rate, self.is_free = 115_200, True
        made = make_reset(
            DEVICE, DeviceLines(reset=settings), signals.factory, signals.raise_event, self.clock.host, self
        )
        assert made is not None
        self.reset: ResetLine = made
        self.line = signals.output("reset")
        assert signals.memory.inputs == {}

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        run_virtually(self.clock, story())

    def tick(self, ahead_ns: int = 0) -> None:
        self.clock.advance(ahead_ns)
        self.reset.tick(self.clock.now_ns(), None)

    @property
    def pulses_s(self) -> list[float]:
        """Times of the active level, s after the start."""
        return [t_ns / NS_PER_S - 1000 for t_ns, active in self.line.history if active]

    async def search(self, seconds: float, every_s: float = 0.5) -> None:
        end_ns = self.clock.now_ns() + seconds * NS_PER_S
        while self.clock.now_ns() < end_ns:
            await asyncio.sleep(every_s)
            self.tick()
            await self.reset.not_found(self.clock.now_ns())

    def write(self, data: bytes) -> None: ...

    def on_reset(self) -> None:
        assert not self.line.active
        self.announced += 1


@pytest.mark.parametrize(("every_s", "first_s"), [(0.5, 4.5), (6.0, 18.0)])
def test_after_three_rounds_and_the_time_a_device_needs_and_then_once_a_minute(every_s: float, first_s: float) -> None:
    """A round every 0.5 s: the first ends at 0.5 s. After 4 s, the device should have returned."""
    it = Scene()
    run_virtually(it.clock, it.search(150, every_s))
    assert it.pulses_s[0] == pytest.approx(first_s, abs=0.01)
    assert all(AGAIN_NS / 1e9 <= b - a < AGAIN_NS / 1e9 + 2 * every_s for a, b in pairwise(it.pulses_s))
    assert len(it.pulses_s) == it.announced == 3
    assert it.events[0].message == f"not found for {first_s - every_s:.0f} s: restarted by its reset line"
    assert [event.detail["line"] for event in it.events] == ["reset"] * 3
    held = [b - a for (a, up), (b, _) in pairwise(it.line.history) if up]
    assert held == pytest.approx([20e6] * 3, abs=10)


@played(Scene)
async def test_a_device_found_in_the_meantime_is_not_reset(it: Scene) -> None:
    for _ in range(10):
        await it.search(4)
        it.reset.found()
    assert it.pulses_s == []


@played(Scene)
async def test_a_line_that_fails_in_a_search_does_not_end_it(it: Scene) -> None:
    it.tick()
    it.line.set_error = LinkMissing("gone")
    await it.search(6)
    assert [event.message for event in it.events] == [
        "not found for 4 s: restarted by its reset line",
        "line reset: gone",
    ]


@played(Scene)
async def test_a_pulse_on_request_is_at_once_and_a_search_waits_for_its_end(it: Scene) -> None:
    it.tick()
    begin_ns = it.clock.now_ns()
    task = asyncio.create_task(it.reset.pulse())
    await asyncio.sleep(0)
    await it.reset.settled()
    assert it.clock.now_ns() - begin_ns == pytest.approx(3.02e9, abs=1000)
    await task
    await it.search(3)  # no sample since: no immediate second reset
    assert it.pulses_s == [0.0]


def test_the_line_is_kept_inactive_and_left_so() -> None:
    it = Scene()
    it.tick()
    assert it.line.is_open
    it.reset.close()
    assert not it.line.is_open
    it.tick(10 * RETRY_NS)
    assert not it.line.is_open
    assert it.line.history == []


@in_loop
async def test_a_line_that_is_busy_or_fails_when_it_is_driven_is_reported_and_opened_again() -> None:
    it = Scene()
    it.line.open_error = LinkBusy("in use by gpioset")
    for _ in range(6):
        it.tick(RETRY_NS // 2)
    assert [event.message for event in it.events] == ["line reset: in use by gpioset"]
    assert it.reset.problem == "in use by gpioset"
    with pytest.raises(CommandError, match="in use by gpioset"):
        await it.reset.pulse()
    it.line.open_error = None
    it.tick(RETRY_NS)
    assert it.line.is_open
    assert not it.reset.problem

    it = Scene()
    it.tick()
    it.line.set_error = LinkMissing("gone")
    with pytest.raises(CommandError, match="gone"):
        await it.reset.pulse()
    assert it.reset.problem == "gone"
    assert not it.line.is_open
    it.line.set_error = None
    it.tick(RETRY_NS - 1)
    assert not it.line.is_open
    it.tick(1)
    assert it.line.is_open


@pytest.mark.parametrize("at_start", [True, False])
@played(lambda at_start: Scene(ResetOptions(line="RESET", hold_ms=20, at_start=at_start)))
async def test_at_the_start_it_is_pulsed_once_before_the_device_is_asked(it: Scene, at_start: bool) -> None:
    it.tick()
    await it.reset.settled()
    waited_ns = it.clock.now_ns() - 1000 * NS_PER_S
    assert waited_ns == pytest.approx(3.02 * NS_PER_S if at_start else 0, abs=1e8)
    await it.reset.settled()
    assert it.clock.now_ns() - 1000 * NS_PER_S - waited_ns < 1e8
    assert it.announced == len(it.pulses_s) == at_start
    assert [event.message for event in it.events] == ["restarted by its reset line at the start"] * at_start


@played(lambda: Scene(ResetOptions(line="RESET", at_start=True)))
async def test_a_line_that_cannot_be_driven_at_the_start_holds_nothing_up(it: Scene) -> None:
    it.line.set_error = LinkMissing("gone")
    it.tick()
    await it.reset.settled()
    assert it.clock.now_ns() - 1000 * NS_PER_S < 1e8
    assert [event.message for event in it.events][-1] == "line reset: gone"
