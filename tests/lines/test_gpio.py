"""Inputs and outputs on a fake chip: the requests to the kernel, and the results of its replies."""

import asyncio
import errno
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from unittest.mock import Mock

import pytest
from gpiod.line import Bias, Clock, Direction, Drive, Value
from gpiod.line import Edge as Detection

from imud.contracts.lines import Edge, InputOptions, LineOptions, OutputOptions, ResetOptions
from imud.lines import gpio
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
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
    line = gpio.GpioInput(
        InputOptions(line="SOUT", active_low=True, bias="pull-down"), "bow sout " + "x" * 40, devices=tmp_path
    )
    assert line.fileno() == -1
    line.open()
    assert (line.title, line.fileno()) == ("gpiochip0 line 0 (SOUT)", gpiod.requests[0].fd)
    ((chip, offset, consumer, events),) = gpiod.asked
    assert (chip, offset, events) == ("gpiochip0", 0, 1024)
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
    line, sink = gpio.GpioInput(SOUT, devices=tmp_path), Sink()
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
    line, sink = gpio.GpioInput(SOUT, devices=tmp_path), Sink()
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
    line, sink = gpio.GpioInput(SOUT, devices=tmp_path), Sink()
    line.open()
    line.start(sink.on_edges, sink.on_end)
    count = 1024 + 64
    gpiod.requests[0].feed(*((n, 1, n) for n in range(1, count + 1)))
    line.drain()
    assert (len(sink.edges), sink.calls) == (1024, 1024 // 64)
    async with asyncio.timeout(LIMIT_S):
        while len(sink.edges) < count:
            await asyncio.sleep(0)
    line.close()


@in_loop
async def test_a_line_closed_by_the_handler_of_its_edges(gpiod: FakeGpiod, tmp_path: Path) -> None:
    line, sink = gpio.GpioInput(SOUT, devices=tmp_path), Sink()
    line.open()

    def on_edges(edges: Sequence[Edge]) -> None:
        sink.on_edges(edges)
        line.close()

    line.start(on_edges, sink.on_end)
    gpiod.requests[0].feed(*((n, 1, n) for n in range(1, 64 * 3)))
    await sink.wait()
    assert (len(sink.edges), sink.end) == (64, None)


@in_loop
async def test_a_vanished_chip_ends_the_line(gpiod: FakeGpiod, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line, sink = gpio.GpioInput(SOUT, devices=tmp_path), Sink()
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
    line = gpio.GpioInput(SOUT, devices=tmp_path)
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
    for line in (gpio.GpioInput(SOUT, devices=tmp_path), gpio.GpioOutput(OutputOptions(line="SOUT"), devices=tmp_path)):
        with pytest.raises(LinkBusy, match="in use by spi0 CS0"):
            line.open()
        line.close()


def test_an_output_is_inactive_from_its_first_moment_to_its_last(gpiod: FakeGpiod, tmp_path: Path) -> None:
    done: list[tuple[int, bool, bool]] = []
    line = gpio.GpioOutput(
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


def test_an_output_whose_chip_vanishes_or_that_is_no_line(
    gpiod: FakeGpiod, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(_fd: int, _active: bool) -> None:
        raise OSError(errno.ENODEV, "by the test")

    line = gpio.GpioOutput(OutputOptions(line="RESET"), devices=tmp_path, drive=gone)
    line.open()
    with pytest.raises(LinkMissing, match="gpiochip10 line 0"):
        line.set(True)
    line.close()
    assert gpiod.requests[0].released
    assert gpiod.requests[0].settings.drive is Drive.PUSH_PULL
    # The kernel's own reply to the ioctl on a pipe
    assert isinstance(gpio.GPIO_LINES.make_output(OutputOptions(line="RESET"), "x"), gpio.GpioOutput)
    line = gpio.GpioOutput(OutputOptions(line="RESET"), devices=tmp_path)
    line.open()
    with pytest.raises(LinkError, match="cannot be used: Inappropriate ioctl"):
        line.set(True)
    line.close()
    calls: list[tuple[int, int, list[int]]] = []
    monkeypatch.setattr(gpio, "ioctl", lambda *call: calls.append((*call[:2], [*call[2]])) or 0)  # type: ignore[func-returns-value]
    for active in (True, False):
        gpio.set_line(9, active)
    # _IOWR(0xB4, 0x0F, two u64): direction 3, size 16
    request = 3 << 30 | 16 << 16 | 0xB4 << 8 | 0x0F
    assert calls == [(9, request, [1, 1]), (9, request, [0, 1])]


def event(t_ns: int, kind: int, seqno: int) -> bytes:
    """Return a `struct gpio_v2_line_event` of line 5, in a request with another count."""
    words = (kind, 5, 77, seqno)
    return t_ns.to_bytes(8, "little") + b"".join(word.to_bytes(4, "little") for word in words) + bytes(24)


def test_jumps_of_the_count_are_losses_and_numbers_go_on_when_it_wraps_and_after_a_restart() -> None:
    events = gpio.LineEventDecoder()
    data = event(0x0102030405060708, 1, 1) + event(2**63 - 1, 2, 2)
    assert events.decode(data) == [Edge(0x0102030405060708, True, 1), Edge(2**63 - 1, False, 2)]
    assert events.decode(b"") == []
    assert events.lost == 0
    events = gpio.LineEventDecoder()
    assert [edge.number for edge in events.decode(event(1, 1, 2) + event(2, 2, 10) + event(3, 1, 11))] == [2, 10, 11]
    assert events.lost == 1 + 7
    events = gpio.LineEventDecoder()
    events.decode(event(1, 1, 2**32 - 1))
    assert [edge.number for edge in events.decode(event(2, 2, 0) + event(3, 1, 1))] == [2**32, 2**32 + 1]
    assert events.lost == 2**32 - 2
    events = gpio.LineEventDecoder()
    events.decode(event(1, 1, 1) + event(2, 2, 2))
    events.restart()
    assert [edge.number for edge in events.decode(event(3, 1, 1))] == [3]
    assert (events.lost, gpio.EVENT.size) == (0, 48)


# ruff: noqa: E501 - a row of the table is a case and the whole message for it


@pytest.mark.parametrize("chip", ["gpiochip0", "pinctrl-bcm2711"])
@pytest.mark.parametrize(("line", "offset", "name"), [(0, 0, "SOUT"), (1, 1, ""), ("SOUT", 0, "SOUT")])
def test_by_chip(gpiod: FakeGpiod, tmp_path: Path, chip: str, line: int | str, offset: int, name: str) -> None:
    place = gpio.find_line(gpiod, LineOptions(line=line, chip=chip), tmp_path)
    assert place == gpio.LineLocation(str(tmp_path / "gpiochip0"), offset, name)


def test_by_path_or_by_name_alone_whatever_other_names_a_chip_has(gpiod: FakeGpiod, tmp_path: Path) -> None:
    place = gpio.find_line(gpiod, LineOptions(line="TWIN", chip=str(tmp_path / "gpiochip10")))
    assert str(place) == "gpiochip10 line 1 (TWIN)"
    assert str(gpio.find_line(gpiod, LineOptions(line="RESET"), tmp_path)) == "gpiochip10 line 0 (RESET)"
    (tmp_path / "gpiochip4").symlink_to(tmp_path / "gpiochip0")
    assert gpio.find_line(gpiod, LineOptions(line="SOUT"), tmp_path).path == str(tmp_path / "gpiochip0")


@pytest.mark.parametrize(
    ("line", "chip", "kind", "message"),
    [
        ("TWIN", "", LinkError, "expected the name TWIN on one line, got it on gpiochip0 line 2 (TWIN) and gpiochip10 line 1 (TWIN)"),
        ("SOUP", "", LinkMissing, "no line has the name SOUP on gpiochip0 (pinctrl-bcm2711), gpiochip10 (expander); did you mean SOUT?"),
        ("SOUT", "expander", LinkMissing, "no line has the name SOUT on gpiochip10 (expander)"),
        (3, "gpiochip0", LinkMissing, "gpiochip0 (pinctrl-bcm2711) has no line 3: its lines are 0 to 2"),
        (0, "gpiochip7", LinkMissing, "GPIO chip gpiochip7 does not exist; existing chips: gpiochip0 (pinctrl-bcm2711), gpiochip10 (expander)"),
    ],
)  # fmt: skip
def test_errors_of_missing_lines(
    gpiod: FakeGpiod, tmp_path: Path, line: int | str, chip: str, kind: type[LinkError], message: str
) -> None:
    with pytest.raises(LinkError) as caught:
        gpio.find_line(gpiod, LineOptions(line=line, chip=chip), tmp_path)
    assert type(caught.value) is kind
    assert message in str(caught.value)


def test_no_chip_at_all_or_two_of_a_label(tmp_path: Path, gpiod: FakeGpiod) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(LinkMissing, match="on any chip: no chip exists"):
        gpio.find_line(gpiod, LineOptions(line="SOUT"), empty)
    with pytest.raises(LinkMissing, match="existing chips: none"):
        gpio.find_line(gpiod, LineOptions(line=0, chip="gpiochip0"), empty)
    gpiod.chips["gpiochip10"] = gpiod.chips["gpiochip0"]
    with pytest.raises(LinkError, match=r"on one GPIO chip, got it on gpiochip0 \(.*\) and gpiochip10 \("):
        gpio.find_line(gpiod, LineOptions(line=0, chip="pinctrl-bcm2711"), tmp_path)


def test_a_denied_or_missing_chip_matters_only_if_no_other_chip_has_the_line(gpiod: FakeGpiod, tmp_path: Path) -> None:
    gpiod.errors["gpiochip0"] = errno.EACCES
    assert gpio.find_line(gpiod, LineOptions(line="RESET"), tmp_path).offset == 0
    for settings in (LineOptions(line="SOUT"), LineOptions(line=0, chip="gpiochip0"), LineOptions(line=0, chip="x")):
        with pytest.raises(
            LinkDenied, match=r"cannot open .*gpiochip0: user .* lacks the permission; the node must belong to group"
        ):
            gpio.find_line(gpiod, settings, tmp_path)
    gpiod.errors["gpiochip0"] = errno.ENODEV
    assert gpio.find_line(gpiod, LineOptions(line="RESET"), tmp_path).offset == 0
    with pytest.raises(LinkMissing, match="gpiochip0 is missing, or is not a GPIO chip: No such device"):
        gpio.find_line(gpiod, LineOptions(line=0, chip="gpiochip0"), tmp_path)
    (tmp_path / "ttyS0").touch()
    with pytest.raises(LinkError, match=r"cannot use .*ttyS0 as a GPIO chip"):
        gpio.find_line(gpiod, LineOptions(line=0, chip="ttyS0"), tmp_path)


@pytest.mark.parametrize(
    ("number", "kind", "message"),
    [
        (errno.EBUSY, LinkBusy, "gpiochip0 line 0 (SOUT) is in use by gpiomon: stop it"),
        (errno.EACCES, LinkDenied, "cannot open"),
        (errno.EPERM, LinkDenied, "add a line `DeviceAllow="),
        (errno.ENODEV, LinkMissing, "is missing"),
        (errno.ENXIO, LinkError, "gpiochip0 line 0 (SOUT) cannot be requested: No such device or address; an input"),
    ],
)
def test_a_line_request_that_the_kernel_refuses(
    gpiod: FakeGpiod, tmp_path: Path, number: int, kind: type[LinkError], message: str
) -> None:
    gpiod.holder = "gpiomon"
    error = gpio.request_error(
        gpiod, OSError(number, "by the test"), gpio.LineLocation(str(tmp_path / "gpiochip0"), 0, "SOUT")
    )
    assert type(error) is kind
    assert message in str(error)


def test_a_holder_without_a_name(gpiod: FakeGpiod, tmp_path: Path) -> None:
    place = gpio.LineLocation(str(tmp_path / "gpiochip0"), 0, "SOUT")
    assert "in use by an unknown program" in str(gpio.request_error(gpiod, OSError(errno.EBUSY, ""), place))
    gpiod.errors["gpiochip0"] = errno.ENODEV
    assert isinstance(gpio.request_error(gpiod, OSError(errno.EBUSY, ""), place), LinkBusy)


def test_gpiod_of_the_environment_is_missing_or_that_of_libgpiod_1(monkeypatch: pytest.MonkeyPatch) -> None:
    assert hasattr(gpio.load_gpiod(), "request_lines")
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(LinkError, match=r"need the Python package gpiod, got none; run `.* install 'gpiod>=2\.3'`"):
        gpio.load_gpiod()
    old = ModuleType("gpiod")
    old.__file__ = "/usr/lib/python3/dist-packages/gpiod.so"
    monkeypatch.setitem(sys.modules, "gpiod", old)
    with pytest.raises(LinkError, match=r"2\.3 or later, got the module of libgpiod 1 \(/usr/lib.*Debian 12"):
        gpio.load_gpiod()


@pytest.mark.parametrize("error", [RuntimeError("x"), SystemExit(0), asyncio.CancelledError()])
@pytest.mark.parametrize("place", ["Chip", "request_lines", "get_value", "release"])
def test_gpiod_errors(
    gpiod: FakeGpiod, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str, error: BaseException
) -> None:
    """An exception of any class of gpiod becomes a LinkError, and close always succeeds."""
    line = gpio.GpioInput(SOUT, devices=tmp_path)
    if place in ("Chip", "request_lines"):
        monkeypatch.setattr(gpiod, place, Mock(side_effect=error))
        with pytest.raises(LinkError, match="cannot"):
            line.open()
    else:
        line.open()
        fake = gpiod.requests[0]
        release = fake.release
        monkeypatch.setattr(fake, place, Mock(side_effect=error))
    if place == "get_value":
        with pytest.raises(LinkError, match="cannot read"):
            line.level()
    line.close()
    line.close()
    if place == "release":
        release()
