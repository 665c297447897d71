"""A candump log as a bus."""

import asyncio
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.contracts.link import CanLink
from imud.formats.can import CanFilter, CanFrame
from imud.links import LINKS
from imud.links.replay import CanReplayLink, ReplayOptions, _problem
from imud.model.errors import LinkError, LinkMissing
from tests.support.event_loops import VirtualClock, run_virtually
from tests.support.files import candump_line

MS = 1_000_000
BEGIN_NS = 1_763_717_507_000 * MS


def write(path: Path, count: int, step_ms: int = 10) -> Path:
    lines = [
        candump_line(CanFrame(100 + n % 3, False, bytes([n % 256]), BEGIN_NS + n * step_ms * MS)) for n in range(count)
    ]
    path.write_text("".join(lines))
    return path


def make(path: Path, **keys: object) -> CanLink:
    row = LINKS["replay"]
    return row.make_can(msgspec.convert({"path": str(path), **keys}, row.settings))


def play(
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
    frames, ends, took_ns = play(write(tmp_path / "a.log", 1600), speed="maximum")
    assert (ends, took_ns) == ([None], 0)
    assert len(frames) == sum(n % 3 != 0 for n in range(1600))
    assert {frame.can_id for frame in frames} == {101, 102}
    assert frames[1].t_rx_ns - frames[0].t_rx_ns == 10 * MS
    assert VirtualClock().now_ns() - frames[-1].t_rx_ns == 10 * MS, "the last frame does not pass the filters"


def test_recorded_speed_takes_its_time(tmp_path: Path) -> None:
    looks: list[int] = []
    frames, _, took_ns = play(write(tmp_path / "a.log", 9, step_ms=5), looks=looks)
    assert len(looks) <= 2 * 9, "one wait for each frame"
    assert took_ns == pytest.approx(40 * MS, abs=100)
    assert [b.t_rx_ns - a.t_rx_ns for a, b in itertools.pairwise(frames)] == [5 * MS, 10 * MS] * 2 + [5 * MS]


def test_it_can_repeat_and_be_closed_by_the_receiver(tmp_path: Path) -> None:
    frames, ends, _ = play(write(tmp_path / "a.log", 3, step_ms=1), enough=7, repeat=True)
    assert [frame.can_id for frame in frames[:6]] == [101, 102] * 3
    assert ends == []
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
    log, long = write(tmp_path / "a.log", 3), tmp_path / "long"
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
