"""Histograms: bars, edges, lengths. Tables and times."""

import time

import pytest

from imud.cli.output import BARS, WIDTH, bar_width, fitted, histogram, local_time, paragraph, table


def test_a_histogram_has_bars_with_shares() -> None:
    assert histogram([], "µs") == []
    assert histogram([7.0] * 10, "µs") == ["           7 µs 100.0 % " + "#" * WIDTH]
    lines = histogram([0.0] * 50 + [1.5] * 25 + [8.0] * 25, "ms")
    assert len(lines) == 9
    assert lines[0] == "           0 ms  50.0 % " + "#" * WIDTH
    assert lines[1] == "           1 ms  25.0 % " + "#" * (WIDTH // 2)
    assert lines[5] == "           5 ms   0.0 % "
    assert lines[8] == "           8 ms  25.0 % " + "#" * (WIDTH // 2)
    lines = histogram([-0.25, -0.15, 0.05], "ms")
    assert lines[0].startswith("       -0.25 ms")
    assert 3 <= len(lines) <= BARS + 1
    assert sum(float(line.split()[2]) for line in lines) == pytest.approx(100, abs=0.2)
    values = [float(v % 10) for v in range(999)] + [1e9]
    lines = histogram(values, "µs")
    assert len(lines) == 10
    assert float(lines[-1].split()[2]) == pytest.approx(10.0)  # the last bar counts the outlier
    for span, width in [(0, 1), (11, 1), (11.1, 2), (22, 2), (50, 5), (100, 10), (0.011, 0.001)]:
        assert bar_width(span) == pytest.approx(width)


def test_a_paragraph_with_a_label_longer_than_a_line_has_room_for_its_text() -> None:
    assert paragraph("x" * 200, "some words") == ["x" * 200 + "some words"]


def test_a_table_aligns_numbers_and_cannot_write_to_the_terminal() -> None:
    assert table(("A",), [("x\x1b[2J\ny",)]) == "A\nx\\x1b[2J\\ny"
    rows = [("mode", "6-axis, slowly", 7), ("baud", 115200, 11), ("node", "-", "-")]
    assert table(("SETTING", "ACTUAL", "N"), rows).splitlines() == [
        "SETTING  ACTUAL          N", "mode     6-axis, slowly   7", "baud     115200          11",
        "node     -               -",
    ]  # fmt: skip
    for value, width, text in [
        (12.34, 5, "12.34"),
        (12345.6, 5, "12346"),
        (123456.0, 5, "1.2e5"),
        (1234567.0, 4, "1e6"),
        (-1e300, 3, "###"),
        (-12.34, 5, "-12.3"),
    ]:
        assert fitted(value, width, lambda number: f"{number:.2f}") == text


def test_local_time_has_its_offset_then(monkeypatch: pytest.MonkeyPatch) -> None:
    """The offset is the offset at that time, not today's offset: summer and winter time differ."""
    monkeypatch.setenv("TZ", "CET-1CEST,M3.5.0,M10.5.0/3")
    time.tzset()
    try:
        assert local_time(1_790_000_000_123_456_789).isoformat() == "2026-09-21T16:13:20.123456+02:00"
        assert local_time(1_800_000_000_000_000_000).isoformat() == "2027-01-15T09:00:00+01:00"
        assert local_time(-1_000).isoformat() == "1970-01-01T00:59:59.999999+01:00"
    finally:
        monkeypatch.undo()
        time.tzset()
