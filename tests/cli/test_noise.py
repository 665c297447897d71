"""Cells, comparisons and limits in a noise report."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from imud.analysis.noise import Coefficient
from imud.analysis.quantities import ShownUnit
from imud.analysis.series import FloatArray, Readings
from imud.cli import noise
from imud.cli.noise import text
from imud.cli.sample_set import SampleSet
from imud.contracts.driver import DataSheet, ModelFigures, SensorFigures
from imud.model.errors import BadArgument, ImudError
from tests.analysis.synthetic import stamps_ns, white
from tests.support.files import ROOT

RATE_HZ = 100.0
COUNT = 10_000
MILLI = ShownUnit("m", 1000.0)


def sample_set_of(values: FloatArray, driver: str = "hipnuc-canopen") -> SampleSet:
    readings = Readings(stamps_ns(len(values), RATE_HZ), values, None, None)
    return SampleSet("a file", "bow", driver, "can0", {"product": "HI14"}, readings=readings, stamps="edge")


def noise_of_three(n: float = 1e-3) -> FloatArray:
    random = np.random.default_rng(1)
    return np.stack([white(random, COUNT, RATE_HZ, n) for _ in range(3)], axis=1)


def test_cells_and_durations_and_figures_hold_or_not_and_open_ones_have_no_verdict() -> None:
    for figure, words in [
        (None, "-"), (Coefficient(0.00123456, 0.0, 0.0), "1.23"),
        (Coefficient(0.00123456, 0.0000412, 0.0), "1.23 ±0.04"), (Coefficient(None, 0.0, 0.005), "< 5"),
        (Coefficient(3.26e3, 3e2, 0.0), "3.26e6 ±3e5"),
    ]:  # fmt: skip
        assert noise.cell(figure, MILLI) == words == noise.narrow(words)
    assert noise.narrow("0.00666 ±0.0009") == "0.00666±0.0009"
    for seconds, words in [(12.34, "12.3 s"), (150.0, "2 min 30 s"), (7260.0, "2 h 1 min")]:
        assert noise.duration_words(seconds) == words
    sheet = ModelFigures(gyro=SensorFigures(random_walk=1.2e-3, noise_density=1e-3), source="a sheet")
    walk, density = noise.comparisons(noise.noise_report(sample_set_of(noise_of_three()), sheet), "gyro")
    assert (walk.quantity.key, walk.verdict) == ("random_walk", "within")
    assert walk.ratio == pytest.approx(1 / 1.2, rel=0.05)
    assert (density.quantity.key, density.verdict) == ("noise_density", "ABOVE")
    assert density.ratio == pytest.approx(np.sqrt(2), rel=0.05)
    sheet = ModelFigures(gyro=SensorFigures(bias_instability=1e-6, rate_random_walk=10.0), source="a sheet")
    bias, walk = noise.comparisons(noise.noise_report(sample_set_of(noise_of_three()), sheet), "gyro")
    assert (bias.measured, bias.verdict, walk.verdict) == (None, "not resolved", "within")


def test_what_limits_the_figures_and_what_is_not_compared() -> None:
    values = np.round(noise_of_three() / 1.7453293e-3) * 1.7453293e-3
    words = " ".join(noise.limits(noise.noise_report(sample_set_of(values), None), "gyro"))
    assert "multiples of 0.001745 rad/s (in the manual)" in words
    moved = noise_of_three()
    moved[2000:4000] += np.sin(np.arange(2000) / 10)[:, None]
    words = " ".join(noise.limits(noise.noise_report(sample_set_of(moved, "imu61x-can"), None), "gyro"))
    assert "DISTURBED: in 20 of 100 seconds" in words
    assert "filter of the device: low-pass 47 Hz (factory setting" in words
    words = text(noise.noise_report(sample_set_of(noise_of_three()), None))
    assert "bow: noise" in words
    head = f"\ngyroscope{'x':>39}{'y':>15}{'z':>15}\n  angle random walk N    deg/√h         3."
    assert head in words
    assert "product HI14" in words
    assert "No comparison with a data sheet: HiPNUC" in words
    made = noise.noise_report(sample_set_of(noise_of_three(), "<can>"), None)
    page = noise.html(replace(made, motion="it <turned>"))
    assert "<p class='above'>NOT AT REST: it &lt;turned&gt;. All values below" in page
    assert page.count("<h3>Comparison") == noise.html(made).count("class='above'") == 0
    assert f"<p>{noise.without_sheet(made).replace('<', '&lt;').replace('>', '&gt;')}.</p>" in page
    empty = Readings(stamps_ns(COUNT, RATE_HZ), None, None, None)
    with pytest.raises(ImudError, match="bow sends neither angular rate nor acceleration"):
        noise.noise_report(SampleSet("a file", "bow", readings=empty), None)
    with pytest.raises(ImudError, match="found no samples"):
        noise.noise_report(SampleSet("a file", "bow"), None)


def test_figures_become_si_and_those_of_the_user_come_first_and_what_is_wrong_is_named(tmp_path: Path) -> None:
    file = tmp_path / "sheet.yaml"
    file.write_text(
        "source: data sheet, table 2\n"
        "gyro: {random_walk_deg_sqrt_h: 0.3, bias_instability_deg_h: 2.5}\n"
        "accel: {noise_density_ug_sqrt_hz: 60, bias_instability_mg: 0.03}\n"
    )
    found = noise.read_sheet(file)
    assert found.source == "data sheet, table 2"
    assert found.gyro.random_walk == pytest.approx(0.3 * 2.9088821e-4)
    assert found.gyro.bias_instability == pytest.approx(2.5 * 4.8481368e-6)
    assert found.accel.noise_density == pytest.approx(60 * 9.80665e-6)
    assert found.accel.bias_instability == pytest.approx(0.03 * 9.80665e-3)
    assert found.accel.random_walk is None
    page = (ROOT / "docs/analysis.md").read_text()
    (tmp_path / "sheet.yaml").write_text(page.partition("```yaml\n")[2].partition("```")[0])
    found = noise.read_sheet(tmp_path / "sheet.yaml")
    for sensor in (found.gyro, found.accel):
        assert all(getattr(sensor, name) is not None for name in sensor.__struct_fields__)
    assert found.accel.temperature_slope == pytest.approx(0.05 * 9.80665e-3)
    with pytest.raises(BadArgument, match=r"--sheet .*none\.yaml"):
        noise.read_sheet(tmp_path / "none.yaml")
    given, stated = ModelFigures(source="given"), ModelFigures(source="stated")
    sheet = DataSheet(models={"HI14": stated})
    assert noise.figures_for(sheet, "HI14R2", given) is given
    assert noise.figures_for(sheet, "HI14R2", None) is stated
    assert noise.figures_for(sheet, "CH100", None) is None
    file = tmp_path / "sheet.yaml"
    for content, words in [
        ("gyro: {random_walk: 0.3}", "random_walk"), ("gyro: {random_walk_deg_sqrt_h: -1}", "gyro"),
        ("gyro: {random_walk_deg_sqrt_h: .nan}", "gyro"), ("gyroscope: {}", "gyroscope"), ("- 1", "mapping"),
        ("a: [", "YAML"), ("x" * 65537, "at most"),
    ]:  # fmt: skip
        file.write_text(content)
        with pytest.raises(BadArgument, match=words) as caught:
            noise.read_sheet(file)
        assert str(file) in str(caught.value)
