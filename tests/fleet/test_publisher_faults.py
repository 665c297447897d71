"""Killed gateways, and brokers that restart, freeze or refuse: the ledger of the collector balances.

The spool file is the reference. After the gateway ended, each stored number is in the collector or in the spool. A
killed gateway loses the samples in memory: samples of `batch_s` and samples since the last transaction. They have no
number in a stream.
"""

import os
from contextlib import closing, suppress
from pathlib import Path
from random import Random
from time import monotonic

import pytest

from imud.fleet.accounts import FleetLedger, StreamCounts
from imud.fleet.messages import Stream, decode_message
from imud.model.units import NS_PER_S
from tests.fleet.gateways import KilledGateway, LiveGateway, closes, in_spool
from tests.fleet.mosquitto import NO_MOSQUITTO, Collector, Mosquitto, running_broker
from tests.fleet.proxy import Proxy
from tests.support.daemon_process import LIMIT_S
from tests.support.surroundings import free_port

pytestmark = [pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO), pytest.mark.live]


BOOT = f"{7:016x}"


def finish(gateway: LiveGateway, collector: Collector) -> StreamCounts:
    """End the gateway. Check that no sample was lost. Return the counts of the samples."""

    def everything() -> bool:
        counts = {key.stream: one for key, one in collector.ledger.counts.items()}
        return "samples" in counts and counts["samples"].newest >= gateway.seq - 100

    collector.wait_for(everything)
    gateway.output.close()
    counts = closes(collector, gateway.folder)[BOOT, "samples"]
    assert (counts.missing, counts.dropped, counts.thinned) == (0, {}, 0)
    return counts


def test_a_restart_of_the_broker_loses_nothing(tmp_path: Path, broker: Mosquitto) -> None:
    collector, gateway = Collector(broker.port), LiveGateway(tmp_path / "spool", broker.port)
    for _ in range(3):
        gateway.publish(1000)
        gateway.wait_for(lambda: gateway.output.status().acknowledged > 0)
        broker.stop()
        gateway.publish(1000)
        gateway.wait_for(lambda: not gateway.output.status().broker)
        broker.start()
        gateway.wait_for(lambda: bool(gateway.output.status().broker))
    assert gateway.output.status().reconnects == 3
    finish(gateway, collector)


def test_a_restart_of_the_broker_with_shares_loses_nothing(
    tmp_path: Path, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a restart, mosquitto has the sessions, but no shared subscription until the collector subscribes again."""
    monkeypatch.setattr("imud.fleet.sender.UNCLAIMED_SKIP_NS", NS_PER_S // 10)
    collector = Collector(broker.port, "$share/fleet/imud/#")
    gateway = LiveGateway(tmp_path / "spool", broker.port)
    gateway.publish(1000)
    gateway.wait_for(lambda: gateway.output.status().acknowledged > 0)
    collector.subscribes_again = False
    broker.stop()
    broker.start()
    gateway.publish(1000)
    gateway.wait_for(lambda: "imud/default/gw/bow/samples" in gateway.output.status().refused)
    collector.subscribe()
    gateway.wait_for(lambda: not gateway.output.status().refused)
    assert finish(gateway, collector).newest >= 1900


def test_a_frozen_broker_is_replaced_without_loss(tmp_path: Path, broker: Mosquitto) -> None:
    collector, gateway = Collector(broker.port), LiveGateway(tmp_path / "spool", broker.port)
    gateway.publish(2000)
    gateway.wait_for(lambda: gateway.output.status().acknowledged > 0)
    broker.freeze()
    gateway.publish(5000)
    gateway.wait_for(lambda: not gateway.output.status().broker)
    assert gateway.output.status().problem
    broker.thaw()
    counts = finish(gateway, collector)
    assert counts.newest >= 6900


def test_refused_messages_are_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.topics.SKIP_NS", 1)
    rights = tmp_path / "rights"
    rights.write_text("topic read #\ntopic write imud/default/gw/state\n")
    port = free_port()
    with running_broker(tmp_path / "broker", "allow_anonymous true", f"acl_file {rights}", port=port) as broker:
        collector, gateway = Collector(port), LiveGateway(tmp_path / "spool", port)
        gateway.publish(3000)
        gateway.wait_for(lambda: "imud/default/gw/bow/samples" in gateway.output.status().refused)
        rights.write_text("topic readwrite #\n")
        broker.reload()
        assert finish(gateway, collector).newest >= 2900


def test_the_ledger_balances_after_a_kill_with_a_full_spool(tmp_path: Path) -> None:
    port, spool = free_port(), tmp_path / "spool"
    live = LiveGateway(spool, port, spool_mb=1)
    for number in range(1, 6):
        live.publish(15_000)
        live.wait_for(lambda least=300 * number - 10: live.output.status().spooled >= least)  # type: ignore[misc]
    live.wait_for(lambda: live.output.status().thinned > 0)
    live.output.close()
    gateway = KilledGateway(port, spool, 8, megabytes=1)
    gateway.wait_until(1)
    gateway.kill()
    with running_broker(tmp_path / "broker", port=port):
        collector, gateway = Collector(port), KilledGateway(port, spool, 9, megabytes=1)
        collector.wait_for(lambda: any(key.boot == f"{9:016x}" for key in collector.ledger.counts))
        gateway.kill()
        counts = closes(collector, spool)
    one = counts[BOOT, "samples"]
    assert one.thinned > 0
    assert (one.newest, one.missing, one.balance) == (75_000, 0, 0)


KILLS = int(os.environ.get("IMUD_KILLS", "4"))  # Number of kills, about 3 s each. Use 20 or more for a long test.


class Killings:
    """Sequence of gateways that are killed at a random time or before a random statement of a transaction."""

    def __init__(self, port: int, spool: Path, seed: int) -> None:
        self.told: dict[int, list[int]] = {}  # newest sample of each reported transaction, by epoch
        self._port, self._spool, self._random = port, spool, Random(seed)

    def kill_one(self, epoch: int, *, in_commit: bool, newest_seq: int = 0) -> None:
        """Start a gateway and kill it within 1.5 s after its first report, or inside a transaction."""
        statements = self._random.randint(STATEMENTS, 4 * STATEMENTS) if in_commit else 0
        gateway = KilledGateway(self._port, self._spool, epoch, newest_seq=newest_seq, statements=statements)
        state = gateway.state(LIMIT_S)
        end_s = monotonic() + (LIMIT_S if in_commit else self._random.uniform(0.0, 1.5))
        with suppress(AssertionError):  # the gateway ended
            while state is not None:
                self.told.setdefault(epoch, []).append(state.seq)
                state = gateway.state(max(0.0, end_s - monotonic()))
        assert not in_commit or gateway.process.wait(LIMIT_S) < 0
        gateway.kill()


STATEMENTS = 12  # approximate number of statements in one transaction
BATCH_SAMPLES = 200  # samples of `batch_s` (0.2 s) at 1 kHz that wait for their message


def test_a_kill_loses_only_the_samples_in_memory(tmp_path: Path) -> None:
    port, spool = free_port(), tmp_path / "spool"
    with running_broker(tmp_path / "broker", port=port):
        collector, killings = Collector(port), Killings(port, spool, seed=16)
        for epoch in range(1, KILLS + 1):
            killings.kill_one(epoch, in_commit=bool(epoch % 2))
        counts = closes(collector, spool)
    _, positions = in_spool(spool)
    stored = {one.boot: one.last for one in positions if one.stream == "samples"}
    for epoch, told in killings.told.items():
        boot = f"{epoch:016x}"
        # a transaction contains the samples before its start, and starts after the last report but one
        assert stored[boot] >= max([1, *(seq - BATCH_SAMPLES for seq in told[:-2])]), f"boot {epoch}"
        one = counts.get((boot, "samples"))
        if one is not None:  # the received numbers have no gap; the other numbers are in the spool
            assert (one.missing, one.dropped, one.thinned, one.balance) == (0, {}, 0, 0)
    assert len(stored) == KILLS


def test_a_kill_within_one_boot_shows_the_loss_as_a_gap(tmp_path: Path) -> None:
    port, spool = free_port(), tmp_path / "spool"
    begun = 0
    with running_broker(tmp_path / "broker", port=port):
        collector, killings = Collector(port), Killings(port, spool, seed=17)
        for number in range(KILLS):
            killings.kill_one(7, in_commit=bool(number % 2), newest_seq=begun)
            # more than the gateway can have stored without a report
            begun = max([begun, *killings.told.get(7, [])]) + 10_000
        rows, positions = in_spool(spool)
        closes(collector, spool)
    whole = FleetLedger(from_begin=True)
    came = [payload for topic, payload in collector.messages if topic.endswith("/samples")]
    for payload in (*came, *(row.payload for row in rows if row.stream == Stream.SAMPLES)):
        whole.take(decode_message(payload), Stream.SAMPLES)
    (one,) = whole.counts.values()
    (last,) = [position.last for position in positions if position.stream == "samples"]
    assert ((one.newest, one.missing, one.balance), set(one.dropped)) == ((last, 0, 0), {"off"})
    assert one.dropped["off"] > (KILLS - 2) * 5000  # the last gateway may have stored nothing


def test_a_slow_network_neither_blocks_nor_loses_samples(tmp_path: Path, broker: Mosquitto) -> None:
    with closing(Proxy(broker.port)) as proxy:
        collector, gateway = Collector(broker.port), LiveGateway(tmp_path / "spool", proxy.port)
        proxy.bytes_s = 20_000
        gateway.publish(5000)
        gateway.wait_for(lambda: (now := gateway.output.status()).waiting > 20 and bool(now.broker))
        proxy.bytes_s = None
        assert finish(gateway, collector).newest >= 4900
