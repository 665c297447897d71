"""`imud schema` says what the fields of a sample mean, and how drivers differ."""

import json

import pytest

from imud.cli import main
from imud.cli.schema import driver_schemas
from imud.devices import DRIVERS
from imud.sample import SAMPLE_FIELDS


def test_schema_names_the_status_bits_of_each_driver(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "magnetic disturbance" in line)
    assert row.split()[:2] == ["hipnuc-uart", "4"]
    assert main(["schema", "--json"]) == 0
    assert '"status_bits":{"3":"gyroscope bias not converged",' in capsys.readouterr().out


def test_schema_names_every_field_with_its_unit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema"]) == 0
    text = capsys.readouterr().out
    for word in ("accel_m_s2", "m/s²", "gyro_rad_s", "rad/s", "hipnuc-uart", "ENU"):
        assert word in text


def test_json_has_every_field_and_every_driver(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert tuple(field["name"] for field in found["fields"]) == SAMPLE_FIELDS
    assert found["drivers"].keys() == DRIVERS.keys() == driver_schemas().keys()
    assert found["drivers"]["hipnuc-uart"]["navigation_frame"] == "ENU"
