"""The queue of messages for one browser."""

import asyncio

from imud.web.hub import FRAMES_MAX, WINDOW_MAX, Mailbox


async def taken(mailbox: Mailbox, count: int) -> list[str]:
    return [await mailbox.take() for _ in range(count)]


async def test_messages_wait_in_order_and_are_dropped_or_forgotten() -> None:
    mailbox = Mailbox()
    mailbox.put("a")
    mailbox.put_newest("status", "old")
    mailbox.put_newest("status", "new")
    mailbox.put("b")
    assert await taken(mailbox, 3) == ["new", "a", "b"]
    assert mailbox.waiting == 0
    mailbox = Mailbox()
    for number in range(FRAMES_MAX + 7):
        mailbox.put(str(number))
    assert mailbox.dropped == 7
    assert await taken(mailbox, 2) == ["7", "8"]
    mailbox = Mailbox()
    mailbox.put("a")
    mailbox.put_newest("status", "b")
    mailbox.forget()
    assert mailbox.waiting == 0
    assert mailbox.dropped == 0, "nobody misses it"


async def test_a_page_that_does_not_acknowledge_gets_no_more() -> None:
    mailbox = Mailbox()
    for _ in range(2):
        for number in range(WINDOW_MAX // 2):
            mailbox.put(str(number))
        await taken(mailbox, WINDOW_MAX // 2)
    mailbox.put("one more")
    waiting = asyncio.ensure_future(mailbox.take())
    for _ in range(5):
        await asyncio.sleep(0)
    assert not waiting.done()
    mailbox.acknowledge(1)
    assert await waiting == "one more"
    mailbox.acknowledge(10**9)  # more messages than sent
    mailbox.acknowledge(-5)
    mailbox.put("and one")
    assert await mailbox.take() == "and one"
