"""The sensor inside every simulated device follows the options."""

import pytest

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
