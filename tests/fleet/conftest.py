"""Fixtures: a certificate authority, a real broker, and a gateway that sends to the broker."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from imud.fleet.spool import Spool
from tests.fleet.authority import Authority
from tests.fleet.fleet_gateway import SendingGateway
from tests.fleet.mosquitto import NO_MOSQUITTO, Mosquitto, running_broker
from tests.fleet.postgres_server import NO_POSTGRES, PostgresServer, query, running_server
from tests.fleet.proxy import Proxy


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    if NO_MOSQUITTO:
        pytest.skip(NO_MOSQUITTO)
    with running_broker(tmp_path / "broker") as one:
        yield one


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    if NO_POSTGRES:
        pytest.skip(NO_POSTGRES)
    with running_server() as made:
        yield made


@pytest.fixture
def database(server: PostgresServer) -> str:
    """Return the URL of an empty database."""
    query(server.url, "DROP SCHEMA public CASCADE; CREATE SCHEMA public")
    return server.url


@pytest.fixture
def gateway(broker: Mosquitto) -> Iterator[SendingGateway]:
    one = SendingGateway(broker.port)
    yield one
    one.close()


@pytest.fixture
def proxy(broker: Mosquitto) -> Iterator[Proxy]:
    one = Proxy(broker.port)
    yield one
    one.close()


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    return Authority(tmp_path_factory.mktemp("authority"))


@pytest.fixture(autouse=True)
def _closed_spools(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Close databases that a test leaves open. Python 3.13 and newer warn about each of them."""
    opened: list[Spool] = []
    opening = Spool.open

    def noted(spool: Spool) -> None:
        opened.append(spool)
        opening(spool)

    monkeypatch.setattr(Spool, "open", noted)
    yield
    for spool in opened:
        spool.close()
