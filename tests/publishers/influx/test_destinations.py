"""Destinations: every line is acknowledged, waiting or dropped; receivers that fail; files that rotate."""

import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from imud.host.http_post import HttpPost, PostAccess, PostUrl, RequestTooLarge, post_url
from imud.host.threads import Job
from imud.model.units import NS_PER_S
from imud.publishers.influx.destinations import (
    BATCH_BYTES,
    DATAGRAM_BYTES,
    IDLE_NS,
    FileDelivery,
    HttpDelivery,
    LineAccount,
    QueuedDestination,
    TcpDelivery,
    UdpDestination,
)
from tests.support.event_loops import VirtualClock
from tests.support.line_protocol import FakeDatabase, fake_database
from tests.support.surroundings import free_port

ONE = b"m f=1i 1\n"


class StillWorker:
    """Worker that never calls its job: the test does."""

    def __init__(self, _name: str, _job: Job) -> None: ...

    def ring(self) -> None: ...

    def end(self) -> bool:
        return True


class FakeDelivery:
    def __init__(self) -> None:
        self.fails: list[Exception | None] = []
        self.got: list[bytes] = []
        self.while_sending: Callable[[], object] = lambda: None
        self.is_stopped = False

    def stop(self) -> None:
        self.is_stopped = True

    def send(self, batch: bytes) -> None:
        self.while_sending()
        error = self.fails.pop(0) if self.fails else None
        if error is not None:
            raise error
        self.got.append(batch)

    def close(self) -> None: ...


class Rig:
    def __init__(self, delivery: FakeDelivery | HttpDelivery, queue_bytes: int = 1000) -> None:
        self.clock = VirtualClock()
        self.one = QueuedDestination("d", delivery, (queue_bytes, NS_PER_S), self.clock.now_ns, StillWorker)
        self.one.start()

    def put(self, lines: bytes) -> None:
        """Put lines as a batch of their own."""
        self.one.put(lines, lines.count(b"\n"), self.clock.now_ns())
        self.one.finish()

    def run(self, seconds: float = 0) -> int:
        self.clock.advance(round(seconds * NS_PER_S))
        rest_ns = self.one.do_round()
        self.balanced()
        return rest_ns

    def balanced(self) -> LineAccount:
        found = self.one.account()
        assert found.made == found.acknowledged + found.waiting + found.dropped
        return found


@pytest.fixture
def database() -> Iterator[FakeDatabase]:
    with fake_database() as made:
        yield made


def test_lines_wait_for_the_age_of_their_batch_and_a_full_batch_does_not_wait() -> None:
    fake = FakeDelivery()
    rig = Rig(fake, 10**9)
    rig.one.put(ONE, 1, rig.clock.now_ns())
    rig.one.tick(rig.clock.now_ns() + NS_PER_S - 1)
    assert (rig.run(), fake.got, rig.balanced()) == (IDLE_NS, [], (1, 0, 1, 0))
    rig.one.tick(rig.clock.now_ns() + NS_PER_S)
    assert (rig.run(), fake.got, rig.balanced()) == (0, [ONE], (1, 1, 0, 0))
    for full in (ONE * 5000, b"m f=1i 1" + b"0" * 1_000_000 + b"\n"):
        rig.one.put(full, full.count(b"\n"), 0)
        rig.run()
        assert fake.got[-1] == full


def test_failures_repeat_the_batch_after_a_doubling_pause(caplog: pytest.LogCaptureFixture) -> None:
    fake = FakeDelivery()
    rig = Rig(fake)
    fake.fails = [OSError("no route")] * 8
    rig.put(ONE)
    for pause_s in (1, 2, 4, 8, 16, 32, 60, 60):
        assert rig.run() == pause_s * NS_PER_S
        assert rig.run(pause_s - 0.5) == NS_PER_S // 2, "new lines do not shorten the pause"
        assert (rig.one.status().problem, rig.one.status().readers) == ("no route; trying again", 0)
        rig.clock.advance(NS_PER_S // 2)
    assert (rig.run(), fake.got, rig.one.status().problem, rig.balanced()) == (0, [ONE], "", (1, 1, 0, 0))
    assert len(caplog.messages) == 1
    fake.fails = [OSError("again")]
    rig.put(ONE)
    assert rig.run() == NS_PER_S, "the pause is short again"


def test_a_full_queue_drops_the_oldest_lines_but_never_the_lines_in_flight() -> None:
    fake = FakeDelivery()
    rig = Rig(fake, 3 * len(ONE))
    fake.fails = [OSError("down")]
    rig.put(ONE.replace(b"1i", b"0i"))
    rig.run()
    for number in range(1, 10):
        rig.put(ONE.replace(b"1i", b"%di" % number))
    assert rig.balanced() == (10, 0, 4, 6)
    while rig.run(1) != IDLE_NS:
        pass
    assert [batch[4:5] for batch in fake.got] == [b"0", b"7", b"8", b"9"]
    fake.while_sending = rig.balanced
    rig.put(ONE * 10)
    assert (rig.run(), rig.balanced()) == (0, (20, 14, 0, 6)), "a batch above the limit alone is kept"


def test_the_end_counts_the_remaining_lines(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig(FakeDelivery())
    rig.put(ONE)
    rig.one.put(ONE, 1, 0)
    for _ in range(2):
        rig.one.close()
        assert rig.balanced() == (2, 0, 0, 2)
    assert caplog.messages == ["influx: d: dropping 2 lines at the end"]


def test_an_internal_error_is_a_problem() -> None:
    rig = Rig(FakeDelivery())
    rig.one.round_failed(KeyError("x"))
    assert rig.one.status().problem == "internal error KeyError: 'x'"


def http_rig(database: FakeDatabase, *, compress: bool = False) -> Rig:
    url = post_url(database.url)
    assert url is not None
    return Rig(HttpDelivery(HttpPost(url, PostAccess(), VirtualClock().now_ns, compress=compress)))


@pytest.mark.parametrize(
    ("reply", "account", "problem"),
    [
        ((204, ""), (1, 1, 0, 0), ""), ((200, "{}"), (1, 1, 0, 0), ""),
        ((400, "partial\nwrite"), (1, 0, 0, 1), 'the server replied 400: partial write; imud dropped 1 lines'),
        ((422, ""), (1, 0, 0, 1), "the server replied 422; imud dropped 1 lines"),
        ((401, ""), (1, 0, 1, 0), "the server replied 401; trying again"),
        ((403, "read only"), (1, 0, 1, 0), "the server replied 403: read only; trying again"),
        ((404, "x" * 9000), (1, 0, 1, 0), f"the server replied 404: {'x' * 200}; trying again"),
        ((413, ""), (1, 0, 1, 0), "the server replied 413 to a request of 9 bytes; trying again"),
        ((429, "slow"), (1, 0, 1, 0), "the server replied 429: slow; trying again"),
        ((302, ""), (1, 0, 1, 0), "the server replied 302; trying again"),
        ((503, "busy"), (1, 0, 1, 0), "the server replied 503: busy; trying again"),
        ((0, ""), (1, 0, 1, 0), "the server closed the connection without a reply; trying again"),
    ],
)  # fmt: skip
def test_replies(database: FakeDatabase, reply: tuple[int, str], account: tuple[int, ...], problem: str) -> None:
    rig = http_rig(database)
    database.replies = [reply]
    rig.put(ONE)
    rig.run()
    assert (rig.balanced(), rig.one.status().problem) == (account, problem)
    rig.put(ONE)
    rig.run(1)
    rig.run()
    assert rig.balanced() == (2, 2 - account[3], 0, account[3])
    assert rig.one.status().problem == ""
    rig.one.close()


def test_a_lost_reply_repeats_equal_lines_and_an_absent_server_is_a_problem(database: FakeDatabase) -> None:
    rig = http_rig(database, compress=False)
    database.replies = [(0, "")]
    rig.put(ONE)
    rig.run()
    rig.run(1)
    assert database.bodies == [ONE, ONE], "the database identifies the row by series and time"
    assert rig.balanced() == (1, 1, 0, 0)
    rig.one.close()
    absent = Rig(
        HttpDelivery(HttpPost(PostUrl("127.0.0.1", free_port(), False, "/write"), PostAccess(), VirtualClock().now_ns))
    )
    absent.put(ONE)
    absent.run()
    assert absent.one.status().problem == "Connection refused; trying again"


def receiver(kind: socket.SocketKind) -> tuple[socket.socket, tuple[str, int]]:
    made = socket.socket(socket.AF_INET, kind)
    made.bind(("127.0.0.1", 0))
    made.settimeout(60)
    return made, made.getsockname()


def test_datagrams_have_complete_lines_of_at_most_1400_bytes() -> None:
    sock, address = receiver(socket.SOCK_DGRAM)
    one = UdpDestination("udp", address)
    long, lines = b"x" * DATAGRAM_BYTES + b"\n", [b"m f=%di 1\n" % number for number in range(200)]
    one.put(b"".join([*lines[:100], long, *lines[100:]]), 201, 0)
    found, datagrams = b"", []
    while found.count(b"\n") < 200:
        datagrams.append(sock.recv(1 << 16))
        found += datagrams[-1]
    assert found == b"".join(lines)
    assert all(len(datagram) <= DATAGRAM_BYTES and datagram.endswith(b"\n") for datagram in datagrams)
    assert (one.account(), one.status().problem) == ((201, 200, 0, 1), "")
    one.put(long, 1, 0)
    assert one.status().problem == "expected lines of at most 1400 bytes, got 1401; try tcp or http"
    one.close()
    unreachable = UdpDestination("udp", ("240.0.0.1", 9))
    unreachable.put(ONE, 1, 0)
    assert unreachable.account().made == 1
    for made in (sock, unreachable):
        made.close()


def test_a_tcp_connection_begins_with_a_complete_batch_after_a_failure() -> None:
    listener, address = receiver(socket.SOCK_STREAM)
    one = TcpDelivery(address, VirtualClock().now_ns)
    listener.listen()
    for number in range(3):
        one.send(b"m f=%di 1\n" % number)
        accepted, _ = listener.accept()
        with accepted:
            assert accepted.recv(100) == b"m f=%di 1\n" % number
            accepted.sendall(b"ignored")
    listener.close()
    for _ in range(2):
        with pytest.raises(OSError, match="refused"):
            one.send(ONE)
    one.close()


def test_tcp_receiver_that_floods_ends_the_batch() -> None:
    """The receiver reads nothing and sends without end: imud ignores a limited number of bytes."""
    listener, address = receiver(socket.SOCK_STREAM)
    listener.listen()

    def flood() -> None:
        accepted, _ = listener.accept()
        with accepted, suppress(OSError):
            while True:
                accepted.sendall(bytes(1 << 16))

    thread = threading.Thread(target=flood)
    thread.start()
    one = TcpDelivery(address, VirtualClock().now_ns)
    with pytest.raises(OSError, match=r"sends nothing, got \d+ bytes"):
        one.send(bytes(50_000_000))
    thread.join()
    listener.close()
    with pytest.raises(OSError):  # noqa: PT011 - the stopped delivery connects to nothing
        one.send(ONE)


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def imud_line(text: str) -> bytes:
    return f"imud_{text}\n".encode()


def test_a_file_rotates_and_continues_after_a_restart(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    one = FileDelivery(str(path), 25, 3)
    c = imud_line("c" * 35)
    e = imud_line("e" * 19)
    for batch in (imud_line("a"), imud_line("b" * 17), c, imud_line("d"), e, imud_line("f")):
        one.send(batch)
    assert files_of(tmp_path) == {"lines": imud_line("f"), "lines.1": e, "lines.2": imud_line("d")}, c
    one.close()
    with path.open("ab") as file:
        file.write(b"imud_half a li")
    one.send(imud_line("g"))
    assert path.read_bytes() == b"imud_f\nimud_g\n", "the incomplete line of a power failure is removed"
    path.rename(tmp_path / "moved")
    one.send(imud_line("h"))
    assert path.read_bytes() == imud_line("h"), "another program moved the file"
    one.close()
    single = FileDelivery(str(path), 8, 1)
    for batch in (imud_line("i"), imud_line("j")):
        single.send(batch)
    assert path.read_bytes() == imud_line("j")
    single.close()


FOREIGN_FILES = {
    "without a line end": b"x" * 65_536, "text": b"root:x:0:0\n", "zeros": bytes(100), "short": b"imx",
    "cut": b"imud_a f=1i 1\nforeign", "longer than the tail": b"imud_a\n" + b"x" * 70_000,
    "zeros after a power failure": b"imud_a f=1i 1\n" + bytes(10),
}  # fmt: skip


@pytest.mark.parametrize("content", FOREIGN_FILES.values(), ids=list(FOREIGN_FILES))
def test_foreign_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "lines"
    path.write_bytes(content)
    one = FileDelivery(str(path), 10**6, 3)
    for _ in range(2):
        with pytest.raises(OSError, match=r"data that imud did not write; set another path in influx\.to"):
            one.send(imud_line("a"))
    assert path.read_bytes() == content
    one.close()


@pytest.mark.parametrize("name", ["lines.1", "lines.2"])
def test_rotation_keeps_foreign_file(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"foreign")
    one = FileDelivery(str(tmp_path / "lines"), 10, 3)
    one.send(imud_line("a"))
    with pytest.raises(OSError, match=f"{name} contains data that imud did not write"):
        one.send(imud_line("b" * 9))
    assert files_of(tmp_path) == {"lines": imud_line("a"), name: b"foreign"}
    one.close()


class SizedReceiver(FakeDelivery):
    """Receiver that refuses requests above a size with 413."""

    def __init__(self, bytes_max: int) -> None:
        super().__init__()
        self.bytes_max = bytes_max
        self.refusals = 0

    def send(self, batch: bytes) -> None:
        if len(batch) > self.bytes_max:
            self.refusals += 1
            raise RequestTooLarge(413, "")
        super().send(batch)


def test_refused_sizes_divide_requests() -> None:
    receiver = SizedReceiver(100)
    rig = Rig(receiver, 10**6)
    for first in (0, 1000):
        rig.put(b"".join(b"m f=%04di 1\n" % number for number in range(first, first + 1000)))
    while rig.run(1) != IDLE_NS:
        pass
    numbers = [int(line[4:8]) for batch in receiver.got for line in batch.splitlines()]
    assert numbers == list(range(2000))
    assert (rig.balanced(), rig.one.status().problem) == ((2000, 2000, 0, 0), "")
    # 8 halves of 24 kB, and 3 tests of twice the size during 300 requests
    assert receiver.refusals <= 11, "imud remembers the accepted size"


def test_long_line_is_dropped_alone() -> None:
    receiver = SizedReceiver(100)
    rig = Rig(receiver, 10**6)
    long_line = b"m f=" + b"1" * 200 + b"i 1\n"
    rig.put(ONE * 20 + long_line + ONE * 20)
    while rig.run(1) != IDLE_NS:
        pass
    assert rig.balanced() == (41, 40, 0, 1)
    assert b"".join(receiver.got) == ONE * 40


def test_lines_wait_while_every_size_is_refused() -> None:
    receiver = SizedReceiver(0)
    rig = Rig(receiver, 10**6)
    rig.put(ONE * 10)
    for _ in range(1000):
        rig.run(1)
    assert rig.balanced() == (10, 0, 10, 0)
    assert receiver.refusals < 40, "the pause grows"
    receiver.bytes_max = 1000
    while rig.run(60) != IDLE_NS:
        pass
    assert rig.balanced() == (10, 10, 0, 0)


def test_size_of_requests_grows_again() -> None:
    receiver = SizedReceiver(20)
    rig = Rig(receiver, 10**7)
    rig.put(ONE * 100)
    rig.run()
    receiver.bytes_max = 10**6
    for _ in range(4000):
        rig.put(ONE * 1000)
        while rig.run() != IDLE_NS:
            pass
        if len(receiver.got[-1]) >= 4500:
            break
    assert len(receiver.got[-1]) >= 4500


def test_size_is_checked_before_lines_are_added() -> None:
    fake = FakeDelivery()
    rig = Rig(fake, 10**8)
    lines = (b"m f=1i " + b"1" * 991 + b"\n") * 600
    for _ in range(4):
        rig.one.put(lines, 600, 0)
    rig.one.put(lines * 4, 2400, 0)
    rig.one.finish()
    while rig.run() != IDLE_NS:
        pass
    assert max(map(len, fake.got)) <= BATCH_BYTES
    assert b"".join(fake.got) == lines * 8
    assert rig.balanced() == (4800, 4800, 0, 0)


def test_missing_delivery_is_a_problem() -> None:
    fake = FakeDelivery()
    rig = Rig(fake)
    statuses = []
    rig.put(ONE)

    def wait_for_reply() -> None:
        for _ in range(3):
            rig.clock.advance(5 * NS_PER_S)
            statuses.append(rig.one.status())

    fake.while_sending = wait_for_reply
    rig.run()
    text = "no delivery for {} s: the receiver has not confirmed a request; check the receiver"
    assert [status.problem for status in statuses] == ["", text.format(10), text.format(15)]
    assert [status.readers for status in statuses] == [1, 0, 0]
    rig.run()
    rig.clock.advance(100 * NS_PER_S)
    assert (rig.one.status().problem, rig.one.status().readers) == ("", 1), "without lines, no delivery is due"


def test_end_stops_the_delivery(caplog: pytest.LogCaptureFixture) -> None:
    fake = FakeDelivery()
    rig = Rig(fake)
    rig.put(ONE)

    def end() -> None:
        rig.one.stop()
        raise OSError("stopped")

    fake.while_sending = end
    assert rig.run() == IDLE_NS
    rig.one.close()
    assert fake.is_stopped
    assert caplog.messages == ["influx: d: dropping 1 lines at the end"]


def test_a_full_disk_leaves_complete_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, real = FileDelivery(str(tmp_path / "lines"), 1000, 1), os.write
    one.send(b"imud_a\n")

    def write(descriptor: int, data: bytes) -> int:
        if len(data) < 4:
            raise OSError(28, "No space left on device")
        return real(descriptor, bytes(data[:2]))

    monkeypatch.setattr(os, "write", write)
    with pytest.raises(OSError, match="No space"):
        one.send(b"bcdef\n")
    monkeypatch.undo()
    assert files_of(tmp_path) == {"lines": b"imud_a\n"}
    one.send(b"bcdef\n")
    assert files_of(tmp_path) == {"lines": b"imud_a\nbcdef\n"}
    one.close()


def test_a_fifo_and_a_link_are_not_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    for name in ("fifo", "link", "absent/lines"):
        with pytest.raises(OSError, match=r"expected a regular file|symbolic links|No such file"):
            FileDelivery(str(tmp_path / name), 1000, 1).send(ONE)
    assert not (tmp_path / "target").exists()
