"""Examples of docs/fleet-database.md in a real PostgreSQL."""

import re
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import DROPPED, INTERVALS, LEDGER, SAMPLES
from imud.fleet.database.upkeep import Upkeep
from tests.fleet.database.fleet_rows import START, insert
from tests.fleet.postgres_server import NO_POSTGRES, running_postgres
from tests.support.files import ROOT

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]
PAGE = (ROOT / "docs/fleet-database.md").read_text()
NAMES: dict[str, Any] = {"gateway": "gw-17"}


def examples(language: str) -> Iterator[str]:
    yield from re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture(scope="module")
def database() -> Iterator[str]:
    """Yield the URL of a database with rows, and with the user of the page."""
    import psycopg

    with running_postgres() as url:
        with psycopg.connect(url) as connection:
            cursor = connection.cursor()
            Upkeep(CollectorSettings()).prepare(cursor)
            insert(cursor, INTERVALS, time="now", first=2, temperature_mean_c=21.0, accel_z_mean_m_s2=9.8, **NAMES)
            insert(cursor, INTERVALS, time="now", first=3, utc_set=False, temperature_mean_c=99.0, **NAMES)
            insert(cursor, DROPPED, time="now", first=5, last=9, **NAMES)
            insert(cursor, LEDGER, updated_at="now", newest=9, missing=4, sent=10, **NAMES)
            for at_s in (0.0, 0.5, 3600.0):
                insert(cursor, SAMPLES, at_s, seq=round(at_s * 2) + 1, accel_z_m_s2=9.8, **NAMES)
                insert(cursor, INTERVALS, at_s, samples=2, temperature_mean_c=at_s, **NAMES)
            for text in examples("sql"):
                if text.startswith("CREATE ROLE"):
                    cursor.execute(text.encode())
        yield url.replace("user=imud", "user=reader")


def test_queries_have_rows(database: str) -> None:
    import psycopg

    answers = []
    with psycopg.connect(database) as connection:
        for text in examples("sql"):
            for query in re.findall(r"^SELECT.*?;", text, re.DOTALL | re.MULTILINE):
                answers.append([row[:3] + row[4:] for row in connection.execute(query.encode())])
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            connection.execute("DELETE FROM imud_samples")
    newest, dropped, missing, samples, hours = answers
    assert newest == [("mill", "gw-17", "bow", 21.0, 9.8)]
    assert dropped == [("mill", "gw-17", "bow", "space", 5)]
    assert [row[4:6] for row in missing] == [(4, 1)]
    assert [row[0] for row in samples] == [START, START.replace(microsecond=500_000)]
    assert [row[1] for row in hours] == [4, 2], "without the hour of today"


class FakeModule:
    """Substitute for pandas, which the tests do not need."""

    def DataFrame(self, rows: list[Any], columns: list[str]) -> Any:
        return [dict(zip(columns, row, strict=True)) for row in rows]


def test_hours_become_a_data_frame(database: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", FakeModule())
    (text,) = examples("python")
    names: dict[str, Any] = {}
    exec(text.replace("postgresql://reader@db.example/fleet", database), names)
    assert [row["temperature_mean_c"] for row in names["frame"]] == [0.25, 3600.0]
    assert list(names["frame"][0]) == ["time", "samples", "temperature_mean_c"]
