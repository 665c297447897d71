"""The requirements for stream drivers find a driver with a defect."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from random import Random
from typing import Any

import pytest

from imud.contracts.codec import BadFrame, CodecEvent
from imud.contracts.driver import StreamDriver
from imud.drivers import DRIVERS
from imud.drivers.imu61x.uart.codec import Imu61xCodec
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim import SIMULATORS
from imud.testing import REQUIREMENTS, rows

GOOD: Any = DRIVERS["imu61x-uart"]


class Codec(Imu61xCodec):
    """A codec with one defect."""

    def __init__(self, defect: str, ledger: Ledger, options: Any) -> None:
        super().__init__(ledger, options)
        self._defect = defect

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        events = list(super().feed(data))
        match self._defect:
            case "raises":
                assert not any(isinstance(event, BadFrame) for event in events)
            case "hides damage":
                return [event for event in events if not isinstance(event, BadFrame)]
            case "needs whole reads":
                super().reset()
            case "counts twice":
                self.ledger.bytes_skipped += len(data) > 50
            case "loses the second":
                samples = [event for event in events if isinstance(event, Measurement)]
                return [event for event in events if event not in samples[1:]]
        return events

    def reset(self) -> None:
        if self._defect != "never resets":
            super().reset()


CODEC_DEFECTS = (
    "raises", "hides damage", "needs whole reads", "counts twice", "loses the second", "never resets",
)  # fmt: skip
ROW_DEFECTS: dict[str, dict[str, Any]] = {
    "no title": {"title": ""}, "no frame": {"navigation_frame": ""}, "constant": {"example_frame": lambda _: b"ab"},
}  # fmt: skip


def failed(driver: StreamDriver) -> list[str]:
    """Return the names of the requirements that a driver does not fulfil, for ten random inputs."""
    names = []
    for kind, requirements in REQUIREMENTS:
        for one in requirements if isinstance(driver, kind) else ():
            try:
                for seed in range(10):
                    one(driver, Random(seed), Random(seed).randbytes(60 * seed))
            except (AssertionError, ValueError):
                names.append(one.__name__)
    return names


def test_each_defect_is_found() -> None:
    assert failed(GOOD) == []
    for defect in CODEC_DEFECTS:
        assert failed(replace(GOOD, make_codec=lambda *given, defect=defect: Codec(defect, *given))), defect
    for name, fields in ROW_DEFECTS.items():
        assert failed(replace(GOOD, **fields)), name


def test_a_simulator_with_a_defect_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    row = SIMULATORS["imu61x-uart"]
    make: Callable[..., Any] = row.make
    defects: dict[str, Callable[[Any], None]] = {
        "next_ns": lambda module: monkeypatch.setattr(module, "next_ns", lambda: 1),
        "boot": lambda module: monkeypatch.setattr(module, "advance", lambda _now_ns: []),
    }

    def found(spoil: Callable[[Any], None]) -> int:
        def spoilt(*given: Any) -> Any:
            module = make(*given)
            spoil(module)
            return module

        count = 0
        for one in rows.SIMULATOR_REQUIREMENTS:
            with suppress(AssertionError, IndexError):
                one(replace(row, make=spoilt))
                count += 1
        return len(rows.SIMULATOR_REQUIREMENTS) - count

    assert found(lambda _module: None) == 0
    assert all(found(spoil) for spoil in defects.values())
