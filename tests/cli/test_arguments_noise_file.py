"""Deviations from a report of `imud noise --json`, and invalid reports."""

import json
from pathlib import Path
from typing import Any

import pytest

from imud.cli.arguments import read_noise
from imud.contracts.status import Deviations
from imud.model.errors import ImudError


def report(**sensors: list[float]) -> dict[str, Any]:
    """Return a report with the used members and some others."""
    found: dict[str, Any] = {}
    for name, values in sensors.items():
        axes = zip("xyz", values, strict=True)
        found[name] = {"unit": "x", "axes": {axis: {"spread": {"value": value, "si": "x"}} for axis, value in axes}}
    return {"measurement": {"device": "bow", "imud": "1"}, "sensors": found, "data_sheet": None}


def written(tmp_path: Path, content: object) -> Path:
    file = tmp_path / "noise.json"
    file.write_text(json.dumps(content))
    return file


def test_deviations_are_the_quadratic_mean_of_the_axes(tmp_path: Path) -> None:
    file = written(tmp_path, report(gyro=[0.001, 0.007, 0.005], accel=[0.02, 0.02, 0.02]))
    device, noise = read_noise(file)
    assert device == "bow"
    assert noise.gyro_rad_s == pytest.approx(0.005)  # (1 + 49 + 25) / 3 = 25
    assert noise.accel_m_s2 == pytest.approx(0.02)
    assert (noise.mag_t, noise.attitude_rad) == (None, None)
    assert read_noise(written(tmp_path, report(gyro=[0.0, 0.0, 0.0])))[1] == Deviations()
    with pytest.raises(ImudError, match=r"nothing\.json: expected a report"):
        read_noise(tmp_path / "nothing.json")
    moved = report(gyro=[0.001, 0.007, 0.005]) | {"at_rest": False, "motion": "angular rate: too large"}
    with pytest.raises(ImudError, match=r"at rest, got motion \(angular rate: too large\); measure again"):
        read_noise(written(tmp_path, moved))
    had = Deviations(gyro_rad_s=1.0, mag_t=2.0)
    assert had.updated(Deviations(gyro_rad_s=3.0, accel_m_s2=4.0)) == Deviations(
        gyro_rad_s=3.0, mag_t=2.0, accel_m_s2=4.0
    )
    for content in [[], {}, {"measurement": {"device": "bow"}, "sensors": {"gyro": 1}}, "text"]:
        with pytest.raises(ImudError, match="expected a report of `imud noise --json`"):
            read_noise(written(tmp_path, content))
