"""Table: what the Forsense manual states of the sensors' noise, resolution and filters.

Manual of the IMU61x (A): no chapter states random walk, bias instability, noise density or a drift with temperature of
any model; the low-pass filters are in section 2.4.2, table 21, and are 47 Hz as delivered (section 1.6, parameter 31:
0xBB).
"""

from collections.abc import Mapping
from typing import Final

from imud.contracts.sensors.data_sheet import DataSheet, SensorName
from imud.devices.imu61x.common.family import FILTER_DEFAULT, FILTERS, filter_codes


def filter_words(settings: Mapping[str, str], sensor: SensorName) -> str:
    """Describe the low-pass filter of a sensor, from the settings as read back."""
    read = settings.get(f"{sensor}_filter")
    if read is not None:
        return f"low-pass {read}"
    accel, gyro = filter_codes(FILTER_DEFAULT)
    return f"low-pass {FILTERS[accel if sensor == 'accel' else gyro]} as delivered; it was not read back"


SHEET: Final = DataSheet(
    document="Forsense IMU61x manual (IMU612, IMU614, IMU618, IMU6132A, IMU6132B): no figure of noise for any model",
    filter_words=filter_words,
)
