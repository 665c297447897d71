"""Output line that imud keeps open: due openings, the last level after a failure, inactive at the end."""

from imud.contracts.lines import LineFactory, OutputOptions
from imud.lines.driven_line import driving
from imud.model.errors import LinkError
from tests.support.event_loops import VirtualClock

S = 10**9


class FakeOutput:
    title = "line"

    def __init__(self) -> None:
        self.did: list[object] = []
        self.failing = ""

    def _do(self, step: object) -> None:
        self.did.append(step)
        if self.failing == step:
            raise LinkError(f"cannot {step}")

    def open(self) -> None:
        self._do("open")

    def set(self, active: bool) -> None:
        self._do(active)

    def close(self) -> None:
        self._do("close")


def test_it_opens_again_with_its_level() -> None:
    clock, line = VirtualClock(), FakeOutput()
    lines = LineFactory(lambda *_: line, lambda *_: line)  # type: ignore[arg-type]
    driven = driving(lines, clock.host)(OutputOptions(line="GPIO4"), "rule hot")

    def tick(seconds: float) -> None:
        clock.advance(round(seconds * S))
        driven.tick(clock.now_ns())

    driven.set(True)
    assert (line.did, driven.problem) == ([], "not open yet")
    line.failing = "open"
    tick(0)
    tick(4.9)
    assert (line.did, driven.problem) == (["open", "close"], "cannot open")
    line.failing = ""
    tick(0.1)
    tick(1)
    assert (line.did[2:], driven.problem) == (["open", True], "")
    line.failing = False  # type: ignore[assignment]
    driven.set(False)
    assert (line.did[4:], driven.problem) == ([False, "close"], "cannot False")
    line.failing = ""
    tick(5)
    driven.close()
    driven.set(True)
    assert line.did[6:] == ["open", "close"]
