"""What waits for one browser."""

import asyncio

from imud.web.mailbox import FRAMES_MAX, WINDOW_MAX, Mailbox


async def taken(mailbox: Mailbox, count: int) -> list[str]:
    return [await mailbox.take() for _ in range(count)]


async def test_messages_come_in_order_and_the_newest_state_once() -> None:
    mailbox = Mailbox()
    mailbox.put("a")
    mailbox.put_newest("status", "old")
    mailbox.put_newest("status", "new")
    mailbox.put("b")
    assert await taken(mailbox, 3) == ["new", "a", "b"]
    assert mailbox.waiting == 0


async def test_the_oldest_goes_where_there_are_too_many_and_is_counted() -> None:
    mailbox = Mailbox()
    for number in range(FRAMES_MAX + 7):
        mailbox.put(str(number))
    assert mailbox.dropped == 7
    assert await taken(mailbox, 2) == ["7", "8"]


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
    mailbox.acknowledge(10**9)  # more than was sent
    mailbox.acknowledge(-5)
    mailbox.put("and one")
    assert await mailbox.take() == "and one"


async def test_what_waits_for_another_view_is_thrown_away() -> None:
    mailbox = Mailbox()
    mailbox.put("a")
    mailbox.put_newest("status", "b")
    mailbox.forget()
    assert mailbox.waiting == 0
    assert mailbox.dropped == 0, "nobody misses it"
