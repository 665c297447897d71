"""Commands to the Forsense IMU61x on a UART. Manual "IMU61X Interface Protocol", section 1.6, tables 10 to 12.

    55 AA | command u16 | 24 u16 | param1 f32 | 0 f32 | param3 u32 | 0 u32 | 0 i32 | 0 i32 | CRC-32

Each function returns a `Request`. Values are checked where they enter, by the annotations of `actions.py`: for one that
the device does not have it would silently use a default instead. Settings last until power is off unless `save`
follows. Whether the device accepts more than `output_mode` while it streams is not documented; `session.py` does not
depend on it.

Commands that change something are acknowledged (K1). Its result is not judged here, because its codes are not
documented: any K1 for the command ends the reply. `contact.py` judges it, by one option of the driver.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final, Literal, get_args

from imud.contracts.codec import Message
from imud.contracts.session import Request, never
from imud.devices.imu61x.common.family import filter_control
from imud.devices.imu61x.uart.framing import HOST_SYNC, OVERHEAD_BYTES, encode_frame
from imud.devices.imu61x.uart.replies import (
    Parameter,
    pack_parameters,
    parse_acknowledgement,
    parse_parameter,
    parse_status,
)
from imud.errors import BadArgument
from imud.sample import Measurement
from imud.units import BITS_PER_UART_BYTE, NS_PER_MS, NS_PER_S

BaudRate = Literal[115200, 921600, 460800, 230400, 1500000]
"""A rate of table 12, bit/s."""
BAUD_RATES: Final[tuple[BaudRate, ...]] = get_args(BaudRate)
"""All baud rates, the factory setting first, then those usual for 200 and 400 Hz."""
RateHz = Literal[1, 10, 50, 100, 200, 400]
"""An AHRS output rate of table 12."""
RATES_HZ: Final[tuple[RateHz, ...]] = get_args(RateHz)
"""All of them."""
AHRS_FRAME_BYTES: Final = OVERHEAD_BYTES + 44
REPLY_TIMEOUT_NS: Final = 300 * NS_PER_MS
"""A reply of 76 bytes takes 7 ms at 115200 baud, and a USB adapter holds it for 16 ms; the manual gives no time."""
FLASH_TIMEOUT_NS: Final = 5 * NS_PER_S
"""Erasing and writing flash may take 2 s; the manual gives no time."""
CALIBRATION_TIMEOUT_NS: Final = 10 * NS_PER_S
"""A calibration until its acknowledgement, which may come at its begin or at its end; assumed."""


class Command(Enum):
    """Numbers of commands (table 12)."""

    STATUS = 1
    AHRS = 2
    OUTPUT_MODE = 3
    HEADING = 4
    SAVE = 5
    READ_PARAMETER = 6
    CALIBRATE_INSTALLATION = 7
    INSTALLATION_STATUS = 8
    RESTART = 9
    CALIBRATE_GYRO = 10
    SET_PARAMETER = 14
    FACTORY_RESET = 15


class OutputMode(Enum):
    """Messages that the device sends without a request."""

    STREAM = 1
    """Sends AHRS frames."""
    COMMAND = 100
    """Sends nothing but replies."""


class BusMode(Enum):
    """The second bus of the device, next to the UART (parameter 27)."""

    UART_ONLY = 0
    SPI = 1
    """Factory setting."""
    I2C = 2
    BY_PIN = 3
    """A pin decides: open or low is SPI, high is I2C."""


# --- questions --------------------------------------------------------------------------------------------------------


def ask_status() -> Request:
    """Ask for S1: versions, model, serial number, status (CMD 1)."""
    return _command(Command.STATUS, "status", is_end=lambda message: parse_status(message) is not None)


def ask_ahrs() -> Request:
    """Ask for one AHRS frame (CMD 2). It comes as a measurement, which ends the reply, and is published as any other.

    While the device streams, the measurement may be the next of the stream.
    """
    return _command(Command.AHRS, "AHRS once", is_end=never, is_sample=any_sample)


def await_sample(timeout_ns: int) -> Request:
    """Wait for the next measurement without a command."""
    return Request(b"", "sample", never, never, never, timeout_ns, is_sample=any_sample)


def any_sample(_sample: Measurement) -> bool:
    """Return True: every measurement of the device will do."""
    return True


def read_parameter(parameter: Parameter) -> Request:
    """Ask for a parameter (CMD 6)."""

    def is_end(message: Message) -> bool:
        value = parse_parameter(message)
        return value is not None and value.index == parameter

    return _command(Command.READ_PARAMETER, f"read parameter {parameter.name}", param3=parameter, is_end=is_end)


def ask_installation_status() -> Request:
    """Ask for the state of the installation error calibration (CMD 8).

    Whether K1 or S1 carries the answer is not documented: both are accepted.
    """
    command = Command.INSTALLATION_STATUS
    acknowledged = _acknowledges(command)
    return _command(
        command,
        "installation calibration status",
        is_end=lambda message: acknowledged(message) or parse_status(message) is not None,
    )


# --- orders -----------------------------------------------------------------------------------------------------------


def output_mode(mode: OutputMode, *, baud: int = 0) -> Request:
    """Stream AHRS frames, or only reply (CMD 3). With `baud`, the line is set to that rate first."""
    return _command(Command.OUTPUT_MODE, f"output mode {mode.name}", param1=mode.value, baud=baud)


def reset_heading(heading_deg: float) -> Request:
    """Make the heading of the AHRS 0° … 360° (CMD 4)."""
    return _command(Command.HEADING, "heading reset", param1=heading_deg)


def save() -> Request:
    """Write the present parameters to flash, the output mode included (CMD 5)."""
    return _command(Command.SAVE, "save", timeout_ns=FLASH_TIMEOUT_NS)


def start_installation_calibration() -> Request:
    """Begin to measure the mounting error (CMD 7); `ask_installation_status` asks for its progress."""
    return _command(Command.CALIBRATE_INSTALLATION, "installation calibration", timeout_ns=CALIBRATION_TIMEOUT_NS)


def restart() -> Request:
    """Start the device's software anew (CMD 9)."""
    return _command(Command.RESTART, "restart")


def calibrate_gyro() -> Request:
    """Measure the zero bias of the gyroscope (CMD 10); the device must be at rest."""
    return _command(Command.CALIBRATE_GYRO, "gyro calibration", timeout_ns=CALIBRATION_TIMEOUT_NS)


def set_baud(baud: int) -> Request:
    """Set the rate of the UART (CMD 14, parameter 3). `session.change_baud` does it without losing the device."""
    return _set(Parameter.BAUD, baud)


def set_rate(rate_hz: int, *, baud: int = 0) -> Request:
    """Set the AHRS output rate (CMD 14, parameter 21). With `baud`, raises BadArgument if it does not fit."""
    if baud:
        require_fit(rate_hz, baud)
    return _set(Parameter.AHRS_RATE, rate_hz)


def set_bus_mode(mode: BusMode) -> Request:
    """Choose the second bus, next to the UART (CMD 14, parameter 27)."""
    return _set(Parameter.BUS_MODE, mode.value)


def set_i2c_address(address: int) -> Request:
    """Set the 7-bit I2C address, 0x18 … 0x1B (CMD 14, parameter 30)."""
    return _set(Parameter.I2C_ADDRESS, address)


def set_filter(accel: int, gyro: int) -> Request:
    """Set the low-pass filters by their codes, indices of `FILTERS` (CMD 14, parameter 31)."""
    return _set(Parameter.FILTER, filter_control(accel, gyro))


def factory_reset() -> Request:
    """Restore the factory settings, the baud rate included (CMD 15). `session.factory_reset` follows the device."""
    return _command(Command.FACTORY_RESET, "factory reset", timeout_ns=FLASH_TIMEOUT_NS)


def max_rate_hz(baud: int) -> int:
    """Highest output rate that fits through a line of `baud` (200 Hz at 115200, note 1 of table 3)."""
    return max(rate_hz for rate_hz in RATES_HZ if rate_hz * AHRS_FRAME_BYTES * BITS_PER_UART_BYTE <= baud)


def min_baud(rate_hz: float) -> int:
    """Lowest baud rate of the device that carries an output rate; its highest where none does."""
    return next((baud for baud in sorted(BAUD_RATES) if rate_hz <= max_rate_hz(baud)), max(BAUD_RATES))


def require_fit(rate_hz: float, baud: int) -> None:
    """Raise BadArgument, with figures and what to change, for an output rate that the line does not carry."""
    if rate_hz > max_rate_hz(baud):
        needed = round(rate_hz * AHRS_FRAME_BYTES * BITS_PER_UART_BYTE)
        raise BadArgument(
            f"expected at most {max_rate_hz(baud)} Hz at {baud} baud, got {rate_hz:g} Hz, which is {needed} bit/s on "
            f"the wire: samples would be lost; {rate_hz:g} Hz need {min_baud(rate_hz)} baud"
        )


# --- encoding ---------------------------------------------------------------------------------------------------------


def encode_command(command: Command, param1: float = 0.0, param3: int = 0) -> bytes:
    """The frame of a command, without any check of its arguments."""
    return encode_frame(HOST_SYNC, command.value, pack_parameters(param1, param3))


def _set(parameter: Parameter, value: int) -> Request:
    return _command(Command.SET_PARAMETER, f"set parameter {parameter.name} to {value}", param1=value, param3=parameter)


def _command(
    command: Command,
    name: str,
    *,
    param1: float = 0.0,
    param3: int = 0,
    is_end: Callable[[Message], bool] | None = None,
    timeout_ns: int = REPLY_TIMEOUT_NS,
    baud: int = 0,
    is_sample: Callable[[Measurement], bool] | None = None,
) -> Request:
    acknowledged = _acknowledges(command)
    payload = encode_command(command, param1, param3)
    # an acknowledgement of a question is part of its reply but does not end it
    ends = is_end or acknowledged
    return Request(payload, name, ends, never, acknowledged, timeout_ns, baud=baud, is_sample=is_sample)


def _acknowledges(command: Command) -> Callable[[Message], bool]:
    def holds(message: Message) -> bool:
        reply = parse_acknowledgement(message)
        return reply is not None and reply.command == command.value

    return holds
