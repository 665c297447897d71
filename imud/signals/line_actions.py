"""What a device can be told by its lines, whatever its driver: `reset` and `trigger`."""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

from imud.contracts.action import Action
from imud.signals.reset import ResetLine
from imud.signals.sync_signals import SyncSignals


def _no_conversation(_target: object, _params: object) -> None:
    raise AssertionError("a line is driven by `LineActions.run`")


RESET: Final = Action("pulse the reset line, and wait until the device works again", _no_conversation)
TRIGGER: Final = Action("make one edge on SIN, besides those of its rate", _no_conversation)


class LineActions:
    """Those of one device."""

    def __init__(self, reset: ResetLine | None, wires: SyncSignals | None) -> None:
        self.rows: dict[str, Action] = {}
        """By name."""
        self._work: dict[str, Callable[[], Awaitable[None]]] = {}
        if reset is not None:
            self.rows["reset"], self._work["reset"] = RESET, reset.pulse
        if wires is not None and wires.can_trigger:

            async def trigger() -> None:
                wires.trigger_once()

            self.rows["trigger"], self._work["trigger"] = TRIGGER, trigger

    async def run(self, name: str, arguments: Mapping[str, Any]) -> object:
        """Do it; the answer is nothing. Raises BadArgument, CommandError."""
        self.rows[name].arguments(arguments)
        await self._work[name]()
        return None
