"""`imud probe` of serial ports in virtual time: detection, and requests only with permission."""

import asyncio
import json
from collections.abc import Callable, Sequence
from typing import ClassVar
from unittest.mock import Mock

import pytest

from imud.cli import probe
from imud.cli.probe import ProbeReport, block
from imud.contracts.driver import Driver, StreamDriver
from imud.contracts.link import LinkType, OnBusNews, OnEnd, OnFrames
from imud.device import can_search as detection
from imud.device.stream_search import StreamFound
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.uart.codec import encode_frame
from imud.formats.can import CanFrame
from imud.host.netlink import CanDetails
from imud.links.memory import MemoryCanLink, MemoryOptions
from imud.links.socketcan import ControllerState, SocketCanOptions
from imud.model.errors import LinkError
from imud.model.options import Options
from imud.model.units import NS_PER_MS
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings
from tests.cli.conftest import Cli
from tests.support.event_loops import VirtualClock, VirtualLoop
from tests.support.fake_drivers import fake_can_driver, fake_can_frame
from tests.support.simulated_modules import HIPNUC_STILL
from tests.support.wired_device import LinkedModule

PORT = "/dev/ttyUSB0"
HI91, UNKNOWN = (encode_frame(bytes([tag]) + bytes(75)) for tag in (0x91, 0x77))


class PortSettings(Options, frozen=True, kw_only=True):
    port: str
    baud: str


class Port(LinkedModule[HipnucModule]):
    def __init__(self, baud: int = 460_800, hardware: HipnucHardware = HIPNUC_STILL) -> None:
        clock = VirtualClock()
        module = HipnucModule(clock.now_ns(), ModuleSettings(baud=baud), hardware)
        super().__init__(MemoryOptions(name=PORT, baud="auto"), module, clock)
        self.opened = 0
        self.is_deaf = False
        self._carrying: asyncio.Task[None] | None = None

    def make(self, settings: PortSettings) -> "Port":
        assert (settings.port, settings.baud) == (PORT, "auto")
        return self

    def open(self) -> None:
        super().open()
        self.opened += 1
        self._carrying = asyncio.get_running_loop().create_task(self.carry())

    def close(self) -> None:
        super().close()
        if self._carrying is not None:
            self._carrying.cancel()

    def write(self, data: bytes) -> None:
        if self.is_deaf:
            self.written.append(data)
        else:
            super().write(data)


Ports = Callable[[Port], Port]


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> Ports:
    def use(port: Port) -> Port:
        def run(body: object) -> object:
            with asyncio.Runner(loop_factory=lambda: VirtualLoop(port.clock)) as runner:
                return runner.run(body)  # type: ignore[arg-type]

        monkeypatch.setattr(probe, "LINKS", {"uart": LinkType("uart", PortSettings, make=port.make)})
        monkeypatch.setattr(probe, "HostClock", lambda: port.clock.host)
        monkeypatch.setattr("imud.cli.probe.asyncio.run", run)
        monkeypatch.setattr(probe, "list_ports", lambda: [type("Listed", (), {"path": PORT, "title": "FT232R"})])
        monkeypatch.setattr(probe, "can_interfaces", lambda **_: [])
        return port

    return use


def printed(cli: Cli, *words: str, status: int = 0) -> ProbeReport:
    (report,) = [json.loads(line) for line in cli("probe", "--json", *words, status=status).out.splitlines()]
    return ProbeReport(**report)


def test_boot_loader_is_named_after_a_ping_at_its_baud_rate(ports: Ports, cli: Cli) -> None:
    port = ports(Port())
    port.module.memory.erase()
    port.module.reboot(port.clock.now_ns())
    found = printed(cli, "--active", PORT)
    assert (found.driver, found.baud) == ("hipnuc-uart", 460_800)
    assert found.problem == "the device is in its boot loader: it has no complete firmware; run `imud firmware`"
    port.is_deaf = True
    assert "got no byte at" in printed(cli, "--active", PORT, status=1).problem


def test_a_port_is_listened_to_and_only_asked_with_active(ports: Ports, cli: Cli) -> None:
    port = ports(Port())
    assert printed(cli) == ProbeReport(PORT, "FT232R", "hipnuc-uart", "", 460_800)
    assert (port.written, port.opened, port.is_open) == ([], 1, False)
    asked = printed(cli, "--active", PORT)
    assert asked.identity["product"].startswith("HI14R3")
    assert asked.identity["serial_number"]
    assert port.written
    lines = cli("probe", "--active", PORT, PORT).out.splitlines()
    assert lines[:2] == [PORT, "  hipnuc-uart at 460800 baud"]
    assert lines[2].startswith(f"  product {asked.identity['product']}, serial number ")
    assert lines[-1] == "  FT232R"
    assert max(map(len, lines)) <= 80
    assert port.opened == 3, "a port that is named twice is opened once"
    driver = DRIVERS["hipnuc-uart"]
    assert isinstance(driver, StreamDriver)
    for frames, words in (
        (HI91 + UNKNOWN, "also valid frames of unknown types (tag 0x77: 2)"), (UNKNOWN, "(tag 0x77: 2)"), (HI91, ""),
    ):  # fmt: skip
        named = probe.unknown_of(StreamFound(driver, 115200, ((frames, 0), (frames, 0))))
        assert (words in named, bool(named)) == (True, bool(words))
    deaf = ports(Port())
    deaf.is_deaf = True
    found = printed(cli, "--active", PORT)
    assert found == ProbeReport(PORT, "FT232R", "hipnuc-uart", "", 460_800), "without a reply: no identity"
    assert (deaf.written != [], deaf.is_open) == (True, False)


def test_a_silent_port_a_port_that_ends_and_one_that_cannot_be_opened(ports: Ports, cli: Cli) -> None:
    silent = ports(Port())
    silent.module_is_on = False
    report = printed(cli, status=1)
    assert (report.driver, report.title, silent.written) == ("", "FT232R", [])
    assert "got no byte at 115200, " in report.problem
    assert printed(cli, "--active", PORT, status=1).driver == ""
    assert silent.written, "a silent module may be asked for samples"
    for error, problem in ((LinkError("it was pulled out"), "it was pulled out"), (None, f"{PORT} ended")):

        class Ending(Port):
            def open(self, error: LinkError | None = error) -> None:
                super().open()
                asyncio.get_running_loop().call_later(0.01, self.end, error)

        ending = ports(Ending())
        ending.module_is_on = False
        assert printed(cli, status=1).problem == problem
        assert not ending.is_open
    ports(Port()).is_open = True
    assert printed(cli, status=1) == ProbeReport(PORT, "FT232R", problem=f"{PORT} is already open")


def test_a_host_without_ports_says_so(ports: Ports, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    ports(Port())
    monkeypatch.setattr(probe, "list_ports", list)
    assert cli("probe", status=1).out.startswith("found no serial port and no CAN interface: is the adapter plugged in")
    assert cli("probe", "--json", status=1).out == ""


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
    monkeypatch.setattr(probe, "DRIVERS", table)
    monkeypatch.setattr(probe, "LINKS", {"socketcan": LinkType("socketcan", SocketCanOptions, make_can=Own)})
    monkeypatch.setattr(probe, "can_details", lambda name: CanDetails(500_000, 0))
    monkeypatch.setattr(detection, "LISTEN_NS", 5 * NS_PER_MS)
    return Own


def examined(*, ask: bool = False) -> list[ProbeReport]:
    return asyncio.run(probe.examine_all(["can0"], {"can0"} if ask else set(), {}))


def test_every_device_of_the_bus_is_listed_and_queried_where_it_is_allowed(bus: type[Bus]) -> None:
    bus.frames = [fake_can_frame(node, number) for number in (1, 2) for node in (8, 9)]
    reports = examined()
    assert [(r.port, r.driver, r.device, r.baud, r.title, r.identity) for r in reports] == [
        ("can0", "fake-can", "node 8", 500_000, "error-active", {}),
        ("can0", "fake-can", "node 9", 500_000, "error-active", {}),
    ]
    assert (block(reports[0]), bus.made[0].written) == ("can0\n  fake-can node 8 at 500000 bit/s\n  error-active", [])
    assert not bus.made[0].is_open
    bus.frames = [fake_can_frame(8, number) for number in (1, 2)]
    assert [report.identity for report in examined(ask=True)] == [{"product": "FAKE"}]


def test_why_nobody_is_listed(bus: type[Bus], monkeypatch: pytest.MonkeyPatch) -> None:
    assert "no frame arrives on can0" in examined()[0].problem
    bus.frames = [CanFrame(0x123, False, b"", 0)]
    assert "frames of unknown types arrive on can0 (0x123)" in examined()[0].problem
    bus.problem = "can0 is bus-off: x"
    assert examined()[0].problem == "can0 is bus-off: x"
    bus.down = True
    assert examined() == [ProbeReport("can0", problem="can0 is down: set its bit rate")]
    bus.down = False
    ended = LinkError("can0 was taken down")
    monkeypatch.setattr(bus, "start", lambda _self, _on_frames, _on_news, on_end: on_end(ended))
    assert examined()[0].problem == "can0 was taken down"


def test_the_state_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    for details, words in [
        (CanDetails(None, None), "bus without a bit rate"), (CanDetails(500_000, 3), "bus-off"),
        (CanDetails(500_000, 2), "error-passive"), (CanDetails(1, 9), ""), (CanDetails(1, len(ControllerState)), ""),
    ]:  # fmt: skip
        monkeypatch.setattr(probe, "can_details", Mock(return_value=details))
        assert probe.state_of("can0") == words
