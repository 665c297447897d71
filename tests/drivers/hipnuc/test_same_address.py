"""Detection of several devices with the same address. Each frame contains the number of its device. Times are in ms."""

from collections.abc import Callable, Iterable
from random import Random

import pytest

from imud.contracts.driver import CanDriver, of_kind
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.assembly import Assembly
from imud.drivers.hipnuc.same_address import SameAddress
from imud.formats.can import CanFrame
from imud.model.ledger import Ledger
from imud.model.sample import Measurement

MS = 1_000_000
FRAME_MS = 0.24


def feed(
    assembly: Assembly,
    devices: Iterable[tuple[float, float]],
    *,
    begin: float = 0,
    end: float = 3000,
    kinds: int = 3,
    has_sids: bool = False,
    loss: float = 0.0,
    late: Callable[[int, Random], float] = lambda number, random: 0.1 * random.random(),
) -> list[str]:
    """Send the frames of devices (period, phase). Each device has a crystal of its own. Return the problem after each
    frame."""
    random, frames = Random(1), []
    for device, (period, phase) in enumerate(devices):
        for number in range(int((end - begin - phase) / period)):
            t = begin + phase + number * period * (1 + device / 30_000) + late(number, random)
            for kind in range(kinds):
                if random.random() >= loss:
                    sid = (number + 77 * device) % 253 if has_sids else None
                    frames.append((t + kind * FRAME_MS, kind, bytes([device, number % 256, number // 256]), sid))
    problems = []
    for t, kind, data, sid in sorted(frames):
        assembly.add_frame(kind, data, 10**9 + round(t * MS), sid)
        problems.append(assembly.problem)
    return problems


@pytest.mark.parametrize("kinds", [1, 3])
@pytest.mark.parametrize("has_sids", [False, True])
@pytest.mark.parametrize(
    ("devices", "periods"),
    [
        ([(5, 0), (5, 0.75)], "2 series with the periods 5.0 ms, 5.0 ms;"),
        ([(10, 0), (10, 3.5)], "2 series with the periods 10.0 ms, 10.0 ms;"),
        ([(10, 0), (10, 2), (10, 5.5)], "3 series with the periods 10.0 ms, 10.0 ms, 10.0 ms;"),
        ([(10, 0), (10, 1.3), (10, 2.6)], "3 series with"), ([(10, 0), (10, 1.5), (10, 4), (10, 6.2)], "4 series with"),
        ([(20, 0), (20, 1), (20, 2.1), (20, 3.4)], "4 series with"),
        ([(10, 0), (20, 3)], "2 series with the periods 10.0 ms, 20.0 ms;"),
        ([(10, 0), (33.3, 3)], "2 series with the periods 10.0 ms, 33.3 ms;"),
        ([(10, 0), (10, 4), (20, 7)], "3 series with"), ([(10, 0), (12, 4), (14, 5)], "3 series with"),
        ([(5, 0), (50, 502)], "2 series with the periods 5.0 ms, 50.0 ms;"),
        ([(5, 0), (50, 2), (70, 3)], "3 series with the periods 5.0 ms, 50.0 ms, 70.0 ms;"),
    ],
)  # fmt: skip
def test_devices_with_one_address_are_reported_until_one_remains(
    devices: list[tuple[float, float]], periods: str, kinds: int, has_sids: bool
) -> None:
    assembly = Assembly(Ledger())
    assert not any(feed(assembly, devices[:1], end=300, kinds=kinds, has_sids=has_sids))
    assert f"frames arrive in {periods}" in feed(assembly, devices, begin=300, kinds=kinds, has_sids=has_sids)[-1]
    assert any(feed(assembly, devices, begin=3000, end=6000, kinds=kinds, has_sids=has_sids, loss=0.03))
    assert not feed(assembly, devices[:1], begin=6000, end=8500, kinds=kinds, has_sids=has_sids)[-1]


@pytest.mark.parametrize("kinds", [1, 3])
@pytest.mark.parametrize("loss", [0, 0.05, 0.2])
@pytest.mark.parametrize(
    "late",
    [
        lambda number, random: 0.1 * random.random(), lambda number, random: 3 * random.random(),
        lambda number, random: 8 * random.random(), lambda number, random: 8 * (random.random() < 0.2),
        lambda number, random: 2 * (number % 2 == 0),  # each second frame waits for another device
        lambda number, random: 3 * (number % 5 == 0), lambda number, random: 10 * (-number % 3) + 1.2 * (number % 3),
        lambda number, random: max(10 * (number - 150), 0.0), lambda number, random: -7 * max(number - 150, 0.0),
        lambda number, random: -(number * 10) % 4,  # a timer with a resolution of 4 ms
    ],
    ids=["quiet", "jitter", "scatter", "delays", "half delayed", "some delayed", "bursts", "half", "triple", "ticks"],
)  # fmt: skip
def test_one_device_is_not_a_conflict(late: Callable[[int, Random], float], loss: float, kinds: int) -> None:
    assert not any(feed(Assembly(Ledger()), [(10, 0)], end=6000, late=late, loss=loss, kinds=kinds))


@pytest.mark.parametrize("driver", [one for one in of_kind(DRIVERS.values(), CanDriver) if "hipnuc" in one.name])
def test_every_codec_reports_the_conflict(driver: CanDriver) -> None:
    codec, frames = driver.make_codec(Ledger(), driver.settings()), list[CanFrame]()
    for t_ms in (*range(0, 3000, 10), *range(3, 3000, 10)):
        burst = driver.example_frames(Random(t_ms))
        frames += (one._replace(t_rx_ns=t_ms * MS + place * 240_000) for place, one in enumerate(burst))
    for frame in sorted(frames, key=lambda frame: frame.t_rx_ns):
        codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns)
    assert "frames arrive in 2 series with the periods 10.0 ms, 10.0 ms;" in codec.problem


@pytest.mark.parametrize("devices", [1, 2, 3, 4])
def test_values_in_a_fixed_order_are_from_several_devices(devices: int) -> None:
    """The devices turn together."""
    same, random = SameAddress(), Random(2)
    for number in range(600):
        device = number % devices
        yaw = (0.001 * number + 0.6 * device * device + random.gauss(0, 0.002) + 3) % 6.28 - 3
        same.add_values(Measurement(0, 0, None, euler_rad=(0.0, 0.0, yaw), accel_m_s2=(0.0, 0.0, random.gauss(9.8, 2))))
    assert ("the values of consecutive samples repeat in a fixed order" in same.problem) == (devices > 1)
