"""Requirements for the row of every driver, and for every simulator."""

from collections.abc import Sequence
from random import Random
from typing import Any, Final

import msgspec

from imud.contracts.command import CalibrationInfo, infos
from imud.contracts.driver import CanDriver, Driver, PolledDriver, StreamDriver
from imud.drivers import DRIVERS
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_S
from imud.sim.can_module import CanSimulator
from imud.sim.sensor import Simulator, SimulatorOptions
from imud.testing.invariants import feed_stream

AnySimulator = Simulator | CanSimulator
BEGIN_NS: Final = 5 * NS_PER_S  # CLOCK_MONOTONIC of the power-on of a simulated device


def example_of(driver: Driver, random: Random) -> object:
    """Return an example: a frame, the frames of a sample, or the bytes of a poll."""
    if isinstance(driver, StreamDriver):
        return driver.example_frame(random)
    if isinstance(driver, CanDriver):
        return driver.example_frames(random)
    assert isinstance(driver, PolledDriver)
    return driver.example_reading(random)


def the_row_is_complete(driver: Driver, _random: Random, _data: bytes) -> None:
    assert driver.name
    assert driver.title
    assert driver.navigation_frame
    assert driver.euler_convention
    assert driver.tick_modulus > 1
    assert driver.tick_ns >= 0
    assert driver.settings() == driver.settings()
    described = infos(driver.calibrations)
    assert msgspec.json.decode(msgspec.json.encode(described), type=list[CalibrationInfo]) == described


def examples_depend_only_on_the_random_numbers(driver: Driver, random: Random, _data: bytes) -> None:
    seed = random.randrange(1 << 32)
    assert example_of(driver, Random(seed)) == example_of(driver, Random(seed)) != example_of(driver, Random(seed + 1))


DRIVER_REQUIREMENTS: Final = (the_row_is_complete, examples_depend_only_on_the_random_numbers)


def frames_leave_exactly_at_the_time_of_next_ns(simulator: AnySimulator) -> None:
    """Before this time nothing is sent. The same is valid after a restart, which cuts the frames on the wire."""
    module = simulator.make(SimulatorOptions(noise="none", skew_ppm=50.0), BEGIN_NS)
    now_ns, sent = BEGIN_NS, 0
    for number in range(60):
        next_ns = module.next_ns()
        assert next_ns is not None
        assert next_ns > now_ns or not number
        assert not list(module.advance(next_ns - 1))
        now_ns = next_ns
        frames: list[Any] = [*module.advance(now_ns)]
        assert frames
        assert all(frame.due_ns == now_ns for frame in frames)
        sent += len(frames)
        if number == 30:
            module.reboot(now_ns + 500_000)
    counters = module.counters()
    assert sent - 1 <= counters["frames_sent"] <= sent + 6  # a restart drops a frame, and a set is not complete


def the_crystal_and_the_boot_time_decide_the_times(simulator: AnySimulator) -> None:
    """A crystal that is 1 % fast makes all periods 1 % shorter. A device is silent while it boots."""
    spans_ns = []
    for skew_ppm in (0.0, 10_000.0):
        module = simulator.make(SimulatorOptions(noise="none", skew_ppm=skew_ppm, boot_ms=300), BEGIN_NS)
        frames: Sequence[Any] = [*module.advance(BEGIN_NS + 20 * NS_PER_S)]
        times_ns = [one.due_ns for one in frames if one.sample_ns is not None]
        assert BEGIN_NS + 300_000_000 < times_ns[0] < BEGIN_NS + 500_000_000
        spans_ns.append(times_ns[1000] - times_ns[0])
    assert abs(spans_ns[0] / spans_ns[1] - 1.01) < 1e-3 * 1.01


def the_driver_decodes_each_frame(simulator: AnySimulator) -> None:
    """Each burst with a sample makes one measurement, and the driver rejects and skips no byte."""
    driver = DRIVERS[simulator.name]
    if not isinstance(simulator, Simulator) or not isinstance(driver, StreamDriver):
        return
    module = simulator.make(SimulatorOptions(), BEGIN_NS)
    bursts = module.advance(BEGIN_NS + 3 * NS_PER_S)
    codec = driver.make_codec(Ledger(), driver.settings())
    events = feed_stream(codec, [burst.data for burst in bursts])
    sampled = sum(burst.sample_ns is not None for burst in bursts)
    assert len([event for event in events if isinstance(event, Measurement)]) == sampled > 0
    assert codec.ledger.frames_bad() == codec.ledger.bytes_skipped == codec.ledger.bytes_pending == 0


SIMULATOR_REQUIREMENTS: Final = (
    frames_leave_exactly_at_the_time_of_next_ns,
    the_crystal_and_the_boot_time_decide_the_times,
    the_driver_decodes_each_frame,
)
