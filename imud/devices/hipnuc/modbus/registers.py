"""Registers of HiPNUC modules on Modbus: all of manual "IMU配置手冊" V1.5.9, section 4.2, and those of newer firmware.

Values of two registers have the high word first. Three departures from the table of the manual: the quaternion is
signed and its scale is 2⁻¹⁵ in older firmware and 0.0001 in newer (the codec decides by the values); 0.011 of the
inclinometer is 360/32768 or 180/32768, by product; MAIN_STATUS, the two of the magnetic calibration and UPTIME are of
newer firmware, as the vendor's own programs read them.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import tau
from typing import Final, Literal, get_args

from imud.devices.hipnuc.common.raw_units import (
    ACCEL_M_S2_PER_LSB,
    EULER_RAD_PER_LSB,
    GYRO_RAD_S_PER_LSB,
    MAG_T_PER_LSB,
    PRESSURE_PA_PER_LSB,
    TEMPERATURE_C_PER_LSB,
)


class Access(StrEnum):
    """Permitted accesses to a register."""

    READ = "R"
    WRITE = "W"
    BOTH = "R/W"


@dataclass(frozen=True, slots=True)
class Register:
    """A value in the registers: address, width, and scale to SI."""

    name: str
    address: int
    kind: str
    """u16, i16, u32, i32, or text."""
    count: int
    """Registers that it takes."""
    access: Access
    meaning: str
    scale: float = 1.0
    """SI value of one count; 1 where it is a plain number or decided elsewhere."""
    unit: str = ""
    """SI unit; empty for a plain number."""
    values: tuple[int, ...] | range = ()
    """Values that may be written, where these are limited."""


QUAT_OLD_PER_LSB: Final = 2.0**-15
INCLI_SINGLE_RAD_PER_LSB: Final = tau / 32768
INCLI_DUAL_RAD_PER_LSB: Final = tau / 2 / 32768

BaudRate = Literal[4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600, 256000]
BAUD_RATES: Final[tuple[BaudRate, ...]] = get_args(BaudRate)
"""By their code in UART1_BAUD (section 4.3.2); code 9 is not in the manual, the vendor's own programs have it."""
FACTORY_BAUD: Final[BaudRate] = 115200
ID_MAX: Final = 128
"""Highest ID that register MD_ID takes; more by serial number only."""

_R, _W, _RW = Access.READ, Access.WRITE, Access.BOTH

REGISTERS: Final = (
    Register("CTRL", 0x00, "u16", 1, _W, "0 saves all settings, 1 restores the factory's, 0xFF restarts",
             values=(0x0000, 0x0001, 0x00FF)),
    Register("UART1_BAUD", 0x04, "u16", 1, _RW, "baud rate by code, after a restart", values=range(len(BAUD_RATES))),
    Register("MD_ID", 0x05, "u16", 1, _RW, "address on the line, at once in force", values=range(1, ID_MAX + 1)),
    Register("HEADING_MODE", 0x06, "u16", 1, _RW, "0 six axes, heading from power-on; 1 nine axes", values=(0, 1)),
    Register("MAIN_STATUS", 0x09, "u16", 1, _R, "status bits, as in HI91"),
    Register("MAG_CALIBRATION", 0x0A, "u16", 1, _R, "state of the magnetic calibration"),
    Register("MAG_PROGRESS", 0x0B, "u16", 1, _R, "progress of the magnetic calibration in percent"),
    Register("ACCX", 0x34, "i16", 1, _R, "acceleration X", ACCEL_M_S2_PER_LSB, "m/s²"),
    Register("ACCY", 0x35, "i16", 1, _R, "acceleration Y", ACCEL_M_S2_PER_LSB, "m/s²"),
    Register("ACCZ", 0x36, "i16", 1, _R, "acceleration Z", ACCEL_M_S2_PER_LSB, "m/s²"),
    Register("GYRX", 0x37, "i16", 1, _R, "angular rate X", GYRO_RAD_S_PER_LSB, "rad/s"),
    Register("GYRY", 0x38, "i16", 1, _R, "angular rate Y", GYRO_RAD_S_PER_LSB, "rad/s"),
    Register("GYRZ", 0x39, "i16", 1, _R, "angular rate Z", GYRO_RAD_S_PER_LSB, "rad/s"),
    Register("MAGX", 0x3A, "i16", 1, _R, "magnetic field X", MAG_T_PER_LSB, "T"),
    Register("MAGY", 0x3B, "i16", 1, _R, "magnetic field Y", MAG_T_PER_LSB, "T"),
    Register("MAGZ", 0x3C, "i16", 1, _R, "magnetic field Z", MAG_T_PER_LSB, "T"),
    Register("ROLL", 0x3D, "i32", 2, _R, "roll", EULER_RAD_PER_LSB, "rad"),
    Register("PITCH", 0x3F, "i32", 2, _R, "pitch", EULER_RAD_PER_LSB, "rad"),
    Register("YAW", 0x41, "i32", 2, _R, "yaw, counter-clockwise", EULER_RAD_PER_LSB, "rad"),
    Register("TEMP", 0x43, "i16", 1, _R, "temperature", TEMPERATURE_C_PER_LSB, "°C"),
    Register("PRS", 0x44, "i32", 2, _R, "air pressure", PRESSURE_PA_PER_LSB, "Pa"),
    Register("Q0", 0x46, "i16", 1, _R, "quaternion W, scale by firmware"),
    Register("Q1", 0x47, "i16", 1, _R, "quaternion X"),
    Register("Q2", 0x48, "i16", 1, _R, "quaternion Y"),
    Register("Q3", 0x49, "i16", 1, _R, "quaternion Z"),
    Register("INCLI_X", 0x4A, "i16", 1, _R, "inclinometer X, ±180° or 0 … 360°, scale by product", unit="rad"),
    Register("INCLI_Y", 0x4B, "i16", 1, _R, "inclinometer Y, ±90°; reserved in single-axis products", unit="rad"),
    Register("UPTIME", 0x4C, "u32", 2, _R, "time since power-on", 0.001, "s"),
    Register("PNAME", 0x70, "text", 8, _R, "product, ASCII"),
    Register("SW_VERSION", 0x78, "u16", 1, _R, "firmware, 152 for 1.5.2"),
    Register("BL_VERSION", 0x79, "u16", 1, _R, "boot loader"),
    Register("SN", 0x7F, "text", 4, _R, "serial number, eight bytes"),
    Register("SET_LV", 0xA5, "u16", 1, _W, "2 level here, 3 only when nearly level, 5 cancels", values=(2, 3, 5)),
    Register("URFR", 0xA6, "u16", 1, _W, "mounting: 0 level, 1 Y down, 2 Y up, 3 X up, 4 X down", values=range(5)),
)  # fmt: skip
"""In the order of their addresses."""

BY_NAME: Final = {register.name: register for register in REGISTERS}

BLOCK_FIRST: Final = BY_NAME["ACCX"].address
BLOCK_REGISTERS: Final = BY_NAME["UPTIME"].address + 2 - BLOCK_FIRST
"""0x34 … 0x4D: all that is measured, and the device's time."""
SHORT_BLOCK_REGISTERS: Final = BY_NAME["UPTIME"].address - BLOCK_FIRST
"""0x34 … 0x4B: the same in firmware without UPTIME."""
IDENTITY_FIRST: Final = BY_NAME["PNAME"].address
IDENTITY_REGISTERS: Final = 20
"""0x70 … 0x83, as in the manual's example (section 4.4)."""
