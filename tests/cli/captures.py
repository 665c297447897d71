"""Captures of a HiPNUC device with chosen values, a crystal error and lost samples."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from imud.analysis.series import FloatArray
from imud.drivers.hipnuc.uart.codec import encode_hi91
from imud.model.units import NS_PER_S
from tests.support.files import CaptureWriter

BEGIN_NS = 1000 * NS_PER_S
BAUD = 921_600


def frame(system_time_ms: int, accel: FloatArray, gyro: FloatArray, temperature_c: float = 25.0) -> bytes:
    return encode_hi91(
        system_time_ms=system_time_ms, accel_m_s2=(float(accel[0]), float(accel[1]), float(accel[2])),
        gyro_rad_s=(float(gyro[0]), float(gyro[1]), float(gyro[2])), mag_t=(0.0, 0.0, 0.0), euler_rad=(0.0, 0.0, 0.0),
        quat_wxyz=(1.0, 0.0, 0.0, 0.0), temperature_c=round(temperature_c), pressure_pa=1e5,
    )  # fmt: skip


def write_capture(
    file: Path, accel: FloatArray, gyro: FloatArray, *, rate_hz: float, fast: float = 0.0,
    missing: Collection[int] = (), temperature_c: FloatArray | None = None,
) -> Path:  # fmt: skip
    """Write samples, shape (n, 3), of a device at `rate_hz` with a crystal error of `fast` (0.02: 2 %).

    The frames contain the device time in ms. The host reads each frame without a delay.
    """
    gone = set(missing)
    with file.open("wb") as out:
        writer = CaptureWriter(out, driver="hipnuc-uart", baud=BAUD)
        for number in range(len(accel)):
            if number not in gone:
                warm = 25.0 if temperature_c is None else float(temperature_c[number])
                data = frame(int(1000 * number / rate_hz), accel[number], gyro[number], warm)
                writer.write(data, BEGIN_NS + round(number * NS_PER_S / (rate_hz * (1 + fast))))
    return file


def shaken(count: int, rate_hz: float, frequency_hz: float, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    """Return 2 m/s² along z at one frequency plus noise, and noise of a gyroscope."""
    random = np.random.default_rng(seed)
    accel = 0.05 * random.standard_normal((count, 3)) + np.array([0.0, 0.0, 9.8])
    accel[:, 2] += 2.0 * np.sin(2 * np.pi * frequency_hz * np.arange(count) / rate_hz)
    return accel, 1e-3 * random.standard_normal((count, 3))


def resting(count: int, rate_hz: float, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    """White noise on both sensors: N = 5e-4 (m/s²)/√Hz and 1e-4 (rad/s)/√Hz."""
    random = np.random.default_rng(seed)
    accel = 5e-4 * np.sqrt(rate_hz) * random.standard_normal((count, 3)) + np.array([0.0, 0.0, 9.8])
    return accel, 1e-4 * np.sqrt(rate_hz) * random.standard_normal((count, 3))
