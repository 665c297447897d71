"""A gateway that is killed, a broker that restarts, freezes or refuses: the collector's ledger closes every time.

The truth is the spool's own file: after the end of the gateway, what it stored is what the collector has or what still
waits. What a gateway that is killed had in memory, samples of `batch_s` and what came since the last transaction, was never
stored, and no number of theirs was given out.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from imud.formats.fleet.ledger import StreamCounts
from tests.publishers.mqtt.gateways import KilledGateway, LiveGateway, closes, in_spool
from tests.publishers.mqtt.mosquitto import NO_MOSQUITTO, Collector, Mosquitto, free_port, running_broker
from tests.publishers.mqtt.proxy import Proxy

pytestmark = [pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO), pytest.mark.timeout(120)]


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    with running_broker(tmp_path / "broker") as made:
        yield made


BOOT = f"{7:016x}"


def finish(gateway: LiveGateway, collector: Collector) -> StreamCounts:
    """Let all arrive, end, and check."""

    def everything() -> bool:
        counts = {key.stream: one for key, one in collector.ledger.counts.items()}
        return "samples" in counts and counts["samples"].newest >= gateway.seq - 100

    collector.wait_for(everything)
    gateway.output.close()
    counts = closes(collector, gateway.folder)[BOOT, "samples"]
    assert (counts.missing, counts.dropped, counts.thinned) == (0, {}, 0)
    return counts


def test_a_restart_of_the_broker_loses_nothing(tmp_path: Path, broker: Mosquitto) -> None:
    collector = Collector(broker.port)
    gateway = LiveGateway(tmp_path / "spool", broker.port)
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


def test_a_broker_that_freezes_is_left_and_loses_nothing(tmp_path: Path, broker: Mosquitto) -> None:
    collector = Collector(broker.port)
    gateway = LiveGateway(tmp_path / "spool", broker.port)
    gateway.publish(2000)
    gateway.wait_for(lambda: gateway.output.status().acknowledged > 0)
    broker.freeze()
    gateway.publish(5000)
    gateway.wait_for(lambda: not gateway.output.status().broker)
    assert gateway.output.status().problem
    broker.thaw()
    counts = finish(gateway, collector)
    assert counts.newest >= 6900


def test_the_next_broker_takes_over(tmp_path: Path, broker: Mosquitto) -> None:
    collector = Collector(broker.port)
    urls = [f"mqtt://127.0.0.1:{free_port()}", f"mqtt://127.0.0.1:{broker.port}"]
    gateway = LiveGateway(tmp_path / "spool", broker.port, brokers=urls)
    gateway.publish(1500)
    gateway.wait_for(lambda: gateway.output.status().broker == urls[1])
    finish(gateway, collector)


def test_a_broker_that_refuses_messages_loses_nothing(tmp_path: Path) -> None:
    rights = tmp_path / "rights"
    rights.write_text("topic read #\ntopic write imud/default/gw/state\n")
    port = free_port()
    with running_broker(tmp_path / "broker", "allow_anonymous true", f"acl_file {rights}", port=port) as broker:
        collector = Collector(port)
        gateway = LiveGateway(tmp_path / "spool", port)
        gateway.publish(3000)
        gateway.wait_for(lambda: "refuses messages of imud/default/gw/bow/" in gateway.output.status().problem)
        rights.write_text("topic readwrite #\n")
        broker.reload()
        finish(gateway, collector)


def test_kill_9_with_a_spool_that_fills_loses_nothing(tmp_path: Path) -> None:
    port, spool = free_port(), tmp_path / "spool"
    for epoch in (1, 2):
        gateway = KilledGateway(port, spool, epoch)
        gateway.wait_until(25 * epoch)
        gateway.kill()
    rows, _ = in_spool(spool)
    assert len(rows) >= 50
    with running_broker(tmp_path / "broker", port=port):
        collector = Collector(port)
        for epoch in (3, 4):
            gateway = KilledGateway(port, spool, epoch)
            boot = f"{epoch:016x}"
            collector.wait_for(
                lambda boot=boot: any(key.boot == boot for key in collector.ledger.counts), 40.0  # type: ignore[misc]
            )  # fmt: skip
            gateway.kill()
        counts = closes(collector, spool)
    for epoch in (1, 2, 3):
        for stream in ("samples", "statistics"):
            one = counts[f"{epoch:016x}", stream]
            assert one.whole > 0
            assert (one.missing, one.dropped, one.thinned, one.balance) == (0, {}, 0, 0)


def test_kill_9_while_the_spool_is_full_closes_with_what_was_thinned(tmp_path: Path) -> None:
    port, spool = free_port(), tmp_path / "spool"
    live = LiveGateway(spool, port, spool_mb=1)
    for number in range(1, 13):
        live.publish(15_000)
        live.wait_for(lambda least=300 * number - 10: live.output.status().spooled >= least, 60.0)  # type: ignore[misc]
    live.wait_for(lambda: live.output.status().thinned > 0)
    live.output.close()
    gateway = KilledGateway(port, spool, 8, megabytes=1)
    gateway.wait_until(1)
    gateway.kill()
    with running_broker(tmp_path / "broker", port=port):
        collector = Collector(port)
        gateway = KilledGateway(port, spool, 9, megabytes=1)
        collector.wait_for(lambda: any(key.boot == f"{9:016x}" for key in collector.ledger.counts), 60.0)
        gateway.kill()
        counts = closes(collector, spool)
    one = counts[BOOT, "samples"]
    assert one.thinned > 0
    assert (one.newest, one.missing, one.balance) == (180_000, 0, 0)


@pytest.fixture
def proxy(broker: Mosquitto) -> Iterator[Proxy]:
    made = Proxy(broker.port)
    yield made
    made.close()


def test_a_half_open_connection_is_noticed_and_loses_nothing(tmp_path: Path, broker: Mosquitto, proxy: Proxy) -> None:
    collector = Collector(broker.port)
    gateway = LiveGateway(tmp_path / "spool", proxy.port)
    gateway.publish(2000)
    gateway.wait_for(lambda: gateway.output.status().acknowledged > 0)
    proxy.stall()
    gateway.publish(3000)
    gateway.wait_for(lambda: not gateway.output.status().broker)
    assert gateway.output.status().problem
    proxy.restore()
    assert finish(gateway, collector).newest >= 4900
    assert proxy.connections >= 2


def test_a_network_that_is_cut_again_and_again_loses_nothing(tmp_path: Path, broker: Mosquitto, proxy: Proxy) -> None:
    collector = Collector(broker.port)
    gateway = LiveGateway(tmp_path / "spool", proxy.port)
    for number in range(1, 4):
        gateway.publish(1000)
        gateway.wait_for(lambda least=number: gateway.output.status().acknowledged >= least)  # type: ignore[misc]
        proxy.cut()
        gateway.publish(1000)
        gateway.wait_for(lambda: not gateway.output.status().broker)
        proxy.restore()
        gateway.wait_for(lambda: bool(gateway.output.status().broker))
    assert gateway.output.status().reconnects >= 3
    finish(gateway, collector)


def test_a_slow_network_holds_up_nothing_and_loses_nothing(tmp_path: Path, broker: Mosquitto, proxy: Proxy) -> None:
    collector = Collector(broker.port)
    gateway = LiveGateway(tmp_path / "spool", proxy.port)
    proxy.bytes_s = 20_000
    gateway.publish(5000)
    gateway.wait_for(lambda: gateway.output.status().waiting > 20)
    assert gateway.output.status().broker, "slow is not gone"
    proxy.bytes_s = None
    finish(gateway, collector)
