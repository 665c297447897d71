"""Rows of a fleet in a real database, without a collector: gateways, boots, ledgers and rejected messages."""

from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.upkeep import Upkeep
from tests.fleet.postgres_server import query


def make_tables(url: str) -> None:
    """Create the empty tables and the views in an empty schema."""
    import psycopg

    with psycopg.connect(url) as connection, connection.cursor() as cursor:
        cursor.execute("DROP SCHEMA public CASCADE; CREATE SCHEMA public")
        Upkeep(CollectorSettings()).prepare(cursor)


def add_gateways(
    url: str, gateways: int = 1, *, boots: int = 1, site: str = "mill", name: str = "gw", online: bool = True,
    reason: str = "", version: str = "1.2.0", utc_set: bool | None = True,
) -> None:  # fmt: skip
    """Add gateways NAME-0001 … with three streams per boot and 1,000 complete samples per stream."""
    names = "SELECT %(name)s || to_char(i, '-FM0000') AS gateway FROM generate_series(1, %(gateways)s) AS i"
    with_boots = f"({names}) AS names, generate_series(1, %(boots)s) AS boot"
    values = {
        "gateways": gateways, "boots": boots, "site": site, "name": name, "online": online, "reason": reason,
        "version": version, "utc_set": utc_set,
    }  # fmt: skip
    for text in (
        "INSERT INTO imud_gateways SELECT %(site)s, gateway, '1', %(online)s, %(reason)s, %(version)s, '{bow}', "
        f"%(utc_set)s, NULL, '{{}}', now() FROM ({names}) AS names",
        f"INSERT INTO imud_boots (gateway, boot) SELECT gateway, boot::text FROM {with_boots}",
        "INSERT INTO imud_ledger SELECT gateway, boot::text, 'bow', stream, %(site)s, 1, 1000, 1000, 0, 0, '{}', 0, 0, "
        "'{}', 1000, now() - (%(boots)s - boot) * interval '1 day' "
        f"FROM {with_boots}, unnest(ARRAY['samples', 'statistics', 'events']) AS stream",
    ):
        query(url, text, values)


def add_rejected(url: str, topic: str, payload: bytes, reason: str = "expected a message of a gateway") -> None:
    query(
        url, "INSERT INTO imud_rejected (topic, reason, payload_bytes, payload) VALUES (%s, %s, %s, %s)",
        (topic, reason, len(payload), payload[:4096]),
    )  # fmt: skip
