"""What a HiPNUC module on RS-485 can be told by name: every command of section 4.3 of the manual.

After another address or baud rate imud does not follow; `imud modbus assign` looks for the module where it has gone.
"""

from collections.abc import Callable
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions
from imud.contracts.polling import TransferScript
from imud.contracts.settings import NoSettings, Settings
from imud.devices.hipnuc.common.registers import BY_NAME, ID_MAX, Access
from imud.devices.hipnuc.modbus import session
from imud.devices.hipnuc.modbus.session import LineMounting
from imud.devices.hipnuc.uart.commands import AttitudeMode, LevelReset
from imud.errors import BadArgument


class ModeParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Whether the magnetometer aids the heading."""

    axes: Literal[6, 9]


class LevelParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What to do with the level."""

    level: Literal["relative", "automatic", "cancel"]


class MountingParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the module is mounted: which axis points where."""

    mounting: Literal["level", "y_down", "y_up", "x_up", "x_down"]


class AddressParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An address."""

    address: Annotated[int, Meta(ge=1, le=ID_MAX)]
    """One that no other module of the line has."""


class BaudParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A rate."""

    baud: int
    """4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800 or 921600."""


class RegisterParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A register by its name in the manual."""

    register: str


def _action(words: str, begin: Callable[[Any], TransferScript[object]], params: type[Settings] = NoSettings) -> Action:
    return Action(words, lambda _target, given: begin(given), params)


def _read(name: str) -> TransferScript[object]:
    register = BY_NAME.get(name.upper())
    if register is None or register.access is Access.WRITE:
        known = ", ".join(one.name for one in BY_NAME.values() if one.access is not Access.WRITE)
        raise BadArgument(f"register: expected one of {known}, got {name[:64]!r}")
    return session.read(register)


ACTIONS: Final[Actions] = {
    "save": _action("write all settings to flash", lambda _: session.save()),
    "restart": _action("restart, as by power-on; what is not saved is lost", lambda _: session.restart()),
    "factory_reset": _action(
        "factory settings, address 80 and 115200 baud included: imud then hears it only where the line is set to that",
        lambda _: session.factory_reset(),
    ),
    "address": _action(
        "set its address, in force at once and not saved: imud then looks for it, and finds it only with "
        "`address: auto`",
        lambda given: session.set_id(given.address),
        AddressParams,
    ),
    "baud": _action(
        "set the baud rate, in force after `save` and `restart`: imud then hears nothing of it until the line and all "
        "other modules have the same",
        lambda given: session.set_baud(given.baud),
        BaudParams,
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
