"""Cluster of NATS servers as a buffer: a collector that was offline receives all messages while a server is killed."""

import pytest

from tests.bench.fleet_jetstream import Plan, run
from tests.bench.fleet_load import LOST, MISSING, OPEN
from tests.fleet.nats_cluster import NO_NATS
from tests.fleet.postgres_server import NO_POSTGRES

pytestmark = pytest.mark.live


@pytest.mark.skipif(bool(NO_NATS or NO_POSTGRES), reason=NO_NATS or NO_POSTGRES)
def test_catch_up_survives_a_killed_server() -> None:
    outcome = run(Plan(gateways=20, devices=1, seconds=300, kill_every_s=0, kills_max=1, outputs=0))
    assert len(outcome.kills) == 1
    assert [outcome.figures[name] for name in (LOST, MISSING, OPEN)] == [0, 0, 0]
