"""Pauses grow to a bound and begin anew after success."""

import asyncio

from imud.utc.retry import FIRST_S, LONGEST_S, Retry


def test_pauses() -> None:
    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    async def scene() -> None:
        retry = Retry(sleep)
        for _ in range(10):
            await retry.pause()
        retry.reset()
        await retry.pause()

    asyncio.run(scene())
    assert pauses[:3] == [FIRST_S, 2 * FIRST_S, 4 * FIRST_S]
    assert pauses[-2:] == [LONGEST_S, FIRST_S]
