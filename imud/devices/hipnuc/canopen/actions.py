"""What a HiPNUC module on CANopen can be told by name: every command of section 5.4 of the manual, and NMT."""

from collections.abc import Callable
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions
from imud.contracts.session import RequestScript
from imud.contracts.settings import NoSettings, Settings
from imud.devices.hipnuc.canopen import session
from imud.devices.hipnuc.canopen.cob_ids import NODE_MAX, NmtCommand
from imud.devices.hipnuc.canopen.session import InclinometerZero, Transmission

TpdoNumber = Literal[1, 2, 3, 4, 6, 7]


class IntervalParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often a TPDO is sent by its timer."""

    tpdo: TpdoNumber
    interval_ms: int
    """5 … 1000; 0 for never."""


class TransmissionParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a TPDO is sent by."""

    tpdo: TpdoNumber
    by: Literal["timer", "sync"]
    """SYNC must be sent by something on the bus: `options.sync_hz` makes imud do it."""


class BitrateParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A bit rate."""

    bitrate: Literal[1_000_000, 500_000, 250_000, 125_000]
    """Of the bus, bit/s."""


class NodeParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The number of a node."""

    node: Annotated[int, Meta(ge=1, le=NODE_MAX)]
    """One that no other node of the bus has."""


class ZeroParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the inclinometer reads zero."""

    zero: Literal["here", "cancel"]


class DirectionParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The signs of the inclinometer."""

    x_reversed: bool
    y_reversed: bool


class NmtParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A command of the network management."""

    command: Literal["start", "stop", "pre_operational", "reset_node", "reset_communication"]
    """`stop` and `pre_operational` end the samples until `start`."""


_ZEROS: Final = {"here": InclinometerZero.SET, "cancel": InclinometerZero.CANCEL}
_TRANSMISSIONS: Final = {"timer": Transmission.TIMER, "sync": Transmission.SYNC}


def _action(
    words: str, begin: Callable[[int, Any], RequestScript[object]], params: type[Settings] = NoSettings
) -> Action:
    return Action(words, lambda target, given: begin(target.settings.node, given), params)


ACTIONS: Final[Actions] = {
    "save": _action("write all settings to flash", lambda node, _: session.save(node)),
    "restart": _action("restart it; what was not saved is lost", lambda node, _: session.restart(node)),
    "factory_reset": _action(
        "factory settings, node 8 and 500 kbit/s included, when power comes back: imud then hears it only where bus "
        "and `options.node` are set to that",
        lambda node, _: session.factory_reset(node),
    ),
    "interval": _action(
        "how often a TPDO is sent by its timer; at once",
        lambda node, given: session.set_tpdo_period(node, given.tpdo, given.interval_ms),
        IntervalParams,
    ),
    "transmission": _action(
        "send a TPDO by its timer, or when SYNC comes; at once",
        lambda node, given: session.set_tpdo_type(node, given.tpdo, _TRANSMISSIONS[given.by]),
        TransmissionParams,
    ),
    "bitrate": _action(
        "set the bit rate, in force after `save` and `restart`: the node is off the bus then, and disturbs it, until "
        "interface and all other nodes have the same",
        lambda node, given: session.set_bit_rate(node, given.bitrate),
        BitrateParams,
    ),
    "node": _action(
        "set its number, in force after `save` and `restart`: imud then hears nothing of it until `options.node` says "
        "the new one; with `driver: auto` it looks again after 15 s",
        lambda node, given: session.set_node_id(node, given.node),
        NodeParams,
    ),
    "zero": _action(
        "make the present position the inclinometer's zero, or cancel that; at once",
        lambda node, given: session.set_inclinometer_zero(node, _ZEROS[given.zero]),
        ZeroParams,
    ),
    "direction": _action(
        "turn the signs of the inclinometer, or leave them as delivered; at once",
        lambda node, given: session.set_inclinometer_signs(node, invert_x=given.x_reversed, invert_y=given.y_reversed),
        DirectionParams,
    ),
    "nmt": _action(
        "start or stop its TPDOs, or reset it; of a reset, whether its boot-up message came",
        lambda node, given: session.nmt(node, NmtCommand[given.command.upper()]),
        NmtParams,
    ),
}
