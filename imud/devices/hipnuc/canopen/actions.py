"""Actions of a HiPNUC module on CANopen: every command of section 5.4 of the manual by name, and NMT.

The parameters of each function describe the arguments of its action: type, range, unit and section of the manual.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions, Risk, Target
from imud.contracts.session import RequestScript
from imud.devices.hipnuc.canopen import moves, session
from imud.devices.hipnuc.canopen.cia301 import NODE_MAX, NmtCommand, TpdoNumber
from imud.devices.hipnuc.canopen.session import PERIOD_MAX_MS, BitRate, InclinometerZero
from imud.devices.hipnuc.canopen.settings import TRANSMISSIONS, set_interval

Tpdo = Annotated[TpdoNumber, Meta(extra={"section": "5.2"})]
Reversed = Annotated[bool, Meta(extra={"section": "5.4.1"})]

_ZEROS: Final = {"here": InclinometerZero.SET, "cancel": InclinometerZero.CANCEL}


def _simple(words: str, begin: Callable[[int], RequestScript[None]], risk: Risk = Risk.NONE) -> Action:
    """An action without arguments."""
    return Action(words, lambda target: begin(target.settings.node), risk)


def _interval(
    target: Target,
    *,
    tpdo: Tpdo,
    interval_ms: Annotated[
        int,
        Meta(
            ge=0,
            le=PERIOD_MAX_MS,
            description="time from one to the next, 5 or more; 0 for never",
            extra={"unit": "ms", "section": "5.4.1"},
        ),
    ],
) -> RequestScript[str]:
    return set_interval(target, tpdo, interval_ms)


def _transmission(
    target: Target,
    *,
    tpdo: Tpdo,
    by: Annotated[
        Literal["timer", "sync"],
        Meta(
            description="SYNC must be sent by something on the bus: `options.sync_hz` makes imud do it",
            extra={"section": "5.4.2"},
        ),
    ],
) -> RequestScript[str]:
    return session.set_tpdo_type(target.settings.node, tpdo, TRANSMISSIONS[by])


def _bitrate(
    target: Target,
    *,
    bitrate: Annotated[BitRate, Meta(description="rate of the bus", extra={"unit": "bit/s", "section": "5.4.1"})],
) -> RequestScript[str]:
    return session.set_bit_rate(target.settings.node, bitrate)


def _node(
    target: Target,
    *,
    node: Annotated[
        int, Meta(ge=1, le=NODE_MAX, description="one that no other node of the bus has", extra={"section": "5.4.1"})
    ],
) -> RequestScript[str]:
    return moves.change_node(target.settings, node)


def _zero(
    target: Target, *, zero: Annotated[Literal["here", "cancel"], Meta(extra={"section": "5.4.1"})]
) -> RequestScript[None]:
    return session.set_inclinometer_zero(target.settings.node, _ZEROS[zero])


def _direction(target: Target, *, x_reversed: Reversed, y_reversed: Reversed) -> RequestScript[str]:
    return session.set_inclinometer_signs(target.settings.node, invert_x=x_reversed, invert_y=y_reversed)


def _nmt(
    target: Target,
    *,
    command: Annotated[
        Literal["start", "stop", "pre_operational", "reset_node", "reset_communication"],
        Meta(
            description="`stop` and `pre_operational` end the samples until `start`",
            extra={"section": "CiA 301, 7.2.8.2"},
        ),
    ],
) -> RequestScript[str | None]:
    made = NmtCommand[command.upper()]
    if made in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
        return moves.reset(target.settings, target.baud, made)
    return session.nmt(target.settings.node, made)


ACTIONS: Final[Actions] = {
    "save": replace(_simple("write all settings to flash", session.save), saves=True),
    "restart": Action(
        "restart it and wait until it is heard, also under another number; what was not saved is lost",
        lambda target: moves.restart(target.settings, target.baud),
    ),
    "factory_reset": Action(
        "factory settings, node 8 and 500 kbit/s included, in force after a restart; refused if another node of the "
        "bus has number 8",
        lambda target: moves.factory_reset_and_find(target.settings),
        Risk.RESET,
    ),
    "interval": Action("how often a TPDO is sent by its timer; at once. Refused if the bus cannot carry it", _interval),
    "transmission": Action("send a TPDO by its timer, or when SYNC comes; at once", _transmission),
    "bitrate": Action(
        "set the bit rate, in force after `save` and `restart`: the node is off the bus then, and disturbs it, until "
        "interface and all other nodes have the same",
        _bitrate,
        Risk.CONNECTION,
    ),
    "node": Action(
        "set its number, in force after `save` and `restart`, in some modules at once: imud follows. Refused if "
        "something on the bus has it already",
        _node,
        Risk.CONNECTION,
    ),
    "zero": Action("make the present position the inclinometer's zero, or cancel that; at once", _zero),
    "direction": Action("turn the signs of the inclinometer, or leave them as delivered; at once", _direction),
    "nmt": Action("start or stop its TPDOs, or reset it, and follow it then", _nmt),
}
