"""`imud probe` of CAN interfaces: detected devices, silence, and requests only with permission."""

import asyncio
from collections.abc import Sequence
from typing import ClassVar

import pytest

from imud.cli import probe
from imud.cli import probe as probe_can
from imud.cli.probe import ProbeReport, row
from imud.contracts.driver import Driver
from imud.contracts.link import LinkType, OnBusNews, OnEnd, OnFrames
from imud.device import can_search as detection
from imud.drivers import DRIVERS
from imud.formats.can import CanFrame
from imud.links.memory import MemoryCanLink, MemoryOptions
from imud.links.netlink import CanDetails
from imud.links.socketcan import ControllerState, SocketCanOptions
from imud.model.errors import LinkError
from imud.model.units import NS_PER_MS
from tests.support.fake_drivers import fake_can_driver, fake_can_frame


class Bus(MemoryCanLink):
    frames: Sequence[CanFrame] = ()
    problem = ""
    down = False
    made: ClassVar[list["Bus"]]

    def __init__(self, settings: SocketCanOptions) -> None:
        super().__init__(MemoryOptions(name=settings.interface, baud=500_000))
        self.made.append(self)

    def absence(self) -> str:
        return "can0 is down: set its bit rate" if self.down else ""

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        super().start(on_frames, on_news, on_end)
        if self.problem:
            on_news(self.problem, self.problem)
        self.feed(self.frames)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> type[Bus]:
    class Own(Bus):
        made: ClassVar[list[Bus]] = []

    table: dict[str, Driver] = {**dict(DRIVERS), "fake-can": fake_can_driver()}
    monkeypatch.setattr(probe_can, "DRIVERS", table)
    monkeypatch.setattr(probe_can, "LINKS", {"socketcan": LinkType("socketcan", SocketCanOptions, make_can=Own)})
    monkeypatch.setattr(probe_can, "can_details", lambda name: CanDetails(500_000, 0))
    monkeypatch.setattr(detection, "LISTEN_NS", 5 * NS_PER_MS)
    return Own


def examined(*, ask: bool = False) -> list[ProbeReport]:
    return asyncio.run(probe.examine_all(["can0"], {"can0"} if ask else set(), {}))


def test_every_device_of_the_bus_is_listed(bus: type[Bus]) -> None:
    bus.frames = [fake_can_frame(node, number) for number in (1, 2) for node in (8, 9)]
    reports = examined()
    assert [(r.port, r.driver, r.device, r.baud, r.title, r.identity) for r in reports] == [
        ("can0", "fake-can", "node 8", 500_000, "error-active", {}),
        ("can0", "fake-can", "node 9", 500_000, "error-active", {}),
    ]
    assert row(reports[0])[:3] == ("can0", "fake-can node 8", 500_000)
    assert bus.made[0].written == []
    assert not bus.made[0].is_open


def test_a_query_where_it_is_allowed(bus: type[Bus]) -> None:
    bus.frames = [fake_can_frame(8, number) for number in (1, 2)]
    assert [report.identity for report in examined(ask=True)] == [{"product": "FAKE"}]


def test_why_nobody_is_listed(bus: type[Bus]) -> None:
    assert "no frame arrives on can0" in examined()[0].problem
    bus.frames = [CanFrame(0x123, False, b"", 0)]
    assert "unknown frames arrive on can0 (0x123)" in examined()[0].problem
    bus.problem = "can0 is bus-off: x"
    assert examined()[0].problem == "can0 is bus-off: x"
    bus.down = True
    assert examined() == [ProbeReport("can0", problem="can0 is down: set its bit rate")]


def test_a_bus_that_ends_is_reported(bus: type[Bus], monkeypatch: pytest.MonkeyPatch) -> None:
    def start(self: Bus, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        on_end(LinkError("can0 was taken down"))

    monkeypatch.setattr(bus, "start", start)
    assert examined()[0].problem == "can0 was taken down"


@pytest.mark.parametrize(
    ("details", "words"),
    [
        ((None, None), "bus without a bit rate"), ((500_000, 3), "bus-off"), ((500_000, 2), "error-passive"),
        ((1, 9), ""), ((1, len(ControllerState)), ""),
    ],
)  # fmt: skip
def test_the_state_in_words(
    details: tuple[int | None, int | None], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(probe_can, "can_details", lambda name: CanDetails(*details))
    assert probe_can.state_of("can0") == words
