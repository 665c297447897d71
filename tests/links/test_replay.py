"""Captures and CAN logs replayed through their links."""

import asyncio
import errno
import os
from collections.abc import Sequence
from io import BytesIO
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.contracts.link import CanLink, StreamLink
from imud.contracts.status import KernelCounters
from imud.formats.can import CanFilter, CanFrame
from imud.links import LINKS
from imud.links.replay import CanReplayLink, ReplayLink, ReplayOptions, _problem
from imud.model.errors import LinkDenied, LinkError, LinkMissing
from imud.model.units import NS_PER_MS, uart_byte_ns
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import VirtualClock, in_loop, run_virtually
from tests.support.files import CaptureWriter, candump_line
from tests.support.leaks import open_descriptors

READS = [(b"a" * 82, 1_000_000_000), (b"b" * 41, 1_004_000_000), (b"c", 1_004_000_000), (b"d" * 82, 1_030_000_000)]


@pytest.fixture
def stamped(tmp_path: Path) -> Path:
    path = tmp_path / "stamped"
    with path.open("wb") as file:
        writer = CaptureWriter(file, driver="hipnuc-uart", baud=115200, details={"hold_ns": 16_000_000})
        for data, t_ns in READS:
            writer.write(data, t_ns)
    return path


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    path = tmp_path / "raw"
    path.write_bytes(bytes(range(256)) * 2)
    return path


class Played:
    """A link that replays a capture in simulated time, with the delivered data and its times."""

    def __init__(self, path: Path, **settings: Any) -> None:
        self.clock = VirtualClock()
        self.link = ReplayLink(ReplayOptions(path=str(path), **settings), self.clock.now_ns)
        self.chunks: list[tuple[bytes, int]] = []
        self.delivered_ns: list[int] = []
        self.started_ns = 0
        self.ends: list[LinkError | None] = []

    @property
    def data(self) -> bytes:
        return b"".join(data for data, _ in self.chunks)

    @property
    def offsets_ns(self) -> list[int]:
        return [t_rx_ns - self.chunks[0][1] for _, t_rx_ns in self.chunks]

    def play(self, pieces_max: int) -> None:
        """Replay to the end, or until `pieces_max` pieces have arrived."""
        run_virtually(self.clock, self._play(pieces_max))

    async def _play(self, pieces_max: int) -> None:
        done, link = asyncio.Event(), self.link

        def on_data(data: bytes, t_rx_ns: int) -> None:
            self.chunks.append((data, t_rx_ns))
            self.delivered_ns.append(self.clock.now_ns())
            if len(self.chunks) >= pieces_max:
                link.close()
                done.set()

        def on_end(error: LinkError | None) -> None:
            self.ends.append(error)
            done.set()

        await link.wait_present()
        link.open()
        self.started_ns = self.clock.now_ns()
        link.start(on_data, on_end)
        await done.wait()
        link.close()


def play(path: Path, *, pieces_max: int = 1 << 30, **settings: Any) -> Played:
    played = Played(path, **settings)
    played.play(pieces_max)
    return played


def check_times(played: Played) -> None:
    """Check the times, for any speed: they are not in the future and do not decrease."""
    times = [t_rx_ns for _, t_rx_ns in played.chunks]
    assert times == sorted(times)
    assert all(t_rx_ns <= now_ns for t_rx_ns, now_ns in zip(times, played.delivered_ns, strict=True))


def test_recorded_speed_keeps_the_recorded_jitter(stamped: Path) -> None:
    played = play(stamped)
    assert [data for data, _ in played.chunks] == [data for data, _ in READS]
    assert played.offsets_ns == [t_ns - READS[0][1] for _, t_ns in READS]
    assert played.delivered_ns[-1] - played.delivered_ns[0] == pytest.approx(30 * NS_PER_MS, abs=100)
    assert played.ends == [None]
    assert (played.link.baud, played.link.hold_ns, played.link.writable) == (115200, 16_000_000, False)
    check_times(played)


def test_real_speed_is_the_wire_s(raw: Path, stamped: Path) -> None:
    played = play(raw, speed="real", baud=115200)
    assert played.data == raw.read_bytes()
    byte_ns = uart_byte_ns(115200)
    assert max(len(data) for data, _ in played.chunks) == 2 * NS_PER_MS // byte_ns
    whole_ns = played.chunks[-1][1] - played.chunks[0][1] + len(played.chunks[0][0]) * byte_ns
    assert whole_ns == len(played.data) * byte_ns
    assert played.delivered_ns[-1] - played.started_ns == pytest.approx(whole_ns, abs=100)
    assert played.link.hold_ns == 2 * NS_PER_MS
    check_times(played)
    played = play(stamped, speed="real")
    assert played.data == b"".join(data for data, _ in READS)
    assert len(played.chunks) > len(READS)


def test_maximum_speed_is_virtual_time(tmp_path: Path, stamped: Path) -> None:
    path = tmp_path / "long"
    path.write_bytes(bytes(3 * 65536 + 5))
    played = play(path, speed="maximum", baud=921600)
    assert len(played.data) == 3 * 65536 + 5
    byte_ns, sizes = uart_byte_ns(921600), [len(data) for data, _ in played.chunks]
    assert [b - a for a, b in pairwise(played.offsets_ns)] == [size * byte_ns for size in sizes[1:]]
    check_times(played)
    assert set(play(path, speed="maximum").offsets_ns) == {0}
    played = play(stamped, speed="maximum")
    assert played.offsets_ns == [t_ns - READS[0][1] for _, t_ns in READS]
    assert {*played.delivered_ns} == {played.started_ns} == {played.chunks[-1][1]}  # the replay did not wait
    check_times(played)


@in_loop
async def test_others_get_their_turn_at_maximum_speed(tmp_path: Path) -> None:
    path = tmp_path / "long"
    link = ReplayLink(ReplayOptions(path=str(path), speed="maximum"))
    waiting = asyncio.create_task(link.wait_present())
    for _ in range(20):
        await asyncio.sleep(0)
    assert not waiting.done()
    path.write_bytes(bytes(1 << 20))
    await asyncio.wait_for(waiting, LIMIT_S)
    order: list[str] = []
    done = asyncio.Event()
    link.open()
    link.start(lambda data, t_rx_ns: order.append("data"), lambda error: done.set())
    while not done.is_set():
        order.append("other")
        await asyncio.sleep(0)
    assert order.count("data") == (1 << 20) // 4096
    assert max(len(list(run)) for who, run in groupby(order) if who == "data") == 16384 // 4096


def test_a_capture_can_be_repeated_and_played_again(stamped: Path) -> None:
    played = play(stamped, repeat=True, pieces_max=2 * len(READS))
    assert played.data == 2 * b"".join(data for data, _ in READS)
    assert played.offsets_ns[len(READS)] > played.offsets_ns[len(READS) - 1]
    assert played.ends == []
    check_times(played)
    played = play(stamped, speed="maximum")
    first = played.data
    played.play(1 << 30)
    assert played.data == 2 * first


def test_a_capture_without_an_end_plays_its_whole_records(
    stamped: Path, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    stamped.write_bytes(stamped.read_bytes()[:-1])
    played = play(stamped, speed="maximum")
    assert played.data == b"".join(data for data, _ in READS[:-1])
    assert played.ends == [None]
    assert "incomplete" in caplog.text
    path = tmp_path / "empty"
    with path.open("wb") as file:
        CaptureWriter(file, driver="x")
    assert play(path, repeat=True).ends == [None]


def test_captures_that_cannot_be_played(raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LinkError, match="raw capture without times"):
        ReplayLink(ReplayOptions(path=str(raw))).open()
    with pytest.raises(LinkError, match="needs the key baud"):
        ReplayLink(ReplayOptions(path=str(raw), speed="real")).open()
    raw.write_bytes(b"#imud-capture 9\n")
    with pytest.raises(LinkError, match="version 1, got '9'"):
        ReplayLink(ReplayOptions(path=str(raw))).open()
    with pytest.raises(LinkMissing, match="expected a capture file"):
        ReplayLink(ReplayOptions(path=str(tmp_path / "none"))).open()
    with pytest.raises(LinkError, match="not a regular file"):
        ReplayLink(ReplayOptions(path=str(tmp_path))).open()

    def refuse(path: str) -> None:
        raise PermissionError

    monkeypatch.setattr("imud.host.files.os.stat", refuse)
    with pytest.raises(LinkDenied):
        ReplayLink(ReplayOptions(path=str(tmp_path))).open()


class BrokenFile(BytesIO):
    def read(self, size: int | None = -1) -> bytes:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    readline = read


@pytest.mark.parametrize(
    ("kind", "file", "words"),
    [(ReplayLink, BrokenFile(), "cannot read a: Input/output error"),
     (CanReplayLink, BrokenFile(), "cannot read a: Input/output error"),
     (CanReplayLink, BytesIO(b"(1.0) a 100#\n(1.1) b 100#\n"), "^a: "),
     (ReplayLink, BytesIO(bytes(512)), "raw capture without times")],
)  # fmt: skip
def test_a_file_that_is_refused_or_whose_read_fails_is_closed(
    monkeypatch: pytest.MonkeyPatch, kind: type[ReplayLink | CanReplayLink], file: BytesIO, words: str
) -> None:
    monkeypatch.setattr("imud.links.replay.open_regular", lambda _path: file)
    with pytest.raises(LinkError, match=words):
        kind(ReplayOptions(path="a")).open()
    assert file.closed


def test_a_replay_has_settings_and_refuses_commands(stamped: Path) -> None:
    row = LINKS["replay"]
    link: StreamLink = row.make(msgspec.convert({"path": "a", "speed": "maximum"}, row.settings))
    assert (link.title, link.auto_baud) == ("a", False)
    with pytest.raises(msgspec.ValidationError, match="repeat: expected false at speed maximum"):
        msgspec.convert({"path": "a", "speed": "maximum", "repeat": True}, row.settings)
    link = ReplayLink(ReplayOptions(path=str(stamped)))
    with pytest.raises(LinkError, match="and cannot receive data"):
        link.write(b"x")
    with pytest.raises(LinkError, match="fixed baud rate"):
        link.set_baud(9600)
    assert link.kernel_counters() == KernelCounters()


BEGIN_NS = 1_763_717_507_000 * NS_PER_MS


def write_log(path: Path, count: int, step_ms: int = 10) -> Path:
    lines = [
        candump_line(CanFrame(100 + n % 3, False, bytes([n % 256]), BEGIN_NS + n * step_ms * NS_PER_MS))
        for n in range(count)
    ]
    path.write_text("".join(lines))
    return path


def make(path: Path, **keys: object) -> CanLink:
    row = LINKS["replay"]
    return row.make_can(msgspec.convert({"path": str(path), **keys}, row.settings))


def play_log(
    path: Path, enough: int = 1 << 30, looks: list[int] | None = None, **keys: Any
) -> tuple[list[CanFrame], list[LinkError | None], int]:
    """Replay in simulated time to the end, or until `enough` frames. Return frames, ends and duration.

    `looks` gets the times at which the link reads the clock.
    """
    clock = VirtualClock()

    def now_ns() -> int:
        if looks is not None:
            looks.append(clock.now_ns())
        return clock.now_ns()

    link = CanReplayLink(ReplayOptions(path=str(path), **keys), now_ns)
    link.filters = [CanFilter(101, 0x7FF, False), CanFilter(102, 0x7FF, False)]
    frames: list[CanFrame] = []
    ends: list[LinkError | None] = []

    async def story() -> None:
        done = asyncio.Event()

        def on_frames(some: Sequence[CanFrame]) -> None:
            assert len(some) <= 512, "others get their turn"
            frames.extend(some)
            if len(frames) >= enough:
                link.close()
                done.set()

        def end(error: LinkError | None) -> None:
            assert str(path) not in open_descriptors().values()
            ends.append(error)
            done.set()

        await link.wait_present()
        link.open()
        link.start(on_frames, lambda news, problem: None, end)
        await done.wait()
        link.close()

    begin_ns = clock.now_ns()
    run_virtually(clock, story())
    return frames, ends, clock.now_ns() - begin_ns


def test_maximum_speed_ends_now_and_keeps_the_recorded_steps(tmp_path: Path) -> None:
    frames, ends, took_ns = play_log(write_log(tmp_path / "a.log", 1600), speed="maximum")
    assert ((ends, took_ns), len(frames)) == (([None], 0), sum(n % 3 != 0 for n in range(1600)))
    assert {frame.can_id for frame in frames} == {101, 102}
    assert frames[1].t_rx_ns - frames[0].t_rx_ns == 10 * NS_PER_MS
    assert VirtualClock().now_ns() - frames[-1].t_rx_ns == 10 * NS_PER_MS, "the last frame does not pass the filters"


def test_recorded_speed_takes_its_time(tmp_path: Path) -> None:
    looks: list[int] = []
    frames, _, took_ns = play_log(write_log(tmp_path / "a.log", 9, step_ms=5), looks=looks)
    assert len(looks) <= 2 * 9, "one wait for each frame"
    assert took_ns == pytest.approx(40 * NS_PER_MS, abs=100)
    assert [b.t_rx_ns - a.t_rx_ns for a, b in pairwise(frames)] == [5 * NS_PER_MS, 10 * NS_PER_MS] * 2 + [5 * NS_PER_MS]


def test_it_can_repeat_and_be_closed_by_the_receiver(tmp_path: Path) -> None:
    frames, ends, _ = play_log(write_log(tmp_path / "a.log", 3, step_ms=1), enough=7, repeat=True)
    assert ([frame.can_id for frame in frames[:6]], ends) == ([101, 102] * 3, [])
    times = [frame.t_rx_ns for frame in frames]
    assert times == sorted(times)


def test_what_cannot_be_played(tmp_path: Path) -> None:
    bad = tmp_path / "bad"
    bad.write_bytes(b"Z\xa5 no log\n")
    with pytest.raises(LinkError, match="is not a CAN log"):
        make(bad).open()
    missing = make(tmp_path / "missing")
    assert "does not exist" in missing.absence()
    with pytest.raises(LinkMissing):
        missing.open()
    with pytest.raises(LinkError, match="replay"):
        missing.write(b"")
    log, long = write_log(tmp_path / "a.log", 3), tmp_path / "long"
    long.write_bytes(b"#" * 65536)
    for path, frames, interface, expected in (
        (bad, True, "can0", "is not a CAN log: expected frames in the format of `candump -L`, got none"),
        (bad, False, "", "is a raw capture without times: use speed real with the key baud, or speed maximum"),
        (log, True, "can0", ""), (log, True, "", ""), (tmp_path / "missing", True, "", ""),
        (long, True, "", ""), (long, True, "can0", ""),  # frames can follow
        (tmp_path, False, "", "is not a regular file: expected a capture file"),
    ):  # fmt: skip
        settings = ReplayOptions(path=str(path), interface=interface)
        assert _problem(settings, frames) == (f"{path} {expected}" if expected else "")
    words = f"interface: expected a log of a CAN bus, got {log} for a driver of bytes"
    assert _problem(ReplayOptions(path=str(log), interface="can0"), frames=False) == words
