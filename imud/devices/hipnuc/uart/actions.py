"""Actions of a HiPNUC module on a UART: every command of chapter 2 of the manual by name, with its arguments.

The parameters of each function describe the arguments of its action: type, range, unit and section of the manual.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions, Risk, Target
from imud.contracts.driver import Identity
from imud.contracts.session import Request, RequestScript
from imud.devices.hipnuc.uart import commands, session
from imud.devices.hipnuc.uart.commands import (
    PIN_MAX,
    SOUT_DIVIDER_MAX,
    AlarmAxis,
    AttitudeMode,
    BaudRate,
    LevelReset,
    Mounting,
    MountingName,
    OutputMessage,
    OutputRate,
    PinFunction,
    PinName,
    YawMode,
)
from imud.devices.hipnuc.uart.session import send

Message = Annotated[OutputMessage, Meta(extra={"section": "2.2.5"})]
Degrees = Annotated[float, Meta(ge=-180, le=180, extra={"unit": "°", "section": "2.2.4"})]
Enabled = Annotated[bool, Meta(extra={"section": "2.2.4"})]

_MOUNTINGS: Final = {mounting.name.lower(): mounting for mounting in Mounting}


def _simple(words: str, make: Callable[[], Request], risk: Risk = Risk.NONE) -> Action:
    """An action without arguments that is one command."""
    return Action(words, lambda _target: send(make()), risk)


def _restart(target: Target) -> RequestScript[Identity]:
    return session.restart(target.baud)


def _factory_reset(target: Target) -> RequestScript[dict[str, int | str]]:
    return _followed(target, session.reset_to_factory(target.baud))


def _followed(target: Target, script: RequestScript[int]) -> RequestScript[dict[str, int | str]]:
    """Answer the baud rate at which the module is now, and what to change in the configuration."""
    baud = yield from script
    answer: dict[str, int | str] = {"baud": baud}
    if advice := session.advice(baud, target.fixed_baud):
        answer["configuration"] = advice
    return answer


def _wake(target: Target) -> RequestScript[str]:
    return session.wake_by_force(target.baud)


def _baud(
    target: Target,
    *,
    baud: Annotated[BaudRate, Meta(description="rate of the line", extra={"unit": "bit/s", "section": "2.2.3"})],
) -> RequestScript[dict[str, int | str]]:
    return _followed(target, session.change_baud(baud, target.baud))


def _output(
    target: Target,
    *,
    message: Message,
    rate_hz: Annotated[
        OutputRate, Meta(description="output rate, 0 for off", extra={"unit": "Hz", "section": "2.2.5"})
    ],
) -> RequestScript[None]:
    return session.set_output(message, rate_hz, target.baud)


def _output_on_mark(_target: Target, *, message: Message) -> RequestScript[None]:
    return send(commands.log_onmark(message))


def _output_once(_target: Target, *, message: Message) -> RequestScript[None]:
    return send(commands.log_once(message))


def _output_enabled(_target: Target, *, enabled: Enabled) -> RequestScript[None]:
    return send(commands.log_enable() if enabled else commands.log_disable())


def _mode(_target: Target, *, axes: Annotated[Literal[6, 9], Meta(extra={"section": "2.2.4"})]) -> RequestScript[None]:
    return send(commands.attitude_mode(AttitudeMode.NINE_AXIS if axes == 9 else AttitudeMode.SIX_AXIS))


def _level(
    _target: Target,
    *,
    level: Annotated[Literal["relative", "automatic", "cancel"], Meta(extra={"section": "2.2.4"})],
) -> RequestScript[None]:
    return send(commands.level_reset(LevelReset[level.upper()]))


def _yaw(
    _target: Target,
    *,
    angle_deg: Degrees,
    relative: Annotated[bool, Meta(description="add it to the present one")] = False,
) -> RequestScript[None]:
    return send(commands.yaw(YawMode.RELATIVE if relative else YawMode.ABSOLUTE, angle_deg))


def _mounting(
    _target: Target,
    *,
    turned: Annotated[
        MountingName | Annotated[list[float], Meta(min_length=9, max_length=9)],
        Meta(
            description="new axis that points up or down where Z pointed up, or the nine numbers C00 … C22 of URFR",
            extra={"section": "2.2.4"},
        ),
    ],
) -> RequestScript[None]:
    if isinstance(turned, str):
        return send(commands.mounting(_MOUNTINGS[turned]))
    a, b, c, d, e, f, g, h, i = turned
    return send(commands.mounting(((a, b, c), (d, e, f), (g, h, i))))


def _magnetic_calibration(_target: Target, *, enabled: Enabled) -> RequestScript[None]:
    return send(commands.magnetic_calibration(enabled))


def _pin(
    _target: Target,
    *,
    function: Annotated[PinName, Meta(extra={"section": "2.2.4"})],
    pin: Annotated[int, Meta(ge=1, le=PIN_MAX, description="1 for IO1, and so on", extra={"section": "2.2.4"})],
) -> RequestScript[None]:
    return send(commands.pin_function(PinFunction[function.upper()], pin))


def _alarm(
    _target: Target, *, axis: AlarmAxis, min_deg: Degrees, max_deg: Degrees, enabled: Enabled = True
) -> RequestScript[None]:
    return send(commands.alarm(axis, min_deg, max_deg, enabled))


def _sout_divider(
    _target: Target, *, divisor: Annotated[int, Meta(ge=1, le=SOUT_DIVIDER_MAX, extra={"section": "2.2.4"})]
) -> RequestScript[None]:
    return send(commands.sout_divider(divisor))


ACTIONS: Final[Actions] = {
    "save": replace(_simple("write all settings to flash", commands.save_config), saves=True),
    "restart": Action("restart it and wait until it answers; what was not saved is lost", _restart),
    "factory_reset": Action(
        "factory settings, the baud rate (115200) included: restart it, so that they are in force, and follow",
        _factory_reset,
        Risk.RESET,
    ),
    "wake": Action(
        "let frames out, and send HI91 where no message has a rate, also in place of output on mark; not saved", _wake
    ),
    "baud": Action("set the baud rate, save, restart and follow", _baud, Risk.CONNECTION, saves=True),
    "output": Action("send a message by itself at a rate, or not at all (0)", _output),
    "output_on_mark": Action("send a message for each pulse on SIN", _output_on_mark),
    "output_once": Action("send a message once, as a pulse on SIN would", _output_once),
    "output_none": _simple("send nothing by itself", commands.unlog_all),
    "output_enabled": Action("let frames out, or none whatever their rates", _output_enabled),
    "mode": Action("6 axes, or 9 with the magnetometer", _mode),
    "level": Action("make the present pitch and roll zero, level when nearly level, or cancel; at rest only", _level),
    "yaw": Action("set the heading; lost at power-off", _yaw),
    "mounting": Action("how the module is mounted; needs save and restart", _mounting),
    "magnetic_calibration": Action("calibrate the magnetometer in the background", _magnetic_calibration),
    "pin": Action("give a function to a pin", _pin),
    "alarm": Action("watch an angle with the alarm pin", _alarm),
    "sout_divider": Action("divide SOUT for SOUT_DIV", _sout_divider),
}
