"""Table: scales of raw values of HiPNUC modules to SI that two or more protocols share; and counts of SI values.

Manual "IMU配置手冊" V1.5.9: HI91 and HI92 in section 3.3, registers in section 4.2, TPDOs in section 5.2, PGNs in
section 6.1. A scale that one protocol has alone stands with its layout.

    quantity       HI91 (float)   HI92        Modbus, J1939   CANopen
    acceleration   G              own         G / 2048 *      0.001 G
    angular rate   °/s            own         0.061035 °/s    0.1 °/s
    field          µT             0.030517 µT on all three of them
    angles         °              0.001°      0.001°          0.01°
    quaternion     1              0.0001 on all (Modbus of older firmware: 2⁻¹⁵)

(*) printed as 0.00048828 G; 16 / 32768 G would be 2.6e-6 more.
"""

from math import isnan
from typing import Final

from imud.units import RAD_PER_DEG, T_PER_UT

M_S2_PER_G: Final = 9.8
"""The firmware divides m/s² by 9.8, so this G is not standard gravity."""
ACCEL_M_S2_PER_LSB: Final = 0.00048828 * M_S2_PER_G
GYRO_RAD_S_PER_LSB: Final = 0.061035 * RAD_PER_DEG
MAG_T_PER_LSB: Final = 0.030517 * T_PER_UT
"""As the manual prints it; 1000 / 32768 µT would be 1.9e-5 more."""
EULER_RAD_PER_LSB: Final = 0.001 * RAD_PER_DEG
QUAT_PER_LSB: Final = 0.0001
TEMPERATURE_C_PER_LSB: Final = 0.01
PRESSURE_PA_PER_LSB: Final = 0.01


def counts_of(value: float, bits: int) -> int:
    """Round to a count of a signed field, clipped to its range. Raises ValueError for NaN."""
    if isnan(value):
        raise ValueError("NaN has no count")
    most = 1 << bits - 1
    return round(max(-most, min(most - 1, value)))
