"""Reset: how long, how often, and what a cancellation leaves behind."""

import asyncio

import pytest

from imud.errors import LinkMissing
from imud.kit.lines import ResetSettings
from imud.pipeline.reset import reset
from imud.sim.lines import MemoryOutput
from tests.in_loop import in_loop

SETTINGS = ResetSettings(line="RESET", hold_ms=20)


@in_loop
async def test_the_line_is_held_and_then_the_device_has_its_time() -> None:
    story: list[object] = []
    line = MemoryOutput(on_change=lambda _t_ns, active: story.append(active))
    line.open()

    async def sleep(seconds: float) -> None:
        story.append(seconds)

    await reset(line, SETTINGS, sleep)
    assert story == [True, 0.02, False, 3.0]


@in_loop
async def test_cancelled_while_it_is_held() -> None:
    line = MemoryOutput()
    line.open()
    held = asyncio.Event()

    async def sleep(_seconds: float) -> None:
        held.set()
        await asyncio.Event().wait()

    task = asyncio.create_task(reset(line, SETTINGS, sleep))
    await asyncio.wait_for(held.wait(), 10)
    assert line.active
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert [active for _, active in line.history] == [True, False]


@in_loop
async def test_a_line_that_is_gone() -> None:
    line = MemoryOutput()
    line.open()
    line.set_error = LinkMissing("gone")
    with pytest.raises(LinkMissing):
        await reset(line, SETTINGS)
