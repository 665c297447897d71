"""Actions of a HiPNUC module on J1939: every row of the manual's table 6.2.2 by name, and a message sent once.

The parameters of each function describe the arguments of its action: type, range, unit and section of the manual.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Final, Literal

from msgspec import Meta

from imud.contracts.action import Action, Actions, Risk, Target
from imud.contracts.session import RequestScript
from imud.devices.hipnuc.j1939 import moves, session
from imud.devices.hipnuc.j1939.messages import PgnName
from imud.devices.hipnuc.j1939.session import (
    INTERVAL_MAX_MS,
    INTERVAL_MIN_MS,
    MODULE_ADDRESS_MAX,
    MODULE_ADDRESS_MIN,
    BitRate,
    J1939Node,
    Zero,
)
from imud.devices.hipnuc.j1939.settings import set_interval

Pgn = Annotated[PgnName, Meta(description="the last four digits of its number", extra={"section": "6.1"})]


def _simple(words: str, begin: Callable[[J1939Node], RequestScript[None]], risk: Risk = Risk.NONE) -> Action:
    """An action without arguments."""
    return Action(words, lambda target: begin(target.settings.peer), risk)


def _interval(
    target: Target,
    *,
    pgn: Pgn,
    interval_ms: Annotated[int, Meta(ge=INTERVAL_MIN_MS, le=INTERVAL_MAX_MS, extra={"unit": "ms", "section": "6.2.2"})],
) -> RequestScript[str]:
    return set_interval(target, int(pgn, 16), interval_ms)


def _send_once(target: Target, *, pgn: Pgn) -> RequestScript[None]:
    return session.send_once(target.settings.peer, int(pgn, 16))


def _bitrate(
    target: Target,
    *,
    bitrate: Annotated[BitRate, Meta(description="rate of the bus", extra={"unit": "bit/s", "section": "6.2.2"})],
) -> RequestScript[str]:
    return session.set_bitrate(target.settings.peer, bitrate)


def _address(
    target: Target,
    *,
    address: Annotated[
        int,
        Meta(
            ge=MODULE_ADDRESS_MIN,
            le=MODULE_ADDRESS_MAX,
            description="one that no other module of the bus has",
            extra={"section": "6.2.2"},
        ),
    ],
) -> RequestScript[str]:
    return moves.change_address(target.settings, address)


def _zero(
    target: Target, *, zero: Annotated[Literal["here", "cancel"], Meta(extra={"section": "6.2.2"})]
) -> RequestScript[None]:
    return session.zero(target.settings.peer, Zero[zero.upper()])


def _direction(
    target: Target, *, axis: Annotated[Literal["X", "Y"], Meta(extra={"section": "6.2.2"})], reversed: bool
) -> RequestScript[str]:
    return session.set_direction(target.settings.peer, axis, reversed)


ACTIONS: Final[Actions] = {
    "save": replace(_simple("write all settings to flash", session.save), saves=True),
    "restart": Action(
        "restart it and wait until it is heard, also at another address; what was not saved is lost",
        lambda target: moves.restart(target.settings, target.baud),
    ),
    "factory_reset": Action(
        "factory settings, address 8 and its bit rate included, in force after a restart at the latest; refused if "
        "another node of the bus has address 8",
        lambda target: moves.factory_reset_and_find(target.settings),
        Risk.RESET,
    ),
    "interval": Action("how often a message is sent; refused if the bus cannot carry it", _interval),
    "send_once": Action("send a message once, now, and wait for it", _send_once),
    "bitrate": Action(
        "set the bit rate, in force after `save` and `restart`: the module is off the bus then, and disturbs it, until "
        "interface and all others have the same",
        _bitrate,
        Risk.CONNECTION,
    ),
    "address": Action(
        "set its address, in force after `save` and `restart`, in some modules at once: imud follows. Refused if "
        "something on the bus has it already",
        _address,
        Risk.CONNECTION,
    ),
    "zero": Action("make the present position zero, or cancel that", _zero),
    "direction": Action("turn the sign of an angle", _direction),
}
