"""Readers of the daemon's loop: called when their descriptors are readable, and by nothing else."""

import asyncio
import os
import selectors
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from imud.runtime.event_loop import ReaderSelector, SampleLoop, run
from tests.support.event_loops import in_loop

TURNS = 3


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two ends of a connection."""
    ours, theirs = socket.socketpair()
    ours.setblocking(False)
    with ours, theirs:
        yield ours, theirs


async def turns(count: int = TURNS) -> None:
    """So many turns of the loop."""
    for _ in range(count):
        await asyncio.sleep(0)


def read(sock: socket.socket, seen: list[str], word: str) -> None:
    """Take what is there, and note that it was done."""
    sock.recv(9)
    seen.append(word)


def loop_in_use() -> SampleLoop:
    """The running loop, which these tests are about."""
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
async def test_a_reader_is_called_in_each_turn_in_which_its_descriptor_is_readable() -> None:
    loop, seen = loop_in_use(), list[bytes]()
    ours, theirs = socket.socketpair()
    with ours, theirs:
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
        assert seen == [b"a", b"b"]


@in_loop
async def test_a_reader_may_be_given_by_its_file_and_have_arguments() -> None:
    loop, seen = loop_in_use(), list[tuple[int, str]]()
    ours, theirs = socket.socketpair()
    with ours, theirs:
        loop.add_reader(ours, lambda *got: seen.append((len(ours.recv(9)), *got)), "x")
        theirs.send(b"abc")
        await turns()
        assert seen == [(3, "x")]
        assert loop.remove_reader(ours)
    assert not loop.remove_reader(ours)


@in_loop
async def test_a_second_reader_replaces_the_first() -> None:
    loop, seen = loop_in_use(), list[str]()
    ours, theirs = socket.socketpair()
    with ours, theirs:
        loop.add_reader(ours, lambda: seen.append("first"))
        loop.add_reader(ours, read, ours, seen, "second")
        theirs.send(b"a")
        await turns()
        assert seen == ["second"]
        loop.remove_reader(ours)


@in_loop
async def test_the_end_of_a_connection_is_readable() -> None:
    loop, seen = loop_in_use(), list[bytes]()
    ours, theirs = socket.socketpair()
    with ours:
        loop.add_reader(ours, lambda: seen.append(ours.recv(9)))
        theirs.close()
        await asyncio.sleep(0)
        loop.remove_reader(ours)
        await turns()
        assert seen == [b""]


@in_loop
async def test_a_reader_removed_by_another_in_the_same_turn_is_not_called() -> None:
    loop, seen = loop_in_use(), list[int]()
    pairs = [socket.socketpair() for _ in range(2)]

    def remove_both(number: int) -> None:
        seen.append(number)
        for ours, _ in pairs:
            loop.remove_reader(ours)

    for number, (ours, theirs) in enumerate(pairs):
        loop.add_reader(ours, remove_both, number)
        theirs.send(b"a")
    await turns()
    assert len(seen) == 1
    for sockets in pairs:
        for sock in sockets:
            sock.close()


@in_loop
async def test_an_event_is_not_that_of_a_new_descriptor_with_the_same_number() -> None:
    """Both are readable in one turn; the first closes the second and opens a descriptor of that number."""
    loop, spurious = loop_in_use(), list[str]()
    pairs = [socket.socketpair() for _ in range(2)]
    new = socket.socketpair()

    def exchange(number: int) -> None:
        for ours, _ in pairs:
            loop.remove_reader(ours)
        other = pairs[1 - number][0]
        os.dup2(new[0].fileno(), other.fileno())
        loop.add_reader(other, spurious.append, "nothing was sent to it")

    for number, (ours, theirs) in enumerate(pairs):
        loop.add_reader(ours, exchange, number)
        theirs.send(b"a")
    await turns()
    assert spurious == []
    for sockets in (*pairs, new):
        for sock in sockets:
            loop.remove_reader(sock)
            sock.close()


@in_loop
async def test_a_descriptor_that_was_closed_with_its_reader_can_have_another() -> None:
    """The kernel forgets the old one by itself."""
    loop, seen = loop_in_use(), list[bytes]()
    first, far = socket.socketpair()
    number = first.fileno()
    loop.add_reader(number, lambda: seen.append(b"old"))
    first.close()
    far.close()
    ours, theirs = socket.socketpair()
    ours = socket.socket(fileno=os.dup2(ours.detach(), number)) if ours.fileno() != number else ours
    with ours, theirs:
        loop.add_reader(number, lambda: seen.append(ours.recv(9)))
        theirs.send(b"new")
        await turns()
        assert seen == [b"new"]
        loop.remove_reader(number)


@in_loop
async def test_reader_and_writer_of_a_descriptor_are_independent() -> None:
    loop, seen = loop_in_use(), list[str]()
    ours, theirs = socket.socketpair()
    with ours, theirs:
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
async def test_an_error_of_a_reader_goes_to_the_handler_of_the_loop_and_the_others_go_on() -> None:
    loop, seen, reported = loop_in_use(), list[bytes](), list[dict[str, Any]]()
    loop.set_exception_handler(lambda _loop, context: reported.append(context))
    pairs = [socket.socketpair() for _ in range(3)]

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
    for ours, theirs in pairs:
        loop.remove_reader(ours)
        ours.close()
        theirs.close()


@in_loop
async def test_a_reader_without_end_leaves_their_turns_to_tasks_timers_and_other_readers() -> None:
    loop, seen = loop_in_use(), list[str]()
    flood, far = socket.socketpair()
    ours, theirs = socket.socketpair()
    with flood, far, ours, theirs:
        far.send(b"never read")
        timer, late_s = loop.create_future(), time.monotonic() + 30

        def note_flood() -> None:
            seen.append("flood")
            if time.monotonic() > late_s and not timer.done():
                timer.set_exception(AssertionError("timers have no turn"))

        loop.add_reader(flood, note_flood)
        loop.add_reader(ours, read, ours, seen, "other")
        loop.call_later(0.001, timer.set_result, None)
        theirs.send(b"a")
        await timer
        assert "other" in seen
        assert seen.count("flood") > 1
        loop.remove_reader(flood)
        loop.remove_reader(ours)


@in_loop
async def test_what_a_reader_schedules_is_done_in_the_same_turn() -> None:
    loop, order = loop_in_use(), list[str]()
    ours, theirs = socket.socketpair()

    def read_and_schedule() -> None:
        read(ours, order, "reader")
        loop.call_soon(order.append, "scheduled")

    with ours, theirs:
        loop.add_reader(ours, read_and_schedule)
        theirs.send(b"a")
        await asyncio.sleep(0)
        assert order == ["reader"]
        await asyncio.sleep(0)
        assert order == ["reader", "scheduled"]
        loop.remove_reader(ours)


@in_loop
async def test_a_read_of_asyncio_that_is_cancelled_leaves_no_reader() -> None:
    loop = loop_in_use()
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.setblocking(False)
        for _ in range(2):
            reading = asyncio.ensure_future(loop.sock_recv(ours, 9))
            await turns()
            reading.cancel()
            await turns()
        reading = asyncio.ensure_future(loop.sock_recv(ours, 9))
        await turns()
        theirs.send(b"a")
        assert await asyncio.wait_for(reading, 5) == b"a"
        assert not loop.remove_reader(ours)


@in_loop
async def test_signals_and_connections_of_asyncio_are_served_beside_readers() -> None:
    loop = loop_in_use()
    came, ours_was = loop.create_future(), signal.getsignal(signal.SIGUSR1)
    loop.add_signal_handler(signal.SIGUSR1, came.set_result, None)
    try:
        os.kill(os.getpid(), signal.SIGUSR1)
        await asyncio.wait_for(came, 5)
    finally:
        loop.remove_signal_handler(signal.SIGUSR1)
        signal.signal(signal.SIGUSR1, ours_was)
    ours, theirs = socket.socketpair()
    reader, writer = await asyncio.open_connection(sock=ours)
    theirs.send(b"line\n")
    assert await asyncio.wait_for(reader.readline(), 5) == b"line\n"
    writer.close()
    await writer.wait_closed()
    theirs.close()


def test_a_reader_may_stop_the_loop(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    loop = SampleLoop()
    loop.add_reader(ours, loop.stop)
    theirs.send(b"a")
    loop.run_forever()
    loop.close()


class CountingSelector(ReaderSelector):
    """Counts the turns of its loop."""

    turns = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.turns += 1
        return super().select(timeout)


def test_the_loop_does_not_turn_for_readers_that_give_it_nothing(pair: tuple[socket.socket, socket.socket]) -> None:
    ours, theirs = pair
    selector = CountingSelector()
    loop, calls, began = SampleLoop(selector), 100, list[int]()

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
    """A signal comes a little later."""
    loop.add_signal_handler(signal.SIGUSR1, done.set_result, None)
    threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGUSR1)).start()


@pytest.mark.parametrize(
    "give",
    [
        lambda loop, done: loop.call_soon(done.set_result, None),
        lambda loop, done: loop.call_later(0.001, done.set_result, None),
        lambda loop, done: loop.call_at(loop.time() + 0.001, done.set_result, None),
        lambda _loop, done: done.set_result(None),
        lambda loop, done: loop.call_soon_threadsafe(done.set_result, None),
        lambda loop, done: threading.Timer(0.01, loop.call_soon_threadsafe, (done.set_result, None)).start(),
        lambda loop, done: loop.run_in_executor(None, int).add_done_callback(lambda _: done.set_result(None)),
        lambda loop, done: loop.create_task(asyncio.sleep(0.001)).add_done_callback(lambda _: done.set_result(None)),
        send_signal,
    ],
    ids=["soon", "later", "at", "future", "threadsafe", "thread", "executor", "task", "signal"],
)
@in_loop
async def test_what_a_reader_gives_to_the_loop_is_done_at_once(
    pair: tuple[socket.socket, socket.socket], give: Callable[[SampleLoop, asyncio.Future[None]], object]
) -> None:
    """Nothing else ends the wait of the loop: without its turn this would take as long as the next timer."""
    ours, theirs = pair
    loop = loop_in_use()
    done, begun_s = loop.create_future(), loop.time()

    def read_and_give() -> None:
        ours.recv(9)
        give(loop, done)

    loop.add_reader(ours, read_and_give)
    loop.call_later(0.05, theirs.send, b"a")
    await asyncio.wait_for(done, 30)
    assert loop.time() - begun_s < 20
    loop.remove_reader(ours)
    loop.remove_signal_handler(signal.SIGUSR1)
    was = signal.getsignal(signal.SIGUSR1)
    signal.signal(signal.SIGUSR1, was)


@in_loop
async def test_a_writer_that_a_reader_adds_is_called_at_once() -> None:
    loop = loop_in_use()
    ours, theirs = socket.socketpair()
    done = loop.create_future()

    def write() -> None:
        loop.remove_writer(ours)
        done.set_result(None)

    def read_and_write() -> None:
        ours.recv(9)
        loop.add_writer(ours, write)

    with ours, theirs:
        loop.add_reader(ours, read_and_write)
        loop.call_later(0.05, theirs.send, b"a")
        await asyncio.wait_for(done, 30)
        loop.remove_reader(ours)


@in_loop
async def test_a_descriptor_of_the_same_number_is_watched_from_the_next_wait_of_a_turn_on() -> None:
    """The reader replaces its descriptor; what comes to the new one is seen though the loop did not turn."""
    loop, seen = loop_in_use(), loop_in_use().create_future()
    first, first_far = socket.socketpair()
    second, second_far = socket.socketpair()

    def take() -> None:
        loop.remove_reader(first)
        seen.set_result(first.recv(9))

    def replace() -> None:
        loop.remove_reader(first)
        os.dup2(second.fileno(), first.fileno())
        loop.add_reader(first, take)
        second_far.send(b"new")

    with first, first_far, second, second_far:
        loop.add_reader(first, replace)
        begun_s = loop.time()
        loop.call_later(0.05, first_far.send, b"a")
        assert await asyncio.wait_for(seen, 30) == b"new"
        assert loop.time() - begun_s < 20
