"""Files with data sheet values: units and errors."""

from pathlib import Path

import pytest

from imud.cli.noise import SHEET_BYTES_MOST, figures_for, read_sheet
from imud.contracts.driver import DataSheet, ModelFigures
from imud.model.errors import BadArgument
from tests.support.files import ROOT


def test_figures_become_si_and_those_of_the_user_come_first(tmp_path: Path) -> None:
    file = tmp_path / "sheet.yaml"
    file.write_text(
        "source: data sheet, table 2\n"
        "gyro: {random_walk_deg_sqrt_h: 0.3, bias_instability_deg_h: 2.5}\n"
        "accel: {noise_density_ug_sqrt_hz: 60, bias_instability_mg: 0.03}\n"
    )
    found = read_sheet(file)
    assert found.source == "data sheet, table 2"
    assert found.gyro.random_walk == pytest.approx(0.3 * 2.9088821e-4)
    assert found.gyro.bias_instability == pytest.approx(2.5 * 4.8481368e-6)
    assert found.accel.noise_density == pytest.approx(60 * 9.80665e-6)
    assert found.accel.bias_instability == pytest.approx(0.03 * 9.80665e-3)
    assert found.accel.random_walk is None
    page = (ROOT / "docs/analysis.md").read_text()
    (tmp_path / "sheet.yaml").write_text(page.partition("```yaml\n")[2].partition("```")[0])
    found = read_sheet(tmp_path / "sheet.yaml")
    for sensor in (found.gyro, found.accel):
        assert all(getattr(sensor, name) is not None for name in sensor.__struct_fields__)
    assert found.accel.temperature_slope == pytest.approx(0.05 * 9.80665e-3)
    with pytest.raises(BadArgument, match=r"--sheet .*none\.yaml"):
        read_sheet(tmp_path / "none.yaml")
    given, stated = ModelFigures(source="given"), ModelFigures(source="stated")
    sheet = DataSheet(models={"HI14": stated})
    assert figures_for(sheet, "HI14R2", given) is given
    assert figures_for(sheet, "HI14R2", None) is stated
    assert figures_for(sheet, "CH100", None) is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("gyro: {random_walk: 0.3}", "random_walk"), ("gyro: {random_walk_deg_sqrt_h: -1}", "gyro"),
        ("gyro: {random_walk_deg_sqrt_h: .nan}", "gyro"), ("gyroscope: {}", "gyroscope"), ("- 1", "mapping"),
        ("a: [", "YAML"), ("x" * (SHEET_BYTES_MOST + 1), "at most"),
    ],
    ids=["unknown figure", "negative", "not a number", "unknown sensor", "a list", "no YAML", "too long"],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "sheet.yaml"
    file.write_text(text)
    with pytest.raises(BadArgument, match=words) as caught:
        read_sheet(file)
    assert str(file) in str(caught.value)
