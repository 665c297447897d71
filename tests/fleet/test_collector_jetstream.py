"""Cluster of NATS servers as a buffer: a collector that was offline receives all messages while a server is killed."""

import pytest

from tests.bench.fleet_jetstream import Plan, run
from tests.bench.fleet_load import LOST, MISSING, OPEN
from tests.fleet.nats_cluster import NO_NATS, is_reliable, program_version
from tests.fleet.postgres_server import NO_POSTGRES

pytestmark = pytest.mark.live


@pytest.mark.skipif(bool(NO_NATS or NO_POSTGRES), reason=NO_NATS or NO_POSTGRES)
@pytest.mark.parametrize("kills", [0, 1])
def test_a_collector_catches_up_while_servers_are_killed(kills: int) -> None:
    if kills and not is_reliable():
        pytest.skip(f"nats-server {program_version()} can skip messages of a session after SIGKILL")
    outcome = run(Plan(gateways=20, devices=1, seconds=300, kill_every_s=0, kills_max=kills, outputs=0))
    assert len(outcome.kills) == kills
    assert [outcome.figures[name] for name in (LOST, MISSING, OPEN)] == [0, 0, 0]
