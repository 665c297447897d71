"""`imud demo` with real processes: summary at the end, and children that end too early."""

import io
import itertools
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock
from urllib.request import urlopen

import msgspec
import pytest

from imud.cli import demo as command
from imud.cli import main
from imud.cli.demo import View
from imud.client.connection import Client
from imud.model.errors import ImudError, LinkMissing
from imud.model.sample import Sample, Sync
from tests.cli.conftest import Cli, ImudProcess, imud_process
from tests.support.daemon_process import LIMIT_S, wait_until


@contextmanager
def demo(*words: str) -> Iterator[tuple[ImudProcess, Path]]:
    with imud_process("demo", "--plain", *words, start_new_session=True) as process:
        found = re.match(r"socket of the daemon: (\S+)/imud.sock", process.out.readline())
        assert found is not None
        try:
            yield process, Path(found[1])
        finally:
            if process.process.poll() is None:
                process.end(signal.SIGTERM)


@pytest.mark.live
@pytest.mark.parametrize(
    ("device", "product"), [("hipnuc-uart", "HI14R3"), ("imu61x-uart", "IMU61x"), ("hipnuc-modbus", "HI14R2N")]
)
def test_samples_flow_and_the_ledger_closes(device: str, product: str) -> None:
    with demo("--device", device, "--rate", "200") as (process, folder):
        with Client(folder / "imud.sock") as client:

            def watched_and_known() -> bool:
                state = client.status()
                watching = any(one["sent"] > 20 for one in state["socket"]["clients"])  # enough samples for a rate
                return watching and state["devices"][0]["identity"].get("product", "").startswith(product)

            wait_until(watched_and_known, f"{product} is known and watched", 3 * LIMIT_S)
        out = process.end(signal.SIGTERM).out
    assert "the ledger balances" in out
    assert re.search(r"client +\d+ samples at \d+\.\d+ Hz, 0 lost", out)
    assert product in out
    assert not folder.exists()


@pytest.mark.live
def test_the_commands_it_prints_reach_it_from_another_directory() -> None:
    with demo() as (process, _folder):
        export, status, watch, clock, ring, scrape = (line.strip() for line in itertools.islice(process.out, 6))
        assert clock.endswith("imud clock")
        printed = pasted(export, f"{watch} --count 3", status, f"{clock} --duration 0.1", ring)
        assert len(re.findall(r"^\d\d:\d\d:\d\d\.\d{3} ", printed, re.MULTILINE)) == 3
        for words in ("demo: ok", "running; ", "verdict", "accel_m_s2="):
            assert words in printed
        with urlopen(scrape.removeprefix("curl ")) as answer:
            assert b'imud_samples_total{device="demo"}' in answer.read()


@pytest.mark.live
def test_it_ends_after_its_duration(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--duration", "0.2", "--rate", "200", "--plain"]) == 0
    out = capfd.readouterr().out
    assert "the ledger balances" in out
    folder = re.search(r"socket of the daemon: (\S+)/imud.sock", out)
    assert folder is not None
    assert not Path(folder[1]).exists()


def pasted(*lines: str) -> str:
    script = "\n".join(["set -e", *lines])
    return subprocess.run(
        ["/bin/sh", "-c", script], cwd="/", env={}, capture_output=True, text=True, timeout=LIMIT_S, check=True
    ).stdout


@pytest.mark.live
def test_children_that_end_early(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "START_LIMIT_S", LIMIT_S)
    simulator = command.simulator(tmp_path / "no" / "folder", [("hipnuc-uart", 0)], 100.0, "")
    with pytest.raises(ImudError, match=r"^the simulator ended with status \d+ before it opened its port$"), simulator:
        pass
    daemon = command.daemon(tmp_path, {"bow": {"driver": "none"}}, 0)
    with pytest.raises(ImudError, match=r"^the daemon ended during its start with status 78$"), daemon:
        pass
    monkeypatch.setattr(command, "START_LIMIT_S", 0.0)
    daemon = command.daemon(tmp_path, {}, 0)
    with pytest.raises(LinkMissing, match="the daemon did not open its socket within 0 s"), daemon:
        pass
    monkeypatch.setattr(command, "STOP_LIMIT_S", 0.1)
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(99)"
    with command.child([sys.executable, "-c", deaf], "the child", stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
    assert process.returncode == -signal.SIGKILL
    assert capsys.readouterr().err.endswith("the child did not stop within 0 s; imud killed it\n")


def test_devices_that_cannot_be_shown(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    for words, said in [
        (["--device", "imu61x-i2c"], "cannot simulate imu61x-i2c; name the bus of a real device, for example --bus 1"),
        (["--device", "imu61x-spi", "--bus", "1"],
         "cannot simulate imu61x-spi; name the bus of a real device, for example --port /dev/spidev0.0"),
        (["--device", "imu61x-i2c", "--device", "imu61x-uart"],
         "expected imu61x-i2c as the only device, got 2 devices"),
        (["--device", "hipnuc-uart", "--device", "imu61x-can"],
         "several devices: expected CAN devices only; simulate one device of another kind at a time"),
        (["--device", "imu61x-can", "--device", "imu61x-can"],
         "expected different devices, for example --device imu61x-can:101 --device imu61x-can:201"),
    ]:  # fmt: skip
        assert cli("demo", *words, status=2).err == f"imud demo: {said}\n"
    monkeypatch.setattr("imud.sim.ports.can_port.can_interfaces", list)
    cli.refuses("ip link add vcan0 type vcan", "demo", "--device", "imu61x-can", "--duration", "1")
    shown = Mock(return_value=0)
    monkeypatch.setattr(command, "watch_daemon", shown)
    for words, link in (
        (["imu61x-i2c", "--bus", "1"], {"i2c": {"bus": 1, "rate_hz": 50.0}}),
        (["imu61x-spi", "--port", "/dev/spidev0.0"], {"spi": {"port": "/dev/spidev0.0", "rate_hz": 50.0}}),
    ):
        cli("demo", "--rate", "50", "--device", *words)
        assert shown.call_args.args[2] == {"demo": {"driver": words[0], **link}}
    for node, options in ((9, {"base_id": 9}), (0, {})):
        found = command.device(Path("/run"), "imu61x-can", "vcan0", node)
        assert found == {"driver": "imu61x-can", "options": options, "socketcan": {"interface": "vcan0"}}


def sample(seq: int) -> Sample:
    t_ns = seq * 10_000_000
    return Sample("demo", seq, t_ns, 50_000, Sync.REGRESSION, t_ns + 100, 0, euler_rad=(0.1, 0, 0))


def test_view_counts_what_is_missing_of_each_device() -> None:
    view = View(io.StringIO(), live=False)
    for seq in (1, 2, 5):
        view.add(sample(seq))
    assert (view.samples, view.missed) == (3, 2)
    assert "3 samples at 100.00 Hz, 2 lost" in view.account()
    assert "no sample arrived" in View(io.StringIO(), live=False).account()
    view = View(io.StringIO(), live=False)
    for name, seq in (("a", 1), ("b", 7), ("a", 2), ("b", 9)):
        view.add(msgspec.structs.replace(sample(seq), device=name))
    assert (view.samples, view.missed) == (4, 1)


def test_live_view_draws_in_place_ten_times_per_second(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    view = View(out, live=True)
    for number, now_ms in enumerate((1000, 1099, 1100, 1199, 1200), 1):
        monkeypatch.setattr("imud.cli.demo.monotonic_ns", lambda now_ms=now_ms: now_ms * 1_000_000)
        view.add(sample(number))
    assert [number for number in range(1, 6) if f"demo #{number}" in out.getvalue()] == [1, 3, 5]
    first = out.getvalue().partition("demo #3")[0]
    assert "5.730" in first  # 0.1 rad in degrees
    assert "\x1b[5A" not in first.partition("demo #1")[0]
