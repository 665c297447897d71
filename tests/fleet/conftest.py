"""Fixtures: a real broker, and a gateway that sends to it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fleet.fleet_gateway import SendingGateway
from tests.publishers.mqtt.conftest import authority
from tests.publishers.mqtt.mosquitto import NO_MOSQUITTO, Mosquitto, running_broker
from tests.publishers.mqtt.proxy import Proxy

__all__ = ["authority", "broker", "gateway", "proxy"]


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    if NO_MOSQUITTO:
        pytest.skip(NO_MOSQUITTO)
    with running_broker(tmp_path / "broker") as one:
        yield one


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
