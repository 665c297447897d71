"""The sensor inside every simulated device follows the options."""

from typing import Any

import pytest

from imud.model.units import NS_PER_S
from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.sim.physics import Noise, swing
from imud.sim.sensor import SensorHardware, SimulatorOptions, sensor_of

OPTIONS = SimulatorOptions(gravity_m_s2=9.7, noise="none", skew_ppm=-35.0, boot_ms=7, processing_ns=11)


def test_every_option_of_the_sensor_arrives() -> None:
    sensor = SensorHardware(**sensor_of(OPTIONS))
    assert (sensor.skew_ppm, sensor.boot_ms, sensor.processing_ns) == (-35.0, 7, 11)
    made = SensorHardware()
    assert (made.skew_ppm, made.boot_ms, made.processing_ns) == (20.0, 500, 125_000)
    assert sensor.noise is None
    assert sensor.reading(1.25) == swing(9.7).at(1.25)
    sensor = SensorHardware(**sensor_of(SimulatorOptions(seed=3)))
    assert sensor.reading(0.5) == Noise(3).add(swing().at(0.5), 0.5) != swing().at(0.5)
    with pytest.raises(ValueError, match="motion 'dance': expected"):
        sensor_of(SimulatorOptions(motion="dance"))


BEGIN_NS = 5 * NS_PER_S


@pytest.mark.parametrize("name", [*(name for name in SIMULATORS if name != "hipnuc-modbus"), *CAN_SIMULATORS])
def test_a_device_sends_exactly_at_the_time_of_next_ns(name: str) -> None:
    """Before this time nothing is sent. The same is valid after a restart, which cuts the frames on the wire."""
    simulator = SIMULATORS[name] if name in SIMULATORS else CAN_SIMULATORS[name]
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


@pytest.mark.parametrize("name", [*(name for name in SIMULATORS if name != "hipnuc-modbus"), *CAN_SIMULATORS])
def test_the_crystal_and_the_boot_time_decide_the_times_of_frames(name: str) -> None:
    """A crystal that is 1 % fast makes all periods 1 % shorter. A device is silent while it boots."""
    simulator = SIMULATORS[name] if name in SIMULATORS else CAN_SIMULATORS[name]
    spans_ns = []
    for skew_ppm in (0.0, 10_000.0):
        module = simulator.make(SimulatorOptions(noise="none", skew_ppm=skew_ppm, boot_ms=300), BEGIN_NS)
        frames: list[Any] = [*module.advance(BEGIN_NS + 20 * NS_PER_S)]
        times_ns = [one.due_ns for one in frames if one.sample_ns is not None]
        assert BEGIN_NS + 300_000_000 < times_ns[0] < BEGIN_NS + 500_000_000
        spans_ns.append(times_ns[1000] - times_ns[0])
    assert spans_ns[0] / spans_ns[1] == pytest.approx(1.01, rel=1e-3)
