"""The progress bar: only on a terminal, with a limited number of updates."""

from io import StringIO

from imud.cli.export_sources import CLEAR, EVERY_S, LOOK_SAMPLES, Progress
from tests.cli.conftest import Terminal


def pictures(terminal: Terminal) -> list[str]:
    return [one for one in terminal.getvalue().split(CLEAR) if one]


def test_a_bar_with_share_samples_and_time() -> None:
    terminal, now_s = Terminal(), [100.0]
    progress = Progress(1000, terminal, lambda: now_s[0])
    now_s[0] = 110.0
    progress.add(LOOK_SAMPLES, lambda: 250)
    progress.close()
    progress.close()
    assert pictures(terminal) == [f"[######..................]  25 %  {LOOK_SAMPLES} samples, 30 s left"]
    assert terminal.getvalue().endswith(CLEAR)
    assert progress.spent_s == 10.0


def test_it_is_drawn_immediately_and_after_each_fifth_of_a_second() -> None:
    terminal, now_s = Terminal(), [100.0]
    progress = Progress(1000, terminal, lambda: now_s[0])
    for samples, second, expected in [(1999, 100.0, 0), (1, 100.0, 1), (2000, 100.19, 1), (2000, 100.2, 2)]:
        now_s[0] = second
        progress.add(samples, lambda: 20)
        assert len(pictures(terminal)) == expected
    assert pictures(terminal)[-1] == "[........................]   2 %  6000 samples"  # no estimate up to 2 %


def test_it_is_not_drawn_more_often_than_it_can_be_read_or_without_a_terminal() -> None:
    terminal, now_s = Terminal(), [0.0]
    progress = Progress(1000, terminal, lambda: now_s[0])
    for step in range(100):
        now_s[0] = step * EVERY_S / 10
        progress.add(LOOK_SAMPLES, lambda: 0)
    assert 9 <= len(pictures(terminal)) <= 11
    assert progress.samples == 100 * LOOK_SAMPLES
    out = StringIO()
    progress = Progress(1000, out, lambda: 0.0)
    progress.add(10 * LOOK_SAMPLES, lambda: 500)
    progress.close()
    assert out.getvalue() == ""
    assert progress.samples == 10 * LOOK_SAMPLES
