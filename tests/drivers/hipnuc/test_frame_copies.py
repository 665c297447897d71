"""Copies of frames by a gateway are ignored. Equal frames of a device at rest, and frames of a queue, are kept."""

from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.drivers.hipnuc.assembly import Assembly
from imud.drivers.hipnuc.frame_copies import COPY_NS
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

KINDS = (1, 2, 3, 4)
SPACING_NS = 200 * NS_PER_US
Frame = tuple[int, int, bytes]  # arrival time, kind, data


def burst(index: int, start_ns: int, *, is_moving: bool) -> list[Frame]:
    """Return the frames of one instant. Two kinds never change. Two kinds change if the device moves."""
    data = bytes((index % 250 if is_moving else 0,))
    return [(start_ns + place * SPACING_NS, kind, data if kind % 2 else b"same") for place, kind in enumerate(KINDS)]


def assemble(frames: Iterable[Frame]) -> tuple[int, Ledger]:
    """Return the number of samples and the ledger."""
    ledger = Ledger()
    assembly = Assembly(ledger)
    count = 0
    for t_ns, kind, data in sorted(frames):
        ledger.frames_good += 1
        count += len(assembly.add_frame(kind, data, t_ns))
    count += len(assembly.flush())
    assert ledger.closes()
    assert ledger.lost_gap_device == ledger.frames_lost == 0
    return count, ledger


@pytest.mark.parametrize("period_ms", [10, 20, 100])
@pytest.mark.parametrize("delay_us", [100, 500, 800, 1000, 1500, 2000, 2500])
def test_copies_are_ignored(delay_us: int, period_ms: int) -> None:
    frames = [frame for index in range(200) for frame in burst(index, index * period_ms * NS_PER_MS, is_moving=True)]
    copies = [(t_ns + delay_us * NS_PER_US + 1, kind, data) for t_ns, kind, data in frames]
    count, ledger = assemble(frames + copies)
    assert abs(count - 200) <= 2
    assert ledger.frames_ignored >= len(copies) - 8


def test_two_copies_of_each_frame_are_ignored() -> None:
    frames = [frame for index in range(200) for frame in burst(index, index * 10 * NS_PER_MS, is_moving=True)]
    copies = [(t_ns + delay_ns, kind, data) for t_ns, kind, data in frames for delay_ns in (900_000, 1_900_000)]
    count, ledger = assemble(frames + copies)
    assert abs(count - 200) <= 4
    assert ledger.frames_ignored >= len(copies) - 16


@given(
    st.integers(COPY_NS + NS_PER_MS, NS_PER_S // 2),
    st.lists(st.floats(0, 0.2), min_size=60, max_size=60),
    st.booleans(),
)
def test_equal_frames_at_the_period_are_kept(period_ns: int, jitters: list[float], is_moving: bool) -> None:
    """A device at rest sends the same bytes at each period. The bus delays frames by up to a fifth of it."""
    frames: list[Frame] = []
    for index, jitter in enumerate(jitters):
        frames += burst(index, index * period_ns + int(jitter * period_ns), is_moving=is_moving)
    _, ledger = assemble(frames)
    assert ledger.frames_ignored == 0


def test_fast_device_at_rest_loses_one_burst() -> None:
    """Above 333 Hz, the second burst of a device at rest can be a copy of the first burst."""
    frames = [frame for index in range(500) for frame in burst(index, index * 2 * NS_PER_MS, is_moving=False)]
    _, ledger = assemble(frames)
    assert ledger.frames_ignored == len(KINDS)


def test_queued_frames_of_moving_device_are_kept() -> None:
    """An adapter delivers the frames of two instants together, 1 ms apart, each 20 ms."""
    frames = [
        frame
        for index in range(200)
        for frame in burst(index, index // 2 * 20 * NS_PER_MS + index % 2 * NS_PER_MS, is_moving=True)
    ]
    _, ledger = assemble(frames)
    assert ledger.frames_ignored <= 2  # the first frames of the two kinds that never change
