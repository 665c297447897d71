"""Overview of a fleet in a real database: states, sums, causes of losses, rejected messages, and errors."""

from collections.abc import Iterator

import pytest

from imud.fleet.database.overview import FleetSelection, GatewayCondition, OverviewReader
from imud.model.errors import BadArgument, ServerError
from tests.fleet.database.gateway_rows import add_gateways, add_rejected, make_tables
from tests.fleet.postgres_server import NO_POSTGRES, query
from tests.support.daemon_process import LIMIT_S

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]
EVERYTHING = FleetSelection()


@pytest.fixture
def database(database: str) -> str:
    make_tables(database)
    return database


@pytest.fixture
def reader(database: str) -> Iterator[OverviewReader]:
    with OverviewReader(database) as made:
        yield made


def test_each_gateway_has_a_state_and_absent_gateways_are_first(database: str, reader: OverviewReader) -> None:
    for name in ("a", "lossy", "quiet", "gone", "new", "unset"):
        add_gateways(database, name=name, online=name != "gone", reason="connection lost" if name == "gone" else "",
                     utc_set={"unset": False, "new": None}.get(name, True))  # fmt: skip
    query(database, "UPDATE imud_ledger SET missing = 3, newest = 900, dropped = 9, dropped_by_cause = "
          "'{\"space\": 5, \"age\": 4}' WHERE gateway = 'lossy-0001' AND stream = 'samples'")  # fmt: skip
    query(database, "UPDATE imud_ledger SET updated_at = now() - interval '400 s' WHERE gateway = 'quiet-0001'")
    query(
        database,
        "DELETE FROM imud_ledger WHERE gateway = 'new-0001'; DELETE FROM imud_gateways WHERE gateway = 'a-0001'",
    )
    rows = {row.gateway: row for row in reader.gateways(EVERYTHING)}
    states = {name: (row.state.value, row.has_problem) for name, row in rows.items()}
    assert list(states.items()) == [
        ("gone-0001", ("offline", True)), ("quiet-0001", ("silent", True)), ("lossy-0001", ("online", True)),
        ("unset-0001", ("online", True)), ("a-0001", ("online", False)), ("new-0001", ("online", False)),
    ]  # fmt: skip
    lossy = rows["lossy-0001"]
    assert (lossy.missing, lossy.dropped, lossy.in_spool) == (3, 9, 100)
    assert lossy.dropped_by_cause == {"age": 4, "space": 5}
    assert rows["gone-0001"].reason == "connection lost"
    assert (rows["a-0001"].version, rows["a-0001"].devices, rows["a-0001"].utc_set) == ("", [], None)
    assert rows["new-0001"].silent_s < LIMIT_S
    assert rows["quiet-0001"].silent_s >= 400
    assert [row.gateway for row in reader.gateways(EVERYTHING, absent=True)] == ["gone-0001", "quiet-0001"]
    assert len(reader.gateways(EVERYTHING, problems=True)) == 4
    assert len(reader.gateways(EVERYTHING, limit=2)) == 2
    assert reader.gateways(FleetSelection(gateway="quiet-0001", silent_s=1000))[0].state is GatewayCondition.ONLINE
    unknown, group = reader.groups(EVERYTHING)
    assert (unknown.version, unknown.gateways) == ("", 1)
    assert (group.gateways, group.online, group.silent, group.offline) == (5, 3, 1, 1)
    assert (group.with_problem, group.with_losses, group.clock_not_set) == (4, 1, 1)
    assert (group.missing, group.dropped, group.in_spool) == (3, 9, 100)


def test_groups_are_by_site_and_version_and_the_selection_applies(database: str, reader: OverviewReader) -> None:
    add_gateways(database, 2, boots=3)
    add_gateways(database, site="harbour", name="h", version="1.1.0")
    found = [(group.site, group.version, group.gateways) for group in reader.groups(EVERYTHING)]
    assert found == [("harbour", "1.1.0", 1), ("mill", "1.2.0", 2)]
    assert [group.site for group in reader.groups(FleetSelection(site="harbour"))] == ["harbour"]
    assert [row.gateway for row in reader.gateways(FleetSelection("mill", "gw-0002"))] == ["gw-0002"]
    summary = reader.summary(FleetSelection(site="mill"))
    assert (summary.gateways, summary.versions, summary.streams, summary.boots) == (2, {"1.2.0": 2}, 21, 7)
    assert 0 <= (summary.newest_s or 0) < LIMIT_S


def test_sums_above_64_bits_do_not_fail(database: str, reader: OverviewReader) -> None:
    add_gateways(database, 2)
    query(database, "UPDATE imud_ledger SET missing = 4611686018427387903, dropped = missing, dropped_by_cause = "
          "'{\"age\": 4611686018427387903}'")  # fmt: skip
    assert [row.missing for row in reader.gateways(EVERYTHING)] == [2**63 - 1] * 2
    assert reader.groups(EVERYTHING)[0].missing == 2 * (2**63 - 1)


def test_rejected_messages_are_newest_first_and_counted_by_reason(database: str, reader: OverviewReader) -> None:
    assert reader.rejected() == ([], (0, {}))
    add_rejected(database, "imud/mill/gw/bow/samples", b"\x00\xff" * 3000, "too long")
    add_rejected(database, "imud/mill/other/state", b"{}")
    add_rejected(database, "imud/mill/gw/bow/events", b"[]")
    query(database, "UPDATE imud_rejected SET rejected_at = now() - interval '1 hour' WHERE id = 1")
    messages, counts = reader.rejected()
    assert [(one.id, one.bytes) for one in messages] == [(3, 2), (2, 2), (1, 6000)]
    assert counts == (3, {"expected a message of a gateway": 2, "too long": 1})
    assert [one.id for one in reader.rejected("gw")[0]] == [3, 1]
    assert [one.id for one in reader.rejected("gw", 60)[0]] == [3]
    messages, counts = reader.rejected(limit=1)
    assert ([one.id for one in messages], counts.total) == ([3], 3)
    assert reader.payload(1) == ((b"\x00\xff" * 3000)[:4096], 6000)
    assert reader.payload(4) is None
    assert reader.payload(2**70) is None


def test_errors_name_the_next_step_and_no_password(database: str) -> None:
    with pytest.raises(BadArgument, match="expected the database as a URL like postgresql://"):
        OverviewReader("mqtt://broker")
    with pytest.raises(ServerError, match=r"cannot parse the URL: .*does not show it") as caught:
        OverviewReader("postgresql://imud:secret@[::1")
    assert "secret" not in str(caught.value)
    query(database, "DROP SCHEMA public CASCADE; CREATE SCHEMA public")
    with (
        OverviewReader(database) as reader,
        pytest.raises(ServerError, match="is this the database of `imud fleet"),
    ):
        reader.groups(EVERYTHING)


def test_a_user_with_select_is_sufficient_and_can_write_nothing(database: str) -> None:
    query(database, "DROP ROLE IF EXISTS viewer; CREATE ROLE viewer LOGIN; GRANT USAGE ON SCHEMA public TO viewer")
    add_gateways(database)
    url = database.replace("user=imud", "user=viewer")
    with OverviewReader(url) as reader:
        with pytest.raises(ServerError, match="grant SELECT on all tables imud_"):
            reader.gateways(EVERYTHING)
        query(database, "GRANT SELECT ON ALL TABLES IN SCHEMA public TO viewer")
        assert len(reader.gateways(EVERYTHING)) == 1
        assert reader.rejected()[1].total == 0
        with pytest.raises(ServerError, match="read-only transaction"):
            reader._rows("CREATE TABLE new ()", {})
    query(database, "DROP OWNED BY viewer; DROP ROLE viewer")
