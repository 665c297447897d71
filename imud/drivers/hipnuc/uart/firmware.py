"""Commands of HiPNUC firmware that is older or newer than manual V1.5.9.

Source: SDK and newer manuals of the vendor (COORD, URFR digits, MCAL, COMn, INS models), and code of a third party
(codes of older firmware). No source shows the lines of the reports: imud accepts NAME=VALUE, NAME: VALUE and the form
of the command.

    newer   CONFIG IMU COORD 4 | CONFIG IMU URFR 134 | CONFIG MCAL START [2D] | LOG MCAL STAT
            LOG COM2 HI91 ONTIME 0.01 | SERIALCONFIG COM2 921600
    older   CONFIG IMU ZARU/ABW/ARG/GBW/GRG/INC_FMT n | CONFIG ATT RST 1 or 4
    INS     LOG GGA/RMC/SXT/HI81 ONTIME 1 | LOG INSCONFIG | SETBASELINE n

A device replies ERR to a command that its firmware does not know; older firmware does not reply.
"""

import re
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Annotated, Any, Final, Literal, get_args

import msgspec
from msgspec import Meta

from imud.attitude.rotation import Matrix3, is_rotation
from imud.contracts.command import Target, Verdict
from imud.contracts.script import Request, RequestScript
from imud.contracts.setting import Setting
from imud.drivers.hipnuc.uart import commands
from imud.drivers.hipnuc.uart.commands import BaudRate, Query, command, number_text, send_if_known
from imud.drivers.hipnuc.uart.replies import PeriodicOutputs, numbers_of, parse_report, whole
from imud.model.errors import BadArgument

ON_MARK: Final = "on_mark"
SOURCE: Final = "not in V1.5.9"  # section of a setting that the manual does not contain


def described(value_type: Any, description: str, section: str, unit: str = "") -> Any:
    """Return the type of a setting with its description."""
    return Annotated[value_type, Meta(description=description, extra={"section": section, "unit": unit})]


# --- mounting by digits -----------------------------------------------------------------------------------------------

# Directions of a physical axis in the new axes (x right, y forward, z up), by digit: right, left, front, back, up, down
DIRECTIONS: Final = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
Digits = Literal[
    "024", "035", "043", "052", "125", "134", "142", "153", "205", "214", "240", "251",
    "304", "315", "341", "350", "402", "413", "421", "430", "503", "512", "520", "531",
]  # fmt: skip
# Digits as a number: YAML and `--set` read 134 as a number. Leading zeros are not necessary: 24 is 024.
DigitsNumber = Annotated[int, Meta(ge=24, le=531)]
_DIGITS: Final = re.compile(r"[0-5]{1,3}")


def digits_of(value: str | int) -> str:
    """Return three digits of a mounting, also without leading zeros; empty for another text."""
    return str(value).zfill(3) if _DIGITS.fullmatch(str(value)) else ""


def matrix_of_digits(digits: str) -> Matrix3:
    """Return the URFR matrix of three digits 0 … 5, from new axes to physical axes. Raises BadArgument."""
    rows = [DIRECTIONS[int(digit)] for digit in digits_of(digits)]
    names = ", ".join(("right", "left", "front", "back", "up", "down")[int(digit)] for digit in digits_of(digits))
    problem = ""
    if len(rows) != 3:
        problem = f"expected three digits from 0 to 5, got {digits}"
    elif len({int(digit) // 2 for digit in digits_of(digits)}) < 3:
        problem = f"expected three different axes, got {digits_of(digits)} ({names}): two are parallel"
    elif not is_rotation((rows[0], rows[1], rows[2])):
        problem = f"expected right-handed axes, got {digits_of(digits)} ({names}): reverse one or three directions"
    if problem:
        raise BadArgument(f"mounting: {problem}; possible values: {', '.join(get_args(Digits))}")
    return (rows[0], rows[1], rows[2])


def mounting_by_digits(digits: str) -> Request:
    """Set the direction of the physical axes X, Y, Z. Raises BadArgument for impossible directions."""
    matrix_of_digits(digits)
    return command(f"CONFIG IMU URFR {digits_of(digits)}")


# --- magnetometer -----------------------------------------------------------------------------------------------------

# Words in the state of LOG MCAL STAT (assumption). imud shows other states and does not verify the calibration.
_DONE: Final = re.compile(r"(?<![A-Z])(?:DONE|FINISH(?:ED)?|COMPLETED?|SUCCESS|CALIBRATED)(?![A-Z])", re.IGNORECASE)
_FAILED: Final = re.compile(r"FAIL|ERR|ABORT|TIMEOUT", re.IGNORECASE)
_NOT: Final = re.compile(r"(?<![A-Z])NOT(?![A-Z])", re.IGNORECASE)
_NO_FAULT: Final = ("0", "NO", "NONE", "OK")  # values of a field such as ERROR without a fault (assumption)
_PERCENT: Final = re.compile(r"(\d{1,3}(?:\.\d*)?)\s*%?")
MCAL_STAT: Final = "MCAL STAT"


def start_calibration(planar: bool) -> Request:
    """Start the calibration of the magnetometer. `planar`: the user turns the device only about the vertical axis."""
    return command("CONFIG MCAL START 2D" if planar else "CONFIG MCAL START")


def ask_calibration() -> Request:
    """Request the state of the calibration."""
    return commands.ask_lines(MCAL_STAT)


def read_calibration(lines: Sequence[str]) -> Verdict:
    """Return the state in the lines of LOG MCAL STAT."""
    report = parse_report(lines)
    progress, states = None, []
    for name, text in (*report.values.items(), *(("", line) for line in report.other)):
        number = _PERCENT.fullmatch(text.strip())
        if number and ("PROG" in name.upper() or text.rstrip().endswith("%")):
            progress = min(float(number[1]) / 100, 1.0)
        else:
            states.append(f"{name} {text}".strip())
    state = ", ".join(states)
    faults = [text for text in states if text.split()[-1].upper() not in _NO_FAULT]
    has_failed = any(_FAILED.search(text) for text in faults)
    is_end = _DONE.search(state) is not None or (not states and progress == 1.0)
    done = is_end and not has_failed and _NOT.search(state) is None
    return Verdict(done, state, progress, has_failed)


def calibration_state() -> RequestScript[Verdict]:
    """Read the state of the calibration. Raises NoReply, Rejected."""
    return read_calibration((yield from send_if_known(ask_calibration())))


# --- several ports ----------------------------------------------------------------------------------------------------

Port = Literal["com1", "com2", "com3", "com4"]


def _write_port_baud(target: Target, value: Mapping[Port, BaudRate]) -> RequestScript[None]:
    """Set the baud rate of other ports. Raises BadArgument for the port of imud, and restores its baud rate."""
    for port, baud in value.items():
        yield from send_port_baud(port, baud, target.baud)


def send_port_baud(port: str, baud: int, present_baud: int) -> RequestScript[None]:
    """Set the baud rate of one port. Raises BadArgument if imud is on this port, NoReply, Rejected."""
    name = port.upper()
    request = command(f"SERIALCONFIG {name} {baud}")
    outcome = yield request
    if present_baud and baud != present_baud:
        heard = yield from commands.find((present_baud, baud))
        if heard == baud:
            yield command(f"SERIALCONFIG {name} {present_baud}")
            yield from commands.find((present_baud, baud))
            raise BadArgument(f"port_baud.{port}: imud uses {name}; imud restored {present_baud} baud: use `baud`")
    yield from commands.require_known(request, outcome)


def has_all(declared: Mapping[str, Any], actual: Mapping[str, Any]) -> bool:
    """Return whether the actual values contain all declared values."""
    plain = msgspec.to_builtins(actual)
    return all(plain.get(name) == value for name, value in msgspec.to_builtins(declared).items())


def rates_of(outputs: PeriodicOutputs) -> dict[str, Any]:
    """Return the rate of each message of a port, Hz, or ON_MARK."""
    rates: dict[str, Any] = {}
    for message, period_s in outputs.periods_s.items():
        rate_hz = round(1 / period_s, 3) if period_s else 0
        rates[message.lower()] = int(rate_hz) if rate_hz == int(rate_hz) else rate_hz
    return rates | {message.lower(): ON_MARK for message in outputs.on_mark}


def shown_rates(name: str, rates: Mapping[str, Any]) -> dict[str, str]:
    """Return the rates of messages, or of the messages of several ports, as text."""
    found: dict[str, str] = {}
    for key, rate in sorted(rates.items()):
        if isinstance(rate, Mapping):
            found |= shown_rates(f"{name}.{key}", rate)
        else:
            found[f"{name}.{key}"] = "on mark" if rate == ON_MARK else f"{rate:g} Hz" if rate else "off"
    return found


_PORT_BAUD: Final = re.compile(r"\bCOM([1-4])\b\W*(?:BAUD\w*)?\W*([0-9]{4,6})\b", re.IGNORECASE)


def port_bauds(raw: Mapping[str, str]) -> dict[str, int]:
    """Return the baud rates of named ports in reports."""
    found = {}
    for name, text in raw.items():
        for port, baud in _PORT_BAUD.findall(f"{name}: {text}"):
            if int(baud) in commands.BAUD_RATES:
                found[f"com{port}"] = int(baud)
    return found


# --- settings ---------------------------------------------------------------------------------------------------------


class OlderCode(Enum):
    """Codes of older firmware by setting: name of the device, maximum, meaning. No document gives their units."""

    ZERO_RATE_UPDATE = ("ZARU", None, "threshold of the zero angular rate update")
    ACCEL_BANDWIDTH = ("ABW", 6, "bandwidth of the accelerometer")
    ACCEL_RANGE = ("ARG", 3, "range of the accelerometer")
    GYRO_BANDWIDTH = ("GBW", 6, "bandwidth of the gyroscope")
    GYRO_RANGE = ("GRG", 3, "range of the gyroscope")
    INCLINATION_FORMAT = ("INC_FMT", 1, "format of the inclinometer")


def _code(code: OlderCode) -> Setting:
    name, most, meaning = code.value

    def write(_target: Target, value: float) -> RequestScript[None]:
        yield from send_if_known(command(f"CONFIG IMU {name} {number_text(value)}"))

    value_type = Annotated[float, Meta(ge=0)] if most is None else Annotated[int, Meta(ge=0, le=most)]
    description = f"{meaning}, code {name} of older firmware without a documented unit"
    return Setting(type=described(value_type, description, SOURCE), write=write, report=Query.USRCONFIG)


def code_values(raw: Mapping[str, str]) -> dict[str, Any]:
    """Return the codes of older firmware in reports. Values outside their range are not included."""
    found: dict[str, Any] = {}
    for code in OlderCode:
        name, most, _ = code.value
        text = raw.get(name, "")
        number = (numbers_of(text, 1) or [-1])[0] if most is None else whole(text)
        if number is not None and number >= 0 and (most is None or number <= most):
            found[code.name.lower()] = number
    return found


# --- INS models -------------------------------------------------------------------------------------------------------


def _write_baseline(_target: Target, value: float) -> RequestScript[None]:
    yield from send_if_known(command(f"SETBASELINE {number_text(value)}"))


_BASELINE: Final = re.compile(r"\bBASELINE\b\W*?([-+]?\d+(?:\.\d*)?)", re.IGNORECASE)


def baseline_of(raw: Mapping[str, str]) -> float | None:
    """Return the baseline in reports, m; None without it."""
    for name, text in raw.items():
        if found := _BASELINE.search(f"{name}: {text}"):
            return float(found[1])
    return None


def ins_config(_target: Target) -> RequestScript[dict[str, str]]:
    """Read the configuration of the INS (LOG INSCONFIG) by the names of the device. Raises NoReply, Rejected."""
    lines = yield from send_if_known(commands.ask(Query.INSCONFIG))
    report = parse_report(lines)
    return {**report.values, **{f"line {number}": line for number, line in enumerate(report.other, 1)}}


def reset_attitude(_target: Target, *, kind: Annotated[Literal[1, 4], Meta(extra={"section": SOURCE})]) -> Any:
    """Send ATT RST 1 or 4 of older firmware."""
    return send_if_known(command(f"CONFIG ATT RST {kind}"))


SETTINGS: Final[Mapping[str, Setting]] = {
    **{code.name.lower(): _code(code) for code in OlderCode},
    "baseline": Setting(
        type=described(float, "baseline of INS models (SETBASELINE; assumption: one number)", SOURCE, "m"),
        write=_write_baseline,
        report=Query.INSCONFIG,
    ),
    "port_baud": Setting(
        type=described(dict[Port, BaudRate], "baud rate of other ports of the device", SOURCE, "bit/s"),
        write=_write_port_baud,
        report=Query.COMCONFIG,
        agrees=has_all,
    ),
}

# Names of all settings that firmware 1.5.9 does not report
NAMES: Final = frozenset({*SETTINGS, "port_output", "coordinates"})
