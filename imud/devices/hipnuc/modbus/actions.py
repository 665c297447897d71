"""Actions of a HiPNUC module on RS-485: every command of section 4.3 of the manual by name.

The parameters of each function describe the arguments of its action: type, range, unit and section of the manual. imud
follows the module to another address. A baud rate is the whole line's, so imud does not follow there.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions, Risk, Target
from imud.contracts.polling import TransferScript
from imud.devices.hipnuc.modbus import session
from imud.devices.hipnuc.modbus.registers import BY_NAME, ID_MAX, Access, BaudRate
from imud.devices.hipnuc.modbus.session import LineMounting
from imud.devices.hipnuc.uart.commands import AttitudeMode, LevelReset
from imud.errors import BadArgument


def _simple(words: str, begin: Callable[[], TransferScript[None]], risk: Risk = Risk.NONE) -> Action:
    """An action without arguments."""
    return Action(words, lambda _target: begin(), risk)


def _address(
    target: Target,
    *,
    address: Annotated[
        int,
        Meta(ge=1, le=ID_MAX, description="one that no other module of the line has", extra={"section": "4.3.3"}),
    ],
) -> TransferScript[str]:
    return session.change_address(session.places_of(target)[0], address)


def _restart(target: Target) -> TransferScript[str]:
    return session.restart(session.places_of(target), target.baud)


def _factory_reset(target: Target) -> TransferScript[str]:
    return session.factory_reset(session.places_of(target), target.baud)


def _baud(
    _target: Target,
    *,
    baud: Annotated[BaudRate, Meta(description="rate of the line", extra={"unit": "bit/s", "section": "4.3.2"})],
) -> TransferScript[str]:
    return session.set_baud(baud)


def _attitude_mode(
    _target: Target, *, axes: Annotated[Literal[6, 9], Meta(extra={"section": "4.3.6"})]
) -> TransferScript[str]:
    return session.set_heading_mode(AttitudeMode.NINE_AXIS if axes == 9 else AttitudeMode.SIX_AXIS)


def _level(
    _target: Target, *, level: Annotated[Literal["relative", "automatic", "cancel"], Meta(extra={"section": "4.3.5"})]
) -> TransferScript[None]:
    return session.auto_level(LevelReset[level.upper()])


def _mounting(
    _target: Target,
    *,
    mounting: Annotated[Literal["level", "y_down", "y_up", "x_up", "x_down"], Meta(extra={"section": "4.3.4"})],
) -> TransferScript[str]:
    return session.set_mounting(LineMounting[mounting.upper()])


def _read(
    _target: Target, *, register: Annotated[str, Meta(description="its name in the manual", extra={"section": "4.2"})]
) -> TransferScript[tuple[int, ...]]:
    found = BY_NAME.get(register.upper())
    if found is None or found.access is Access.WRITE:
        known = ", ".join(one.name for one in BY_NAME.values() if one.access is not Access.WRITE)
        raise BadArgument(f"register: expected one of {known}, got {register[:64]!r}")
    return session.read(found)


ACTIONS: Final[Actions] = {
    "save": replace(_simple("write all settings to flash", session.save), saves=True),
    "restart": Action("restart, as by power-on, and wait until it answers; what is not saved is lost", _restart),
    "factory_reset": Action(
        "factory settings, and restart: imud follows it to address 80 if no other module has that and the line has the "
        "factory's 115200 baud",
        _factory_reset,
        Risk.RESET,
    ),
    "address": Action(
        "set its address and follow it there; not saved. Refused if another module of the line answers there",
        _address,
        Risk.CONNECTION,
    ),
    "baud": Action(
        "set the baud rate, in force after `save` and `restart`: imud then hears nothing of it until the line and all "
        "other modules have the same",
        _baud,
        Risk.CONNECTION,
    ),
    "attitude_mode": Action("six axes, or nine with the magnetometer", _attitude_mode),
    "level": Action("make the present attitude level, or cancel that; the module must be at rest", _level),
    "mounting": Action("say how the module is mounted", _mounting),
    "read": Action("read a register, as words of 16 bits", _read),
}
