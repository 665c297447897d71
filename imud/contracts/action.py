"""What a device can be told to do by name, besides sending samples: calibrate, save, restart, another baud rate."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from imud.contracts.expected import expected, shown
from imud.contracts.settings import NoSettings, Settings
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
    """A row of a driver's actions."""

    help: str
    """What it does, one sentence."""
    begin: Callable[[Target, Any], Any]
    """Makes the conversation (polled drivers: the dialogue) from the target and an instance of `params`.

    Its value is the answer, something that JSON can carry. Raises BadArgument, like the conversation itself.
    """
    params: type[Settings] = NoSettings
    """Its arguments, with units in their names."""

    def arguments(self, given: Mapping[str, Any]) -> Settings:
        """The arguments checked. Raises BadArgument naming what was expected and what came."""
        try:
            return msgspec.convert(dict(given), self.params)
        except msgspec.ValidationError as error:
            known = ", ".join(str(parameter) for parameter in parameters_of(self)) or "none"
            raise BadArgument(f"{error}; arguments: {known}") from None


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
        for field in msgspec.structs.fields(action.params)
    )


def described(actions: Actions) -> list[ActionInfo]:
    """All actions, in their order."""
    return [ActionInfo(name, action.help, parameters_of(action)) for name, action in actions.items()]
