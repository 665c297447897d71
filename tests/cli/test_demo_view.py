"""Live view and summary of `imud demo`."""

import io

import msgspec
import pytest

from imud.cli.demo import View
from imud.model.sample import Sample, Sync


def sample(seq: int) -> Sample:
    t_ns = seq * 10_000_000
    return Sample("demo", seq, t_ns, 50_000, Sync.REGRESSION, t_ns + 100, 0, euler_rad=(0.1, 0, 0))


def test_view_counts_what_is_missing_of_each_device() -> None:
    view = View(io.StringIO(), live=False)
    for seq in (1, 2, 5):
        view.add(sample(seq))
    assert (view.samples, view.missed) == (3, 2)
    assert "3 samples at 100.00 Hz, 2 lost" in view.account()
    assert "no sample arrived" in View(io.StringIO(), live=False).account()
    view = View(io.StringIO(), live=False)
    for name, seq in (("a", 1), ("b", 7), ("a", 2), ("b", 9)):
        view.add(msgspec.structs.replace(sample(seq), device=name))
    assert (view.samples, view.missed) == (4, 1)


def test_live_view_draws_ten_times_per_second(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    view = View(out, live=True)
    for number, now_ms in enumerate((1000, 1099, 1100, 1199, 1200), 1):
        monkeypatch.setattr("imud.cli.demo.monotonic_ns", lambda now_ms=now_ms: now_ms * 1_000_000)
        view.add(sample(number))
    assert [number for number in range(1, 6) if f"demo #{number}" in out.getvalue()] == [1, 3, 5]


def test_live_view_draws_in_place() -> None:
    out = io.StringIO()
    view = View(out, live=True)
    view.add(sample(1))
    first = out.getvalue()
    assert "demo #1" in first
    assert "5.730" in first  # 0.1 rad in degrees
    assert "\x1b[5A" not in first
