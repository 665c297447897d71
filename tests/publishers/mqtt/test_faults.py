"""A gateway that is killed, a broker that restarts, freezes or refuses: the collector's ledger closes every time.

The truth is the spool's own file: after the end of the gateway, what it stored is what the collector has or what still
waits. Samples of the last second of a gateway that is killed were never stored, and no number of theirs was given out.
"""

import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from imud.contracts.publisher import Batch, PublisherContext
from imud.formats.fleet.ledger import FleetLedger, StreamCounts
from imud.formats.fleet.messages import decode_message
from imud.formats.fleet.topics import Stream
from imud.host_clock import HostClock
from imud.publishers.mqtt.publisher import MqttPublisher
from imud.publishers.mqtt.settings import MqttSettings
from imud.publishers.mqtt.spool import Position, Spool, Spooled
from imud.sample import Sample, Sync
from imud.units import NS_PER_MS, NS_PER_S
from tests.publishers.mqtt.mosquitto import NO_MOSQUITTO, Collector, Mosquitto, free_port, running_broker

pytestmark = [pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO), pytest.mark.timeout(120)]


class LiveGateway:
    """The real output in this process; samples come when the test says so."""

    def __init__(self, folder: Path, port: int, **settings: object) -> None:
        self.host = HostClock()
        self.folder = folder
        made = {
            "brokers": [f"mqtt://127.0.0.1:{port}"], "gateway": "gw", "spool_directory": str(folder),
            "retry_max_s": 1, "keep_alive_s": 5, "devices": {"*": {"whole": "slots", "rate_hz": 10, "batch_s": 0.1}},
        }  # fmt: skip
        context = PublisherContext(list, 7, self.host.now_ns, utc_offset_ns=self.host.utc_offset_ns)
        self.output = MqttPublisher(msgspec.convert(made | settings, MqttSettings), context)
        self.output.add_device("bow", 0)
        self.output.start()
        self.seq = 0
        self.base_ns = self.host.now_ns() - 3600 * NS_PER_S

    def publish(self, count: int) -> None:
        """So many samples at once, stamped at 1 kHz."""
        samples = []
        for _ in range(count):
            self.seq += 1
            t_ns = self.base_ns + self.seq * NS_PER_MS
            samples.append(Sample("bow", self.seq, t_ns, 0, Sync.EDGE, t_ns, t_ns, accel_m_s2=(self.seq / 7, 0, 9.8)))
        self.output.publish(Batch("bow", 0, samples))

    def wait_for(self, true: Callable[[], bool], limit_s: float = 30.0) -> None:
        """Wait for the threads of the output."""
        end_ns, pause = self.host.now_ns() + round(limit_s * NS_PER_S), threading.Event()
        while not true():
            assert self.host.now_ns() < end_ns, self.output.status()
            self.output.tick(self.host.now_ns())
            pause.wait(0.02)


def in_spool(folder: Path) -> tuple[list[Spooled], list[Position]]:
    """What is in the spool of a gateway that has ended, and how far its streams came."""
    spool = Spool(folder, 1 << 40, 1 << 62)
    spool.open()
    found = spool.after(1_000_000), spool.positions()
    spool.close()
    return found


def closes(collector: Collector, folder: Path) -> dict[tuple[str, str], StreamCounts]:
    """Check: stored = received + still in the spool, by boot and stream; return the counts of the collector."""
    rows, positions = in_spool(folder)
    due = {(one.boot, one.stream): one.last for one in positions}
    for row in reversed(rows):
        due[row.boot, row.stream] = row.first - 1

    def has_come() -> bool:
        newest = {(key.boot, key.stream): one.newest for key, one in collector.ledger.counts.items()}
        return all(newest.get(key, 0) >= last for key, last in due.items())

    collector.wait_for(has_come)  # the broker acknowledges before it passes on
    collector.close()
    whole = FleetLedger(from_begin=True)
    for topic, payload in collector.messages:
        leaf = topic.rpartition("/")[2]
        if leaf in Stream.__members__.values():
            whole.take(decode_message(payload), Stream(leaf))
    for row in rows:
        whole.take(decode_message(row.payload), Stream(row.stream))
    counts = {(key.boot, key.stream): one for key, one in whole.counts.items()}
    assert {(one.boot, one.stream): one.last for one in positions} == {key: one.newest for key, one in counts.items()}
    for one in counts.values():
        assert (one.missing, one.balance) == (0, 0)
    return {(key.boot, key.stream): one for key, one in collector.ledger.counts.items()}


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


class KilledGateway:
    """`gateway_process`, which is killed."""

    def __init__(self, port: int, spool: Path, epoch: int, megabytes: float = 256) -> None:
        words = [str(port), str(spool), str(epoch), str(megabytes)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.publishers.mqtt.gateway_process", *words], stdout=subprocess.PIPE, text=True
        )

    def wait_until(self, waiting: int) -> None:
        """Until so many messages wait in its spool."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if int(line.split()[0]) >= waiting:
                return
        raise AssertionError("the gateway ended")

    def kill(self) -> None:
        """With SIGKILL."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(10)
        assert self.process.stdout is not None
        self.process.stdout.close()


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
