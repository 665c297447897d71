"""What a HiPNUC module on J1939 can be told by name: every row of the manual's section 6.2.2, and the one-shot."""

from collections.abc import Callable
from typing import Any, Final, Literal

from imud.contracts.action import Action, Actions
from imud.contracts.session import RequestScript
from imud.contracts.settings import NoSettings, Settings
from imud.devices.hipnuc.j1939 import session
from imud.devices.hipnuc.j1939.session import J1939Node, Zero

MeasuredName = Literal["FF34", "FF37", "FF3A", "FF3D", "FF41", "FF43", "FF46", "FF4A"]
"""A message that samples are made of, by the last four digits of its number."""
PgnName = MeasuredName | Literal["FF2F"]
"""Any message."""


class IntervalParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often a message is sent."""

    pgn: PgnName
    """The last four digits of its number."""
    interval_ms: int
    """5 … 1000."""


class PgnParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A message."""

    pgn: PgnName


class BitrateParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A bit rate."""

    bitrate: int
    """1000000, 800000, 500000, 250000 or 125000 bit/s."""


class AddressParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An address."""

    address: int
    """1 … 128, one that no other module of the bus has."""


class ZeroParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the angles are zero."""

    zero: Literal["here", "cancel"]


class DirectionParams(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The sign of an angle."""

    axis: Literal["X", "Y"]
    reversed: bool


def _action(
    words: str, begin: Callable[[J1939Node, Any], RequestScript[None]], params: type[Settings] = NoSettings
) -> Action:
    return Action(words, lambda target, given: begin(target.settings.peer, given), params)


def _direction(peer: J1939Node, params: DirectionParams) -> RequestScript[None]:
    return session.set_direction(peer, session.X_SIGN if params.axis == "X" else session.Y_SIGN, params.reversed)


ACTIONS: Final[Actions] = {
    "save": _action("write all settings to flash", lambda peer, _: session.save(peer)),
    "restart": _action("restart it; what was not saved is lost", lambda peer, _: session.restart(peer)),
    "factory_reset": _action(
        "factory settings, address 8 and its bit rate included: imud then hears it only where bus and "
        "`options.address` are set to that",
        lambda peer, _: session.factory_reset(peer),
    ),
    "interval": _action(
        "how often a message is sent",
        lambda peer, p: session.set_interval(peer, int(p.pgn, 16), p.interval_ms),
        IntervalParams,
    ),
    "send_once": _action(
        "send a message once, now", lambda peer, p: session.send_once(peer, int(p.pgn, 16)), PgnParams
    ),
    "bitrate": _action(
        "set the bit rate, in force after `save` and `restart`: the module is off the bus then, and disturbs it, until "
        "interface and all others have the same",
        lambda peer, p: session.set_bitrate(peer, p.bitrate),
        BitrateParams,
    ),
    "address": _action(
        "set its address, in force after `save` and `restart`: imud then hears nothing of it until `options.address` "
        "says the new one; with `driver: auto` it looks again after 15 s",
        lambda peer, p: session.set_address(peer, p.address),
        AddressParams,
    ),
    "zero": _action(
        "make the present position zero, or cancel that",
        lambda peer, p: session.zero(peer, Zero[p.zero.upper()]),
        ZeroParams,
    ),
    "direction": _action("turn the sign of an angle", _direction, DirectionParams),
}
