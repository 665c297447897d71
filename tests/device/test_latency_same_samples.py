"""With any hold and any division of the data: the same samples except for their times, and the same ledger."""

from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import msgspec
import pytest

from imud.contracts.driver import CanDriver, Driver, StreamDriver, of_kind
from imud.contracts.publisher import Batch
from imud.drivers import DRIVERS
from imud.formats.can import CanFrame
from imud.model.ledger import Ledger
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sampling.clock import SampleClock
from imud.sampling.path import CanPath, PathContext, StreamPath
from tests.support.codec_invariants import cut
from tests.support.event_loops import VirtualClock

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


def stream_path(driver: StreamDriver) -> Path:
    return Path(
        lambda ledger, context: StreamPath(driver.make_codec(ledger, driver.settings()), clock_of(driver), context)
    )


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
    plain, held = stream_path(driver), stream_path(driver)
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


def can_path(driver: CanDriver) -> Path:
    return Path(
        lambda ledger, context: CanPath(driver.make_codec(ledger, driver.settings()), clock_of(driver), context)
    )


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
    plain, held = can_path(driver), can_path(driver)
    for frame in frames:
        plain.path.on_frames([frame])
    at = 0
    while at < len(frames):
        some: Sequence[CanFrame] = frames[at : at + random.randint(1, 40)]
        held.path.on_frames(some)
        at += len(some)
    assert plain.samples
    assert held.came() == plain.came()
