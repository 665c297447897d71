"""Settings of a HiPNUC device on a UART: manual "IMU配置手冊" V1.5.9, chapter 2 and section 8.2.

imud reads them from LOG USRCONFIG, COMCONFIG and MAGCONFIG (`replies.py`). The manual shows one line of each report, so
imud ignores values of an unknown form. `report_values` returns the known values by name, `shown` as readable text.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import chain
from math import isclose
from typing import Annotated, Any, Final, Literal, get_args

import msgspec
from msgspec import Meta

from imud.attitude.conventions import FLU_NWU, RFU_ENU, EulerOrder
from imud.attitude.rotation import Matrix3
from imud.contracts.command import Target
from imud.contracts.driver import SentAxes
from imud.contracts.lines import AlarmRange, AlarmRanges, DeviceLines
from imud.contracts.script import RequestScript
from imud.contracts.setting import DeviceReport, Effect, Reports, Setting, SettingsTable
from imud.drivers.hipnuc.common import AttitudeMode
from imud.drivers.hipnuc.uart import commands, firmware
from imud.drivers.hipnuc.uart.commands import (
    BAUD_RATES,
    MAX_RATE_HZ,
    PIN_MAX,
    ROTATION_TOLERANCE,
    SOUT_DIVIDER_MAX,
    AlarmAxis,
    BaudRate,
    Mounting,
    MountingName,
    OutputMessage,
    OutputRate,
    PinFunction,
    PinName,
    Query,
    command,
    message_of,
    send,
    send_if_known,
)
from imud.drivers.hipnuc.uart.firmware import (
    ON_MARK,
    Digits,
    DigitsNumber,
    Port,
    described,
    digits_of,
    has_all,
    matrix_of_digits,
)
from imud.drivers.hipnuc.uart.replies import numbers_of, parse_comconfig, whole
from imud.model.errors import BadArgument
from imud.model.options import Options

# Values of COORD (newer firmware): axes and angles that the device sends
RFU_312: Final = SentAxes(
    RFU_ENU, "312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above", "ENU"
)
COORDINATES: Final = {
    "0": RFU_312,
    "4": SentAxes(
        FLU_NWU,
        "ZYX (321): yaw about Z, then pitch about Y, then roll about X; yaw counter-clockwise from above",
        "NWU",
    ),
}


def axes_by_settings(settings: Mapping[str, str]) -> SentAxes:
    """Return the axes of the setting `coordinates`; without the setting, the axes of the manual."""
    value = settings.get("coordinates", "0")
    if value in COORDINATES:
        return COORDINATES[value]
    known = " or ".join(COORDINATES)
    problem = (
        f"coordinates: expected {known} from the device (COORD), got {value}: imud describes axes and angles as with "
        "0, which can be wrong; run `imud settings NAME --set coordinates=0 --save`, or configure `frame`"
    )
    return replace(RFU_312, problem=problem)


PIN_SETTING: Final = "PMUX5"  # selects the function of the pin
MOUNTING_SETTING: Final = "URFR"  # rotates the sensor axes, also X and Y of the alarm
# Index of the angle about an axis in `euler_rad`: with 312, pitch is about X. With 321, roll is about X.
EULER_INDEX: Final = {EulerOrder.ZXY: {"X": 1, "Y": 0}, EulerOrder.ZYX: {"X": 0, "Y": 1}}

_NUMBER = r"[-+]?[0-9]+(?:\.[0-9]*)?"
_NAME: Final = re.compile(rf"(?:{PIN_SETTING}|.*ALARM)(?:[_ ]?([XY]))?", re.IGNORECASE)
_VALUES: Final = re.compile(
    rf"(?:([XY])\s*,\s*)?({_NUMBER})\s*,\s*({_NUMBER})\s*,\s*{_NUMBER}\s*,\s*([01])", re.IGNORECASE
)
# `COORD 4`, `COORD=4`, `COORD: 4` or `coord,4`; no document of the vendor shows the line
_COORD: Final = re.compile(r"(?<![A-Z])COORD(?![A-Z])\s*[=:,]*\s*([^\s,;]*)", re.IGNORECASE)
_PIN: Final = re.compile(r"IO([1-9])\b")
_DIVISOR: Final = re.compile(r"(?:.*\bDIV)?\s*(\d{1,2})\b")


def alarm_ranges(settings: Mapping[str, Any]) -> AlarmRanges:
    """Return the alarm ranges in the values of the device settings."""
    index = EULER_INDEX[axes_by_settings({"coordinates": str(settings.get("coordinates", 0))}).axes.order]
    by_axis = {
        axis.upper(): AlarmRange(index[axis.upper()], one.min_deg, one.max_deg, one.enabled)
        for axis, one in settings.get("alarm", {}).items()
    }
    return AlarmRanges(by_axis, PIN_SETTING, MOUNTING_SETTING)


MessageName = Literal["hi91", "hi92", "hi81", "hi83", "gga", "rmc", "sxt"]
MANUAL_MESSAGES: Final = frozenset({"hi91", "hi92"})  # messages of every device; the others need newer firmware
SAMPLE_MESSAGES: Final = {one.value.lower() for one in OutputMessage}  # messages that imud decodes
Output = dict[MessageName, OutputRate | Literal["on_mark"]]
PortOutput = dict[Port, Output]
Modes = Literal["6-axis", "9-axis", "humanoid", "slow_vehicle", "low_dynamics"]
MODES: Final[Mapping[Modes, AttitudeMode]] = {
    "6-axis": AttitudeMode.SIX_AXIS, "9-axis": AttitudeMode.NINE_AXIS, "humanoid": AttitudeMode.HUMANOID,
    "slow_vehicle": AttitudeMode.SLOW_VEHICLE, "low_dynamics": AttitudeMode.LOW_DYNAMICS,
}  # fmt: skip
MODE_OF: Final = {mode.value: name for name, mode in MODES.items()}  # by the value of ATT_MODE
Coordinates = Literal[0, 4]
MountingValue = MountingName | Digits | DigitsNumber | list[float]
Axis = Literal["x", "y"]
Pin = Annotated[int, Meta(ge=1, le=PIN_MAX)]
Angle = Annotated[float, Meta(ge=-180, le=180, extra={"unit": "°"})]


class AngleAlarm(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Range of one angle. The alarm pin is high outside the range."""

    min_deg: Angle
    max_deg: Angle
    enabled: bool = True


# --- reading ----------------------------------------------------------------------------------------------------------


def report_values(raw: Mapping[str, str]) -> dict[str, Any]:
    """Return the settings in reports (`commands.read_report`) by name."""
    outputs = parse_comconfig(raw.values())
    alarms: dict[str, AngleAlarm] = {}
    coordinates: int | str | None = None
    for name, text in raw.items():
        named, values = _NAME.fullmatch(name.strip()), _VALUES.fullmatch(text.strip())
        if named and values and (axis := (values[1] or named[1] or "").lower()):
            low, high = float(values[2]), float(values[3])
            alarms[axis] = AngleAlarm(min_deg=low, max_deg=high, enabled=values[4] == "1")
        if coordinates is None and (found := _COORD.search(f"{name}: {text}")):
            number = numbers_of(found[1], 1)
            coordinates = found[1] or "no value"
            if number is not None:
                coordinates = int(number[0]) if number[0] == int(number[0]) else f"{number[0]:g}"
    pins = {}
    for function in PinFunction:
        if found := _PIN.match(raw.get(f"PMUX{function.value}", "")):
            pins[function.name.lower()] = int(found[1])
    urfr = numbers_of(raw.get("URFR", ""), 9)
    mounting: str | list[float] | None = urfr
    if (digits := digits_of(raw.get("URFR", ""))) in get_args(Digits):
        mounting = digits
    for one in Mounting:
        if urfr is not None and _near(chain(*one.value), urfr):
            mounting = one.name.lower()
            break
    calibrates, baud, mode = whole(raw.get("EN_MCAL")), whole(raw.get("BAUD")), whole(raw.get("ATT_MODE"))
    divisor = _DIVISOR.match(raw.get("SOUT_DIV", ""))
    reported: dict[str, Any] = {
        "output": firmware.rates_of(outputs) or None,
        "port_output": {port.lower(): firmware.rates_of(one) for port, one in outputs.ports.items()} or None,
        "port_baud": firmware.port_bauds(raw) or None,
        "mode": None if mode is None else MODE_OF.get(mode, str(mode)),
        "mounting": mounting,
        "magnetic_calibration": None if calibrates is None else calibrates != 0,
        "pins": pins or None,
        "sout_divisor": int(divisor[1]) if divisor else None,
        "alarm": alarms or None,
        "coordinates": coordinates,
        "magnetometer_bias": numbers_of(raw.get("MB", ""), 3),
        "baud": baud if baud in BAUD_RATES else None,
        "baseline": firmware.baseline_of(raw),
        **firmware.code_values(raw),
    }
    return {name: value for name, value in reported.items() if value is not None}


def why_silent(settings: Mapping[str, Any]) -> str:
    """Return why a device with these values of its settings replies but sends no samples."""
    output = {name: rate for name, rate in settings.get("output", {}).items() if name in SAMPLE_MESSAGES}
    rates = {name: rate for name, rate in output.items() if rate not in (0, ON_MARK)}
    if rates:
        name, rate_hz = max(rates.items(), key=lambda item: item[1])
        return f"its output is disabled (LOG DISABLE); {name.upper()} has the rate {rate_hz:g} Hz"
    if marked := sorted(name.upper() for name, rate in output.items() if rate == ON_MARK):
        return f"{' and '.join(marked)} on mark, one frame for each pulse on SIN"
    return "no message has a rate" if output else "its output is off, or on mark"


def shown(raw: Mapping[str, str]) -> dict[str, str]:
    """Return the settings by name, as text with units. Unknown settings keep the name and text of the device."""
    found: dict[str, str] = {}
    known = report_values(raw)
    for name, value in known.items():
        match name, value:
            case "output" | "port_output", dict():
                found |= firmware.shown_rates(name, value)
            case "port_baud", dict():
                found |= {f"port_baud.{port}": f"{baud} bit/s" for port, baud in value.items()}
            case "pins", dict():
                for function, pin in value.items():
                    found[f"pins.{function}"] = f"IO{pin}"
            case "alarm", dict():
                for axis, alarm in value.items():
                    state = "on" if alarm.enabled else "off"
                    found[f"alarm.{axis}"] = f"{alarm.min_deg:g}° … {alarm.max_deg:g}°, {state}"
            case "magnetometer_bias", [x, y, z]:
                found[name] = f"{x:g}, {y:g}, {z:g} µT" if any(value) else "0, 0, 0 µT: not calibrated"
            case "baud", int():
                found[name] = f"{value} bit/s"
            case "mounting", list():
                found[name] = ", ".join(f"{number:g}" for number in value)
            case "baseline", float():
                found[name] = f"{value:g} m"
            case _:
                found[name] = {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)
    # a line contains no known setting if the known settings are the same without its text
    return found | {name: text for name, text in raw.items() if report_values({**raw, name: ""}) == known}


def _near(one: Iterable[float], other: Iterable[float]) -> bool:
    """Return whether two mountings agree, each given by its nine numbers."""
    return all(map(partial(isclose, rel_tol=0, abs_tol=ROTATION_TOLERANCE), one, other))


def _read(_target: Target, names: Collection[str] | None) -> RequestScript[Reports]:
    reports: dict[str, DeviceReport] = {}
    for query in (Query.USRCONFIG, Query.COMCONFIG, Query.MAGCONFIG, Query.INSCONFIG):
        output = reports[Query.COMCONFIG].values.get("output", {}) if Query.COMCONFIG in reports else {}
        is_due = query is not Query.INSCONFIG or not output.keys() <= {*MANUAL_MESSAGES, "hi83"}  # an INS model
        if (names is None and is_due) or (names is not None and query in names):
            words = yield from commands.read_report(query)
            if words is not None:
                reports[str(query)] = DeviceReport(words, report_values(words))
    return reports


# --- writing ----------------------------------------------------------------------------------------------------------


def _output(_target: Target, value: Output) -> RequestScript[None]:
    """Set each named message. `check` compares the load with the baud rate, which imud sets later."""
    if value.keys() >= MANUAL_MESSAGES and not any(value.values()):
        yield from send(commands.unlog_all())  # also messages that imud does not decode
    yield from _send_output(value)


def _send_output(value: Output, port: str = "") -> RequestScript[None]:
    """Set each named message. `port`: empty for the port of imud, otherwise for example `COM2 `."""
    for name, rate in value.items():
        message = message_of(name)
        for request in (
            commands.log_ontime(message, 0 if rate == ON_MARK else rate, port),
            *([commands.log_onmark(message, port)] if rate == ON_MARK else []),
        ):
            if port or name not in MANUAL_MESSAGES:
                yield from send_if_known(request)
            else:
                yield from send(request)


def _port_output(_target: Target, value: PortOutput) -> RequestScript[None]:
    for port, output in value.items():
        yield from _send_output(output, f"{port.upper()} ")


def _output_enabled(_target: Target, value: bool) -> RequestScript[None]:
    return send(commands.log_enable() if value else commands.log_disable())


def _mode(_target: Target, value: Modes) -> RequestScript[None]:
    request = commands.attitude_mode(MODES[value])
    if value in ("6-axis", "9-axis"):
        yield from send(request)
    else:
        yield from send_if_known(request)


def _coordinates(_target: Target, value: Coordinates) -> RequestScript[None]:
    yield from send_if_known(command(f"CONFIG IMU COORD {value}"))


def _mounting(_target: Target, value: MountingValue) -> RequestScript[None]:
    if not isinstance(value, list) and digits_of(value):
        yield from send_if_known(firmware.mounting_by_digits(str(value)))
    else:
        yield from send(commands.mounting(matrix_of(value)))


def matrix_of(value: MountingValue) -> Matrix3:
    """Return the URFR matrix of a mounting by name, by its digits or by its nine numbers, rows first.

    Raises BadArgument for impossible digits.
    """
    if isinstance(value, int) or (isinstance(value, str) and digits_of(value)):
        return matrix_of_digits(str(value))
    if isinstance(value, str):
        return Mounting[value.upper()].value
    a, b, c, d, e, f, g, h, i = value
    return ((a, b, c), (d, e, f), (g, h, i))


def _magnetic_calibration(_target: Target, value: bool) -> RequestScript[None]:
    return send(commands.magnetic_calibration(value))


def _pins(_target: Target, value: dict[PinName, int]) -> RequestScript[None]:
    for function, pin in value.items():
        yield from send(commands.pin_function(PinFunction[function.upper()], pin))


def _sout_divisor(_target: Target, value: int) -> RequestScript[None]:
    return send(commands.sout_divider(value))


def _write_alarm(_target: Target, value: dict[Axis, AngleAlarm]) -> RequestScript[None]:
    for axis, one in value.items():
        yield from send(commands.alarm(AlarmAxis(axis.upper()), one.min_deg, one.max_deg, one.enabled))


def _baud(target: Target, value: BaudRate) -> RequestScript[int]:
    return commands.change_baud(value, target.baud)


def _save(_target: Target) -> RequestScript[None]:
    return send(commands.save_config())


def _restart(target: Target) -> RequestScript[Any]:
    return commands.restart(target.baud)


# --- comparison and checks --------------------------------------------------------------------------------------


def _has_all_parts(declared: Mapping[str, Any], actual: Mapping[str, Any]) -> bool:
    """Return whether the actual values of each port contain the declared values of this port."""
    return all(has_all(one, actual.get(port, {})) for port, one in declared.items())


def _has_outputs(declared: Output, actual: Output) -> bool:
    """Return whether all declared messages have their rate. HI81 or HI83 is off if the device does not report it."""
    return all(actual.get(name, None if name in MANUAL_MESSAGES else 0) == rate for name, rate in declared.items())


def _same_mounting(declared: MountingValue, actual: MountingValue) -> bool:
    return _near(chain(*matrix_of(declared)), chain(*matrix_of(actual)))


def _check(target: Target, values: Mapping[str, Any]) -> None:
    """Raise BadArgument for too much output, two functions on one pin, and an empty range of an alarm."""
    problems = []
    baud = values.get("baud", target.baud)
    output = values.get("output", {})
    if baud in BAUD_RATES:
        rates = {message_of(name): float(rate) for name, rate in output.items() if rate != ON_MARK}
        try:
            commands.require_room(rates, baud)
        except BadArgument as error:
            problems.append(str(error))
    if isinstance(mounting := values.get("mounting"), int):
        try:
            matrix_of(mounting)
        except BadArgument as error:
            problems.append(str(error))
    taken: dict[int, str] = {}
    for function, pin in values.get("pins", {}).items():
        if pin in taken:
            both = f"{taken[pin]} and {function}"
            problems.append(f"pins: expected another pin for each function, got IO{pin} for {both}")
        taken[pin] = function
    for axis, one in msgspec.to_builtins(values.get("alarm", {})).items():
        if not one["min_deg"] < one["max_deg"]:
            got = f"{one['min_deg']:g}° and {one['max_deg']:g}°"
            problems.append(f"alarm.{axis}: expected the minimum below the maximum, got {got}")
    if problems:
        raise BadArgument("; ".join(problems))


# Settings of a device, in writing order. Level (CONFIG ATT RST) and heading (CONFIG YAW) depend on the present
# attitude, so they are verbs.
SETTINGS: Final = SettingsTable(
    table={
        "mode": Setting(
            type=described(
                Modes,
                "attitude without or with the magnetometer for the heading; three modes of newer firmware",
                "2.2.4",
            ),
            write=_mode,
            report=Query.USRCONFIG,
        ),
        "mounting": Setting(
            type=described(
                MountingName | Digits | DigitsNumber | Annotated[list[float], Meta(min_length=9, max_length=9)],
                "new sensor axis that points up or down in place of Z, the nine numbers C00 … C22 of URFR, or "
                "digits of newer firmware: direction of X, Y, Z, 0 right, 1 left, 2 front, 3 back, 4 up, 5 down",
                "2.2.4",
            ),
            write=_mounting,
            report=Query.USRCONFIG,
            effect=Effect.AFTER_RESTART,
            agrees=_same_mounting,
        ),
        "magnetic_calibration": Setting(
            type=described(bool, "whether the background calibration of the magnetometer is enabled", "8.2"),
            write=_magnetic_calibration,
            report=Query.USRCONFIG,
        ),
        "pins": Setting(
            type=described(
                dict[PinName, Pin], "pin of each function, 1 for IO1; other functions are unchanged", "2.2.4"
            ),
            write=_pins,
            report=Query.USRCONFIG,
            agrees=has_all,
        ),
        "sout_divisor": Setting(
            type=described(
                Annotated[int, Meta(ge=1, le=SOUT_DIVIDER_MAX)], "pulses on SOUT per pulse on SOUT_DIV", "2.2.4"
            ),
            write=_sout_divisor,
            report=Query.USRCONFIG,
        ),
        "alarm": Setting(
            type=described(
                dict[Axis, AngleAlarm],
                "angles outside which the alarm pin is high, by axis; other axes are unchanged",
                "2.2.4",
                "°",
            ),
            write=_write_alarm,
            report=Query.USRCONFIG,
            agrees=has_all,
        ),
        "output": Setting(
            type=described(
                Output,
                "rate of each message, 0: off, on_mark: one frame for each pulse on SIN; other messages are unchanged",
                "2.2.5",
                "Hz",
            ),
            write=_output,
            report=Query.COMCONFIG,
            agrees=_has_outputs,
        ),
        "output_enabled": Setting(
            type=described(bool, "whether the device sends frames of any rate", "2.2.5"),
            write=_output_enabled,
            readable=False,
        ),
        "coordinates": Setting(
            type=described(
                Coordinates,
                "axes and angles of newer firmware (COORD): 0 as in the manual (ENU), 4 NWU with x forward",
                firmware.SOURCE,
            ),
            write=_coordinates,
            report=Query.USRCONFIG,
            effect=Effect.AFTER_RESTART,  # no document states it: after a restart, the axes agree with the report
        ),
        "port_output": Setting(
            type=described(PortOutput, "rate of each message on other ports of the device", firmware.SOURCE, "Hz"),
            write=_port_output,
            report=Query.COMCONFIG,
            agrees=_has_all_parts,
        ),
        **firmware.SETTINGS,
        "magnetometer_bias": Setting(
            type=described(
                list[float],
                "offset from the calibration of the magnetometer; zero: not calibrated",
                "8.1.1",
                "µT",
            ),
            report=Query.MAGCONFIG,
        ),
        "baud": Setting(
            type=described(BaudRate, "baud rate of the serial port; saves all other settings too", "2.2.3", "bit/s"),
            write=_baud,
            report=Query.COMCONFIG,
            connection=True,
            saves=True,
        ),
    },
    read=_read,
    save=_save,
    restart=_restart,
    check=_check,
)

# Function of the device pin by key of the GPIO line
FUNCTIONS: Final = {"sin": "sin", "pps": "sin", "sout": "sout", "sout_div": "sout_div", "alarm": "alarm"}


def declared_line_differences(values: Mapping[str, Any], lines: DeviceLines) -> dict[str, str]:
    """Return contradictions of GPIO lines and declared settings. A partial declaration is not compared."""
    known = dict(values)
    if not set(known.get("output") or ()) >= MANUAL_MESSAGES:
        known.pop("output", None)
    known.pop("alarm", None)
    return line_differences(known, lines)


def message_limits(values: Mapping[str, Any], lines: DeviceLines, fed: bool) -> list[str]:
    """Return the restrictions of HI92 with this configuration, if the declared settings enable HI92.

    `fed`: imud sends sentences with UTC to the device.
    """
    output = values.get("output") or {}
    if not output.get("hi92"):
        return []
    found = []
    if fed or lines.pps is not None:
        found.append("HI92 has no UTC: the host time-stamps its samples; HI91 can have UTC time stamps")
    if output.get("hi91"):
        found.append("HI92 next to HI91 is time-stamped by its arrival; alone it is time-stamped by its pps_sync_stamp")
    return found


def line_differences(values: Mapping[str, Any], lines: DeviceLines) -> dict[str, str]:
    """Return contradictions of GPIO lines and device settings, one sentence by key of the line."""
    found: dict[str, list[str]] = {}
    for key, words in (
        *_shared_pins(values.get("pins", {}), lines),
        *_divisor(values.get("sout_divisor"), lines),
        *_marks(values.get("output"), values.get("baud"), lines),
        *_alarm_differences(values.get("alarm"), lines),
    ):
        found.setdefault(key, []).append(words)
    return {key: "; ".join(words) for key, words in found.items()}


def _shared_pins(pins: Mapping[str, int], lines: DeviceLines) -> Iterator[tuple[str, str]]:
    """Yield the lines whose pin has two functions: the active function is not known."""
    for key, function in FUNCTIONS.items():
        if getattr(lines, key) is None or function not in pins:
            continue
        others = [other for other, pin in pins.items() if pin == pins[function] and other != function]
        if others:
            yield (
                key,
                f"the device has {function} and {' and '.join(others)} on IO{pins[function]}: move one (setting pins)",
            )


def _divisor(divisor: int | None, lines: DeviceLines) -> Iterator[tuple[str, str]]:
    configured = lines.sout_div.divisor if lines.sout_div is not None else divisor
    if divisor is not None and configured != divisor:
        yield "sout_div", f"expected divisor {configured} from the configuration, got {divisor} from the device"


def _marks(output: Mapping[str, Any] | None, baud: int | None, lines: DeviceLines) -> Iterator[tuple[str, str]]:
    """Yield contradictions of messages on mark: triggers need such a message, a pulse per second forbids it."""
    if output is None:
        return
    marked = [
        OutputMessage(name.upper()) for name, rate in output.items() if rate == ON_MARK and name in SAMPLE_MESSAGES
    ]
    if lines.sin is not None:
        if not marked:
            yield (
                "sin",
                "no message of the device is on mark, so triggers make no samples: try output.hi91=on_mark",
            )
        for message in marked:
            most_hz = MAX_RATE_HZ[message].get(baud or 0)
            if baud in BAUD_RATES and most_hz is not None and lines.sin.rate_hz > most_hz:
                got = f"{lines.sin.rate_hz:g} Hz"
                yield "sin", f"expected triggers of at most {most_hz} Hz for {message} at {baud} baud, got {got}"
        if marked == [OutputMessage.HI92]:
            yield "sin", "HI92 on mark has no device time: imud cannot pair its samples with triggers; use HI91"
    if lines.pps is not None and marked:
        yield (
            "pps",
            f"{' and '.join(marked)} on mark: each pulse per second makes a sample; set a rate with the setting output",
        )


def _alarm_differences(alarm: Mapping[str, Any] | None, lines: DeviceLines) -> Iterator[tuple[str, str]]:
    if alarm is not None and lines.alarm is not None and not any(one.enabled for one in alarm.values()):
        yield "alarm", "the device watches no angle, so the line stays low: set a range with the setting alarm"
