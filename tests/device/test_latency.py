"""Latency of each device from all requests."""

from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import msgspec
import pytest

from imud.contracts.driver import CanDriver, Driver, StreamDriver, of_kind
from imud.contracts.publisher import Batch
from imud.device.latency import NOBODY, LatencyBudget, Need
from imud.drivers import DRIVERS
from imud.formats.can import CanFrame
from imud.model.ledger import Ledger
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sampling.path import CanPath, PathContext, StreamPath
from imud.testing.invariants import cut
from tests.support.event_loops import VirtualClock

MOST_NS = 50 * 10**6


class Told:
    def __init__(self, budget: LatencyBudget, name: str) -> None:
        self.needs: list[Need] = []
        budget.add_device(name, self.needs.append)

    @property
    def now(self) -> tuple[float, str]:
        """Return the latency in ms, and its client."""
        return self.needs[-1].latency_ns / NS_PER_MS, self.needs[-1].who


def test_the_smallest_latency_counts_and_a_device_is_notified_of_changes() -> None:
    budget = LatencyBudget()
    bow, stern = Told(budget, "bow"), Told(budget, "stern")
    assert bow.needs == [NOBODY]
    budget.ask("shared memory", 5 * NS_PER_MS)
    budget.ask("client 1", 2 * NS_PER_MS, ["stern"])
    budget.ask("client 2", 20 * NS_PER_MS, ["bow", "stern", "gone"])
    assert bow.now == (5, "shared memory")
    assert stern.now == (2, "client 1")
    budget.ask("client 2", 0)
    assert bow.now == stern.now == (0, "client 2")
    budget.release("client 2")
    budget.release("shared memory")
    assert bow.now == (50, "")
    assert stern.now == (2, "client 1")
    assert budget.need("stern") == Need(2 * NS_PER_MS, "client 1")
    budget = LatencyBudget()
    budget.ask("all", 9 * NS_PER_MS)
    budget.ask("named", 4 * NS_PER_MS, ["bow"])
    assert Told(budget, "bow").now == (4, "named")
    assert Told(budget, "stern").now == (9, "all")
    budget.remove_device("bow")
    budget.remove_device("bow")
    budget.ask("named", 3 * NS_PER_MS, ["bow"])
    assert Told(budget, "bow").now == (3, "named")
    budget = LatencyBudget()
    bow = Told(budget, "bow")
    budget.ask("client 1", 5 * NS_PER_MS)
    budget.ask("client 2", 5 * NS_PER_MS)
    budget.ask("client 3", 7 * NS_PER_MS)
    budget.release("client 3")
    budget.release("nobody")
    budget.ask("client 4", 1, ["stern"])
    assert bow.needs == [NOBODY, Need(5 * NS_PER_MS, "client 1")]
    budget.release("client 1")
    assert bow.needs[2:] == [Need(5 * NS_PER_MS, "client 2")]
    budget = LatencyBudget()
    bow = Told(budget, "bow")
    budget.ask("patient", 10 * MOST_NS)
    assert bow.needs == [NOBODY]
    budget.ask("hasty", -1)
    assert bow.now == (0, "hasty")


def test_the_order_of_requests_does_not_matter() -> None:
    random, budget = Random(1), LatencyBudget()
    names = ["bow", "stern", "mast", "gone"]
    devices = {name: Told(budget, name) for name in names[:3]}
    stand: dict[str, tuple[int, list[str] | None]] = {}
    for _ in range(3000):
        who = f"client {random.randrange(12)}"
        if random.random() < 0.4:
            stand.pop(who, None)
            budget.release(who)
        else:
            latency_ns = random.choice([0, 5, 5, 20, 50, 80]) * NS_PER_MS
            wanted = random.choice([None, random.sample(names, random.randrange(1, 4))])
            stand[who] = latency_ns, wanted
            budget.ask(who, latency_ns, wanted)
        for name, device in devices.items():
            needs = [Need(ns, who) for who, (ns, wanted) in stand.items() if wanted is None or name in wanted]
            assert device.needs[-1] == budget.need(name) == min([*needs, NOBODY])


def test_a_withdrawn_request_does_not_visit_other_requests() -> None:
    budget, compared = LatencyBudget(), 0

    class Counted(str):
        __slots__ = ()

        def __lt__(self, other: str) -> bool:
            nonlocal compared
            compared += 1
            return str.__lt__(self, other)

    bow = Told(budget, "bow")
    names = [Counted(f"client {number:04}") for number in range(1000)]
    for name in names:
        budget.ask(name, 0, ["bow"])
    for name in names:
        budget.release(name)
    assert bow.now == (50, "")
    assert compared < 1000 * 2 * 40, "a search of the list for each, and no more"


STREAM = of_kind(DRIVERS.values(), StreamDriver)
CAN = of_kind(DRIVERS.values(), CanDriver)
FRAMES = 60
BYTE_NS = 10_850

TIMES = ("t_ns", "t_err_ns", "t_rx_ns", "utc_ns", "sync", "t_dev_ns")
"""Members that depend on the arrival if the device times are random."""


class Came(msgspec.Struct):
    samples: list[Sample]
    messages: list[object]
    ledger: dict[str, int]

    def without_times(self) -> tuple[list[dict[str, Any]], list[object], dict[str, int]]:
        """Results that must not depend on the time of the read."""
        plain = [
            {name: value for name, value in msgspec.structs.asdict(sample).items() if name not in TIMES}
            for sample in self.samples
        ]
        return plain, self.messages, self.ledger


def clock_of(driver: Driver) -> SampleClock:
    return SampleClock(
        "imu", tick_ns=driver.tick_ns, tick_modulus=driver.tick_modulus, byte_ns=BYTE_NS, hold_ns=0,
        stamp_modulus=driver.stamp_modulus, bits=driver.time_bits,
    )  # fmt: skip


class Path:
    def __init__(self, make: Callable[[Ledger, PathContext], Any]) -> None:
        self.samples: list[Sample] = []
        self.messages: list[object] = []
        self.ledger = Ledger()
        self.clock = VirtualClock()
        self.path = make(
            self.ledger,
            PathContext(
                "imu", 0, self.ledger, self._publish, lambda message, _t: self.messages.append(message),
                self.messages.append, lambda: 0, self.clock.host,
            ),
        )  # fmt: skip

    def _publish(self, batch: Batch) -> None:
        self.samples += batch.samples

    def came(self) -> Came:
        assert self.ledger.closes()
        return Came(self.samples, self.messages, self.ledger.snapshot())


def path_of(kind: Any, driver: Any) -> Path:
    return Path(lambda ledger, context: kind(driver.make_codec(ledger, driver.settings()), clock_of(driver), context))


def damaged(frame: bytes, random: Random) -> bytes:
    at = random.randrange(len(frame))
    return frame[:at] + bytes([frame[at] ^ 0x5A]) + frame[at + 1 :]


def stream_of(driver: StreamDriver, random: Random) -> bytes:
    """Return frames and text lines; a tenth of the frames is damaged."""
    parts = []
    for _ in range(FRAMES):
        frame = driver.example_frame(random)
        parts.append(damaged(frame, random) if random.random() < 0.1 else frame)
        if random.random() < 0.1:
            parts.append(b"OK\r\n")
    return b"".join(parts)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("driver", STREAM, ids=lambda driver: driver.name)
def test_held_bytes_give_the_same_samples_and_ledger(driver: StreamDriver, seed: int) -> None:
    random = Random(f"{driver.name} {seed}")
    stream = stream_of(driver, random)
    plain, held = path_of(StreamPath, driver), path_of(StreamPath, driver)
    for part in cut(stream, random):
        plain.clock.advance(random.randrange(NS_PER_MS))
        plain.path.on_data(part, plain.clock.now_ns())
    parts = cut(stream, random)
    while parts:
        held.clock.advance(random.randrange(5 * NS_PER_MS))
        held.path.gather(parts.pop(0), held.clock.now_ns())
        count = random.randrange(4)
        some, parts = parts[:count], parts[count:]
        waited_ns = random.randrange(1, 20 * NS_PER_MS)
        held.clock.advance(waited_ns)
        if some:
            held.path.gather(b"".join(some), held.clock.now_ns(), waited_ns)
        held.path.publish_gathered()
    now_ns = NS_PER_S * 10_000
    plain.path.flush(now_ns)
    held.path.flush(now_ns)
    assert len(plain.samples) > FRAMES // 2
    assert held.came().without_times() == plain.came().without_times()
    times = [sample.t_ns for sample in held.samples]
    assert times == sorted(set(times))
    assert all(sample.t_ns <= sample.t_rx_ns for sample in held.samples)


def frames_of(driver: CanDriver, random: Random) -> list[CanFrame]:
    """Return frames of samples, 10 ms apart, without some frames."""
    found = []
    for number in range(FRAMES):
        at_ns = 1000 * NS_PER_S + number * 10 * NS_PER_MS
        for place, frame in enumerate(driver.example_frames(random)):
            if random.random() > 0.05:
                found.append(frame._replace(t_rx_ns=at_ns + place * NS_PER_MS // 4, after_loss=False))
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("driver", CAN, ids=lambda driver: driver.name)
def test_held_frames_give_the_same_samples_and_times(driver: CanDriver, seed: int) -> None:
    random = Random(f"{driver.name} {seed}")
    frames = frames_of(driver, random)
    plain, held = path_of(CanPath, driver), path_of(CanPath, driver)
    for frame in frames:
        plain.path.on_frames([frame])
    at = 0
    while at < len(frames):
        some: Sequence[CanFrame] = frames[at : at + random.randint(1, 40)]
        held.path.on_frames(some)
        at += len(some)
    assert plain.samples
    assert held.came() == plain.came()
