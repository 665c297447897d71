"""A path reports its input to the observer before it publishes the samples of this input.

An output may read the host clocks when it receives samples. A recording must contain this reading after the input:
otherwise a replay uses the new reading for samples that were stamped before it.
"""

from random import Random
from typing import Any

import pytest

from imud.attitude.published import published_frame
from imud.contracts.codec import Reading
from imud.contracts.driver import CanDriver, Driver, PolledDriver, StreamDriver
from imud.drivers import DRIVERS
from imud.host.clock import HostClock
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS
from imud.sampling.path import CanPath, PathContext, PolledPath, PollTiming, SamplePath, StreamPath, make_clock


class Order:
    """Order of the reports to the observer and of the batches."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments, **_: self.seen.append(str(arguments[1]) if name == "call" else name)


def path_of(driver: Driver, order: Order) -> SamplePath:
    ledger, options = Ledger(), driver.settings()
    clock = make_clock("bow", None, driver, None)
    context = PathContext(
        "bow", 0, ledger, lambda _batch: order.seen.append("publish"), lambda *_: None, lambda _bad: None, lambda: 0,
        HostClock(), published_frame(None, None, None, driver.axes),
    )  # fmt: skip
    if isinstance(driver, StreamDriver):
        return StreamPath(driver.make_codec(ledger, options), clock, context)
    if isinstance(driver, CanDriver):
        return CanPath(driver.make_codec(ledger, options), clock, context)
    assert isinstance(driver, PolledDriver)
    return PolledPath(driver.make_codec(ledger, options), PollTiming(NS_PER_MS, 0, None), clock, context)


@pytest.mark.parametrize("name", DRIVERS)
def test_a_read_is_reported_before_its_samples_are_published(name: str) -> None:
    driver, order, random = DRIVERS[name], Order(), Random(1)
    path = path_of(driver, order)
    path.observe(order)
    if isinstance(path, StreamPath):
        assert isinstance(driver, StreamDriver)
        path.on_data(driver.example_frame(random), NS_PER_MS)
        assert order.seen == ["data", "publish"]
        path.gather(driver.example_frame(random), 2 * NS_PER_MS)
        path.publish_gathered()
        assert order.seen[2:] == ["data", "publish_gathered", "publish"]
    elif isinstance(path, CanPath):
        assert isinstance(driver, CanDriver)
        frames = [
            frame._replace(t_rx_ns=(10 * number + place) * NS_PER_MS)
            for number in range(1, 30)
            for place, frame in enumerate(driver.example_frames(random))
        ]
        path.on_frames(frames)
        path.flush(1000 * NS_PER_MS)
        assert order.seen in (["frames", "publish", "flush"], ["frames", "flush", "publish"])
    else:
        assert isinstance(path, PolledPath)
        assert isinstance(driver, PolledDriver)
        path.on_readings([Reading(0, driver.example_reading(random), None, NS_PER_MS, 2 * NS_PER_MS)])
        assert order.seen == ["readings", "publish"]


def test_an_incomplete_frame_is_reported_before_the_frames_in_it_are_published() -> None:
    driver, order = DRIVERS["hipnuc-uart"], Order()
    assert isinstance(driver, StreamDriver)
    path = path_of(driver, order)
    path.observe(order)
    assert isinstance(path, StreamPath)
    path.on_data(b"\x5a\xa5\x00\x01" + driver.example_frame(Random(1)), NS_PER_MS)  # 256 bytes by its length
    path.flush(50 * NS_PER_MS)
    assert order.seen == ["data", "flush", "publish"]
