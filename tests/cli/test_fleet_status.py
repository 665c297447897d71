"""`imud fleet status` and `imud fleet rejected` on a real database: tables, summary, JSON, exit statuses, payloads."""

import json
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import suppress

import pytest
from prometheus_client.parser import text_string_to_metric_families

from imud.cli.fleet_status import ROWS_MAX, STATUS_HEAD, rejected_page
from imud.fleet.database.overview import RejectedCounts
from imud.fleet.metrics import PREFIX
from tests.cli.conftest import Cli, Terminal, imud_process
from tests.fleet.database.gateway_rows import add_gateways, add_rejected, make_tables
from tests.fleet.fleet_gateway import SendingGateway, samples_message
from tests.fleet.mosquitto import Mosquitto
from tests.fleet.postgres_server import NO_POSTGRES, query, running_postgres
from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.surroundings import free_port

needs_postgres = pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with running_postgres() as url:
        yield url


@pytest.fixture
def database(server: str) -> str:
    make_tables(server)
    return server


@needs_postgres
@pytest.mark.live
def test_status_prints_gateways_a_summary_and_a_status(database: str, cli: Cli) -> None:
    assert cli("fleet", "status", database, status=1).out.startswith("no gateway; check --site")
    add_gateways(database)
    page = cli("fleet", "status", database).out.splitlines()
    assert page[0].split() == " ".join(STATUS_HEAD).split()
    assert page[1].split()[:2] == ["mill/gw-0001", "online"]
    assert page[3:] == [
        "gateways    1: 1 online, 0 silent, 0 offline; 0 with a problem", "versions    1.2.0 (1)",
        "losses      0 gateways; 0 numbers dropped, 0 missing, 0 thinned", "backlog     0 numbers in the spools",
        "clocks      0 not set", page[8], "ledger      3 streams, 1 boots",
        "collectors  0 running, with 0 shares",
    ]  # fmt: skip
    add_gateways(database, name="gone", online=False, reason="shut \x1b[31mdown", version="\x07")
    add_gateways(database, name="lossy")
    query(database, "UPDATE imud_ledger SET dropped = 4, dropped_by_cause = '{\"space\": 4}' WHERE stream = 'samples' "
          "AND gateway = 'lossy-0001'")  # fmt: skip
    page = cli("fleet", "status", database, "--problems", status=1).out.splitlines()
    assert page[1].startswith(r"mill/gone-0001   offline: shut \x1b[31mdown")
    assert r" \x07 " in page[1]
    assert "4 space" in page[2]
    assert page[4] == "gateways    3: 2 online, 0 silent, 1 offline; 2 with a problem"
    assert "lossy" not in cli("fleet", "status", database, "--silent-only", status=1).out.split("\n\n")[0]
    assert cli("fleet", "status", database, "--gateway", "gw-0001").out.count("mill/") == 1
    found = json.loads(cli("fleet", "status", database, "--json", status=1).out)
    assert [one["state"] for one in found["gateways"]] == ["offline", "online", "online"]
    assert found["gateways"][1]["dropped_by_cause"] == {"space": 4}
    assert found["summary"]["versions"] == {"1.2.0": 2, "\x07": 1}
    assert (found["summary"]["streams"], found["summary"]["boots"]) == (9, 3)


@needs_postgres
@pytest.mark.live
def test_a_large_fleet_has_a_readable_table(database: str, cli: Cli) -> None:
    add_gateways(database, ROWS_MAX + 20)
    add_gateways(database, 1, name="gone", online=False)
    lines = cli("fleet", "status", database, status=1).out.splitlines()
    assert lines[1].startswith("mill/gone-0001")
    assert lines[ROWS_MAX + 1] == "… 21 more; use --all"
    assert cli("fleet", "status", database, "--all", status=1).out.count("mill/") == ROWS_MAX + 21
    query(database, "UPDATE imud_gateways SET online = false")
    assert "… 21 more" in cli("fleet", "status", database, "--silent-only", status=1).out
    assert "… 21 more" in cli("fleet", "status", database, "--problems", status=1).out
    assert len(json.loads(cli("fleet", "status", database, "--json", status=1).out)["gateways"]) == ROWS_MAX + 21


@needs_postgres
@pytest.mark.live
def test_rejected_prints_messages_and_payloads(database: str, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cli("fleet", "rejected", database).out == "no rejected messages\n"
    add_rejected(database, "imud/mill/gw/bow/samples", b"\x1b[31m\xff\n" + b"x" * 5000, "expected\x07 numbers")
    add_rejected(database, "imud/mill/gw/state", b"{}")
    lines = cli("fleet", "rejected", database).out.splitlines()
    assert [lines[1].split()[0], *lines[1].split()[3:5]] == ["2", "2", "imud/mill/gw/state"]
    assert lines[2].endswith(r"5007  imud/mill/gw/bow/samples  expected\x07 numbers")
    assert lines[4] == "2 messages by reason:"
    assert r"       1  expected\x07 numbers" in lines[5:]
    assert json.loads(cli("fleet", "rejected", database, "--json", "--since", "1h").out)["total"] == 2
    assert cli("fleet", "rejected", database, "--gateway", "other").out == "no rejected messages\n"
    argv = [sys.executable, "-m", "imud", "fleet", "rejected", database, "--payload", "1"]
    done = subprocess.run(argv, capture_output=True, check=True)
    assert done.stdout == b"\x1b[31m\xff\n" + b"x" * 4089
    assert done.stderr == b"the message had 5007 bytes; the database contains the first 4096\n"
    cli.refuses(
        "--payload: expected the ID of a rejected message, got 3", "fleet", "rejected", database, "--payload", 3
    )
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    cli("fleet", "rejected", database, "--payload", 1)
    assert terminal.getvalue().startswith(r"\x1b[31m\udcff\nxxx")
    assert terminal.getvalue().isascii()


@needs_postgres
@pytest.mark.live
def test_a_collector_serves_metrics_and_status_counts_it(database: str, broker: Mosquitto, cli: Cli) -> None:
    port, gateway = free_port(), SendingGateway(broker.port)
    words = ("fleet", "collect", f"mqtt://127.0.0.1:{broker.port}", "--to", database, "--metrics", f"127.0.0.1:{port}")

    def values() -> dict[str, float]:
        with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=LIMIT_S) as answer:
            families = text_string_to_metric_families(answer.read().decode())
            return {one.name.removeprefix(PREFIX): one.value for family in families for one in family.samples}
        return {}

    with imud_process(*words) as process:
        connected = {"shares": 1, "broker_connected": 1}
        wait_until(lambda: values().items() >= connected.items(), "the share has a session")
        gateway.send(samples_message(1, 10), samples_message(8, 12))
        gateway.publish([("imud/mill/gw/bow/samples", b"garbage")])
        stored = {"messages_total": 2, "rejected_total": 1, "waiting_messages": 0}
        wait_until(lambda: values().items() >= stored.items(), "all messages are stored")
        found = values()
        assert (found["rows_total"], found["duplicates_total"]) == (12, 3)
        assert (found["free_shares"], found["database_connected"]) == (0, 1)
        assert 1 <= found["transaction_seconds_count"] <= 3
        assert "imud/mill/gw/bow/samples  expected a message" in cli("fleet", "rejected", database).out
        assert "collectors  1 running, with 1 shares" in cli("fleet", "status", database).out
        process.end(signal.SIGTERM)
    gateway.close()
    assert "collectors  0 running, with 0 shares" in cli("fleet", "status", database).out


def test_frequent_reasons_are_shown_and_the_others_are_counted() -> None:
    page = rejected_page([], RejectedCounts(30, {"a": 20, "b": 4}))
    assert page.splitlines()[-1].split(maxsplit=1) == ["6", "other reasons, after the 20 most frequent reasons"]
