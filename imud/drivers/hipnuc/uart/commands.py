r"""ASCII commands of HiPNUC devices (replies: `replies.py`). Manual "IMU配置手冊" V1.5.9, chapter 2 and section 8.2.

    LOG HI91 ONTIME 0.01\r\n   →   OK\r\n        done
                               →   ERR…\r\n      rejected
                               →   (nothing)     unknown command: the device does not reply
    LOG VERSION\r\n            →   PNAME=HI14R3\r\n … OK\r\n

Most functions return a `Request`. Types define the arguments; the verbs in `driver.py` define ranges; other rules
raise BadArgument here. Settings are lost at power-off unless `save_config` follows; `mounting` takes effect after
`save_config` and `reboot`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import Enum, StrEnum
from functools import cache
from typing import Final, Literal, get_args

from imud.attitude.rotation import Matrix3, is_rotation
from imud.contracts.driver import Identity
from imud.contracts.script import (
    Message,
    Outcome,
    Rejection,
    Reply,
    Request,
    RequestScript,
    Silence,
    never,
    pause,
)
from imud.drivers.hipnuc.common import AttitudeMode, LevelReset
from imud.drivers.hipnuc.uart.replies import (
    PeriodicOutputs,
    is_end,
    is_rejection,
    is_setting_line,
    is_version_line,
    parse_comconfig,
    parse_report,
    parse_version,
)
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.model.units import BITS_PER_UART_BYTE, NS_PER_S

LINE_END: Final = "\r\n"
BaudRate = Literal[115200, 921600, 460800, 256000, 230400, 9600]
# Baud rates of SERIALCONFIG (section 2.2.3) and 230400 of table 3.7; the factory value first
BAUD_RATES: Final[tuple[BaudRate, ...]] = get_args(BaudRate)
REPLY_TIMEOUT_NS: Final = NS_PER_S // 2
NEWER_FIRMWARE: Final = 169  # first firmware that replies ERR to an unknown command, 1.6.9
FLASH_TIMEOUT_NS: Final = 5 * NS_PER_S  # erasing the flash can take more than 2 s; the manual states no time

OutputRate = Literal[0, 1, 2, 4, 5, 8, 10, 20, 25, 40, 50, 100, 125, 200, 250, 500, 1000]
# Output rates: section 2.2.5 lists some periods "and so on". imud accepts every whole rate with a period of whole
# milliseconds, up to table 3.7.
RATES_HZ: Final[tuple[OutputRate, ...]] = get_args(OutputRate)[1:]
# Maximum share of the baud rate for frames: table 3.7 goes up to 94 % (HI92 with 200 Hz at 115200 baud)
LINE_SHARE_MAX: Final = 0.95
SOUT_DIVIDER_MAX: Final = 64
PIN_MAX: Final = 9
ROTATION_TOLERANCE: Final = 1e-3  # tolerance of a rotation matrix of nine numbers with three decimals


class OutputMessage(StrEnum):
    HI91 = "HI91"  # floats, with device time; also called `IMU91`
    HI92 = "HI92"  # integers, without device time
    HI81 = "HI81"  # INS devices with newer firmware: integers, with position
    HI83 = "HI83"  # newer firmware: the fields of a bitmap, for which no source contains a command


class InsMessage(StrEnum):
    """NMEA sentences of INS models that imud only selects."""

    GGA = "GGA"
    RMC = "RMC"
    SXT = "SXT"


AnyMessage = OutputMessage | InsMessage


def message_of(name: str) -> AnyMessage:
    """Return the message with a name in lower or upper case. Raises ValueError."""
    return OutputMessage(name.upper()) if name.upper() in OutputMessage.__members__ else InsMessage(name.upper())


# Maximum output rate by baud rate (table 3.7; for HI81 and HI83 only the share of the baud rate limits the rate)
MAX_RATE_HZ: Final[Mapping[AnyMessage, Mapping[int, int]]] = {
    OutputMessage.HI91: {9600: 10, 115200: 100, 230400: 250, 256000: 250, 460800: 500, 921600: 1000},
    OutputMessage.HI92: {9600: 10, 115200: 200, 230400: 250, 256000: 250, 460800: 500, 921600: 1000},
    OutputMessage.HI81: dict.fromkeys((9600, 115200, 230400, 256000, 460800, 921600), 1000),
    OutputMessage.HI83: dict.fromkeys((9600, 115200, 230400, 256000, 460800, 921600), 1000),
}
# Size of a frame with its header, bytes (sections 3.1, 3.3); of HI83 the minimum. NMEA 0183 permits 82 bytes; SXT has
# 22 fields.
FRAME_BYTES: Final[Mapping[AnyMessage, int]] = {
    OutputMessage.HI91: 6 + 76, OutputMessage.HI92: 6 + 48, OutputMessage.HI81: 6 + 104, OutputMessage.HI83: 6 + 8,
    InsMessage.GGA: 82, InsMessage.RMC: 82, InsMessage.SXT: 255,
}  # fmt: skip


class YawMode(Enum):
    """Meanings of the angle of `yaw`."""

    RELATIVE = 0  # added to the present yaw
    ABSOLUTE = 1  # replaces the present yaw


class PinFunction(Enum):
    """Functions of the multi-purpose pins (firmware 1.5.5 and newer), with their default pin."""

    SIN = 1  # input of sync or PPS pulses; IO1
    SOUT = 2  # high for 80 µs before each frame; IO2
    LED = 3  # IO5
    SOUT_DIV = 4  # every n-th SOUT pulse, see `sout_divider`; IO6
    ALARM = 5  # high while an angle is out of range, see `alarm`; IO9


PinName = Literal["sin", "sout", "led", "sout_div", "alarm"]  # names of `PinFunction`


class AlarmAxis(StrEnum):
    """Axis of the angle that the alarm watches."""

    X = "X"
    Y = "Y"


class Mounting(Enum):
    """The nine mountings of section 2.2.4. The value is the URFR matrix, from new sensor axes to the old axes.

    The name gives the new axis that points up or down while the old Z axis points up. It agrees with the third row of
    the matrix and with the manual's text in brackets. The manual's "turned by ±90° about Y" has the opposite sign.
    """

    LEVEL = ((1, 0, 0), (0, 1, 0), (0, 0, 1))  # Z up, no rotation: the default
    Y_DOWN = ((1, 0, 0), (0, 0, 1), (0, -1, 0))  # The manual prints: turned by -90° about X. Y down.
    Y_UP = ((1, 0, 0), (0, 0, -1), (0, 1, 0))  # The manual prints: turned by 90° about X. Y up.
    Z_DOWN = ((1, 0, 0), (0, -1, 0), (0, 0, -1))  # rotated by 180° about X: Z down, X unchanged
    X_UP = ((0, 0, -1), (0, 1, 0), (1, 0, 0))  # The manual prints: turned by 90° about Y. X up.
    X_DOWN = ((0, 0, 1), (0, 1, 0), (-1, 0, 0))  # The manual prints: turned by -90° about Y. X down.
    Z_DOWN_X_BACK = ((-1, 0, 0), (0, 1, 0), (0, 0, -1))  # rotated by 180° about Y: Z down, X in place of -X
    LEVEL_X_LEFT = ((0, -1, 0), (1, 0, 0), (0, 0, 1))  # rotated by 90° about Z: Z up, X in place of Y
    LEVEL_X_RIGHT = ((0, 1, 0), (-1, 0, 0), (0, 0, 1))  # rotated by -90° about Z: Z up, X in place of -Y


# Names of `Mounting`
MountingName = Literal[
    "level", "y_down", "y_up", "z_down", "x_up", "x_down", "z_down_x_back", "level_x_left", "level_x_right"
]


class Query(StrEnum):
    """Reports of LOG; each reply is some lines and then OK."""

    VERSION = "VERSION"
    USRCONFIG = "USRCONFIG"
    COMCONFIG = "COMCONFIG"
    MAGCONFIG = "MAGCONFIG"
    INSCONFIG = "INSCONFIG"  # INS models


# --- commands ---------------------------------------------------------------------------------------------------------


def reboot() -> Request:
    """Restart the device, as after power-on. It does not reply."""
    return command("REBOOT", silent=True)


def save_config() -> Request:
    """Write all settings to flash."""
    return command("SAVECONFIG", timeout_ns=FLASH_TIMEOUT_NS)


def factory_reset() -> Request:
    """Restore the factory settings with the baud rate. `reset_to_factory` makes them effective."""
    return command("FRESET", timeout_ns=FLASH_TIMEOUT_NS)


def unlog_all() -> Request:
    """Set the rate of every timed message to 0."""
    return command("UNLOGALL")


def serial_config(baud: BaudRate) -> Request:
    """Set the baud rate: effective immediately, even before the reply, or after `save_config` and `reboot`."""
    return command(f"SERIALCONFIG {baud}")


def attitude_mode(mode: AttitudeMode) -> Request:
    """Set 6-axis or 9-axis (AHRS) mode."""
    return command(f"CONFIG ATT MODE {mode.value}")


def level_reset(kind: LevelReset) -> Request:
    """Set or cancel the level."""
    return command(f"CONFIG ATT RST {kind.value}")


def yaw(mode: YawMode, angle_deg: float) -> Request:
    """Set yaw, -180° … 180°; lost at power-off."""
    return command(f"CONFIG YAW {mode.value} {number_text(angle_deg)}")


def mounting(matrix: Mounting | Matrix3) -> Request:
    """Set the rotation from new sensor axes to the old axes (URFR). Raises BadArgument for another matrix."""
    rows: Matrix3 = matrix.value if isinstance(matrix, Mounting) else matrix
    if [len(row) for row in rows] != [3, 3, 3] or not is_rotation(rows, ROTATION_TOLERANCE):
        raise BadArgument(
            f"CONFIG IMU URFR: expected a rotation matrix (3 x 3, orthonormal within {ROTATION_TOLERANCE:g}, "
            f"determinant +1), got {rows}"
        )
    return command("CONFIG IMU URFR " + ",".join(number_text(value) for row in rows for value in row))


def magnetic_calibration(enabled: bool) -> Request:
    """Enable (default) or disable the background calibration of the magnetometer (section 8.2)."""
    return command(f"CONFIG IMU EN_MCAL {int(enabled)}")


def pin_function(function: PinFunction, pin: int) -> Request:
    """Set the function of pin IO1 … IO9. Some products lack some pins."""
    return command(f"CONFIG PMUX{function.value} IO{pin}")


def alarm(axis: AlarmAxis, min_deg: float, max_deg: float, enabled: bool) -> Request:
    """Watch the angle of an axis: the alarm pin is high outside `min_deg` … `max_deg`. Raises BadArgument."""
    name, low, high = "CONFIG PMUX5", number_text(min_deg), number_text(max_deg)
    if not min_deg < max_deg:
        raise BadArgument(f"{name}: expected the minimum below the maximum, got {low}° and {high}°")
    return command(f"{name} {axis},{low},{high},0,{int(enabled)}")


def sout_divider(divider: int) -> Request:
    """Set the divisor of SOUT pulses for the SOUT_DIV pin, 1 … 64."""
    return command(f"CONFIG PMUX4 DIV{divider}")


def log_enable() -> Request:
    """Enable data frames (default)."""
    return command("LOG ENABLE")


def log_disable() -> Request:
    """Disable data frames of all rates."""
    return command("LOG DISABLE")


def log_ontime(message: AnyMessage, rate_hz: OutputRate, port: str = "") -> Request:
    """Set the rate of a message; 0: off. `require_room` checks the baud rate. `port`: `COM2 ` for another port."""
    return command(f"LOG {port}{message} ONTIME {number_text(1 / rate_hz if rate_hz else 0)}")


def log_onmark(message: AnyMessage, port: str = "") -> Request:
    """Send `message` once for each pulse on SIN or `log_once`. First disable timed output (`unlog_all`)."""
    return command(f"LOG {port}{message} ONMARK 1")


def log_once(message: OutputMessage) -> Request:
    """Send `message` once, as after a pulse on SIN. Requires `log_onmark`."""
    return command(f"LOG {message} ONMARK ONCE")


@cache
def ask(query: Query) -> Request:
    """Request one of the reports."""
    if query is not Query.VERSION:
        return ask_lines(query)
    return command(f"LOG {query}", is_part=is_version_line, messages_min=2, kind="version", repeatable=True)


def ask_lines(report: str) -> Request:
    """Request a report with lines of any form."""
    return command(f"LOG {report}", is_part=is_setting_line, messages_min=2, kind="report", repeatable=True)


def require_room(rates_hz: Mapping[AnyMessage, float], baud: int) -> None:
    """Raise BadArgument if the serial port cannot carry all messages, or if one message exceeds table 3.7.

    `baud` is one of BAUD_RATES.
    """
    frame_bytes_s = 0.0
    for message, rate_hz in rates_hz.items():
        frame_bytes_s += rate_hz * FRAME_BYTES[message]
        most_hz = MAX_RATE_HZ.get(message, {}).get(baud)
        if most_hz is not None and rate_hz > most_hz:
            raise BadArgument(
                f"{message}: expected at most {most_hz} Hz at {baud} baud, got {rate_hz:g} Hz; "
                f"set a lower rate or a higher baud rate first"
            )
    bits = frame_bytes_s * BITS_PER_UART_BYTE
    if bits > LINE_SHARE_MAX * baud:
        all_rates = " and ".join(f"{message} at {rate_hz:g} Hz" for message, rate_hz in rates_hz.items() if rate_hz)
        raise BadArgument(
            f"expected at most {LINE_SHARE_MAX * baud:.0f} bit/s of frames at {baud} baud, got {bits:.0f} bit/s by "
            f"{all_rates}; set lower rates or a higher baud rate first"
        )


def command(
    text: str,
    *,
    timeout_ns: int = REPLY_TIMEOUT_NS,
    silent: bool = False,
    is_part: Callable[[Message], bool] = never,
    messages_min: int = 1,
    kind: str = "OK",
    repeatable: bool = False,
) -> Request:
    """Return the request of a command line."""
    payload = (text + LINE_END).encode("ascii")
    return Request(
        payload, text, is_end, is_rejection, is_part, timeout_ns, silent, messages_min, kind, repeatable,
        probe=None if kind == "version" else ask(Query.VERSION),
    )  # fmt: skip


def number_text(value: float) -> str:
    """Return a number as in the manual: no exponent, no trailing zeros, no minus before zero."""
    text = f"{value:.6f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


BOOT_NS: Final = NS_PER_S  # time from REBOOT to the first try, ns; the manual states none
BOOT_TRIES: Final = 5
# Number of tries per baud rate. Bytes sent at another baud rate can spoil the first request in the device's buffer.
LOOK_TRIES: Final = 2
FACTORY_BAUD: Final = BAUD_RATES[0]
WAKE_HZ: Final = 100  # factory output rate (section 3.2)


def identify() -> RequestScript[Identity]:
    """Read product, serial number and firmware (LOG VERSION).

    `details` contains every value by the name of the device; `firmware` is "1.5.6" for APP_VER=156. Raises NoReply,
    Rejected. A reply without a product has lost bytes, which happens to the first reply after a replug.
    """
    request = ask(Query.VERSION)
    lines = require_reply(request, (yield request))
    version = parse_version(lines)
    if not version.product:
        raise NoReply(f"LOG VERSION: expected PNAME=... and other lines, got {' / '.join(lines)}; bytes were lost")
    firmware = "" if version.app_ver is None else ".".join(str(version.app_ver))
    return Identity(version.product, version.uuid, firmware, version.report.values)


def read_report(query: Query) -> RequestScript[Mapping[str, str] | None]:
    """Read one report of settings, by the names of the device.

    A line without a name gets the name "COMCONFIG 1", "COMCONFIG 2" and so on. Raises NoReply, Rejected. Returns None
    for MAGCONFIG and INSCONFIG in these cases, because other models may not know them (assumption).
    """
    request = ask(query)
    outcome = yield request
    if query in (Query.MAGCONFIG, Query.INSCONFIG) and not isinstance(outcome, Reply):
        return None
    report = parse_report(require_reply(request, outcome))
    words = dict(report.values)
    for number, line in enumerate(report.other, 1):
        words[f"{query} {number}"] = line
    return words


def require_reply(request: Request, outcome: Outcome, expected: str = "") -> tuple[str, ...]:
    """Return the lines of a positive reply. Raises NoReply, with the `expected` reply, or Rejected."""
    if isinstance(outcome, Rejection):
        raise Rejected(f"{request.name}: the device rejected the request: {' / '.join(outcome.lines)}")
    if isinstance(outcome, Silence):
        is_report = request.messages_min > 1
        expected = expected or ("lines up to OK" if is_report else "OK")
        heard = f"{len(outcome.lines)} lines without OK" if outcome.lines else "no reply"
        check = "check the transmit wire of the host" + " and the baud rate" * is_report
        raise NoReply(f"{request.name}: expected {expected}, got {heard}; {check}")
    return outcome.lines


def send(request: Request) -> RequestScript[None]:
    """Send one command. Raises NoReply (also for a command that the firmware does not know) and Rejected."""
    require_reply(request, (yield request))


def send_if_known(request: Request) -> RequestScript[tuple[str, ...]]:
    """Send a command that some firmware does not know, and return the lines of its reply. Raises NoReply, Rejected."""
    return (yield from require_known(request, (yield request)))


def require_known(request: Request, outcome: Outcome) -> RequestScript[tuple[str, ...]]:
    """Return the lines of a positive reply to a command that some firmware does not know.

    After no reply, the version shows that the device replies at all, and the second request distinguishes a lost reply
    from an unknown command: newer firmware replies ERR to an unknown command. Raises NoReply, Rejected.
    """
    if isinstance(outcome, Reply):
        return outcome.lines
    firmware = (yield from identify()).firmware
    if isinstance(outcome, Silence):
        outcome = yield request
    if isinstance(outcome, Reply):
        return outcome.lines

    if isinstance(outcome, Silence) and _rejects_unknown_commands(firmware):
        raise NoReply(
            f"{request.name}: expected OK or ERR, got no reply, but firmware {firmware} replies to other commands; "
            "repeat the command"
        )
    got = " / ".join(outcome.lines) if isinstance(outcome, Rejection) else "no reply"
    version = firmware or "of unknown version"
    raise Rejected(f"{request.name}: not supported by firmware {version}: expected OK, got {got}")


def _rejects_unknown_commands(firmware: str) -> bool:
    """Return whether this firmware replies ERR to an unknown command. `firmware`: `1.7.0`."""
    digits = firmware.replace(".", "")
    return digits.isdecimal() and int(digits) >= NEWER_FIRMWARE


# --- output -----------------------------------------------------------------------------------------------------------


def send_once(message: OutputMessage) -> RequestScript[None]:
    """Send `message` once. The reply is OK, or only a frame from newer firmware. Raises NoReply, Rejected."""
    request = replace(log_once(message), is_sample=lambda _sample: True)
    outcome = yield request
    if isinstance(outcome, Reply) and outcome.sample is not None:
        outcome = yield replace(request, payload=b"", is_sample=None)
        if isinstance(outcome, Silence):  # OK can follow the frame
            return
    require_reply(request, outcome, "OK or a frame")


def ask_outputs() -> RequestScript[PeriodicOutputs | None]:
    """Read which messages the device sends at which rate (LOG COMCONFIG); None if the device does not report it."""
    outcome = yield ask(Query.COMCONFIG)
    if not isinstance(outcome, Reply):
        return None
    config = parse_comconfig(outcome.lines)
    return config if config.periods_s or config.on_mark else None


def rates_hz(config: PeriodicOutputs | None) -> dict[AnyMessage, float]:
    """Return the output rates of all timed messages."""
    periods_s = config.periods_s if config is not None else {}
    return {message_of(name): 1 / period_s for name, period_s in periods_s.items() if period_s > 0}


def wake() -> RequestScript[bool | None]:
    """Enable frames (LOG ENABLE) if a message has a rate in the device settings.

    Return True, or None without a change if no message has a rate or one is on mark: such a device is silent by its
    settings. Raises NoReply, Rejected.
    """
    config = yield from ask_outputs()
    if config is None or config.on_mark or not rates_hz(config):
        return None
    yield from send(log_enable())
    return True


def wake_by_force(baud: int) -> RequestScript[str]:
    """Enable frames, set a rate for HI91 if no message has a rate, and return a report. Nothing is saved.

    The rate of HI91 is 100 Hz, or 10 Hz at 9600 baud. Raises NoReply, Rejected.
    """
    yield from send(log_enable())
    config = yield from ask_outputs()
    if config is None:
        return "LOG ENABLE; the device does not report its output rates; if no sample arrives, set a rate with output"
    if any(isinstance(message, OutputMessage) for message in rates_hz(config)):
        return "LOG ENABLE"
    rate_hz: OutputRate = 10 if baud == min(BAUD_RATES) else WAKE_HZ
    yield from send(log_ontime(OutputMessage.HI91, rate_hz))
    return f"LOG ENABLE; HI91 at {rate_hz} Hz, not saved"


# --- restart and baud rate --------------------------------------------------------------------------------------------


def restart(present_baud: int = 0) -> RequestScript[Identity]:
    """Restart the device and wait until it replies. Unsaved settings are lost, also a baud rate. Raises NoReply."""
    yield reboot()
    identity, _ = yield from find_after_boot([present_baud])
    return identity


def change_baud(baud: BaudRate, present_baud: int) -> RequestScript[int]:
    """Set the baud rate, save all settings, restart and follow the device. Return the baud rate.

    The restart verifies the saved baud rate and makes other settings effective. Raises BadArgument if the serial port
    cannot carry the present output, NoReply, and Rejected if the device replies only at the old baud rate, which imud
    keeps.
    """
    require_room(rates_hz((yield from ask_outputs())), baud)
    answered = yield from _acknowledged(serial_config(baud))
    heard = yield from find((present_baud, baud) if answered else (baud, present_baud))
    if heard == present_baud != baud and not answered:
        raise NoReply(f"SERIALCONFIG {baud}: expected OK, got no reply; the device keeps {present_baud} baud")
    if heard != baud:
        yield from _require_reported_baud(baud, present_baud)
    yield from send(save_config())
    yield reboot()
    _, heard = yield from find_after_boot((baud, present_baud))
    if heard != baud:
        raise Rejected(f"SERIALCONFIG {baud}: the device keeps {heard} baud")
    return heard


def _require_reported_baud(baud: BaudRate, present_baud: int) -> RequestScript[None]:
    """Raise Rejected if the device does not report a baud rate that it uses only after a restart (COMCONFIG).

    It is assumed that the report contains the new baud rate before the restart. imud never saves a change of the link
    that it cannot verify.
    """
    report = yield from read_report(Query.COMCONFIG)
    reported = (report or {}).get("BAUD", "no baud rate")
    if reported != str(baud):
        raise Rejected(
            f"SERIALCONFIG {baud}: the device replied OK, but still uses {present_baud} baud and reports {reported}; "
            "imud did not save or restart it"
        )


def reset_to_factory(present_baud: int) -> RequestScript[int]:
    """Restore the factory settings, restart and follow the device. Return the baud rate. Raises NoReply, Rejected."""
    answered = yield from _acknowledged(factory_reset())
    heard = yield from find((present_baud, FACTORY_BAUD) if answered else (FACTORY_BAUD, present_baud))
    if not answered and heard == present_baud:
        raise NoReply("FRESET: expected OK, got no reply; read the settings to check the result")
    yield reboot()
    _, heard = yield from find_after_boot((FACTORY_BAUD, present_baud))
    return heard


def advice(baud: int, fixed_baud: int) -> str:
    """Return the necessary change of a configuration that fixes another baud rate; empty if none is necessary."""
    if fixed_baud in (0, baud):
        return ""
    return f"change `baud: {fixed_baud}` in the configuration to {baud} or auto: imud uses it at its next start"


def _acknowledged(request: Request) -> RequestScript[bool]:
    """Send a command. Return whether the device acknowledged it. Raises Rejected."""
    outcome = yield request
    if not isinstance(outcome, Silence):
        require_reply(request, outcome)
    return isinstance(outcome, Reply)


def find(bauds: Sequence[int]) -> RequestScript[int]:
    """Return the first baud rate at which the device replies and keep it. Raises NoReply and restores the first one."""
    for baud in dict.fromkeys(bauds):
        yield pause(0, baud=baud)
        if (yield from _answers(LOOK_TRIES)) is not None:
            return baud
    yield pause(0, baud=bauds[0])
    rates = " or ".join(str(baud) for baud in dict.fromkeys(bauds))
    raise NoReply(f"LOG VERSION: expected a reply at {rates} baud, got none; `baud: auto` tries all rates")


def find_after_boot(bauds: Sequence[int]) -> RequestScript[tuple[Identity, int]]:
    """Wait for a reply after a restart, at the likely baud rates first, then at all others. Raises NoReply.

    An unsaved baud rate is lost by a restart, and the saved baud rate is not known.
    """
    yield pause(BOOT_NS)  # at the present baud rate: REBOOT may still be in the buffer of the port
    likely = dict.fromkeys(bauds)
    others = [baud for baud in BAUD_RATES if baud not in likely] if bauds[0] else []
    for baud in (*likely, *others):
        yield pause(0, baud=baud)
        identity = yield from _answers(BOOT_TRIES if baud in likely else LOOK_TRIES)
        if identity is not None:
            return identity, baud
    yield pause(0, baud=bauds[0])
    raise NoReply("LOG VERSION: expected a reply after the restart, got none at any baud rate")


def _answers(tries: int) -> RequestScript[Identity | None]:
    """Request the identity several times; None without a reply."""
    for _ in range(tries):
        try:
            return (yield from identify())
        except (NoReply, Rejected):
            continue
    return None
