"""Draws the pictures of docs/analysis.md: `python -m docs.generate.analysis_pictures` (`make pictures`).

The commands draw simulated sensors with known noise. `noise.svg`: a gyroscope with the coefficients that
docs/analysis.md names, two hours at 100 Hz. `noise_page.png`: the start of the page of `imud noise -o` for this
gyroscope and an accelerometer, in chromium; without chromium, the picture does not change. `vibration.png`: an
accelerometer at 400 Hz on a starting motor; its crystal is 2 % fast, and 1 % of the samples are lost.
"""

import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from imud.analysis.noise import SensorNoise, sensor_noise
from imud.analysis.plots import SensorVibration, deviation_figure, spectrum_figure
from imud.analysis.quantities import DEG_PER_RAD, ROOT_S_PER_ROOT_H, S_PER_H
from imud.analysis.series import Readings
from imud.cli.noise import figures_for, html, noise_report, picture
from imud.cli.sample_set import SampleSet
from imud.cli.spectrum import SpectrumOptions, sensor_vibration
from tests.analysis.synthetic import flicker, random_walk, stamps_ns, white
from tests.support.files import ROOT

FOLDER: Final = ROOT / "docs/pictures"
SEED: Final = 15
RATE_HZ, HOURS = 100.0, 2
N_DEG_SQRT_H, B_DEG_H, K_DEG_H_SQRT_H = 0.3, 4.0, 20.0  # noise coefficients of all three axes
VRW_M_S_SQRT_H = 0.03
PRODUCT = "HI14R3"
PAGE_SIZE, PAGE_LIMIT_S = "960,1240", 120.0
VIBRATION_HZ, VIBRATION_S = 408.0, 60
# Times of the start and the full speed of the motor, s, and the full speed, Hz
START_S, FULL_S, FULL_HZ = 15.0, 30.0, 48.3


def turn_rates() -> NDArray[np.float64]:
    random, count = np.random.default_rng(SEED), int(HOURS * S_PER_H * RATE_HZ)
    axes = [
        white(random, count, RATE_HZ, N_DEG_SQRT_H / DEG_PER_RAD / ROOT_S_PER_ROOT_H)
        + flicker(random, count, B_DEG_H / DEG_PER_RAD / S_PER_H)
        + random_walk(random, count, RATE_HZ, K_DEG_H_SQRT_H / DEG_PER_RAD / S_PER_H / ROOT_S_PER_ROOT_H)
        for _ in range(3)
    ]
    return np.stack(axes, axis=1)


def gyroscope() -> SensorNoise:
    values = turn_rates()
    return sensor_noise(Readings(stamps_ns(len(values), RATE_HZ), values, None, None), values)


def page() -> str:
    gyro = turn_rates()
    random, count = np.random.default_rng(SEED + 1), len(gyro)
    axes = [white(random, count, RATE_HZ, VRW_M_S_SQRT_H / ROOT_S_PER_ROOT_H) for _ in range(3)]
    accel = np.stack(axes, axis=1) + np.array([0.0, 0.0, 9.8])
    sample_set = SampleSet(
        "simulated", "bow", "hipnuc-uart", identity={"product": PRODUCT},
        readings=Readings(stamps_ns(count, RATE_HZ), gyro, accel, None), stamps="true",
    )  # fmt: skip
    return html(noise_report(sample_set, figures_for(sample_set.sheet, PRODUCT, None)))


def noise_page_png(chromium: str) -> bytes:
    with tempfile.TemporaryDirectory(prefix="imud-") as name:
        file, picture_file = Path(name) / "noise.html", Path(name) / "noise.png"
        file.write_text(page())
        argv = [
            chromium, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={name}/of",
            f"--screenshot={picture_file}", f"--window-size={PAGE_SIZE}", file.as_uri(),
        ]  # fmt: skip
        subprocess.run(argv, check=True, capture_output=True, timeout=PAGE_LIMIT_S)
        return picture_file.read_bytes()


def machine() -> SensorVibration:
    """Return the vibration of a motor with an imbalance, its second harmonic, and a resonance during the start."""
    random, count = np.random.default_rng(SEED), int(VIBRATION_HZ * VIBRATION_S)
    t_s = np.arange(count) / VIBRATION_HZ
    speed_hz = FULL_HZ * np.clip((t_s - START_S) / (FULL_S - START_S), 0, 1)
    turn = 2 * np.pi * np.cumsum(speed_hz) / VIBRATION_HZ
    imbalance = (speed_hz / FULL_HZ) ** 2
    values = 0.03 * random.standard_normal((count, 3)) + np.array([0.0, 0.0, 9.8])
    values[:, 0] += 1.2 * imbalance * np.sin(turn)
    values[:, 2] += 0.8 * imbalance * np.cos(turn) + 0.25 * imbalance * np.sin(2 * turn)
    values[:, 1] += 0.1 * np.sin(2 * np.pi * 100.0 * t_s)
    keep = np.sort(random.choice(count, round(0.99 * count), replace=False))
    readings = Readings(stamps_ns(count, VIBRATION_HZ)[keep], None, values[keep], None)
    return sensor_vibration(readings, values[keep], SpectrumOptions(("accel",)))


def noise_svg() -> bytes:
    return picture(deviation_figure("gyro", gyroscope()), ".svg")


def vibration_png() -> bytes:
    sensor = machine()
    facts = f"set to 400 Hz, true rate {sensor.grid.rate_hz:.3f} Hz, {sensor.grid.missing} samples missing"
    return picture(spectrum_figure({"accel": sensor}, "A machine that starts after 15 s", [facts]), ".png")


if __name__ == "__main__":
    (FOLDER / "noise.svg").write_bytes(noise_svg())
    (FOLDER / "vibration.png").write_bytes(vibration_png())
    if browser := shutil.which("chromium"):
        (FOLDER / "noise_page.png").write_bytes(noise_page_png(browser))
