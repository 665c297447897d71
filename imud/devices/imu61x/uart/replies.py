"""Replies of the Forsense IMU61x on a UART: status S1, parameter P1, acknowledgement K1. Manual sections 1.4 to 1.7.

    S1, id 0x00FF, 22 … 66 bytes and more   software u32 | hardware u32 | model u16 | serial number 3 u32 |
                                            system status u32 | CPU load u16 | drop rate u16 | I2C master u8 |
                                            voltage u8 | user configuration u8 | calibration u8 | IMU health 32 u8
    P1, id 0x0006, 24 bytes                 value f32 | 0 f32 | index u32 | 0 u32 | 0 i32 | 0 i32
    K1, any id, 4 bytes                     command u16 | result u16

S1 is shorter or longer by model; what lies behind the serial number is as the vendor's programs have it, its units and
codes are not documented. Nor is the id of K1, so any frame with 4 bytes of payload is one, and its result is kept as
sent: that 0 means done is assumed.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from imud.contracts.codec import Message, ReplyFrame

STATUS_FRAME: Final = 0x00FF
PARAMETER_FRAME: Final = 0x0006

_STATUS_HEAD: Final = struct.Struct("<IIH3I")  # 22 bytes: what every model sends
_STATUS_REST: Final = struct.Struct("<IHHBBBB32s")
_STATUS_STEPS: Final = tuple(_STATUS_HEAD.size + n for n in (4, 6, 8, 9, 10, 11, 12, 44))
"""End offset of each member of the rest; a member that is not complete is absent."""
STATUS_BYTES_MIN: Final = _STATUS_HEAD.size
PARAMETERS: Final = struct.Struct("<ffIIii")
"""P1, and R1 of commands: value, 0, index, 0, 0, 0 (tables 8 and 11)."""
ACKNOWLEDGEMENT: Final = struct.Struct("<HH")

RESULT_DONE: Final = 0
"""Result of K1 for a command that was carried out; assumed."""


class Parameter(IntEnum):
    """Parameters that can be read, by their index (table 9)."""

    BAUD = 3
    """Rate of the UART, bit/s."""
    GYRO_X_OFF = 8
    """Zero bias found by the static calibration, °/s; Y and Z as well."""
    GYRO_Y_OFF = 9
    GYRO_Z_OFF = 10
    INSTALL_X_OFF = 16
    """Mounting error angle, °; Y and Z as well."""
    INSTALL_Y_OFF = 17
    INSTALL_Z_OFF = 18
    AHRS_RATE = 21
    """AHRS frames per second, Hz."""
    BUS_MODE = 27
    """The second bus, next to the UART, see `commands.BusMode`."""
    I2C_ADDRESS = 30
    FILTER = 31
    """Filter codes as in FILTER_CTRL, see `filter_codes` of `common/family.py`."""


@dataclass(frozen=True, slots=True)
class Status:
    """S1. Members that the model does not send are None; codes are as sent."""

    software_version: int
    hardware_version: int
    model: int
    serial_number: tuple[int, int, int]
    system_status: int | None = None
    cpu_load: int | None = None
    drop_rate: int | None = None
    i2c_master: int | None = None
    voltage: int | None = None
    user_config_status: int | None = None
    calibration_status: int | None = None
    imu_health: bytes | None = None
    """32 bytes."""


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """P1."""

    index: int
    value: float


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """K1."""

    command: int
    result: int
    """The raw value."""


def is_reply(frame_id: int, payload: bytes) -> bool:
    """Whether a frame is S1, P1 or K1 by its id and length."""
    size = len(payload)
    return (
        size == ACKNOWLEDGEMENT.size
        or (frame_id == STATUS_FRAME and size >= STATUS_BYTES_MIN)
        or (frame_id == PARAMETER_FRAME and size >= PARAMETERS.size)
    )


def parse_status(message: Message) -> Status | None:
    """S1 of any length from 22 bytes on; None for anything else."""
    if not isinstance(message, ReplyFrame) or message.frame_id != STATUS_FRAME:
        return None
    payload = message.payload
    if len(payload) < STATUS_BYTES_MIN:
        return None
    software, hardware, model, *serial = _STATUS_HEAD.unpack_from(payload)
    padded = payload[STATUS_BYTES_MIN:].ljust(_STATUS_REST.size, b"\x00")
    rest = [
        value if len(payload) >= end else None
        for value, end in zip(_STATUS_REST.unpack_from(padded), _STATUS_STEPS, strict=True)
    ]
    return Status(software, hardware, model, (serial[0], serial[1], serial[2]), *rest)


def parse_parameter(message: Message) -> ParameterValue | None:
    """P1; None for anything else. Its value may be NaN or infinite."""
    if not isinstance(message, ReplyFrame) or message.frame_id != PARAMETER_FRAME:
        return None
    if len(message.payload) < PARAMETERS.size:
        return None
    value, _, index, *_ = PARAMETERS.unpack_from(message.payload)
    return ParameterValue(index, value)


def parse_acknowledgement(message: Message) -> Acknowledgement | None:
    """K1; None for anything else."""
    if not isinstance(message, ReplyFrame) or len(message.payload) != ACKNOWLEDGEMENT.size:
        return None
    return Acknowledgement(*ACKNOWLEDGEMENT.unpack(message.payload))


# --- the device's side ------------------------------------------------------------------------------------------------


def pack_status(status: Status) -> bytes:
    """Payload of S1, up to the first member that is None."""
    head = _STATUS_HEAD.pack(status.software_version, status.hardware_version, status.model, *status.serial_number)
    rest = (
        status.system_status, status.cpu_load, status.drop_rate, status.i2c_master, status.voltage,
        status.user_config_status, status.calibration_status, status.imu_health,
    )  # fmt: skip
    there = next((n for n, value in enumerate(rest) if value is None), len(rest))
    values = [b"" if n == 7 else 0 for n in range(8)]
    values[:there] = [value for value in rest[:there] if value is not None]
    end = _STATUS_STEPS[there - 1] if there else STATUS_BYTES_MIN
    return (head + _STATUS_REST.pack(*values))[:end]


def pack_parameters(value: float, index: int) -> bytes:
    """Payload of P1 and of a command (R1). Raises OverflowError for a value beyond 32-bit floats."""
    return PARAMETERS.pack(value, 0.0, index, 0, 0, 0)


def pack_acknowledgement(command: int, result: int) -> bytes:
    """Payload of K1."""
    return ACKNOWLEDGEMENT.pack(command, result)
