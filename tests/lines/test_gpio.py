"""Inputs and outputs on a fake chip: the requests to the kernel, and the results of its replies."""

import asyncio
import errno
import os
from collections.abc import Sequence
from pathlib import Path

import pytest
from gpiod.line import Bias, Clock, Direction, Drive, Value
from gpiod.line import Edge as Detection

from imud.contracts.lines import Edge, InputOptions, OutputOptions, ResetOptions
from imud.lines.gpio import EVENT, GPIO_LINES, KERNEL_EVENTS, READ_EVENTS, GpioInput, GpioOutput
from imud.model.errors import LinkBusy, LinkError, LinkMissing
from tests.support.event_loops import in_loop
from tests.support.signal_bench import FakeGpiod

SOUT = InputOptions(line="SOUT")
LIMIT_S = 60


class Sink:
    def __init__(self) -> None:
        self.edges: list[Edge] = []
        self.calls = 0
        self.end: LinkError | None = None
        self.news = asyncio.Event()

    def on_edges(self, edges: Sequence[Edge]) -> None:
        self.edges += edges
        self.calls += 1
        self.news.set()

    def on_end(self, error: LinkError) -> None:
        assert self.end is None
        self.end = error
        self.news.set()

    async def wait(self) -> None:
        await asyncio.wait_for(self.news.wait(), LIMIT_S)
        self.news.clear()


def test_an_input_asks_for_both_edges_and_a_large_buffer(gpiod: FakeGpiod, tmp_path: Path) -> None:
    line = GpioInput(
        InputOptions(line="SOUT", active_low=True, bias="pull-down"), "bow sout " + "x" * 40, devices=tmp_path
    )
    line.open()
    assert line.title == "gpiochip0 line 0 (SOUT)"
    ((chip, offset, consumer, events),) = gpiod.asked
    assert (chip, offset, events) == ("gpiochip0", 0, KERNEL_EVENTS)
    assert consumer == "imud bow sout " + "x" * 17
    asked = gpiod.requests[0].settings
    assert (asked.direction, asked.edge_detection, asked.event_clock) == (
        Direction.INPUT, Detection.BOTH, Clock.MONOTONIC
    )  # fmt: skip
    assert (asked.bias, asked.active_low, asked.debounce_period.total_seconds()) == (Bias.PULL_DOWN, True, 0)
    line.close()
    line.close()
    assert gpiod.requests[0].released


@in_loop
async def test_edges_come_by_the_loop_and_by_drain_and_lost_ones_are_counted(gpiod: FakeGpiod, tmp_path: Path) -> None:
    line, sink = GpioInput(SOUT, devices=tmp_path), Sink()
    line.open()
    (request,) = gpiod.requests
    request.feed((100, 1, 1))
    line.drain()  # no delivery before `start`
    line.start(sink.on_edges, sink.on_end)
    await sink.wait()
    assert sink.edges == [Edge(100, True, 1)]
    line.drain()
    assert sink.calls == 1
    request.feed((200, 2, 2), (300, 1, 3))
    line.drain()
    assert sink.edges[1:] == [Edge(200, False, 2), Edge(300, True, 3)]
    assert line.edges_lost == 0
    line.close()
    line, sink = GpioInput(SOUT, devices=tmp_path), Sink()
    for seqnos in ((3, 4), (1, 7)):
        line.open()
        line.start(sink.on_edges, sink.on_end)
        gpiod.requests[-1].feed(*((n, 1, n) for n in seqnos))
        line.drain()
        line.close()
    assert [edge.number for edge in sink.edges] == [3, 4, 5, 11]
    assert line.edges_lost == 2 + 5


@in_loop
async def test_many_edges_are_read_in_batches_but_not_for_ever(gpiod: FakeGpiod, tmp_path: Path) -> None:
    line, sink = GpioInput(SOUT, devices=tmp_path), Sink()
    line.open()
    line.start(sink.on_edges, sink.on_end)
    count = KERNEL_EVENTS + READ_EVENTS
    gpiod.requests[0].feed(*((n, 1, n) for n in range(1, count + 1)))
    line.drain()
    assert len(sink.edges) == KERNEL_EVENTS
    assert sink.calls == KERNEL_EVENTS // READ_EVENTS
    async with asyncio.timeout(LIMIT_S):
        while len(sink.edges) < count:
            await asyncio.sleep(0)
    line.close()


@in_loop
async def test_a_line_closed_by_the_handler_of_its_edges(gpiod: FakeGpiod, tmp_path: Path) -> None:
    line, sink = GpioInput(SOUT, devices=tmp_path), Sink()
    line.open()

    def on_edges(edges: Sequence[Edge]) -> None:
        sink.on_edges(edges)
        line.close()

    line.start(on_edges, sink.on_end)
    gpiod.requests[0].feed(*((n, 1, n) for n in range(1, READ_EVENTS * 3)))
    await sink.wait()
    assert (len(sink.edges), sink.end) == (READ_EVENTS, None)


@in_loop
async def test_a_chip_that_vanishes_ends_the_line(
    gpiod: FakeGpiod, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, sink = GpioInput(SOUT, devices=tmp_path), Sink()
    line.open()
    line.start(sink.on_edges, sink.on_end)

    def gone(_fd: int, _size: int) -> bytes:
        raise OSError(errno.ENODEV, "by the test")

    gpiod.requests[0].feed((100, 1, 1))
    with monkeypatch.context() as patch:
        patch.setattr(os, "read", gone)
        line.drain()
    assert isinstance(sink.end, LinkMissing)
    assert "gpiochip0 line 0 (SOUT) is missing (No such device)" in str(sink.end)
    assert gpiod.requests[0].released
    line.drain()
    line.close()
    assert sink.edges == []


def test_level(gpiod: FakeGpiod, tmp_path: Path) -> None:
    line = GpioInput(SOUT, devices=tmp_path)
    with pytest.raises(LinkError, match="not open"):
        line.level()
    line.open()
    assert line.level() is False
    gpiod.requests[0].value = True
    assert line.level() is True
    gpiod.requests[0].error = errno.ENODEV
    with pytest.raises(LinkMissing):
        line.level()
    gpiod.requests[0].error = errno.EIO
    with pytest.raises(LinkError, match="cannot be used: Input/output error"):
        line.level()
    line.close()


def test_a_busy_line(gpiod: FakeGpiod, tmp_path: Path) -> None:
    gpiod.refusal, gpiod.holder = errno.EBUSY, "spi0 CS0"
    for line in (GpioInput(SOUT, devices=tmp_path), GpioOutput(OutputOptions(line="SOUT"), devices=tmp_path)):
        with pytest.raises(LinkBusy, match="in use by spi0 CS0"):
            line.open()
        line.close()


def test_an_output_is_inactive_from_its_first_moment_to_its_last(gpiod: FakeGpiod, tmp_path: Path) -> None:
    done: list[tuple[int, bool, bool]] = []
    line = GpioOutput(
        ResetOptions(line="RESET", open_drain=True), "bow reset", devices=tmp_path,
        drive=lambda fd, active: done.append((fd, active, gpiod.requests[0].released)),
    )  # fmt: skip
    with pytest.raises(LinkError, match="not open"):
        line.set(True)
    line.open()
    (request,) = gpiod.requests
    asked = request.settings
    assert (asked.direction, asked.output_value, asked.active_low) == (Direction.OUTPUT, Value.INACTIVE, True)
    assert asked.drive is Drive.OPEN_DRAIN
    line.set(True)
    line.close()
    line.close()
    assert done == [(request.fd, True, False), (request.fd, False, False)]
    assert request.released


def test_an_output_whose_chip_vanishes_or_that_is_no_line(gpiod: FakeGpiod, tmp_path: Path) -> None:
    def gone(_fd: int, _active: bool) -> None:
        raise OSError(errno.ENODEV, "by the test")

    line = GpioOutput(OutputOptions(line="RESET"), devices=tmp_path, drive=gone)
    line.open()
    with pytest.raises(LinkMissing, match="gpiochip10 line 0"):
        line.set(True)
    line.close()
    assert gpiod.requests[0].released
    assert gpiod.requests[0].settings.drive is Drive.PUSH_PULL
    # The kernel's own reply to the ioctl on a pipe
    assert isinstance(GPIO_LINES.make_output(OutputOptions(line="RESET"), "x"), GpioOutput)
    line = GpioOutput(OutputOptions(line="RESET"), devices=tmp_path)
    line.open()
    with pytest.raises(LinkError, match="cannot be used: Inappropriate ioctl"):
        line.set(True)
    line.close()


def test_size_of_the_kernel_struct() -> None:
    assert EVENT.size == 48
