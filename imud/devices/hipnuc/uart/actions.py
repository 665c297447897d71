"""What a HiPNUC module on a UART can be told by name: every command of chapter 2 of the manual, with its arguments."""

from collections.abc import Callable
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions, Target
from imud.contracts.driver import Identity
from imud.contracts.session import Rejection, Request, RequestScript, Silence, pause
from imud.contracts.settings import Settings
from imud.devices.hipnuc.uart import commands
from imud.devices.hipnuc.uart.commands import (
    BAUD_RATES,
    AlarmAxis,
    AttitudeMode,
    LevelReset,
    Mounting,
    OutputMessage,
    PinFunction,
    YawMode,
)
from imud.devices.hipnuc.uart.session import identify
from imud.errors import BadArgument, NoReply, Rejected
from imud.units import NS_PER_S

BOOT_NS: Final = NS_PER_S
"""From REBOOT until it answers; the manual gives no time."""
BOOT_TRIES: Final = 5


class OutputParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What it sends by itself."""

    message: OutputMessage
    rate_hz: int
    """One of the rates of section 2.2.5; 0 turns the message off."""


class MessageParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A message."""

    message: OutputMessage


class BaudParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A rate."""

    baud: int


class EnabledParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """On or off."""

    enabled: bool


class ModeParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Whether the magnetometer aids the heading."""

    axes: Literal[6, 9]


class LevelParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What to do with the level."""

    level: Literal["relative", "automatic", "cancel"]


class YawParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A heading."""

    angle_deg: float
    relative: bool = False
    """Add it to the present one."""


class MountingParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the module is mounted."""

    turned: Literal["level", "x-90", "x+90", "x180", "y+90", "y-90", "y180", "z+90", "z-90"] | list[float]
    """Turned about one of the old axes, or the nine numbers C00 … C22 of URFR."""


class PinParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A function for a pin."""

    function: Literal["sin", "sout", "led", "sout_div", "alarm"]
    pin: int
    """1 for IO1, and so on."""


class AlarmParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The range outside which the alarm pin is high."""

    axis: AlarmAxis
    min_deg: float
    max_deg: float
    enabled: bool = True


class DividerParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Every which SOUT pulse comes out of SOUT_DIV."""

    divisor: Annotated[int, Meta(ge=1, le=commands.SOUT_DIVIDER_MAX)]


_MOUNTINGS: Final = {
    "level": Mounting.LEVEL,
    "x-90": Mounting.X_MINUS_90,
    "x+90": Mounting.X_PLUS_90,
    "x180": Mounting.X_180,
    "y+90": Mounting.Y_PLUS_90,
    "y-90": Mounting.Y_MINUS_90,
    "y180": Mounting.Y_180,
    "z+90": Mounting.Z_PLUS_90,
    "z-90": Mounting.Z_MINUS_90,
}


def told(request: Request) -> RequestScript[None]:
    """Send one command. Raises NoReply (also for a command this firmware does not know) and Rejected."""
    outcome = yield request
    if isinstance(outcome, Silence):
        raise NoReply(f"{request.name}: expected OK, got nothing; is the host's transmit line connected?")
    if isinstance(outcome, Rejection):
        raise Rejected(f"{request.name}: the module refused: {' / '.join(outcome.lines)}")


def restart() -> RequestScript[Identity]:
    """Restart and wait until it answers. What was not saved is lost. Raises NoReply."""
    yield commands.reboot()
    return (yield from _back(0))


def change_baud(baud: int, present_baud: int) -> RequestScript[int]:
    """Set the baud rate, save, restart, and follow; return the rate. Saves all other settings too.

    Raises BadArgument, NoReply, and Rejected where it answers at the old rate only; the line is then left there.
    """
    yield from told(commands.serial_config(baud))
    yield from told(commands.save_config())
    yield commands.reboot()
    try:
        yield from _back(baud)
    except NoReply:
        yield pause(0, baud=present_baud)
        yield from _back(present_baud)
        raise Rejected(f"SERIALCONFIG {baud}: the module stays at {present_baud} baud") from None
    return baud


def _back(baud: int) -> RequestScript[Identity]:
    """It restarts: ask until it answers, at the rate if one is given."""
    yield pause(BOOT_NS, baud=baud)
    for _ in range(BOOT_TRIES - 1):
        try:
            return (yield from identify())
        except NoReply:
            continue
    return (yield from identify())


def _simple(make: Callable[[], Request], words: str) -> Action:
    return Action(words, lambda _target, _params: told(make()))


def _output(target: Target, params: OutputParams) -> RequestScript[None]:
    baud = target.baud if target.baud in BAUD_RATES else None
    return told(commands.log_ontime(params.message, params.rate_hz, baud))


def _yaw(_target: Target, params: YawParams) -> RequestScript[None]:
    return told(commands.yaw(YawMode.RELATIVE if params.relative else YawMode.ABSOLUTE, params.angle_deg))


def _mounting(_target: Target, params: MountingParams) -> RequestScript[None]:
    turned = params.turned
    if isinstance(turned, str):
        return told(commands.mounting(_MOUNTINGS[turned]))
    if len(turned) != 9:
        raise BadArgument(f"turned: expected nine numbers C00 … C22, got {len(turned)}")
    a, b, c, d, e, f, g, h, i = turned
    return told(commands.mounting(((a, b, c), (d, e, f), (g, h, i))))


ACTIONS: Final[Actions] = {
    "save": _simple(commands.save_config, "write all settings to flash"),
    "restart": Action("restart it and wait until it answers; what was not saved is lost", lambda _t, _p: restart()),
    "factory_reset": _simple(
        commands.factory_reset, "factory settings, the baud rate included, which `baud: auto` finds"
    ),
    "baud": Action("set the baud rate, save, restart and follow", lambda t, p: change_baud(p.baud, t.baud), BaudParams),
    "output": Action("send a message by itself at a rate, or not at all (0)", _output, OutputParams),
    "output_on_mark": Action(
        "send a message for each pulse on SIN", lambda _t, p: told(commands.log_onmark(p.message)), MessageParams
    ),
    "output_once": Action(
        "send a message once, as a pulse on SIN would", lambda _t, p: told(commands.log_once(p.message)), MessageParams
    ),
    "output_none": _simple(commands.unlog_all, "send nothing by itself"),
    "output_enabled": Action(
        "let frames out, or none whatever their rates",
        lambda _t, p: told(commands.log_enable() if p.enabled else commands.log_disable()),
        EnabledParams,
    ),
    "mode": Action(
        "6 axes, or 9 with the magnetometer",
        lambda _t, p: told(commands.attitude_mode(AttitudeMode.NINE_AXIS if p.axes == 9 else AttitudeMode.SIX_AXIS)),
        ModeParams,
    ),
    "level": Action(
        "make the present pitch and roll zero, level when nearly level, or cancel; at rest only",
        lambda _t, p: told(commands.level_reset(LevelReset[p.level.upper()])),
        LevelParams,
    ),
    "yaw": Action("set the heading; lost at power-off", _yaw, YawParams),
    "mounting": Action("how the module is mounted; needs save and restart", _mounting, MountingParams),
    "magnetic_calibration": Action(
        "calibrate the magnetometer in the background",
        lambda _t, p: told(commands.magnetic_calibration(p.enabled)),
        EnabledParams,
    ),
    "pin": Action(
        "give a function to a pin",
        lambda _t, p: told(commands.pin_function(PinFunction[p.function.upper()], p.pin)),
        PinParams,
    ),
    "alarm": Action(
        "watch an angle with the alarm pin",
        lambda _t, p: told(commands.alarm(p.axis, p.min_deg, p.max_deg, p.enabled)),
        AlarmParams,
    ),
    "sout_divider": Action(
        "divide SOUT for SOUT_DIV", lambda _t, p: told(commands.sout_divider(p.divisor)), DividerParams
    ),
}
