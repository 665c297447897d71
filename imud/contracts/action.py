"""Contract of an action: a command that a device executes by name, for example calibrate, save, restart, baud rate."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from inspect import signature
from typing import Any, cast, get_type_hints

import msgspec

from imud.contracts.settings import Settings, expected, shown, wrong_values
from imud.errors import BadArgument


@dataclass(frozen=True, slots=True)
class Target:
    """The device that an action is carried out on."""

    settings: Any
    """Settings of the device's driver."""
    baud: int
    """Present bit rate of the line, bit/s; 0 on a link without one."""
    fixed_baud: int = 0
    """Bit rate that the configuration fixes, bit/s; 0 where it fixes none."""
    places: tuple[int, ...] = ()
    """Addresses at which the device can be on a bus that is polled: the present one, the former one, the configured
    one; empty on other links."""
    other_bits_per_s: float = 0.0
    """What other devices of the configuration send on the same CAN bus, bit/s without stuff bits."""


class Risk(StrEnum):
    """What an action can do that cannot be taken back by another one. Programs for people ask before such an action."""

    NONE = ""
    CONNECTION = "the device may not be reached afterwards"
    RESET = "all settings of the device are lost"
    """Its settings are written to a backup before, as far as they can be read."""


@dataclass(frozen=True, slots=True)
class Action:
    """An action of a device: help, arguments and request script.

    The arguments are the keyword-only parameters of `begin`. Their annotations give type and bounds (`msgspec.Meta`),
    their names the unit; a parameter with a default is optional.
    """

    help: str
    """The effect, one sentence."""
    begin: Callable[..., Any]
    """`begin(target, *, name: type = default, …)` makes the request script, or a polled driver's transfer script.

    The script returns the result of the action, a value that JSON can carry. Both raise BadArgument.
    """
    risk: Risk = Risk.NONE
    saves: bool = False
    """Whether it writes the device's flash, which is counted, and limited per day."""

    @property
    def parameters(self) -> type[Settings]:
        """The parameters of `begin` as a struct type."""
        return _parameters(self.begin)

    def arguments(self, given: Mapping[str, Any]) -> Settings:
        """Check and convert the arguments of a call. Raises BadArgument naming what was expected and what came."""
        if wrong := wrong_values(self.parameters, given, "argument"):
            known = ", ".join(str(parameter) for parameter in parameters_of(self)) or "none"
            raise BadArgument(f"{'; '.join(map(str, wrong))}; arguments: {known}")
        return msgspec.convert(dict(given), self.parameters)

    def script(self, target: Target, arguments: Settings) -> Any:
        """Make the script of the action, from the result of `arguments`."""
        return self.begin(target, **msgspec.structs.asdict(arguments))


@cache
def _parameters(begin: Callable[..., Any]) -> type[Settings]:
    hints = get_type_hints(begin, include_extras=True)
    given = [p for p in signature(begin).parameters.values() if p.kind is p.KEYWORD_ONLY]
    fields = [(p.name, hints[p.name]) if p.default is p.empty else (p.name, hints[p.name], p.default) for p in given]
    made = msgspec.defstruct(
        "Parameters", fields, bases=(Settings,), frozen=True, kw_only=True, forbid_unknown_fields=True
    )
    return cast(type[Settings], made)


Actions = Mapping[str, Action]


class ActionParameter(msgspec.Struct, frozen=True):
    """Description of one argument of an action."""

    name: str
    values: str
    """The accepted values, for example `a whole number from 1 to 127`."""
    default: str | None
    """The default as JSON; None for a required argument."""
    required: bool = False
    """Whether a call without it is refused."""

    def __str__(self) -> str:
        """Format the description, for example `rate_hz (a number; default 100)`."""
        return f"{self.name} ({self.values}{'' if self.default is None else f'; default {self.default}'})"


class ActionInfo(msgspec.Struct, frozen=True):
    """Description of one action."""

    name: str
    help: str
    parameters: tuple[ActionParameter, ...]
    risk: Risk = Risk.NONE
    """Why people are asked before, one clause; empty where they are not."""


def parameters_of(action: Action) -> tuple[ActionParameter, ...]:
    """Describe the arguments of an action."""
    return tuple(
        ActionParameter(one.name, expected(one.type), None if one.required else shown(one.default), one.required)
        for one in msgspec.structs.fields(action.parameters)
    )


def described(actions: Actions) -> list[ActionInfo]:
    """Describe actions, in their order."""
    return [ActionInfo(name, action.help, parameters_of(action), action.risk) for name, action in actions.items()]
