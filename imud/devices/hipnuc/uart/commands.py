r"""ASCII commands of HiPNUC modules (replies: `replies.py`). Manual "IMU配置手冊" V1.5.9, chapter 2 and section 8.2.

    LOG HI91 ONTIME 0.01\r\n   →   OK\r\n        done
                               →   ERR…\r\n      refused
                               →   (nothing)     not understood: unknown commands get no reply at all
    LOG VERSION\r\n            →   PNAME=HI14R3\r\n … OK\r\n

Each function returns a `Request`. Types say what an argument can be; ranges are those of the actions (`actions.py`),
and what no range can express raises BadArgument here. Settings last until power is off unless `save_config` follows;
`mounting` takes effect after `save_config` and `reboot`.
"""

from collections.abc import Callable, Mapping
from enum import Enum, StrEnum
from typing import Final, Literal, get_args

from imud.attitude import Matrix3, is_rotation
from imud.contracts.session import Request, of_text
from imud.devices.hipnuc.uart.replies import is_end, is_rejection, is_setting_line, is_version_line
from imud.errors import BadArgument
from imud.units import BITS_PER_UART_BYTE, NS_PER_S

LINE_END: Final = "\r\n"
BaudRate = Literal[115200, 921600, 460800, 256000, 230400, 9600]
BAUD_RATES: Final[tuple[BaudRate, ...]] = get_args(BaudRate)
"""Rates of SERIALCONFIG (section 2.2.3) and 230400 of table 3.7; the factory default first."""
REPLY_TIMEOUT_NS: Final = NS_PER_S // 2
FLASH_TIMEOUT_NS: Final = 5 * NS_PER_S  # erasing flash can take 2 s and more; the manual gives no time

OutputRate = Literal[0, 1, 2, 4, 5, 8, 10, 20, 25, 40, 50, 100, 125, 200, 250, 500, 1000]
RATES_HZ: Final[tuple[OutputRate, ...]] = get_args(OutputRate)[1:]
"""Output rates: section 2.2.5 lists some periods "and so on", which is read as every whole rate with a period of whole
milliseconds, up to table 3.7."""
LINE_SHARE_MAX: Final = 0.95
"""Share of the line that frames may take: table 3.7 goes up to 94 % (HI92 with 200 Hz at 115200 baud)."""
SOUT_DIVIDER_MAX: Final = 64
PIN_MAX: Final = 9
ROTATION_TOLERANCE: Final = 1e-3
"""Tolerance of nine numbers typed with three decimals against a rotation matrix."""


class OutputMessage(StrEnum):
    """Output messages."""

    HI91 = "HI91"
    """Floats, with device time. `IMU91` is its other name."""
    HI92 = "HI92"
    """Integers, without device time."""


MAX_RATE_HZ: Final = {
    OutputMessage.HI91: {9600: 10, 115200: 100, 230400: 250, 256000: 250, 460800: 500, 921600: 1000},
    OutputMessage.HI92: {9600: 10, 115200: 200, 230400: 250, 256000: 250, 460800: 500, 921600: 1000},
}
"""Highest output rate by baud rate (table 3.7)."""
FRAME_BYTES: Final = {OutputMessage.HI91: 6 + 76, OutputMessage.HI92: 6 + 48}
"""Size of a frame with its header (sections 3.1, 3.3)."""


class AttitudeMode(Enum):
    """Attitude modes: without or with the magnetometer."""

    SIX_AXIS = 0
    """Heading is relative, 0 at power-on."""
    NINE_AXIS = 1
    """Heading is magnetic; needs one calibration and an undisturbed field."""


class LevelReset(Enum):
    """Operations on the level; the module must be at rest."""

    RELATIVE = 2
    """Pitch and roll are zero in the present attitude, at any tilt."""
    AUTOMATIC = 3
    """Like RELATIVE and for the accelerometer too, but only within 5° of level or of upside down."""
    CANCEL = 5
    """Back to the factory's level."""


class YawMode(Enum):
    """Meanings of the angle of `yaw`."""

    RELATIVE = 0
    """Added to the present yaw."""
    ABSOLUTE = 1
    """Replaces the present yaw."""


class PinFunction(Enum):
    """Functions of the multi-purpose pins (firmware 1.5.5 and newer), with the pin they have by default."""

    SIN = 1
    """Input of sync or PPS pulses; IO1."""
    SOUT = 2
    """High for 80 µs before each frame; IO2."""
    LED = 3
    """IO5."""
    SOUT_DIV = 4
    """Every n-th SOUT pulse, see `sout_divider`; IO6."""
    ALARM = 5
    """High while an angle is out of range, see `alarm`; IO9."""


PinName = Literal["sin", "sout", "led", "sout_div", "alarm"]
"""Names of `PinFunction`."""


class AlarmAxis(StrEnum):
    """The axis whose angle the alarm watches."""

    X = "X"
    Y = "Y"


class Mounting(Enum):
    """The nine mountings of section 2.2.4. The value is the URFR matrix, from new sensor axes to the old ones.

    Each is named by the new axis that points up, or down, while the old Z axis does; that is what the third row of the
    matrix says, and what the manual's words in brackets say. Its "turned by ±90° about Y" has the other sign.
    """

    LEVEL = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    """Z up, nothing turned: the default."""
    Y_DOWN = ((1, 0, 0), (0, 0, 1), (0, -1, 0))
    """Printed as turned by -90° about X: Y down."""
    Y_UP = ((1, 0, 0), (0, 0, -1), (0, 1, 0))
    """Printed as turned by 90° about X: Y up."""
    Z_DOWN = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
    """Turned by 180° about X: Z down, X as before."""
    X_UP = ((0, 0, -1), (0, 1, 0), (1, 0, 0))
    """Printed as turned by 90° about Y: X up."""
    X_DOWN = ((0, 0, 1), (0, 1, 0), (-1, 0, 0))
    """Printed as turned by -90° about Y: X down."""
    Z_DOWN_X_BACK = ((-1, 0, 0), (0, 1, 0), (0, 0, -1))
    """Turned by 180° about Y: Z down, X where -X was."""
    LEVEL_X_LEFT = ((0, -1, 0), (1, 0, 0), (0, 0, 1))
    """Turned by 90° about Z: Z up, X where Y was."""
    LEVEL_X_RIGHT = ((0, 1, 0), (-1, 0, 0), (0, 0, 1))
    """Turned by -90° about Z: Z up, X where -Y was."""


MountingName = Literal[
    "level", "y_down", "y_up", "z_down", "x_up", "x_down", "z_down_x_back", "level_x_left", "level_x_right"
]
"""Names of `Mounting`."""


class Query(StrEnum):
    """Reports that LOG asks for; each reply is lines and then OK."""

    VERSION = "VERSION"
    USRCONFIG = "USRCONFIG"
    COMCONFIG = "COMCONFIG"
    MAGCONFIG = "MAGCONFIG"


# --- commands ---------------------------------------------------------------------------------------------------------


def reboot() -> Request:
    """Restart, as by power-on. The module does not answer."""
    return _command("REBOOT", silent=True)


def save_config() -> Request:
    """Write all settings to flash."""
    return _command("SAVECONFIG", timeout_ns=FLASH_TIMEOUT_NS)


def factory_reset() -> Request:
    """Restore the factory settings, the baud rate included. When they come into force is not known: `session.py`."""
    return _command("FRESET", timeout_ns=FLASH_TIMEOUT_NS)


def unlog_all() -> Request:
    """Set the rate of every timed message to 0."""
    return _command("UNLOGALL")


def serial_config(baud: BaudRate) -> Request:
    """Set the baud rate: at once, even before the answer, or after `save_config` and `reboot` (`session.py`)."""
    return _command(f"SERIALCONFIG {baud}")


def attitude_mode(mode: AttitudeMode) -> Request:
    """Choose 6-axis or 9-axis (AHRS) mode."""
    return _command(f"CONFIG ATT MODE {mode.value}")


def level_reset(kind: LevelReset) -> Request:
    """Set or cancel the level."""
    return _command(f"CONFIG ATT RST {kind.value}")


def yaw(mode: YawMode, angle_deg: float) -> Request:
    """Set yaw, -180° … 180°; lost at power-off."""
    return _command(f"CONFIG YAW {mode.value} {_text(angle_deg)}")


def mounting(matrix: Mounting | Matrix3) -> Request:
    """Set the rotation from new sensor axes to the old ones (URFR). Raises BadArgument for what is no rotation."""
    rows: Matrix3 = matrix.value if isinstance(matrix, Mounting) else matrix
    if [len(row) for row in rows] != [3, 3, 3] or not is_rotation(rows, ROTATION_TOLERANCE):
        raise BadArgument(
            f"CONFIG IMU URFR: expected a rotation (three rows of three, orthonormal within {ROTATION_TOLERANCE:g}, "
            f"determinant +1), got {rows}; a mirrored or scaled axis is not a mounting"
        )
    return _command("CONFIG IMU URFR " + ",".join(_text(value) for row in rows for value in row))


def magnetic_calibration(enabled: bool) -> Request:
    """Turn the calibration of the magnetometer in the background on (the default) or off (section 8.2)."""
    return _command(f"CONFIG IMU EN_MCAL {int(enabled)}")


def pin_function(function: PinFunction, pin: int) -> Request:
    """Give `function` to pin IO1 … IO9. Not every product has every pin."""
    return _command(f"CONFIG PMUX{function.value} IO{pin}")


def alarm(axis: AlarmAxis, min_deg: float, max_deg: float, enabled: bool) -> Request:
    """Watch the angle of an axis: the alarm pin is high outside `min_deg` … `max_deg`. Raises BadArgument."""
    name, low, high = "CONFIG PMUX5", _text(min_deg), _text(max_deg)
    if not min_deg < max_deg:
        raise BadArgument(f"{name}: expected the minimum below the maximum, got {low}° and {high}°")
    return _command(f"{name} {axis},{low},{high},0,{int(enabled)}")


def sout_divider(divider: int) -> Request:
    """Divide SOUT pulses by 1 … 64 for the SOUT_DIV pin."""
    return _command(f"CONFIG PMUX4 DIV{divider}")


def log_enable() -> Request:
    """Send data frames (the default)."""
    return _command("LOG ENABLE")


def log_disable() -> Request:
    """Send no data frames, whatever their rates."""
    return _command("LOG DISABLE")


def log_ontime(message: OutputMessage, rate_hz: OutputRate) -> Request:
    """Send `message` at a rate, or not at all (0). Whether the line carries it is for `require_room`."""
    return _command(f"LOG {message} ONTIME {_text(1 / rate_hz if rate_hz else 0)}")


def log_onmark(message: OutputMessage) -> Request:
    """Send `message` once for each pulse on SIN or `log_once`. Turn timed output off first (`unlog_all`)."""
    return _command(f"LOG {message} ONMARK 1")


def log_once(message: OutputMessage) -> Request:
    """Send `message` once, as a pulse on SIN would. `log_onmark` comes first."""
    return _command(f"LOG {message} ONMARK ONCE")


def ask(query: Query) -> Request:
    """Ask for one of the four reports."""
    is_part = is_version_line if query is Query.VERSION else is_setting_line
    return _command(f"LOG {query}", is_part=is_part, messages_min=2)


def max_rate_hz(message: OutputMessage, baud: int) -> int:
    """Highest output rate of `message` at `baud` (table 3.7). Raises BadArgument for a rate the table does not have."""
    rates = MAX_RATE_HZ[message]
    if baud not in rates:
        known = ", ".join(map(str, sorted(rates)))
        raise BadArgument(f"baud rate: expected one of {known}, got {baud!r}")
    return rates[baud]


def require_room(rates_hz: Mapping[OutputMessage, float], baud: int) -> None:
    """Raise BadArgument where the line does not carry all messages together, or one of them is above table 3.7."""
    for message, rate_hz in rates_hz.items():
        if rate_hz > max_rate_hz(message, baud):
            raise BadArgument(
                f"{message}: expected at most {max_rate_hz(message, baud)} Hz at {baud} baud, got {rate_hz:g} Hz; "
                f"set a lower rate or a higher baud rate first"
            )
    bits = sum(rate_hz * FRAME_BYTES[message] for message, rate_hz in rates_hz.items()) * BITS_PER_UART_BYTE
    if bits > LINE_SHARE_MAX * baud:
        all_rates = " and ".join(f"{message} at {rate_hz:g} Hz" for message, rate_hz in rates_hz.items() if rate_hz)
        raise BadArgument(
            f"expected at most {LINE_SHARE_MAX * baud:.0f} bit/s of frames at {baud} baud, got {bits:.0f} bit/s by "
            f"{all_rates}; set lower rates or a higher baud rate first"
        )


def _never(_line: str) -> bool:
    return False


def _command(
    text: str,
    *,
    timeout_ns: int = REPLY_TIMEOUT_NS,
    silent: bool = False,
    is_part: Callable[[str], bool] = _never,
    messages_min: int = 1,
) -> Request:
    payload = (text + LINE_END).encode("ascii")
    return Request(
        payload, text, of_text(is_end), of_text(is_rejection), of_text(is_part), timeout_ns, silent, messages_min
    )


def _text(value: float) -> str:
    """A number as the manual writes it: no exponent, no trailing zeros, no minus before zero."""
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
