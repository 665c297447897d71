"""`imud clock` on a running daemon."""

from collections import deque
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread

import msgspec
import pytest

from imud.cli import main
from imud.cli.clock import aids, block
from imud.contracts.status import ClockStatus
from tests.support.daemon_process import RunningDaemon, running_daemon
from tests.support.files import hi91
from tests.support.metrics import LINES, device, equipped
from tests.support.pty_port import PtyPort


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[RunningDaemon]:
    """A daemon with one device that sends 100 frames a second, or nearly."""
    port = PtyPort()
    ended = Event()

    def send() -> None:
        ms = 0
        while not ended.wait(0.01):
            ms += 10
            port.send(hi91(ms))

    sender = Thread(target=send)
    uart = {"port": port.path, "baud": 115200}
    device = {"driver": "hipnuc-uart", "identify": False, "uart": uart}
    with running_daemon(tmp_path, {"bow": device}) as daemon:
        sender.start()
        try:
            daemon.wait_for("bow", "running")
            yield daemon
        finally:
            ended.set()
            sender.join()
            port.unplug()


def test_a_page_for_people(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["clock", "--socket", str(daemon.socket), "--duration", "0.3"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("bow: time stamps by ")
    for word in ("offset", "skew", "residual", "verdict", "###"):
        assert word in out


def test_json_has_the_clocks(daemon: RunningDaemon, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["clock", "--socket", str(daemon.socket), "--json"]) == 0
    clocks = msgspec.json.decode(capsys.readouterr().out, type=dict[str, ClockStatus])
    assert clocks["bow"].t_err_ns > 0


def test_silence_ends_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    device = {"driver": "hipnuc-uart", "uart": {"port": str(tmp_path / "none"), "baud": 115200}}
    with running_daemon(tmp_path, {"bow": device}) as daemon:
        assert main(["clock", "--socket", str(daemon.socket), "--duration", "0.1"]) == 1
    assert "0 samples" in capsys.readouterr().out


def test_what_tells_the_time_besides_arrivals_has_rows() -> None:
    assert list(aids(device("plain"))) == []
    assert list(aids(equipped("bow"))) == [
        ("SOUT", "4998 pulses, 9 belong to no sample; 17 samples without theirs"),
        ("SIN", "400 triggers, 21 not answered by a sample"),
        ("PPS", "59 pulses, 1 in step with none"),
        ("UTC", "the host knows it to 250.0 µs (one sigma)"),
    ]
    page = block(equipped("bow"), deque([9_000_000] * 100))
    assert "\n  SOUT      4998 pulses" in page
    assert "  verdict   limited by the kernel's stamps" in page


def test_a_device_that_is_triggered_and_has_no_sout_shows_triggers_only() -> None:
    lines = msgspec.structs.replace(LINES, edges={})
    assert [name for name, _ in aids(equipped("bow", lines=lines, utc=None))] == ["SIN", "UTC"]
