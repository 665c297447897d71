"""Creation of tables in a real database: several collectors at the same time, and tables of another user."""

import threading

import pytest

from imud.fleet.database.store import PostgresStore
from imud.model.errors import ServerError
from tests.fleet.database.gateway_rows import make_tables
from tests.fleet.postgres_server import NO_POSTGRES, query

pytestmark = [pytest.mark.skipif(bool(NO_POSTGRES), reason=NO_POSTGRES), pytest.mark.live]


def test_tables_of_several_owners_are_refused(database: str) -> None:
    """In a schema that is open to all users, a user can create a table before the first collector starts."""
    make_tables(database)
    query(database, "DROP ROLE IF EXISTS stranger; CREATE ROLE stranger; ALTER TABLE imud_events OWNER TO stranger")
    with pytest.raises(ServerError, match=r"expected one owner of all tables imud_.*, got .*imud_events of stranger"):
        PostgresStore(database)
    query(database, "DROP OWNED BY stranger; DROP ROLE stranger")


def test_stores_create_tables_together(database: str) -> None:
    gate = threading.Barrier(3)
    errors: list[Exception] = []

    def create() -> None:
        gate.wait()
        try:
            PostgresStore(database).close()
        except ServerError as error:
            errors.append(error)

    threads = [threading.Thread(target=create) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert query(database, "SELECT count(*) FROM imud_schema") == [(1,)]
