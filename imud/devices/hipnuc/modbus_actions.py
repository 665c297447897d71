"""What a HiPNUC module on RS-485 can be told by name: section 4.3 of the manual, but for its address and baud rate.

Those two are changed by `imud modbus`, which looks for the module where it has gone.
"""

from collections.abc import Callable
from typing import Any, Final, Literal

from imud.devices.hipnuc import modbus_session as session
from imud.devices.hipnuc.commands import AttitudeMode, LevelReset
from imud.devices.hipnuc.modbus_registers import BY_NAME, Access
from imud.devices.hipnuc.modbus_session import LineMounting
from imud.errors import BadArgument
from imud.kit.action import Action, Actions
from imud.kit.polling import Dialogue
from imud.kit.settings import NoSettings, Settings


class ModeParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Whether the magnetometer aids the heading."""

    axes: Literal[6, 9]


class LevelParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What to do with the level."""

    level: Literal["relative", "automatic", "cancel"]


class MountingParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the module is mounted: which axis points where."""

    mounting: Literal["level", "y_down", "y_up", "x_up", "x_down"]


class RegisterParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A register by its name in the manual."""

    register: str


def _action(words: str, begin: Callable[[Any], Dialogue[object]], params: type[Settings] = NoSettings) -> Action:
    return Action(words, lambda _target, given: begin(given), params)


def _read(name: str) -> Dialogue[object]:
    register = BY_NAME.get(name.upper())
    if register is None or register.access is Access.WRITE:
        known = ", ".join(one.name for one in BY_NAME.values() if one.access is not Access.WRITE)
        raise BadArgument(f"register: expected one of {known}, got {name[:64]!r}")
    return session.read(register)


ACTIONS: Final[Actions] = {
    "save": _action("write all settings to flash", lambda _: session.save()),
    "restart": _action("restart, as by power-on; what is not saved is lost", lambda _: session.restart()),
    "factory_reset": _action(
        "back to factory settings, address 80 and 115200 baud included", lambda _: session.factory_reset()
    ),
    "attitude_mode": _action(
        "six axes, or nine with the magnetometer",
        lambda given: session.set_heading_mode(AttitudeMode.NINE_AXIS if given.axes == 9 else AttitudeMode.SIX_AXIS),
        ModeParams,
    ),
    "level": _action(
        "make the present attitude level, or cancel that; the module must be at rest",
        lambda given: session.auto_level(LevelReset[given.level.upper()]),
        LevelParams,
    ),
    "mounting": _action(
        "say how the module is mounted", lambda given: session.set_mounting(LineMounting[given.mounting.upper()]),
        MountingParams,
    ),
    "read": _action("read a register, as words of 16 bits", lambda given: _read(given.register), RegisterParams),
}  # fmt: skip
