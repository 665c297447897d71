"""Metrics of a collector as text: counters, shares, histogram, sums of the fleet, and the limits of label values."""

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from imud.fleet.collector import TransactionTimes
from imud.fleet.database.overview import FleetGroup
from imud.fleet.database.transaction import StoreCounts
from imud.fleet.metrics import (
    LABEL_CHARACTERS,
    PREFIX,
    SITES_MAX,
    VERSIONS_MAX,
    FleetSnapshot,
    MetricsPage,
)
from imud.fleet.metrics_server import address_of
from imud.fleet.shares import CollectorStatus
from imud.model.errors import BadArgument


def group(site: str = "mill", version: str = "1", gateways: int = 1, **more: float) -> FleetGroup:
    numbers = dict.fromkeys(FleetGroup._fields[3:], 0) | {"online": gateways, **more}
    return FleetGroup(site, version, gateways, **numbers)  # type: ignore[arg-type]  # numbers by name


NO_TIMES = TransactionTimes()
IDLE = CollectorStatus(StoreCounts(), NO_TIMES.read(), 0, 0, None, broker_connected=True, database_connected=False,
                       write_s=0.0)  # fmt: skip


def lines(status: CollectorStatus = IDLE, fleet: FleetSnapshot | None = None, age_s: float = 0.0) -> dict[str, float]:
    """Return the values of the page by name and labels, as `name{site,state}`."""
    page, registry = MetricsPage(lambda: status), CollectorRegistry()
    page.fleet = None if fleet is None else (fleet, age_s)
    registry.register(page)
    found = {}
    for family in text_string_to_metric_families(generate_latest(registry).decode()):
        for one in family.samples:
            labels = ",".join(one.labels.values())
            found[one.name + (f"{{{labels}}}" if labels else "")] = one.value
    return found


def test_the_page_has_the_state_of_the_process_and_a_histogram() -> None:
    times = TransactionTimes()
    for seconds in (0.02, 0.025, 0.3, 20.0):
        times.add(seconds)
    status = CollectorStatus(
        StoreCounts(40, 160, 8, 4),
        times.read(),
        12,
        2,
        1,
        broker_connected=False,
        database_connected=True,
        write_s=1.5,
    )
    found = {name.removeprefix(PREFIX): value for name, value in lines(status).items()}
    buckets = {name: found.pop(name) for name in list(found) if "bucket" in name}
    assert found == {
        "messages_total": 40, "rows_total": 160, "duplicates_total": 8, "rejected_total": 4, "waiting_messages": 12,
        "shares": 2, "free_shares": 1, "broker_connected": 0, "database_connected": 1, "transaction_seconds_count": 4,
        "transaction_seconds_sum": 20.345, "transaction_age_seconds": 1.5,
    }  # fmt: skip
    at = {le: buckets[f"transaction_seconds_bucket{{{le}}}"] for le in ("0.01", "0.025", "0.5", "10.0", "+Inf")}
    assert at == {"0.01": 0, "0.025": 2, "0.5": 3, "10.0": 3, "+Inf": 4}
    assert PREFIX + "free_shares" not in lines()


def test_the_fleet_has_sums_by_site_and_by_version() -> None:
    groups = [
        group("mill", "1", 5, online=2, silent=2, offline=1, missing=2**70, clock_not_set=1, newest_s=7.0),
        group("mill", "2", 3, missing=4, dropped=6, in_spool=8, newest_s=3.0), group("harbour", "2", newest_s=9.0),
    ]  # fmt: skip
    found = lines(IDLE, FleetSnapshot(groups, 2), age_s=1.5)
    assert {name.removeprefix("imud_fleet_gateways"): value for name, value in found.items() if "gateways" in name} == {
        "{mill,online}": 5, "{mill,silent}": 2, "{mill,offline}": 1, "{harbour,online}": 1, "{harbour,silent}": 0,
        "{harbour,offline}": 0, "_by_version{1}": 5, "_by_version{2}": 4,
    }  # fmt: skip
    assert found["imud_fleet_missing_numbers{mill}"] == 2.0**70
    assert (found["imud_fleet_dropped_numbers{mill}"], found["imud_fleet_backlog_numbers{mill}"]) == (6, 8)
    assert (found["imud_fleet_clocks_not_set{mill}"], found["imud_fleet_clocks_not_set{harbour}"]) == (1, 0)
    assert found["imud_fleet_newest_message_age_seconds"] == 4.5
    assert found["imud_fleet_collectors"] == 2
    without = lines(IDLE, FleetSnapshot([], 0))
    assert [name for name in without if not name.startswith(PREFIX)] == ["imud_fleet_collectors"]


def test_the_number_of_time_series_has_a_limit() -> None:
    many = SITES_MAX + 5
    groups = [group(f"site{number:05}", f"v{number:05}", 2 if number == many - 1 else 1) for number in range(many)]
    groups[0] = groups[0]._replace(version='\x1b"\n' + "x" * 500)
    found = lines(IDLE, FleetSnapshot(groups, 1))
    by_site = [name for name in found if name.startswith("imud_fleet_gateways{") and "online" in name]
    assert len(by_site) == SITES_MAX + 1
    assert found["imud_fleet_gateways{other,online}"] == 6 - 1
    assert f"imud_fleet_gateways{{site{many - 1:05},online}}" in found
    by_version = [name for name in found if "by_version" in name]
    assert len(by_version) == VERSIONS_MAX + 1
    assert found["imud_fleet_gateways_by_version{other}"] == many + 1 - VERSIONS_MAX - 1
    assert all(len(name) < LABEL_CHARACTERS + 40 and name.isprintable() for name in by_version)


def test_an_address_is_host_and_port() -> None:
    assert address_of("127.0.0.1:9322") == ("127.0.0.1", 9322)
    assert address_of("[::1]:0") == ("::1", 0)
    for wrong in ("", "9322", ":9322", "127.0.0.1:", "127.0.0.1:65536", "127.0.0.1:²", "127.0.0.1:" + "1" * 5000):
        with pytest.raises(BadArgument, match=r"expected HOST:PORT, for example 127.0.0.1:9322, got"):
            address_of(wrong)
