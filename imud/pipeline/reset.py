"""Resets a device by its reset line, and waits until it works again."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Final

from imud.kit.lines import OutputLine, ResetSettings

MS_PER_S: Final = 1000

Sleep = Callable[[float], Awaitable[None]]
"""`asyncio.sleep`, or a test's."""


async def reset(line: OutputLine, settings: ResetSettings, sleep: Sleep = asyncio.sleep) -> None:
    """Hold the open line active, let it go, and wait as long as the device needs. Raises LinkError.

    Cancelled at any moment, it leaves the line inactive.
    """
    line.set(True)
    try:
        await sleep(settings.hold_ms / MS_PER_S)
    finally:
        line.set(False)
    await sleep(settings.wait_s)
