"""Request scripts over a line that is also used by others: in order, one at a time, late and missing replies apart."""

import asyncio
from dataclasses import replace
from time import monotonic_ns
from typing import Any

import pytest

from imud.contracts.driver import StreamDriver
from imud.contracts.script import Outcome, Reply, ReplyFrame, Request, RequestScript, Silence, of_text, pause, with_undo
from imud.device.scripts import Exchange
from imud.drivers import DRIVERS
from imud.model.errors import CommandError, LinkMissing, NoReply
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.support.event_loops import VirtualClock, in_loop, run_virtually


def request(name: str, timeout_ns: int = 10**10, *, silent: bool = False) -> Request:
    return Request(
        payload=name.encode() + b"\r\n",
        name=name,
        is_end=of_text(lambda text: text == "OK"),
        is_rejection=of_text(lambda text: text.startswith("ERR")),
        is_part=of_text(lambda text: text.startswith(name)),
        timeout_ns=timeout_ns,
        silent=silent,
    )


def ask(*requests: Request) -> RequestScript[list[Outcome]]:
    outcomes = []
    for one in requests:
        outcomes.append((yield one))
    return outcomes


def made() -> tuple[Exchange, list[bytes]]:
    written: list[bytes] = []
    return Exchange(Ledger(), written.append, monotonic_ns), written


@in_loop
async def test_requests_and_scripts_go_out_one_after_the_other() -> None:
    exchange, written = made()
    task = asyncio.create_task(exchange.run(ask(request("A"), request("B"))))
    await asyncio.sleep(0)
    assert written == [b"A\r\n"]
    exchange.on_message("A=1", 0)
    exchange.on_message("OK", 0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert written == [b"A\r\n", b"B\r\n"]
    exchange.on_message("ERR", 0)
    outcomes = await task
    assert outcomes[0] == Reply(("A=1", "OK"))
    assert outcomes[1].lines == ("ERR",)
    exchange, written = made()
    first = asyncio.create_task(exchange.run(ask(request("A"))))
    second = asyncio.create_task(exchange.run(ask(request("B"))))
    for _ in range(5):
        await asyncio.sleep(0)
    assert written == [b"A\r\n"]
    exchange.on_message("OK", 0)
    await first
    for _ in range(5):
        await asyncio.sleep(0)
    assert written == [b"A\r\n", b"B\r\n"]
    exchange.on_message("OK", 0)
    await second


@in_loop
async def test_silence_ends_a_request_and_a_late_reply_is_counted() -> None:
    ledger = Ledger()
    exchange = Exchange(ledger, lambda data: None, monotonic_ns)
    assert await exchange.run(ask(request("A", timeout_ns=1))) == [Silence(())]
    exchange.on_message("A=1", 0)
    exchange.on_message("OK", 0)
    assert (ledger.replies_late, ledger.replies_unsolicited) == (1, 0)
    exchange.on_message("OK", 0)
    assert ledger.replies_unsolicited == 1


@in_loop
async def test_a_script_that_is_cancelled_or_whose_link_is_gone_leaves_the_line_free() -> None:
    gone = True

    def write(data: bytes) -> None:
        if gone:
            raise LinkMissing("pulled out")

    exchange = Exchange(Ledger(), write, monotonic_ns)
    with pytest.raises(LinkMissing):
        await exchange.run(ask(request("A")))
    gone = False
    assert await exchange.run(ask(request("B", silent=True))) == [Reply(())]
    exchange, _ = made()
    task = asyncio.create_task(exchange.run(ask(request("A"))))
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert await exchange.run(ask(request("B", silent=True))) == [Reply(())]


def test_device_that_never_answers_is_no_reply() -> None:
    clock, driver = VirtualClock(), DRIVERS["hipnuc-uart"]
    assert isinstance(driver, StreamDriver)
    script = driver.identify()

    async def body() -> None:
        with pytest.raises(NoReply, match="LOG VERSION"):
            await Exchange(Ledger(), lambda _data: None, clock.now_ns).run(script)

    run_virtually(clock, body())


@in_loop
async def test_a_script_gets_the_reply_frame_or_measurement_that_it_waits_for_and_pauses_write_nothing() -> None:
    exchange, _ = made()
    wanted = ReplyFrame(5, b"x")
    asking = replace(request("A"), is_end=lambda message: message == wanted)
    task = asyncio.create_task(exchange.run(ask(asking)))
    await asyncio.sleep(0)
    exchange.on_message(wanted, 0)
    assert await task == [Reply((wanted,))]
    exchange, _ = made()
    assert not exchange.wants_samples
    task = asyncio.create_task(exchange.run(ask(replace(request("A"), is_sample=lambda sample: True))))
    await asyncio.sleep(0)
    assert exchange.wants_samples
    exchange.on_sample(Measurement(54, 0, 3))
    exchange.on_sample(Measurement(54, 0, 4))
    assert await task == [Reply((), Measurement(54, 0, 3))]
    assert not exchange.wants_samples
    exchange, written = made()
    assert await exchange.run(ask(pause(1_000_000))) == [Silence(())]
    assert written == []


@pytest.mark.parametrize("is_there", [True, False])
@in_loop
async def test_a_script_given_up_is_undone_if_the_link_is_there(is_there: bool) -> None:
    written: list[bytes] = []

    def write(data: bytes) -> None:
        if not is_there and written:
            raise LinkMissing("gone")
        written.append(data)

    exchange = Exchange(Ledger(), write, monotonic_ns)
    task = asyncio.create_task(exchange.run(with_undo(ask(request("A"), request("B")), b"UNDO")))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert written == [b"A\r\n", *[b"UNDO"] * is_there]


@in_loop
async def test_a_script_that_comes_to_its_end_is_not_undone() -> None:
    """Whether it returns or raises: it had its turn to leave the device in order."""

    def failing() -> RequestScript[None]:
        yield request("A", timeout_ns=1)
        raise NoReply("no")

    exchange, written = made()
    assert await exchange.run(with_undo(ask(request("A", timeout_ns=1)), b"UNDO")) == [Silence(())]
    with pytest.raises(NoReply):
        await exchange.run(with_undo(failing(), b"UNDO"))
    assert written == [b"A\r\n"] * 2


@pytest.mark.parametrize(
    ("change", "words"),
    [({"baud": 9600}, "9600 baud"), ({"settings": "node 9"}, "expected a bus"), ({"also": ["id"]}, "a CAN bus")],
    ids=["rate", "number", "other frames"],
)
@in_loop
async def test_a_request_can_change_how_the_device_is_heard(change: dict[str, Any], words: str) -> None:
    """The change is made before the request is written. A link without the setting is an error."""
    happened: list[object] = []
    note = happened.append
    exchange = Exchange(Ledger(), note, monotonic_ns, set_baud=note, follow=note, listen=note)
    silent = request("B", silent=True)
    assert await exchange.run(ask(request("A", silent=True), replace(silent, **change))) == [Reply(())] * 2
    after = [()] if "also" in change else []
    assert happened == [b"A\r\n", *change.values(), b"B\r\n", *after]
    exchange, written = made()
    with pytest.raises(CommandError, match=words):
        await exchange.run(ask(replace(silent, **change)))
    assert written == []
