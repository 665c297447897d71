"""Gateways with a real broker, in this process or in a process that a test kills, and the check of their ledger."""

import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic
from typing import NamedTuple

import msgspec

from imud.contracts.publisher import Batch
from imud.fleet.accounts import FleetLedger, StreamCounts, StreamPosition
from imud.fleet.messages import Stream, decode_message
from imud.fleet.publisher import MqttPublisher
from imud.fleet.settings import MqttOptions
from imud.fleet.spool import Spool, SpoolRow
from imud.host.clock import HostClock
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.fleet.authority import Authority
from tests.fleet.mosquitto import Collector
from tests.support.daemon_process import LIMIT_S
from tests.support.publisher_context import publisher_context


class LiveGateway:
    def __init__(self, folder: Path, port: int, **settings: object) -> None:
        self.host = HostClock()
        self.folder = folder
        made = {
            "brokers": [f"mqtt://127.0.0.1:{port}"], "gateway": "gw", "spool_directory": str(folder),
            "retry_max_s": 1, "keep_alive_s": 5, "devices": {"*": {"whole": "slots", "rate_hz": 10, "batch_s": 0.1}},
        }  # fmt: skip
        context = publisher_context(list, 7, self.host.now_ns, utc_offset_ns=self.host.utc_offset_ns)
        self.output = MqttPublisher(msgspec.convert(made | settings, MqttOptions), context)
        self.output.add_device("bow", 0)
        self.output.start()
        self.seq = 0
        self.base_ns = self.host.now_ns() - 3600 * NS_PER_S

    def publish(self, count: int) -> None:
        """Publish `count` samples with time stamps at 1 kHz."""
        samples = []
        for _ in range(count):
            self.seq += 1
            t_ns = self.base_ns + self.seq * NS_PER_MS
            samples.append(Sample("bow", self.seq, t_ns, 0, Sync.EDGE, t_ns, t_ns, accel_m_s2=(self.seq / 7, 0, 9.8)))
        self.output.publish(Batch("bow", 0, samples))

    def wait_for(self, true: Callable[[], bool], limit_s: float = LIMIT_S) -> None:
        end_ns, pause = self.host.now_ns() + round(limit_s * NS_PER_S), threading.Event()
        while not true():
            assert self.host.now_ns() < end_ns, self.output.status()
            self.output.tick(self.host.now_ns())
            pause.wait(0.02)


def in_spool(folder: Path) -> tuple[list[SpoolRow], list[StreamPosition]]:
    """Return the messages and the positions in the spool of an ended gateway."""
    spool = Spool(folder, 1 << 40, 1 << 62)
    spool.open()
    found = spool.after(1_000_000), spool.positions()
    spool.close()
    return found


def closes(collector: Collector, folder: Path) -> dict[tuple[str, str], StreamCounts]:
    """Check that stored = received + in the spool, by boot and stream. Return the counts of the collector."""
    rows, positions = in_spool(folder)
    due = {(one.boot, one.stream): one.last for one in positions}
    for row in reversed(rows):
        due[row.boot, row.stream] = row.first - 1

    def has_come() -> bool:
        newest = {(key.boot, key.stream): one.newest for key, one in collector.ledger.counts.items()}
        return all(newest.get(key, 0) >= last for key, last in due.items())

    collector.wait_for(has_come)  # the broker acknowledges a message before it delivers the message
    collector.close()
    whole = FleetLedger(from_begin=True)
    for topic, payload in collector.messages:
        leaf = topic.rpartition("/")[2]
        if leaf in Stream.__members__.values():
            whole.take(decode_message(payload), Stream(leaf))
    for row in rows:
        whole.take(decode_message(row.payload), Stream(row.stream))
    counts = {(key.boot, key.stream): one for key, one in whole.counts.items()}
    numbered = {(one.boot, one.stream): one.last for one in positions}
    newest = {key: one.newest for key, one in counts.items()}
    assert numbered == newest, f"numbered {numbered}, received {newest}"
    for key, one in counts.items():
        assert (one.missing, one.balance) == (0, 0), f"{key}: {one}"
    return {(key.boot, key.stream): one for key, one in collector.ledger.counts.items()}


class GatewayState(NamedTuple):
    """Report of a gateway process after each transaction."""

    waiting: int  # number of messages in its spool
    seq: int  # `seq` of its newest sample
    spool_bytes: int


class KilledGateway:
    """Process of `gateway_process`. The test kills it."""

    def __init__(
        self, port: int | Sequence[int], spool: Path, epoch: int, megabytes: float = 256,
        authority: Authority | None = None, newest_seq: int = 0, statements: int = 0, name: str = "gw",
        version: str = "5",
    ) -> None:  # fmt: skip
        """Start the process. See `gateway_process.main` for the arguments."""
        self._read = b""
        ports = ",".join(map(str, [port] if isinstance(port, int) else port))
        words = [ports, str(spool), str(epoch), str(megabytes), str(authority.folder) if authority else ""]
        words += [str(newest_seq), str(statements), name, version]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.fleet.gateway_process", *words], stdout=subprocess.PIPE, bufsize=0
        )

    def wait_until(self, waiting: int) -> None:
        while (state := self.state(LIMIT_S)) is None or state.waiting < waiting:
            pass

    def state(self, limit_s: float) -> GatewayState | None:
        """Return the next report; None after the time limit. Raises AssertionError if the process ended."""
        assert self.process.stdout is not None
        if b"\n" not in self._read:
            if not select.select([self.process.stdout], [], [], limit_s)[0]:
                return None
            piece = os.read(self.process.stdout.fileno(), 4096)
            assert piece, "the gateway ended"
            self._read += piece
        line, found, rest = self._read.partition(b"\n")
        if not found:
            return None
        self._read = rest
        return GatewayState(*map(int, line.split()))

    def drain(self, limit_s: float) -> bool:
        """Stop making samples and wait until all are sent. Return whether the spool is empty."""
        self.process.send_signal(signal.SIGTERM)
        end_s, waiting = monotonic() + limit_s, 1
        while waiting and monotonic() < end_s:
            state = self.state(max(0.0, end_s - monotonic()))
            waiting = waiting if state is None else state.waiting
        return not waiting

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(LIMIT_S)
        assert self.process.stdout is not None
        self.process.stdout.close()
