"""Overview of a fleet: one row per gateway, and the text without gateways."""

from imud.cli.fleet import FleetOverview
from imud.fleet.accounts import GatewayState, StreamPosition
from imud.fleet.messages import FleetMessage, GatewayClock, Stream
from imud.fleet.reader import Fleet, FleetBatch
from imud.model.units import NS_PER_S
from tests.fleet.fleet_gateway import dropped_message, not_set, samples_message, synchronised


def made() -> Fleet:
    fleet = Fleet("mqtt://broker.example")
    positions = [StreamPosition("1", "bow", "samples", 1, 60)]
    fleet.states["mill", "gw"] = state = GatewayState(v=1, online=True, boot="1", devices=["bow"], positions=positions)
    fleet.states["mill", "old"] = GatewayState(v=1, online=False, boot="1", reason="connection lost")
    fleet._positions.take("gw", state)
    return fleet


def take(fleet: Fleet, overview: FleetOverview, message: FleetMessage) -> None:
    fresh = fleet.ledger.take(message, Stream.SAMPLES)
    assert fresh is not None
    overview.add(FleetBatch("mill", Stream.SAMPLES, fresh))


def test_a_row_for_each_gateway_those_that_are_away_first() -> None:
    fleet, now_ns = made(), [10 * NS_PER_S]
    utc_ns = samples_message(41, 50).utc_ns + 2 * NS_PER_S
    overview = FleetOverview(fleet, lambda: now_ns[0], lambda: utc_ns)
    take(fleet, overview, samples_message(1, 20))
    now_ns[0] += 4 * NS_PER_S
    take(fleet, overview, samples_message(21, 30))
    take(fleet, overview, dropped_message(31, 35))
    take(fleet, overview, samples_message(41, 50))
    found = [line.split() for line in overview.text().splitlines()]
    assert found[1] == ["mill/old", "connection", "lost", "0", "0.0", "0", "0", "0", "-", "-", "-"]
    assert found[2][:7] == ["mill/gw", "online", "1", "9.0", "5", "5", "10"]
    assert found[2][7] == "2.0"
    assert overview.text().splitlines()[-1] == "2 gateways, 1 away"
    now_ns[0] += 2 * NS_PER_S  # the first 20 are older than 5 s
    assert overview.text().splitlines()[2].split()[3] == "5.0"
    fleet.problem = "mqtt://broker.example:1883: the connection was lost"
    assert overview.text().endswith("2 gateways, 1 away; mqtt://broker.example:1883: the connection was lost")


def test_the_wall_clock_has_its_error_and_without_a_gateway_there_is_a_reason() -> None:
    fleet = made()
    overview = FleetOverview(fleet)

    def last() -> str:
        return overview.text().splitlines()[2].rpartition("  ")[2].strip()

    assert last() == "-", "a gateway of an earlier version does not say"
    clock = GatewayClock(0, 0, synchronised=False)
    fleet.states["mill", "gw"] = GatewayState(v=1, online=True, boot="1", clock=clock)
    assert last() == "not set"
    take(fleet, overview, synchronised(samples_message(1, 2), error_ns=123_456))
    assert last() == "0.123"
    take(fleet, overview, not_set(samples_message(3, 4)))
    assert last() == "not set"
    fleet = Fleet("mqtt://broker.example")
    assert FleetOverview(fleet).text() == "no gateway yet; connected"
    fleet.problem = "refused"
    assert FleetOverview(fleet).text() == "no gateway yet; refused"
