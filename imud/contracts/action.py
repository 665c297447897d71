"""Contract of an action: a command that a device executes by name, for example calibrate, save, restart, baud rate."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from inspect import signature
from typing import Any, cast, get_type_hints

import msgspec

from imud.contracts.settings import NoSettings, Settings, expected, shown
from imud.errors import BadArgument


@dataclass(frozen=True, slots=True)
class Target:
    """The device that an action is for."""

    settings: Any
    """Its driver's settings."""
    baud: int
    """Rate of its line now, bit/s; 0 where there is none."""


@dataclass(frozen=True, slots=True)
class Action:
    """A row of a driver's actions.

    Its arguments are described once, by the keyword-only parameters of `begin`. Their annotations give type
    and bounds (`msgspec.Meta`), their names the unit, their defaults what may be left out.
    """

    help: str
    """Its effect, one sentence."""
    begin: Callable[..., Any]
    """`begin(target, *, name: type = default, …)` makes the request script, or a polled driver's transfer script.

    Its value is the answer, something that JSON can carry. Raises BadArgument, like the script itself.
    """
    params: type[Settings] = NoSettings
    """Its arguments, where `begin` takes an instance of a struct as its second parameter."""

    @property
    def parameters(self) -> type[Settings]:
        """The arguments as a struct type."""
        return _parameters(self.begin) if _takes_names(self.begin) else self.params

    def arguments(self, given: Mapping[str, Any]) -> Settings:
        """The arguments checked. Raises BadArgument naming what was expected and what came."""
        try:
            return msgspec.convert(dict(given), self.parameters)
        except msgspec.ValidationError as error:
            known = ", ".join(str(parameter) for parameter in parameters_of(self)) or "none"
            raise BadArgument(f"{error}; arguments: {known}") from None

    def script(self, target: Target, arguments: Settings) -> Any:
        """The script that carries out the action, with arguments that `arguments` returned."""
        if _takes_names(self.begin):
            return self.begin(target, **msgspec.structs.asdict(arguments))
        return self.begin(target, arguments)


@cache
def _takes_names(begin: Callable[..., Any]) -> bool:
    return sum(p.kind is not p.KEYWORD_ONLY for p in signature(begin).parameters.values()) == 1


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
    """One argument of an action, for people."""

    name: str
    values: str
    """What it can be, for example `a whole number from 1 to 127`."""
    default: str | None
    """As JSON; None where it must be given."""

    def __str__(self) -> str:
        """For example `rate_hz (a number; default 100)`."""
        return f"{self.name} ({self.values}{'' if self.default is None else f'; default {self.default}'})"


class ActionInfo(msgspec.Struct, frozen=True):
    """One action, for people."""

    name: str
    help: str
    parameters: tuple[ActionParameter, ...]


def parameters_of(action: Action) -> tuple[ActionParameter, ...]:
    """The arguments that an action takes."""
    return tuple(
        ActionParameter(field.name, expected(field.type), None if field.required else shown(field.default))
        for field in msgspec.structs.fields(action.parameters)
    )


def described(actions: Actions) -> list[ActionInfo]:
    """All actions, in their order."""
    return [ActionInfo(name, action.help, parameters_of(action)) for name, action in actions.items()]
