"""Gateway as a separate process that a test kills: `python -m tests.fleet.gateway_process PORTS SPOOL EPOCH`.

It makes samples of one device at 1 kHz in real time and sends them with the real output. After each transaction, it
prints the newest number of each stream in the spool. After SIGTERM, it makes no more samples and prints the number of
waiting messages.
"""

import os
import signal
import sqlite3
import sys
import threading
import time
from functools import partial
from typing import Any

import msgspec

from imud.contracts.publisher import Batch
from imud.fleet.publisher import MqttPublisher
from imud.fleet.settings import MqttOptions
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS
from tests.support.publisher_context import publisher_context

TICK_S = 0.05
EVERY = {"*": {"whole": "slots", "rate_hz": 10, "batch_s": 0.2}}


def main(
    ports: str, spool: str, epoch: str, megabytes: str = "256", certificates: str = "", newest_seq: str = "0",
    statements: str = "0", name: str = "gw", version: str = "5",
) -> None:  # fmt: skip
    """Run until killed.

    `ports` are the ports of the brokers of a cluster, separated by commas. `certificates` is the folder of an
    `Authority`; empty: no TLS. `newest_seq` is the number before the first sample. With `statements`, the process kills
    itself before this statement inside a transaction. `version` is the version of MQTT.
    """
    if int(statements):
        die_at_statement(int(statements))
    scheme = "mqtts" if certificates else "mqtt"
    made: dict[str, object] = {
        "brokers": [f"{scheme}://127.0.0.1:{port}" for port in ports.split(",")], "gateway": name, "version": version,
        "spool_directory": spool, "retry_max_s": 1, "devices": EVERY, "spool_mb": float(megabytes),
    }  # fmt: skip
    if certificates:
        made |= {"ca_file": f"{certificates}/ca.pem", "cert_file": f"{certificates}/gateway.pem"}
        made |= {"key_file": f"{certificates}/gateway.key"}
    settings = msgspec.convert(made, MqttOptions)
    offset_ns = time.time_ns() - time.monotonic_ns()
    context = publisher_context(list, int(epoch), time.monotonic_ns, utc_offset_ns=lambda: offset_ns)
    output = MqttPublisher(settings, context)
    output.add_device("bow", 0)
    output.start()
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    seq, told = int(newest_seq), 0
    begin_ns = time.monotonic_ns() - seq * NS_PER_MS
    while True:
        samples = []
        while not ended.is_set() and begin_ns + seq * NS_PER_MS < time.monotonic_ns():
            seq += 1
            t_ns = begin_ns + seq * NS_PER_MS
            values = (seq * 0.37, seq / 7, 9.8)
            samples.append(Sample("bow", seq, t_ns, 0, Sync.EDGE, t_ns, t_ns + offset_ns, accel_m_s2=values))
        if samples:
            output.publish(Batch("bow", 0, samples))
        output.tick(time.monotonic_ns())
        status = output.status()
        if status.spooled != told or ended.is_set():
            told = status.spooled
            print(f"{status.waiting} {seq} {status.spool_bytes}", flush=True)
        time.sleep(TICK_S)


def die_at_statement(number: int) -> None:
    """Count the statements inside transactions of SQLite, and kill this process before one of them."""
    left = number
    connect = sqlite3.connect

    class Dying(sqlite3.Connection):
        def execute(self, *args: Any) -> sqlite3.Cursor:
            self._count()
            return super().execute(*args)

        def executemany(self, *args: Any) -> sqlite3.Cursor:
            self._count()
            return super().executemany(*args)

        def _count(self) -> None:
            nonlocal left
            left -= self.in_transaction
            if left <= 0:
                os.kill(os.getpid(), signal.SIGKILL)

    setattr(sqlite3, "connect", partial(connect, factory=Dying))  # noqa: B010 - its type has overloads


if __name__ == "__main__":
    main(*sys.argv[1:])
