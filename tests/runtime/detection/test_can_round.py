"""`driver: auto` on a CAN bus: found, several, exchanged, remembered; and frames that imud sends cyclically."""

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from time import monotonic_ns
from typing import Any

import pytest

from imud.config import DeviceConfig
from imud.contracts.driver import Driver
from imud.contracts.settings import Settings
from imud.contracts.status import DeviceState
from imud.devices import DRIVERS
from imud.formats.can import CyclicFrame
from imud.links.memory import MemoryCanLink, MemorySettings
from imud.runtime.can import runner as can_runner
from imud.runtime.can.buses import CanBuses
from imud.runtime.can.runner import CanRunner
from imud.runtime.detection import can as detection
from imud.runtime.detection.remembered import Remembered, RememberedDevice
from imud.runtime.stream.runner import SILENT_SEARCH_NS
from imud.sample import Sample
from imud.units import NS_PER_MS, NS_PER_S
from tests.support.fake_can import BASE, SYNC_ID, FakeCanSettings, fake_can_driver, fake_frame

LIMIT_S = 10.0
Story = Callable[[list["Bench"]], Coroutine[Any, Any, None]]


@pytest.fixture(autouse=True)
def fake_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fake driver beside the real ones, and rounds of no length."""
    table: dict[str, Driver] = {**dict(DRIVERS), "fake-can": fake_can_driver()}
    monkeypatch.setattr(can_runner, "DRIVERS", table)
    monkeypatch.setattr(detection, "LISTEN_NS", 20 * NS_PER_MS)


class Bench:
    """One device on the bus `can0`."""

    def __init__(
        self,
        name: str,
        buses: CanBuses,
        *,
        driver: str = "auto",
        options: Settings | None = None,
        remembered: Remembered | None = None,
        writable: bool = True,
    ) -> None:
        settings = MemorySettings(name="can0", writable=writable)
        config = DeviceConfig(name, driver, options, True, "memory", settings)
        self.samples: list[Sample] = []
        self.runner = CanRunner(
            config, 1, lambda batch: self.samples.extend(batch.samples), lambda event: None, buses, remembered
        )
        assert isinstance(self.runner.link, MemoryCanLink)
        self.link = self.runner.link

    def hear(self, *nodes: int, number: int = 0) -> None:
        """A frame of each node."""
        self.link.feed([fake_frame(node, number, monotonic_ns()) for node in nodes])

    async def until(self, condition: Callable[[], object], *nodes: int) -> None:
        """Wait until it holds, with those nodes on the bus."""
        end = asyncio.get_running_loop().time() + LIMIT_S
        number = len(self.samples)
        while not condition():
            assert asyncio.get_running_loop().time() < end, f"does not come true: {self.runner.status()}"
            number += 1
            self.hear(*nodes, number=number % 200)
            self.runner.tick(monotonic_ns())
            await asyncio.sleep(0.001)


def play(benches: list[Bench], story: Story) -> None:
    """Run the devices while the story is told; at the end their ledgers close."""

    async def all_of_them() -> None:
        tasks = [asyncio.create_task(bench.runner.run()) for bench in benches]
        try:
            await asyncio.sleep(0)
            await story(benches)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        for bench in benches:
            bench.runner.close()
            assert bench.runner.ledger.closes(), bench.runner.ledger.snapshot()

    asyncio.run(all_of_them())


def test_the_only_device_is_found_and_nothing_was_sent() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: bench.link.listening)
        await bench.until(lambda: bench.runner.state is DeviceState.RUNNING, 8)
        status = bench.runner.status()
        assert (status.driver, status.state, status.problem) == ("fake-can", DeviceState.RUNNING, "")
        assert [wanted.can_id for wanted in bench.link.filters] == [BASE + 8]
        assert bench.runner.ledger.bytes_skipped > 0  # what was heard while searching
        assert bench.link.written == []

    play([Bench("mast", CanBuses())], story)


def test_commands_go_to_the_device_that_was_found() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        assert bench.runner.actions == {}
        await bench.until(lambda: bench.runner.state is DeviceState.RUNNING, 8)
        assert await bench.runner.act("node", {}) == 8

    play([Bench("mast", CanBuses())], story)


def test_commands_go_to_the_device_that_is_configured() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: bench.runner.state is DeviceState.RUNNING, 5)
        assert await bench.runner.act("node", {}) == 5

    play([Bench("mast", CanBuses(), driver="fake-can", options=FakeCanSettings(node=5))], story)


def test_several_are_named_and_the_search_goes_on() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: "2 devices are heard" in bench.runner.status().problem, 8, 9)
        assert "fake-can node 8, fake-can node 9: name driver and options" in bench.runner.status().problem
        assert bench.runner.state is DeviceState.SEARCHING
        await bench.until(lambda: bench.runner.state is DeviceState.RUNNING, 9)  # the other one was taken away

    play([Bench("mast", CanBuses())], story)


def test_a_device_that_another_one_is_configured_for_is_left_alone() -> None:
    buses = CanBuses()
    named = Bench("bow", buses, driver="fake-can", options=FakeCanSettings(node=8))

    async def story(benches: list[Bench]) -> None:
        auto = benches[0]
        await auto.until(lambda: auto.samples, 8, 9)
        assert [wanted.can_id for wanted in auto.link.filters] == [BASE + 9]

    play([Bench("mast", buses), named], story)


def test_two_that_search_do_not_both_take_the_same_device() -> None:
    buses = CanBuses()
    first, second = Bench("bow", buses), Bench("mast", buses)

    async def story(benches: list[Bench]) -> None:
        await first.until(lambda: first.samples, 8)
        await second.until(lambda: "only frames of other" in second.runner.status().problem, 8)
        await second.until(lambda: second.samples, 8, 9)
        assert [wanted.can_id for wanted in second.link.filters] == [BASE + 9]

    play([first, second], story)


def test_what_was_found_is_remembered(tmp_path: Path) -> None:
    remembered = Remembered(tmp_path)

    async def story(benches: list[Bench]) -> None:
        await benches[0].until(lambda: benches[0].samples, 8)

    play([Bench("mast", CanBuses(), remembered=remembered)], story)
    assert Remembered(tmp_path).get("mast") == RememberedDevice("fake-can", 0, 8)

    async def again(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: bench.samples, 8, 9)  # although two are heard now
        assert [wanted.can_id for wanted in bench.link.filters] == [BASE + 8]

    play([Bench("mast", CanBuses(), remembered=Remembered(tmp_path))], again)


def test_after_long_silence_another_device_is_found() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: bench.runner.state is DeviceState.RUNNING, 8)
        newest = bench.samples[-1].seq
        now_ns = monotonic_ns()
        bench.runner.tick(now_ns + 6 * NS_PER_S)
        assert bench.runner.state is DeviceState.SILENT
        bench.runner.tick(now_ns + 6 * NS_PER_S + SILENT_SEARCH_NS + NS_PER_S)
        await bench.until(lambda: len(bench.link.filters) == 2)
        bench.runner.tick(monotonic_ns())
        assert bench.runner.status().state is DeviceState.SEARCHING
        await bench.until(lambda: bench.runner.state is DeviceState.RUNNING, 9)
        assert [wanted.can_id for wanted in bench.link.filters] == [BASE + 9]
        assert bench.samples[-1].seq > newest
        assert [sample.seq for sample in bench.samples] == list(range(1, len(bench.samples) + 1))

    play([Bench("mast", CanBuses())], story)


def test_the_bus_goes_down_while_searching_and_comes_back() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: bench.link.listening)
        bench.hear(8)
        bench.link.disappear()
        await bench.until(lambda: bench.runner.state is DeviceState.MISSING)
        bench.link.appear()
        await bench.until(lambda: bench.samples, 8)

    play([Bench("mast", CanBuses())], story)


def test_trouble_of_the_bus_explains_why_nothing_is_found() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: "nothing is heard on can0" in bench.runner.status().problem)
        bench.link.news("can0 is bus-off: x", "can0 is bus-off: x")
        await bench.until(lambda: bench.runner.status().problem == "can0 is bus-off: x")

    play([Bench("mast", CanBuses())], story)


# --- frames that are sent cyclically ----------------------------------------------------------------------------------


def syncing(name: str, buses: CanBuses, node: int, **more: Any) -> Bench:
    return Bench(name, buses, driver="fake-can", options=FakeCanSettings(node=node, sync_ms=10), **more)


def test_cyclic_frames_are_sent_while_the_link_is_open() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: bench.link.cyclic)
        assert list(bench.link.cyclic) == [CyclicFrame(SYNC_ID, False, b"", 10_000_000)]
        bench.link.disappear()
        await bench.until(lambda: bench.runner.state is DeviceState.MISSING)
        assert not bench.link.cyclic
        bench.link.appear()
        await bench.until(lambda: bench.link.cyclic)

    play([syncing("mast", CanBuses(), 8)], story)


def test_a_link_that_may_not_send_sends_nothing() -> None:
    async def story(benches: list[Bench]) -> None:
        (bench,) = benches
        await bench.until(lambda: bench.samples, 8)
        assert not bench.link.cyclic

    play([syncing("mast", CanBuses(), 8, writable=False)], story)


def test_a_second_sender_of_the_same_frame_is_refused() -> None:
    buses = CanBuses()

    async def story(benches: list[Bench]) -> None:
        first, second = benches
        await first.until(lambda: first.link.cyclic)
        await second.until(lambda: second.runner.state is DeviceState.FAILED)
        assert "bow and mast would both send 0x080 on can0" in second.runner.status().problem
        assert not second.link.cyclic
        assert second.runner.status().connects == 0  # it is not even opened
        assert first.runner.status().problem == ""

    play([syncing("bow", buses, 8), syncing("mast", buses, 9)], story)
