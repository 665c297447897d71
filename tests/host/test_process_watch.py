"""A blocked event loop and a growing process are reported with their cause, without a wait."""

import asyncio
from collections.abc import Callable

import pytest

from imud.host import event_loop
from imud.host.event_loop import SampleLoop
from imud.host.process_watch import GROWTH_BYTES, MEMORY_NS, MemoryWatch, StallWatch, resident_bytes
from imud.host.scope import Scope
from imud.model.units import NS_PER_S
from tests.support.event_loops import VirtualClock


class Rig:
    """A watch in a loop, with a clock of the test. `look` stands for the thread."""

    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.reports: list[tuple[str, int]] = []
        self.watch = StallWatch(self.clock.now_ns, self)
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SampleLoop)
        self.watch.start(loop)
        self.scope = Scope("ex", lambda _error: None)

    def on_growth(self, text: str) -> None: ...

    def on_blocked(self, scope: Scope | None, duration_ns: int) -> None:
        self.reports.append(("" if scope is None else scope.owner, duration_ns))

    def block(self) -> None:
        """Block the loop for 3 s. The thread looks in the meantime."""
        self.clock.advance(3 * NS_PER_S)
        self.watch.look()
        self.watch.look()


PLACES: dict[str, Callable[[Rig], object]] = {
    "call": lambda rig: rig.scope.call(rig.block),
    "callback": lambda rig: rig.scope.run(asyncio.get_running_loop().call_soon, rig.block),
    "nobody": lambda rig: rig.block(),
}


@pytest.mark.parametrize("place", PLACES)
def test_blocking_scope_is_named(place: str, caplog: pytest.LogCaptureFixture) -> None:
    async def body() -> None:
        rig = Rig()
        rig.clock.advance(NS_PER_S)
        rig.watch.look()
        rig.watch.beat(rig.clock.now_ns())
        assert rig.reports == []
        PLACES[place](rig)
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        rig.watch.beat(rig.clock.now_ns())
        rig.watch.close()
        assert rig.reports == [("" if place == "nobody" else "ex", 3 * NS_PER_S)]
        rig.watch.beat(rig.clock.now_ns())
        assert len(rig.reports) == 1

    event_loop.run(body())
    assert caplog.text.count("the event loop is blocked since 3.0 s") == 1


def test_growth_is_reported_once_per_step() -> None:
    sizes = iter([100 << 20, (100 << 20) + GROWTH_BYTES - 1, 500 << 20, 600 << 20, 800 << 20])
    watch = MemoryWatch(lambda: next(sizes))
    texts = [watch.check(number * MEMORY_NS) for number in range(5)]
    first = "imud uses 500 MiB of memory, 100 MiB after its start"
    assert texts == ["", "", first, "", "imud uses 800 MiB of memory, 100 MiB after its start"]
    assert watch.check(4 * MEMORY_NS + 1) == ""
    assert resident_bytes() > 1 << 20
