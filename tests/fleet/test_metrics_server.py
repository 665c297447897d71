"""HTTP endpoint of a collector: page, wrong requests, one reader of the fleet, and a database that fails."""

import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic_ns

import pytest

from imud.fleet import metrics_server
from imud.fleet.metrics_server import REFRESH_S, CollectorMetricsServer, FleetGauges
from imud.model.errors import ServerError
from imud.model.units import NS_PER_S
from tests.fleet.database.gateway_rows import add_gateways, make_tables
from tests.fleet.postgres_server import NO_POSTGRES, PostgresServer, query, running_server
from tests.fleet.test_metrics import IDLE
from tests.support.daemon_process import LIMIT_S, wait_until

NO_DATABASE = "postgresql://127.0.0.1:1/fleet"
GATEWAYS = 'imud_fleet_gateways{site="mill",state="online"} '


@contextmanager
def endpoint(gauges: FleetGauges) -> Iterator[CollectorMetricsServer]:
    made = CollectorMetricsServer("127.0.0.1:0", lambda: IDLE, gauges)
    made.start()
    try:
        yield made
    finally:
        made.close()
        made.close()


def scrape(served: CollectorMetricsServer, path: str = "metrics") -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{served.port}/{path}", timeout=LIMIT_S) as answer:
        text: str = answer.read().decode()
        return text


@pytest.mark.live
def test_the_page_has_metrics_of_the_process_and_other_pages_are_refused() -> None:
    with endpoint(FleetGauges(NO_DATABASE, 300, monotonic_ns)) as served:
        text = scrape(served)
        assert "\nimud_fleet_collector_shares 0.0\n" in text
        assert "process_start_time_seconds" in text
        assert "imud_fleet_gateways" not in text
        assert "/metrics" in scrape(served, "")
        with pytest.raises(urllib.error.HTTPError, match="404"):
            scrape(served, "other")
        with pytest.raises(urllib.error.HTTPError, match="405"):
            urllib.request.urlopen(f"http://127.0.0.1:{served.port}/metrics", data=b"x", timeout=LIMIT_S)
        with pytest.raises(ServerError, match=r"another program uses this port .*, or set --metrics"):
            CollectorMetricsServer(
                f"127.0.0.1:{served.port}", lambda: IDLE, FleetGauges(NO_DATABASE, 300, monotonic_ns)
            ).start()


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    if NO_POSTGRES:
        pytest.skip(NO_POSTGRES)
    with running_server() as made:
        make_tables(made.url)
        add_gateways(made.url, 3)
        yield made


@pytest.mark.live
def test_one_collector_reads_the_fleet_and_another_continues(server: PostgresServer) -> None:
    first, second = (FleetGauges(server.url, 300, monotonic_ns, refresh_s=0) for _ in range(2))
    with endpoint(second) as other:
        with endpoint(first) as served:
            assert GATEWAYS + "3.0" in scrape(served)
            assert "imud_fleet_gateways" not in scrape(other)
            query(server.url, "UPDATE imud_ledger SET updated_at = now() - interval '301 s' WHERE gateway = 'gw-0001'")
            assert GATEWAYS + "2.0" in scrape(served)
        wait_until(lambda: GATEWAYS + "2.0" in scrape(other), "the other collector reads the fleet")
    query(server.url, "UPDATE imud_ledger SET updated_at = now()")


@pytest.mark.live
def test_a_collector_that_prometheus_does_not_scrape_releases_the_lock(server: PostgresServer) -> None:
    first, second = (
        FleetGauges(server.url, 300, monotonic_ns, unused_s=0.05),
        FleetGauges(server.url, 300, monotonic_ns, refresh_s=0),
    )
    with endpoint(first) as served, endpoint(second) as other:
        assert GATEWAYS in scrape(served)
        wait_until(lambda: GATEWAYS in scrape(other), "the other collector reads the fleet")


@pytest.mark.live
def test_the_database_is_read_once_per_interval(server: PostgresServer) -> None:
    now = [0]
    with endpoint(FleetGauges(server.url, 300, lambda: now[0])) as served:
        assert GATEWAYS + "3.0" in scrape(served)
        query(server.url, "UPDATE imud_gateways SET online = false WHERE gateway = 'gw-0001'")
        try:
            now[0] = round((REFRESH_S - 0.1) * NS_PER_S)
            assert GATEWAYS + "3.0" in scrape(served)
            now[0] = round(REFRESH_S * NS_PER_S)
            assert GATEWAYS + "2.0" in scrape(served)
        finally:
            query(server.url, "UPDATE imud_gateways SET online = true")
        query(server.url, "ALTER VIEW imud_gateway_status RENAME TO other")  # the next read fails
        try:
            now[0] += round(REFRESH_S * NS_PER_S)
            assert GATEWAYS not in scrape(served)
        finally:
            query(server.url, "ALTER VIEW other RENAME TO imud_gateway_status")


@pytest.mark.live
def test_without_the_database_the_page_has_the_metrics_of_the_process(server: PostgresServer) -> None:
    with endpoint(FleetGauges(server.url, 300, monotonic_ns, refresh_s=0)) as served:
        assert GATEWAYS in scrape(served)
        server.kill()
        try:
            text = scrape(served)
            assert "imud_fleet_collector_shares" in text
            assert GATEWAYS not in text
        finally:
            server.start()
        wait_until(lambda: GATEWAYS in scrape(served), "the database is read again")


@pytest.mark.live
def test_a_scrape_does_not_wait_for_a_silent_database(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_server, "WAIT_S", 0.05)
    monkeypatch.setattr(metrics_server, "CLOSE_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"postgresql://imud@127.0.0.1:{silent.getsockname()[1]}/fleet"
        with endpoint(FleetGauges(url, 300, monotonic_ns)) as served:
            assert "imud_fleet_collector_shares" in scrape(served)
