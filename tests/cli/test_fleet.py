"""`imud fleet collect --to -` with a real broker: lines, acknowledgements, ledger.
`imud fleet top` with a real broker: plain tables, a terminal, invalid arguments."""

import json
import os
import pty
import signal
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any
from unittest.mock import Mock

import pytest

from imud.cli.fleet import FleetOverview
from imud.fleet.accounts import GatewayState, StreamPosition
from imud.fleet.connection import FleetDelivery
from imud.fleet.messages import FleetMessage, GatewayClock, Stream
from imud.fleet.reader import Fleet, FleetBatch
from imud.model.units import NS_PER_S
from tests.cli.conftest import Cli, ImudProcess, imud_process
from tests.fleet.fleet_gateway import SendingGateway, dropped_message, not_set, samples_message, synchronised
from tests.fleet.mosquitto import Mosquitto

URL = "mqtt://127.0.0.1:{}"


def collecting(broker: Mosquitto) -> AbstractContextManager[ImudProcess]:
    return imud_process("fleet", "collect", URL.format(broker.port), "--to", "-")


def lines(process: ImudProcess, number: int) -> list[dict[str, Any]]:
    return [json.loads(process.out.readline()) for _ in range(number)]


@pytest.mark.live
def test_lines_come_and_the_ledger_is_printed_at_the_end(broker: Mosquitto) -> None:
    gateway = SendingGateway(broker.port)
    positions = [StreamPosition("1", "bow", "samples", 1, 9)]
    gateway.send_state(GatewayState(v=1, online=True, boot="1", positions=positions))
    with collecting(broker) as process:
        while not any("SUBSCRIBE" in line or "imud-reader-collector 1 imud" in line for line in broker.log):
            assert process.process.poll() is None
        gateway.send(samples_message(1, 2), dropped_message(3, 5))
        first, second, third = lines(process, 3)
        ledger = process.end(signal.SIGTERM).err
    gateway.close()
    assert (first["site"], first["gateway"], first["boot"], first["device"]) == ("mill", "gw", "1", "bow")
    assert (first["stream"], first["kind"], first["seq"]) == ("samples", "sample", 1)
    assert (first["accel_m_s2"], second["seq"]) == ([0.125, 0.0, 9.75], 2)
    assert (third["kind"], third["first"], third["last"], third["cause"]) == ("dropped", 3, 5, "space")
    assert ledger.splitlines()[-1].split() == ["gw", "1", "bow", "samples", "9", "2", "3", "space", "0", "4", "0"]


@pytest.mark.live
def test_what_was_not_acknowledged_by_a_killed_collector_comes_again(broker: Mosquitto) -> None:
    gateway = SendingGateway(broker.port)
    seen: set[int] = set()
    with collecting(broker) as process:
        gateway.send(samples_message(1, 1))
        while not any("imud-reader-collector 1 imud" in line for line in broker.log):
            assert process.process.poll() is None
        for round_ in range(20):
            gateway.send(samples_message(10 * round_ + 2, 10 * round_ + 11))
        seen.update(one["seq"] for one in lines(process, 30) if one["kind"] == "sample")
        process.process.kill()
        printed = [line for line in process.out if line.endswith("\n")]  # the acknowledged messages are among them
        seen.update(one["seq"] for one in map(json.loads, printed) if one["kind"] == "sample")
    gateway.send(samples_message(202, 211))
    with collecting(broker) as process:
        while 211 not in seen:
            seen.update(one["seq"] for one in lines(process, 1))
    gateway.close()
    assert seen >= set(range(2, 212))


def test_arguments_are_checked(cli: Cli) -> None:
    for words, problem in [
        (["collect", "mqtt://host", "--to", "elsewhere"], "--to: expected"),
        (["collect", "mqtt://host", "--to", "postgresql://127.0.0.1:1/a"], "PostgreSQL: "),
        (["collect", "mqtt://host", "--to", "postgres://127.0.0.1:1/a"], "PostgreSQL: "),
        (
            ["collect", "mqtt://host", "--to", "-", "--to-token-file", "t"],
            "--to-token-file, --to-ca-file: expected --to",
        ),
        (["collect", "mqtt://host", "--to", "postgresql:///a", "--to-ca-file", "t"], "--to-token-file, --to-ca-file: "),
        (["collect", "mqtt://host", "--to", "-", "--shares", "2"], "--config, --shares, --metrics: expected --to"),
        (["collect", "mqtt://host", "--to", "-", "--metrics", "127.0.0.1:0"], "--metrics: expected --to with a post"),
        (["collect", "mqtt://host", "--to", "postgresql:///a", "--metrics", "x"], "metrics: expected HOST:PORT"),
        (["collect", "mqtt://host", "--to", "postgresql:///a", "--shares", "65"], "--shares: expected 1 to 64, got 65"),
        (
            ["collect", "mqtt://host", "--to", "postgresql:///a", "--shares", "2", "--mqtt-version", "3.1.1"],
            "expected MQTT 5 for several shares, got MQTT 3.1.1",
        ),
        (["collect", "host", "--to", "-"], "expected a URL"),
        (["collect", "mqtt://host", "--to", "-", "--password-file", "f"], "add --user"),
        (["collect", "mqtt://host", "--to", "-", "--key-file", "f"], "add --cert-file"),
        (["top", "--plain", "http://host"], "expected a URL"),
        (["top", "--plain", "mqtt://host", "--interval", "0"], "--interval: expected 0.1 to 3600"),
        (["top", "--plain", "mqtt://host", "--gateway", "a/b"], "gateway: expected 1 to 64 letters"),
    ]:
        cli.refuses(problem, "fleet", *words)
    for command in ("fleet", "modbus"):
        cli.refuses("the following arguments are required: ACTION", command)


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
    assert (found[2][:7], found[2][7]) == (["mill/gw", "online", "1", "9.0", "5", "5", "10"], "2.0")
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


@pytest.fixture
def gateway(broker: Mosquitto) -> Iterator[tuple[Mosquitto, SendingGateway]]:
    made = SendingGateway(broker.port)
    made.send_state(GatewayState(v=1, online=True, boot="1", devices=["bow"]))
    yield broker, made
    made.close()


@pytest.mark.live
def test_tables_come_until_it_is_told_to_end(gateway: tuple[Mosquitto, SendingGateway]) -> None:
    broker, sender = gateway
    with imud_process("fleet", "top", URL.format(broker.port), "--plain", "--interval", "0.2") as process:
        first = 1
        for line in process.out:
            if line.startswith("mill/gw ") and line.split()[1:3] == ["online", "1"] and line.split()[3] != "0.0":
                break
            sender.send(samples_message(first, first + 4))
            first += 5
        assert process.end(signal.SIGTERM).err == ""


@pytest.mark.live
def test_on_a_terminal_the_picture_is_redrawn(gateway: tuple[Mosquitto, SendingGateway]) -> None:
    broker, _ = gateway
    master, slave = pty.openpty()
    words = ("fleet", "top", URL.format(broker.port), "--interval", "0.2")
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100", "LINES": "30"}
    with imud_process(*words, stdin=slave, stdout=slave, env=environment) as process:
        os.close(slave)
        shown = b""
        while b"mill/gw" not in shown or b"\x1b[?1049h" not in shown:  # switches to the alternate screen
            shown += os.read(master, 4096)
        process.process.send_signal(signal.SIGINT)
        while b"\x1b[?1049l" not in shown:
            shown += os.read(master, 4096)
        process.end()
    os.close(master)


@pytest.mark.live
def test_no_gateway_is_an_answer_of_no_and_the_reason_is_told(cli: Cli) -> None:
    printed = cli("fleet", "top", "mqtt://127.0.0.1:1", "--plain", "--interval", "0.2", "--duration", "1s", status=1)
    assert "no gateway yet; " in printed.out
    assert "the broker connection failed at the end: mqtt://127.0.0.1:1" in printed.err
    printed = cli("fleet", "collect", "mqtt://127.0.0.1:1", "--to", "-", "--duration", "0.1s", status=1)
    assert "the broker connection failed at the end: mqtt://127.0.0.1:1" in printed.err


class OverviewBench:
    """Overview of one gateway that sends its state each 5 s."""

    def __init__(self) -> None:
        self.now_ns = 100 * NS_PER_S
        self.utc_ns = 1_800_000_000 * NS_PER_S
        self.fleet = Fleet("mqtt://broker", now_ns=lambda: self.now_ns)
        self.overview = FleetOverview(self.fleet, lambda: self.now_ns, lambda: self.utc_ns)

    def advance(self, seconds: float) -> None:
        self.now_ns += round(seconds * NS_PER_S)
        self.utc_ns += round(seconds * NS_PER_S)

    def take_state(self, *, retain: bool, synchronised: bool = True, age_s: float = 0, **members: object) -> None:
        clock = {"t_ns": 0, "utc_offset_ns": self.utc_ns - round(age_s * NS_PER_S), "synchronised": synchronised}
        state = {"v": 1, "online": True, "boot": "1", "status_s": 5, "clock": clock, **members}
        self.fleet.take(FleetDelivery("imud/mill/gw/state", json.dumps(state).encode(), retain, 1, Mock()))

    @property
    def presence(self) -> str:
        return self.overview.text().splitlines()[1].split()[1]


@pytest.mark.parametrize(("retain", "synchronised"), [(True, True), (True, False), (False, False)])
def test_gateway_without_messages_is_silent(retain: bool, synchronised: bool) -> None:
    """A broker stores the state `online` of a gateway that lost its power together with the broker."""
    bench = OverviewBench()
    bench.take_state(retain=retain, synchronised=synchronised)
    assert bench.presence == "online"
    bench.advance(15)
    assert bench.presence == "online"
    bench.advance(1)
    assert bench.presence == "silent"
    bench.take_state(retain=True, synchronised=synchronised, age_s=31)
    assert bench.presence == "silent", "the broker sent the stored state again"
    bench.take_state(retain=False)
    assert bench.presence == "online"


def test_stored_state_of_an_old_gateway_is_silent() -> None:
    bench = OverviewBench()
    bench.take_state(retain=True, age_s=16)
    assert bench.presence == "silent"
    bench = OverviewBench()
    bench.take_state(retain=True, age_s=100, status_s=None)
    assert bench.presence == "online", "states of an older version arrive each 60 s"
    bench.advance(81)
    assert bench.presence == "silent"
