"""`imud schema`: fields of a sample, and the conventions of the drivers."""

import json

from imud.cli.schema import driver_schemas
from imud.drivers import DRIVERS
from imud.model.sample import SAMPLE_FIELDS
from tests.cli.conftest import Cli


def test_schema_has_every_field_and_every_driver(cli: Cli) -> None:
    text = cli("schema").out
    for word in ("accel_m_s2", "m/s²", "gyro_rad_s", "rad/s", "hipnuc-uart", "ENU"):
        assert word in text
    row = next(line for line in text.splitlines() if "magnetic disturbance" in line)
    assert row.split()[:2] == ["hipnuc-uart", "4"]
    found = json.loads(cli("schema", "--json").out)
    assert tuple(field["name"] for field in found["fields"]) == SAMPLE_FIELDS
    assert found["drivers"].keys() == DRIVERS.keys() == driver_schemas().keys()
    assert found["drivers"]["hipnuc-uart"]["navigation_frame"] == "ENU"
    assert found["drivers"]["hipnuc-uart"]["status_bits"]["3"] == "gyroscope bias not converged"
