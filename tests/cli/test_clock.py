"""`imud clock` with a running daemon."""

import re
import signal
from collections import deque
from pathlib import Path

import msgspec
import pytest

from imud.cli.clock import aids, block, page, verdict
from imud.contracts.status import ClockStatus
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS
from imud.sampling.arrival_time import LinkDelay, error_parts
from tests.cli.conftest import Cli
from tests.support.daemon_process import running_daemon, sending_daemon, wait_until, write_config
from tests.support.files import hi91
from tests.support.metrics import LINES, device, equipped


@pytest.mark.live
def test_a_page_for_people_and_json(tmp_path: Path, cli: Cli) -> None:
    with sending_daemon(tmp_path, lambda number: hi91(10 * number)) as daemon:
        out = cli("clock", "--socket", daemon.socket, "--duration", "1").out
        clocks = msgspec.json.decode(cli("clock", "--socket", daemon.socket, "--json").out, type=dict[str, ClockStatus])
    assert out.startswith("bow: time stamps by ")
    for word in ("offset", "skew", "residual", "verdict", "###"):
        assert word in out
    assert clocks["bow"].t_err_ns > 0


@pytest.mark.live
def test_a_missing_device_and_no_device(tmp_path: Path, cli: Cli) -> None:
    device = {"driver": "hipnuc-uart", "uart": {"port": str(tmp_path / "none"), "baud": 115200}}
    with running_daemon(tmp_path, {"bow": device}) as daemon:
        wait_until(lambda: "does not exist" in str(daemon.statuses()["bow"].condition), "the port is missing")
        out = cli("clock", "--socket", daemon.socket, "--duration", "0.1", status=1).out
        words = " ".join(out.split())
        assert re.fullmatch(r"bow: missing: The port /\S+ does not exist\. bow: no sample yet", words), out
        write_config(tmp_path, {})
        daemon.signal(signal.SIGHUP)
        wait_until(lambda: not daemon.statuses(), "the daemon has no device")
        cli.refuses("imud clock: the daemon has no device; configure", "clock", "--socket", daemon.socket)
        assert cli("clock", "--socket", daemon.socket, "--json").out == "{}\n"


def test_aids_of_the_clock_have_rows() -> None:
    assert list(aids(device("plain"))) == []
    assert list(aids(equipped("bow"))) == [
        ("SOUT", "4998 pulses, 9 without a sample; 17 samples without a pulse"),
        ("SIN", "400 triggers, 21 without a sample"),
        ("PPS", "59 pulses, 1 ignored because of their interval"),
        ("UTC", "error of the host clock 250.0 µs (one sigma)"),
    ]
    parts = error_parts(Sync.EDGE, 4500, LinkDelay(0, 0), None, 0.0, 0.0)
    bow = msgspec.structs.replace(equipped("bow"), clock=msgspec.structs.replace(equipped("bow").clock, parts=parts))
    text = block(bow, deque([9_000_000] * 100))
    assert "\n  pulses    4.5 µs. The interrupt latency of the kernel delays" in text
    assert max(map(len, text.splitlines())) <= 80
    verdict = "  verdict   the kernel's time stamps of the GPIO line"
    assert [words for words in ("\n  SOUT      4998 pulses", " 9000 µs 100.0 % ##", verdict) if words not in text] == []
    both = page([bow, device("stern")], {"bow": deque([9_000_000] * 100), "mast": deque()})
    assert both == f"{text}\n\nmast: no longer in the configuration"
    lines = msgspec.structs.replace(LINES, edges={})
    assert [name for name, _ in aids(equipped("bow", lines=lines, utc=None))] == ["SIN", "UTC"]


# --- what limits a clock: the sentence names the cause that the numbers show ------------------------------------------

MS = NS_PER_MS
WIRE = [9 * MS + 1_000 * (n % 40) for n in range(200)]
TIMER = [2 * MS + (n * 160 % 16_000) * 1_000 for n in range(200)]


def test_the_cause_is_named_and_wires_that_do_not_fit_first() -> None:
    for clock, behind_ns, expected in [
        (ClockStatus(Sync.UTC, t_err_ns=300_000), WIRE, "limits the time stamps: 300.0 µs"),
        (ClockStatus(Sync.EDGE, t_err_ns=4_000), TIMER, "limit the time stamps: 4.0 µs"),
        (ClockStatus(Sync.ARRIVAL, t_err_ns=4_000), WIRE, "imud uses arrival times only"),
        (ClockStatus(Sync.REGRESSION), WIRE[:19], "too few"),
        (ClockStatus(Sync.REGRESSION), WIRE[:20], "arrivals spread over 0.0 ms; without SOUT"),
        (ClockStatus(Sync.REGRESSION, hold_ns=16 * MS), TIMER, "latency timer of the USB adapter, 16 ms"),
        (ClockStatus(Sync.REGRESSION, hold_ns=16 * MS), WIRE, "the constant delay"),
        (ClockStatus(Sync.REGRESSION, hold_ns=16 * MS), [0] * 10 + [8 * MS] * 10, "latency timer of the USB adapter"),
        (ClockStatus(Sync.REGRESSION, hold_ns=16 * MS), [0] * 10 + [8 * MS - 1] * 10, "the host is loaded"),
        (ClockStatus(Sync.REGRESSION), [0] * 10 + [MS] * 10, "the constant delay"),
        (ClockStatus(Sync.REGRESSION), TIMER, "the host is loaded"),
    ]:
        assert expected in verdict(clock, behind_ns)
    for clock, expected in [
        (ClockStatus(Sync.EDGE, edges=1000, edges_unpaired=100, samples_unpaired=100), "stamps of the GPIO line"),
        (ClockStatus(Sync.EDGE, edges=1000, edges_unpaired=101), "101 of 1000 pulses have no sample: is the wire"),
        (ClockStatus(Sync.EDGE, edges=1000, samples_unpaired=3000), "3000 samples have no pulse"),
        (ClockStatus(Sync.EDGE, edges=1000, triggers_missed=100), "stamps of the GPIO line"),
        (ClockStatus(Sync.EDGE, edges=1000, triggers_missed=500), "500 triggers on SIN caused no sample"),
        (ClockStatus(Sync.UTC, edges=1000, edges_unpaired=500), "pulses have no sample"),
        (ClockStatus(Sync.UTC, edges=1000), "the device sends UTC"),
        (ClockStatus(Sync.REGRESSION, edges=1000), "1000 edges in total, but imud cannot match them"),
        (ClockStatus(Sync.REGRESSION, edges=99, edges_unpaired=99), "the constant delay"),
        (ClockStatus(Sync.REGRESSION, edges=100, edges_unpaired=100), "100 of 100 pulses have no sample"),
    ]:
        assert expected in verdict(clock, WIRE)
    assert "1000 edges in total" in block(device("bow", clock=ClockStatus(Sync.ARRIVAL, edges=1000)), deque())
