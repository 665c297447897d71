"""Fixtures: a real PostgreSQL, and an empty database."""

from collections.abc import Iterator

import pytest

from tests.fleet.database.deliveries import query
from tests.fleet.postgres_server import NO_POSTGRES, running_server


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    if NO_POSTGRES:
        pytest.skip(NO_POSTGRES)
    with running_server() as made:
        yield made.url


@pytest.fixture
def database(server: str) -> str:
    query(server, "DROP SCHEMA public CASCADE; CREATE SCHEMA public")
    return server
