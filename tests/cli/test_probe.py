"""`imud probe` of serial ports in virtual time: detection, and requests only with permission."""

import asyncio
import json
from collections.abc import Callable

import pytest

from imud.cli import probe
from imud.cli.probe import ProbeReport
from imud.contracts.link import LinkType
from imud.links.memory import MemoryOptions
from imud.model.errors import LinkError
from imud.model.options import Options
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings
from tests.cli.conftest import Cli
from tests.support.event_loops import VirtualClock, VirtualLoop
from tests.support.simulated_modules import HIPNUC_STILL
from tests.support.wired_device import LinkedModule

PORT = "/dev/ttyUSB0"


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


def test_a_port_is_listened_to_and_only_asked_with_active(ports: Ports, cli: Cli) -> None:
    port = ports(Port())
    assert printed(cli) == ProbeReport(PORT, "FT232R", "hipnuc-uart", "", 460_800)
    assert (port.written, port.opened, port.is_open) == ([], 1, False)
    asked = printed(cli, "--active", PORT)
    assert asked.identity["product"].startswith("HI14R3")
    assert asked.identity["serial_number"]
    assert port.written
    head, row = cli("probe", "--active", PORT, PORT).out.splitlines()
    assert head.split() == ["PORT", "DRIVER", "RATE", "PRODUCT", "SERIAL", "NUMBER"]
    assert row.split()[:4] == [PORT, "hipnuc-uart", "460800", asked.identity["product"]]
    assert row.endswith("FT232R")
    assert port.opened == 3, "a port that is named twice is opened once"


def test_a_device_that_does_not_answer_has_no_identity(ports: Ports, cli: Cli) -> None:
    port = ports(Port())
    port.is_deaf = True
    assert printed(cli, "--active", PORT) == ProbeReport(PORT, "FT232R", "hipnuc-uart", "", 460_800)
    assert port.written
    assert not port.is_open


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
    gone = ports(Port())
    gone.is_open = True
    assert printed(cli, status=1) == ProbeReport(PORT, "FT232R", problem=f"{PORT} is already open")


def test_a_host_without_ports_says_so(ports: Ports, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    ports(Port())
    monkeypatch.setattr(probe, "list_ports", list)
    assert cli("probe", status=1).out.startswith("found no serial port and no CAN interface: is the adapter plugged in")
    assert cli("probe", "--json", status=1).out == ""
