"""Readers of the daemon's event loop: called when their descriptors are readable, and never otherwise."""

import asyncio
import os
import selectors
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from imud.host.event_loop import Alarm, ReaderSelector, SampleLoop, run
from tests.support.event_loops import in_loop

TURNS = 3
LIMIT_S = 60
Pair = tuple[socket.socket, socket.socket]
"""Two ends of a connection; the loop watches the first."""


@pytest.fixture
def pairs() -> Iterator[list[Pair]]:
    """Yield three connections and close them at the end."""
    made = [socket.socketpair() for _ in range(3)]
    for ours, _ in made:
        ours.setblocking(False)
    yield made
    for one in made:
        for sock in one:
            sock.close()


@pytest.fixture
def pair(pairs: list[Pair]) -> Pair:
    return pairs[0]


async def turns(count: int = TURNS) -> None:
    for _ in range(count):
        await asyncio.sleep(0)


def read(sock: socket.socket, seen: list[str], word: str) -> None:
    sock.recv(9)
    seen.append(word)


def loop_in_use() -> SampleLoop:
    """Return the running loop, which these tests check."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, SampleLoop)
    return loop


def test_run_returns_the_result_and_closes_the_loop() -> None:
    async def main() -> SampleLoop:
        return loop_in_use()

    loop = run(main())
    assert loop.is_closed()
    loop.close()


@in_loop
async def test_a_reader_is_called_in_each_turn_in_which_its_descriptor_is_readable(pair: Pair) -> None:
    loop, seen, (ours, theirs) = loop_in_use(), list[bytes](), pair
    loop.add_reader(ours.fileno(), lambda: seen.append(ours.recv(1)))
    await turns()
    assert seen == []
    theirs.send(b"ab")
    await turns()
    assert seen == [b"a", b"b"]
    assert loop.remove_reader(ours.fileno())
    assert not loop.remove_reader(ours.fileno())
    theirs.send(b"c")
    await turns()
    assert (seen, ours.recv(9)) == ([b"a", b"b"], b"c")
    loop.add_reader(ours, lambda: seen.append(ours.recv(9)))
    theirs.close()
    await asyncio.sleep(0)
    loop.remove_reader(ours)
    await turns()
    assert seen == [b"a", b"b", b""]  # the end of a connection is readable


@in_loop
async def test_a_reader_may_be_given_by_its_file_have_arguments_and_replace_another(pair: Pair) -> None:
    loop, seen, (ours, theirs) = loop_in_use(), list[object](), pair
    loop.add_reader(ours, lambda: seen.append("first"))
    loop.add_reader(ours, lambda *got: seen.append((len(ours.recv(9)), *got)), "x")
    theirs.send(b"abc")
    await turns()
    assert seen == [(3, "x")]
    assert loop.remove_reader(ours)
    ours.close()
    assert not loop.remove_reader(ours)


@in_loop
async def test_a_reader_removed_by_another_in_the_same_turn_is_not_called(pairs: list[Pair]) -> None:
    loop, seen = loop_in_use(), list[int]()

    def remove_all(number: int) -> None:
        seen.append(number)
        for ours, _ in pairs:
            loop.remove_reader(ours)

    for number, (ours, theirs) in enumerate(pairs):
        loop.add_reader(ours, remove_all, number)
        theirs.send(b"a")
    await turns()
    assert len(seen) == 1


@in_loop
async def test_an_event_is_not_that_of_a_new_descriptor_with_the_same_number(pairs: list[Pair]) -> None:
    """Two descriptors are readable in one turn. The first reader closes the second descriptor and opens another one
    with the same number.
    """
    loop, spurious = loop_in_use(), list[str]()
    *two, new = pairs

    def exchange(number: int) -> None:
        for ours, _ in two:
            loop.remove_reader(ours)
        other = two[1 - number][0]
        os.dup2(new[0].fileno(), other.fileno())
        loop.add_reader(other, spurious.append, "nothing was sent to it")

    for number, (ours, theirs) in enumerate(two):
        loop.add_reader(ours, exchange, number)
        theirs.send(b"a")
    await turns()
    assert spurious == []
    assert sum(loop.remove_reader(ours) for ours, _ in pairs) == 1


@in_loop
async def test_a_descriptor_that_was_closed_with_its_reader_can_have_another(pairs: list[Pair]) -> None:
    """The kernel removes the closed descriptor itself."""
    loop, seen, (first, _), (ours, theirs) = loop_in_use(), list[bytes](), pairs[0], pairs[1]
    number = first.fileno()
    loop.add_reader(number, lambda: seen.append(b"old"))
    first.close()
    assert os.dup2(ours.fileno(), number) == number
    loop.add_reader(number, lambda: seen.append(ours.recv(9)))
    theirs.send(b"new")
    await turns()
    assert seen == [b"new"]
    loop.remove_reader(number)
    os.close(number)


@in_loop
async def test_reader_and_writer_of_a_descriptor_are_independent(pair: Pair) -> None:
    loop, seen, (ours, theirs) = loop_in_use(), list[str](), pair
    loop.add_reader(ours, read, ours, seen, "read")
    loop.add_writer(ours, lambda: seen.append("write"))
    await turns(2)
    assert set(seen) == {"write"}
    loop.remove_writer(ours)
    seen.clear()
    theirs.send(b"a")
    await turns()
    assert seen == ["read"]
    loop.add_writer(ours, lambda: seen.append("write"))
    loop.remove_reader(ours)
    seen.clear()
    theirs.send(b"a")
    await turns(2)
    assert set(seen) == {"write"}
    loop.remove_writer(ours)


@in_loop
async def test_an_error_of_a_reader_goes_to_the_handler_of_the_loop(pairs: list[Pair]) -> None:
    loop, seen, reported = loop_in_use(), list[bytes](), list[dict[str, Any]]()
    loop.set_exception_handler(lambda _loop, context: reported.append(context))

    def read_unless_second(ours: socket.socket, number: int) -> None:
        data = ours.recv(9)
        if number == 1:
            raise ValueError("one of three")
        seen.append(data)

    for number, (ours, theirs) in enumerate(pairs):
        loop.add_reader(ours, read_unless_second, ours, number)
        theirs.send(b"a")
    await turns()
    assert seen == [b"a", b"a"]
    assert [str(context["exception"]) for context in reported] == ["one of three"]
    for ours, _ in pairs:
        loop.remove_reader(ours)


@in_loop
async def test_a_reader_without_end_leaves_their_turns_to_tasks_timers_and_other_readers(pairs: list[Pair]) -> None:
    loop, seen, (flood, far), (ours, theirs) = loop_in_use(), list[str](), pairs[0], pairs[1]
    far.send(b"never read")
    timer = loop.create_future()
    loop.add_reader(flood, seen.append, "flood")
    loop.add_reader(ours, read, ours, seen, "other")
    loop.call_later(0.001, timer.set_result, None)
    theirs.send(b"a")
    await timer  # the limit of the test ends a loop that never runs its timers
    assert "other" in seen
    assert seen.count("flood") > 1
    loop.remove_reader(flood)
    loop.remove_reader(ours)


@in_loop
async def test_callbacks_of_a_reader_run_in_the_same_turn(pair: Pair) -> None:
    loop, order, (ours, theirs) = loop_in_use(), list[str](), pair

    def read_and_schedule() -> None:
        read(ours, order, "reader")
        loop.call_soon(order.append, "scheduled")

    loop.add_reader(ours, read_and_schedule)
    theirs.send(b"a")
    await asyncio.sleep(0)
    assert order == ["reader"]
    await asyncio.sleep(0)
    assert order == ["reader", "scheduled"]
    loop.remove_reader(ours)


@in_loop
async def test_a_read_of_asyncio_that_is_cancelled_leaves_no_reader(pair: Pair) -> None:
    loop, (ours, theirs) = loop_in_use(), pair
    for _ in range(2):
        reading = asyncio.ensure_future(loop.sock_recv(ours, 9))
        await turns()
        reading.cancel()
        await turns()
    reading = asyncio.ensure_future(loop.sock_recv(ours, 9))
    await turns()
    theirs.send(b"a")
    assert await asyncio.wait_for(reading, LIMIT_S) == b"a"
    assert not loop.remove_reader(ours)


@in_loop
async def test_signals_and_connections_of_asyncio_are_served_beside_readers(pair: Pair) -> None:
    loop, (ours, theirs) = loop_in_use(), pair
    came, ours_was = loop.create_future(), signal.getsignal(signal.SIGUSR1)
    loop.add_signal_handler(signal.SIGUSR1, came.set_result, None)
    try:
        os.kill(os.getpid(), signal.SIGUSR1)
        await asyncio.wait_for(came, LIMIT_S)
    finally:
        loop.remove_signal_handler(signal.SIGUSR1)
        signal.signal(signal.SIGUSR1, ours_was)
    reader, writer = await asyncio.open_connection(sock=ours)
    theirs.send(b"line\n")
    assert await asyncio.wait_for(reader.readline(), LIMIT_S) == b"line\n"
    writer.close()
    await writer.wait_closed()


class CountingSelector(ReaderSelector):
    turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.turns += 1
        return super().select(timeout)


def test_the_loop_does_not_turn_for_readers_that_give_it_nothing(pair: Pair) -> None:
    selector, calls, began, (ours, theirs) = CountingSelector(), 100, list[int](), pair
    loop = SampleLoop(selector)

    def read_and_go_on() -> None:
        ours.recv(1)
        began.append(selector.turns)
        theirs.send(b"a")
        if len(began) == calls:
            loop.stop()

    loop.add_reader(ours, read_and_go_on)
    theirs.send(b"a")
    loop.run_forever()
    assert began == calls * [1]
    loop.close()


def send_signal(loop: SampleLoop, done: asyncio.Future[None]) -> None:
    loop.add_signal_handler(signal.SIGUSR1, done.set_result, None)
    threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGUSR1)).start()


def add_writer(loop: SampleLoop, done: asyncio.Future[None]) -> None:
    ours, theirs = socket.socketpair()

    def write() -> None:
        loop.remove_writer(ours)
        done.set_result(None)
        ours.close()
        theirs.close()

    loop.add_writer(ours, write)


@pytest.mark.parametrize(
    "give",
    [
        lambda loop, done: loop.call_soon(done.set_result, None),
        lambda loop, done: loop.call_later(0.001, done.set_result, None),
        lambda loop, done: loop.call_at(loop.time() + 0.001, done.set_result, None),
        lambda _loop, done: done.set_result(None), lambda loop, done: loop.call_soon_threadsafe(done.set_result, None),
        lambda loop, done: threading.Timer(0.01, loop.call_soon_threadsafe, (done.set_result, None)).start(),
        lambda loop, done: loop.run_in_executor(None, int).add_done_callback(lambda _: done.set_result(None)),
        lambda loop, done: loop.create_task(asyncio.sleep(0.001)).add_done_callback(lambda _: done.set_result(None)),
        send_signal, add_writer,
    ],
    ids=["soon", "later", "at", "future", "threadsafe", "thread", "executor", "task", "signal", "writer"],
)  # fmt: skip
def test_callbacks_of_readers_end_waits(pair: Pair, give: Callable[[SampleLoop, asyncio.Future[None]], object]) -> None:
    """No timer and no other event ends the wait of the loop: otherwise the limit of the test ends it."""
    ours, theirs = pair

    async def main() -> None:
        loop = loop_in_use()
        done = loop.create_future()

        def read_and_give() -> None:
            ours.recv(9)
            give(loop, done)

        loop.add_reader(ours, read_and_give)
        loop.call_later(0.05, theirs.send, b"a")
        await done
        loop.remove_reader(ours)
        loop.remove_signal_handler(signal.SIGUSR1)

    was = signal.getsignal(signal.SIGUSR1)
    run(main())
    signal.signal(signal.SIGUSR1, was)


@in_loop
async def test_a_descriptor_of_the_same_number_is_watched_from_the_next_wait_of_a_turn_on(pairs: list[Pair]) -> None:
    """The reader replaces its descriptor. The loop receives data on the new descriptor in the same turn."""
    loop, seen, (first, first_far), (second, second_far) = loop_in_use(), list[bytes](), pairs[0], pairs[1]
    done = loop.create_future()

    def take() -> None:
        loop.remove_reader(first)
        seen.append(first.recv(9))
        done.set_result(None)

    def replace() -> None:
        loop.remove_reader(first)
        os.dup2(second.fileno(), first.fileno())
        loop.add_reader(first, take)
        second_far.send(b"new")

    loop.add_reader(first, replace)
    loop.call_later(0.05, first_far.send, b"a")
    await done
    assert seen == [b"new"]


@in_loop
async def test_an_alarm_rings_at_its_last_time_without_a_turn_of_asyncio(pair: Pair) -> None:
    loop, (ours, theirs) = loop_in_use(), pair
    errors, done, begin_s = list[dict[str, Any]](), loop.create_future(), loop.time()

    class Owner:
        def __init__(self) -> None:
            self.alarm = Alarm(self)
            self.rung_s: list[float] = []

        def on_alarm(self) -> None:
            self.rung_s.append(loop.time() - begin_s)
            self.alarm.set(0.01 if len(self.rung_s) < 3 else 60)
            theirs.send(b"end" if len(self.rung_s) == 3 else b"x")
            if len(self.rung_s) == 1:
                raise ValueError

    def end() -> None:
        if ours.recv(9).endswith(b"end"):
            done.set_result(None)

    again, never = Owner(), Owner()
    loop.set_exception_handler(lambda _loop, context: errors.append(context))
    loop.add_reader(ours, end)
    again.alarm.set(0.0)
    again.alarm.set(0.02)
    never.alarm.set(0.001)
    never.alarm.cancel()
    await done
    assert again.alarm.due_s is not None
    assert (never.alarm.due_s, len(again.rung_s), never.rung_s) == (None, 3, [])
    again.alarm.cancel()
    loop.remove_reader(ours)
    assert [again.rung_s[0] >= 0.02, again.rung_s[2] >= 0.04] == [True, True]
    assert [type(context["exception"]) for context in errors] == [ValueError]


def test_an_alarm_in_a_loop_of_asyncio_rings_at_its_last_time() -> None:
    async def main() -> None:
        rung = list[str]()
        alarm = Alarm(SimpleNamespace(on_alarm=lambda: rung.append("rung")))
        for delays_s, is_cancelled, count in (((0, 60), False, 0), ((60, 0), False, 1), ((0,), True, 1)):
            for delay_s in delays_s:
                alarm.set(delay_s)
            if is_cancelled:
                alarm.cancel()
            await turns()
            assert (len(rung), alarm.due_s is not None) == (count, count == 0)

    asyncio.run(main())


@in_loop
async def test_a_turn_has_at_most_256_readers() -> None:
    loop, seen = loop_in_use(), list[int]()
    events = [os.eventfd(1) for _ in range(257)]
    for event in events:
        loop.add_reader(event, seen.append, event)
    await turns(1)
    assert len(seen) == 256
    await turns(1)
    assert set(seen) == set(events)
    for event in events:
        loop.remove_reader(event)
        os.close(event)
