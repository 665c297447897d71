"""Table: what the HiPNUC manual states of the sensors' noise, resolution and filters.

Manual "IMU配置手冊" V1.5.9, CH0x0, CH10x, HI14: it describes protocols and configuration. No chapter states random
walk, bias instability, noise density, drift with temperature, range or a low-pass filter of any model; section 8.1
speaks of the nominal accuracy of "the manual", which is another document. The steps of values on the wire are those of
sections 4.2 and 6.1 (Modbus, J1939) and 5.2 (CANopen); HI91 has floats (3.3.1), and HI92 other steps (3.3.2).
"""

from typing import Final

from imud.contracts.sensors.data_sheet import DataSheet
from imud.devices.hipnuc.common.raw_units import ACCEL_M_S2_PER_LSB, GYRO_RAD_S_PER_LSB

DOCUMENT: Final = "HiPNUC IMU configuration manual V1.5.9 (CH0x0, CH10x, HI14): no figure of noise for any model"
FLOATS: Final = DataSheet(document=DOCUMENT)
"""Of the UART."""
REGISTERS: Final = DataSheet(document=DOCUMENT, gyro_step_rad_s=GYRO_RAD_S_PER_LSB, accel_step_m_s2=ACCEL_M_S2_PER_LSB)
"""Of Modbus and J1939."""
