"""Table: actions carried out by the GPIO lines of a device, in addition to those of its driver: `reset`, `trigger`."""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

from imud.contracts.action import Action
from imud.signals.reset import ResetLine
from imud.signals.sync_signals import SyncSignals


def _no_script(_target: object) -> None:
    raise AssertionError("a line is driven by `LineActions.run`")


RESET: Final = Action("pulse the reset line, and wait until the device works again", _no_script)
TRIGGER: Final = Action("make one edge on SIN, in addition to those of its rate", _no_script)


class LineActions:
    """Actions by the GPIO lines of one device. Synchronization: the loop's thread only."""

    def __init__(self, reset: ResetLine | None, signals: SyncSignals | None) -> None:
        self.rows: dict[str, Action] = {}
        """Actions by name."""
        self._coroutines: dict[str, Callable[[], Awaitable[None]]] = {}
        if reset is not None:
            self.rows["reset"], self._coroutines["reset"] = RESET, reset.pulse
        if signals is not None and signals.can_trigger:

            async def trigger() -> None:
                signals.trigger_once()

            self.rows["trigger"], self._coroutines["trigger"] = TRIGGER, trigger

    async def run(self, name: str, arguments: Mapping[str, Any]) -> object:
        """Run an action; none of them has a result. Raises BadArgument, CommandError."""
        self.rows[name].arguments(arguments)
        await self._coroutines[name]()
        return None
