"""`driver: auto` on a CAN bus: one, several, exchanged and remembered devices; and cyclic frames.
Results of searches after a restart. An invalid file only loses the results."""

import asyncio
import os
import threading
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack, closing
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from imud.config.model import DeviceConfig
from imud.contracts.driver import Driver
from imud.contracts.status import DeviceState
from imud.device import can_search as detection
from imud.device import can_transport
from imud.device.search import FILE_NAME, Remembered, RememberedDevice
from imud.drivers import DRIVERS
from imud.formats.can import CyclicFrame
from imud.links.memory import MemoryCanLink, MemoryOptions
from imud.model.options import Options
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.support.device_rig import DeviceRig, DeviceRigs
from tests.support.event_loops import VirtualClock, run_virtually
from tests.support.fake_drivers import BASE, SYNC_ID, FakeCanSettings, fake_can_driver, fake_can_frame
from tests.support.stories import played

SILENT_SEARCH_NS = 15 * 10**9


@pytest.fixture(autouse=True)
def fake_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the fake driver, and make the rounds short."""
    table: dict[str, Driver] = {**dict(DRIVERS), "fake-can": fake_can_driver()}
    monkeypatch.setattr(can_transport, "DRIVERS", table)
    monkeypatch.setattr(detection, "LISTEN_NS", 20 * NS_PER_MS)


class Bus:
    """Devices on the bus `can0` in virtual time. They start at the first wait of the test."""

    def __init__(self, state_dir: Path | None = None) -> None:
        self.clock = VirtualClock()
        self.rigs = DeviceRigs(self.clock.host, state_dir=state_dir)
        self._at_work = AsyncExitStack()
        self._started = False

    def add(
        self, name: str = "mast", driver: str = "auto", options: Options | None = None, *, writable: bool = True
    ) -> "OnBus":
        settings = MemoryOptions(name="can0", writable=writable)
        config = DeviceConfig(name, driver, options, True, "memory", settings)
        return OnBus(self, self.rigs.add(config, MemoryCanLink(settings)))

    def claimed(self, node: int) -> bool:
        """Return whether a device receives the frames of a node."""
        return self.rigs.factory._can_buses.claimed("other", "can0")(BASE + node, False)

    async def start(self) -> None:
        """Start the devices. A second call does nothing."""
        if not self._started:
            self._started = True
            await self._at_work.enter_async_context(self.rigs.at_work())
            await asyncio.sleep(0)

    def play(self, story: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run the story; at the end the ledgers of the devices balance and no link is open."""

        async def whole() -> None:
            async with self._at_work:
                await story()
            assert not any(rig.can_link.is_open for rig in self.rigs.rigs.values())

        run_virtually(self.clock, whole())


class OnBus:
    def __init__(self, bus: Bus, rig: DeviceRig) -> None:
        self._bus = bus
        self.rig = rig
        self.device = rig.device
        self.link = rig.can_link

    @property
    def samples(self) -> list[Sample]:
        return self.rig.samples

    def hear(self, *nodes: int, number: int = 0) -> None:
        self.link.feed([fake_can_frame(node, number, self.rig.now_ns()) for node in nodes])

    async def until(self, condition: Callable[[], object], *nodes: int) -> None:
        await self._bus.start()
        numbers = count(len(self.samples) + 1)
        await self.rig.until(condition, step=lambda: self.hear(*nodes, number=next(numbers) % 200), step_s=0.001)


@played(Bus)
async def test_the_only_device_is_found_without_a_sent_frame(bus: Bus) -> None:
    bench, configured = bus.add(), bus.add("bow", "fake-can", FakeCanSettings(node=5))
    assert bench.device.verbs == {}
    await bench.until(lambda: bench.link.listening)
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING, 8)
    status = bench.device.status()
    assert (status.driver, status.state, status.problem) == ("fake-can", DeviceState.RUNNING, "")
    assert [wanted.can_id for wanted in bench.link.filters] == [BASE + 8]
    assert bench.device.ledger.bytes_skipped > 0  # the frames of the search
    assert bench.link.written == []
    assert await bench.device.act("node", {}) == 8
    await configured.until(lambda: configured.device.state is DeviceState.RUNNING, 5)
    assert await configured.device.act("node", {}) == 5


@pytest.mark.parametrize("driver", ["auto", "fake-can"])
@played(Bus)
async def test_a_device_with_a_new_number_is_followed(bus: Bus, driver: str) -> None:
    bench = bus.add(driver=driver, options=FakeCanSettings(node=8, sync_ms=10) if driver != "auto" else None)
    other = bus.add("bow")
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING, 8)
    path = bench.device._transport.path
    await bench.device.act("renumber", {"node": 8})
    assert bench.device._transport.path is path  # the device already has this number
    await bench.device.act("renumber", {"node": 9})
    assert [wanted.can_id for wanted in bench.link.filters] == [BASE + 9]
    words = "change options.node to 9 in the configuration"
    assert any(words in one.message for one in bench.rig.events) == (driver != "auto")
    heard = len(bench.samples)
    await bench.until(lambda: len(bench.samples) > heard, 9)
    assert await bench.device.act("node", {}) == 9
    await other.until(lambda: other.samples, 8)  # the previous number is free
    assert [wanted.can_id for wanted in other.link.filters] == [BASE + 8]
    assert bench.device.state is DeviceState.RUNNING
    assert [sample.seq for sample in bench.samples] == list(range(1, len(bench.samples) + 1))


@played(Bus)
async def test_several_devices_are_listed_and_the_search_continues(bus: Bus) -> None:
    bench = bus.add()
    await bench.until(lambda: "2 devices send on can0" in bench.rig.problem, 8, 9)
    assert "fake-can node 8, fake-can node 9; configure driver and options" in bench.rig.problem
    assert bench.device.state is DeviceState.SEARCHING
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING, 9)  # the other device was removed


@played(Bus)
async def test_a_device_of_another_configuration_is_not_used(bus: Bus) -> None:
    auto = bus.add()
    bus.add("bow", "fake-can", FakeCanSettings(node=8))
    await auto.until(lambda: auto.samples, 8, 9)
    assert [wanted.can_id for wanted in auto.link.filters] == [BASE + 9]


@played(Bus)
async def test_two_searches_do_not_find_the_same_device(bus: Bus) -> None:
    first, second = bus.add("bow"), bus.add("mast")
    await first.until(lambda: first.samples, 8)
    await second.until(lambda: "only frames of other" in second.rig.problem, 8)
    await second.until(lambda: second.samples, 8, 9)
    assert [wanted.can_id for wanted in second.link.filters] == [BASE + 9]


def test_the_result_of_a_search_is_stored(tmp_path: Path) -> None:
    for nodes in ((8,), (8, 9)):  # although two devices send at the second search
        bus = Bus(tmp_path)
        bench = bus.add()

        async def story(bench: OnBus = bench, nodes: tuple[int, ...] = nodes) -> None:
            await bench.until(lambda: bench.samples, *nodes)
            assert [wanted.can_id for wanted in bench.link.filters] == [BASE + 8]

        bus.play(story)
        with closing(Remembered(tmp_path)) as memory:
            assert memory.get("mast") == RememberedDevice("fake-can", 0, 8)


@played(Bus)
async def test_after_long_silence_another_device_is_found(bus: Bus) -> None:
    bench = bus.add()
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING, 8)
    newest = bench.samples[-1].seq
    now_ns = bench.rig.now_ns()
    bench.device.tick(now_ns + 6 * NS_PER_S)
    assert bench.device.state is DeviceState.SILENT
    bench.device.tick(now_ns + 6 * NS_PER_S + SILENT_SEARCH_NS + NS_PER_S)
    await bench.until(lambda: len(bench.link.filters) == 2)
    bench.device.tick(bench.rig.now_ns())
    assert bench.device.status().state is DeviceState.SEARCHING
    await bench.until(lambda: bench.device.state is DeviceState.RUNNING, 9)
    assert [wanted.can_id for wanted in bench.link.filters] == [BASE + 9]
    assert bench.samples[-1].seq > newest
    assert [sample.seq for sample in bench.samples] == list(range(1, len(bench.samples) + 1))


@played(Bus)
async def test_the_search_continues_after_the_bus_was_down(bus: Bus) -> None:
    bench = bus.add()
    await bench.until(lambda: bench.link.listening)
    await bench.until(lambda: "no frame arrives on can0" in bench.rig.problem)
    bench.link.news("can0 is bus-off: x", "can0 is bus-off: x")
    await bench.until(lambda: "bus-off" in bench.rig.problem)
    assert (bench.rig.problem, bench.rig.state) == ("can0 is bus-off: x", DeviceState.SEARCHING)
    bench.hear(8)
    bench.link.disappear()
    await bench.until(lambda: bench.device.state is DeviceState.MISSING)
    bench.link.appear()
    await bench.until(lambda: bench.samples, 8)
    path = bench.device._transport.path
    bench.link.disappear()
    await bench.until(lambda: bench.rig.is_in(DeviceState.MISSING))
    assert not bus.claimed(8), "another search can find this device"
    bench.link.appear()
    await bench.until(lambda: bench.rig.is_in(DeviceState.RUNNING), 8)
    assert bus.claimed(8)
    assert bench.device._transport.path is path  # the same device


def syncing(bus: Bus, name: str, node: int, *, writable: bool = True) -> OnBus:
    return bus.add(name, "fake-can", FakeCanSettings(node=node, sync_ms=10), writable=writable)


@played(Bus)
async def test_cyclic_frames_are_sent_while_the_link_is_open(bus: Bus) -> None:
    """A configured device keeps its identifiers. A read-only link sends no frame."""
    bench, silent = syncing(bus, "mast", 8), syncing(bus, "bow", 9, writable=False)
    await bench.until(lambda: bench.link.cyclic)
    assert list(bench.link.cyclic) == [CyclicFrame(SYNC_ID, False, b"", 10_000_000)]
    bench.link.disappear()
    await bench.until(lambda: bench.device.state is DeviceState.MISSING)
    assert not bench.link.cyclic
    assert bus.claimed(8)
    bench.link.appear()
    await bench.until(lambda: bench.link.cyclic)
    await silent.until(lambda: silent.samples, 9)
    assert not silent.link.cyclic


@played(Bus)
async def test_a_second_sender_of_the_same_frame_is_refused(bus: Bus) -> None:
    first, second = syncing(bus, "bow", 8), syncing(bus, "mast", 9)
    await first.until(lambda: first.link.cyclic)
    await second.until(lambda: second.device.state is DeviceState.FAILED)
    assert "bow and mast would both send 0x080 on can0" in second.rig.problem
    assert (bool(second.link.cyclic), second.device.status().connects) == (False, 0)  # imud does not open the bus
    assert first.rig.problem.startswith("no sample has arrived yet")


FOUND, OTHER = RememberedDevice("hipnuc-uart", 9600), RememberedDevice("hipnuc-uart", 921600)


def remember(folder: Path, **found: RememberedDevice) -> None:
    """Store results as one daemon from its start to its end."""
    before = set(threading.enumerate())
    with closing(Remembered(folder)) as memory:
        for name, one in found.items():
            memory.put(name, one)
    assert "remembered" not in {thread.name for thread in set(threading.enumerate()) - before}


def recalled(folder: Path, device: str) -> RememberedDevice | None:
    """Return the result that the next daemon reads."""
    with closing(Remembered(folder)) as memory:
        return memory.get(device)


def test_results_survive_a_restart_and_are_written_once(tmp_path: Path) -> None:
    remember(tmp_path, bow=OTHER)
    assert recalled(tmp_path, "bow") == OTHER
    assert recalled(tmp_path, "stern") is None
    assert [file.name for file in tmp_path.iterdir()] == [FILE_NAME]
    remember(tmp_path, bow=FOUND)
    written = (tmp_path / FILE_NAME).stat()
    remember(tmp_path, bow=FOUND)
    assert (tmp_path / FILE_NAME).stat().st_ino == written.st_ino
    with closing(Remembered(tmp_path)) as memory:
        for number in range(500):
            memory.put(f"d{number % 7}", RememberedDevice("hipnuc-uart", number))
    assert [recalled(tmp_path, f"d{number % 7}") for number in range(493, 500)] == [
        RememberedDevice("hipnuc-uart", number) for number in range(493, 500)
    ]
    remember(tmp_path / "var" / "imud", bow=FOUND)
    assert recalled(tmp_path / "var" / "imud", "bow") == FOUND


DEEP = b'{"bow": {"driver": "x", "baud": 1, "more": ' + b"[" * 100_000


def linked(target: str) -> Callable[[Path], object]:
    return lambda file: file.symlink_to(target)


def holding(content: bytes) -> Callable[[Path], object]:
    return lambda file: file.write_bytes(content)


DAMAGED = [b"", b"{", b"[1]", b'{"bow": {"driver": 1, "baud": "x"}}', b"\xff\xfe", DEEP]


@pytest.mark.parametrize(
    "make", [os.mkfifo, *map(linked, ("/dev/zero", "/dev/ptmx", FILE_NAME)), *map(holding, DAMAGED)]
)
@pytest.mark.timeout(5)
def test_an_invalid_file_is_reported_and_replaced(
    tmp_path: Path, make: Callable[[Path], object], caplog: pytest.LogCaptureFixture
) -> None:
    make(tmp_path / FILE_NAME)
    remember(tmp_path, bow=FOUND)
    assert "cannot use" in caplog.text
    assert recalled(tmp_path, "bow") == FOUND
    make(tmp_path / (FILE_NAME + ".new"))  # the temporary file of a killed daemon has any type
    remember(tmp_path, bow=OTHER)
    assert recalled(tmp_path, "bow") == OTHER


def test_a_directory_in_place_of_the_file_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / FILE_NAME).mkdir()
    remember(tmp_path, bow=FOUND)
    assert "cannot use" in caplog.text
    assert "cannot write" in caplog.text
    assert [file.name for file in tmp_path.iterdir()] == [FILE_NAME]


def test_without_a_folder_results_stay_in_memory(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "taken").touch()
    for folder in (None, tmp_path / "taken" / "imud"):
        with closing(Remembered(folder)) as memory:
            memory.put("bow", FOUND)
            assert memory.get("bow") == FOUND
    assert "cannot write" in caplog.text
