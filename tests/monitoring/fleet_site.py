"""A small fleet for alerts: a real broker, a real PostgreSQL, collector processes, and gateways with faults.

    FleetGateways (a thread) ──MQTT──▶ mosquitto ──▶ two collectors ──▶ PostgreSQL
                                                          └──▶ metrics

The gateways are messages of one MQTT client. All other parts are real processes.
"""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import msgspec

from imud.fleet.accounts import GatewayState, StreamPosition
from imud.fleet.messages import STATE, FleetMessage, GatewayClock, Stream, encode_message, topic_of
from tests.fleet.fleet_gateway import dropped_message, intervals_message, samples_message
from tests.fleet.mosquitto import running_broker
from tests.fleet.postgres_server import running_server
from tests.support.daemon_process import LIMIT_S
from tests.support.surroundings import free_port

STEP_S: Final = 0.2
SILENT_S: Final = 3
# A collector that reads the metrics of the fleet from the database at each scrape
COLLECT: Final = (
    "import sys, imud.cli; from imud.fleet.metrics_server import FleetGauges; "
    "FleetGauges.__init__.__kwdefaults__['refresh_s'] = 0; sys.exit(imud.cli.main())"
)
BOOT: Final = "00000000000000a1"


class FaultyGateway:
    """Messages of one gateway. Synchronization: the feeder's thread; other threads set the faults."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.silent = self.offline = self.dropping = self.skipping = self.spooling = False
        self.clock_set, self.version = True, "1.2.0"
        self._newest = 0  # newest sent number
        self._numbered = 0  # newest number with the numbers in the spool

    def step(self) -> Iterator[tuple[str, bytes, bool]]:
        """Yield topic, payload and `retain` of the next messages."""
        if not self.silent and not self.offline:
            for message in self._messages():
                yield topic_of("mill", self.name, "bow", Stream.SAMPLES), encode_message(message), False
        now_ns = time.monotonic_ns()
        clock = GatewayClock(now_ns, time.time_ns() - now_ns, synchronised=self.clock_set, error_ns=1000)
        state = GatewayState(
            v=1, online=not self.offline, boot=BOOT, imud=self.version, devices=["bow"], clock=clock,
            reason="connection lost" if self.offline else "",
            positions=[StreamPosition(BOOT, "bow", "samples", 1, max(self._newest, self._numbered))],
        )  # fmt: skip
        yield topic_of("mill", self.name, "", STATE), msgspec.json.encode(state), True

    def _messages(self) -> Iterator[FleetMessage]:
        if self.spooling:
            self._numbered = max(self._numbered, self._newest) + 1000
        elif self._numbered > self._newest:  # the spool is sent as statistics
            made = intervals_message(self._newest + 1, self._numbered, boot=BOOT)
            yield msgspec.structs.replace(made, gateway=self.name)
            self._newest = self._numbered
        self._newest += 1 + self.skipping
        kind = dropped_message if self.dropping else samples_message
        yield kind(self._newest, self._newest, gateway=self.name, boot=BOOT)


class FleetGateways:
    """Thread that publishes the messages of all gateways until `close`."""

    def __init__(self, port: int, names: tuple[str, ...]) -> None:
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion

        self.all = {name: FaultyGateway(name) for name in names}
        self.garbage = False
        self._client: Any = Client(CallbackAPIVersion.VERSION2, "gateways", protocol=MQTTv5)
        self._client.reconnect_delay_set(1, 1)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._feed, name="gateways")
        self._thread.start()

    def _feed(self) -> None:
        while not self._ended.wait(STEP_S):
            for gateway in self.all.values():
                for topic, payload, retain in gateway.step():
                    self._client.publish(topic, payload, qos=1, retain=retain)
            if self.garbage:
                self._client.publish(topic_of("mill", "steady", "bow", Stream.SAMPLES), b"garbage", qos=1)

    def close(self) -> None:
        self._ended.set()
        self._thread.join(LIMIT_S)
        self._client.disconnect()
        self._client.loop_stop()


class CollectorProcess:
    """`imud fleet collect` in a process that a test kills."""

    def __init__(self, folder: Path, broker: int, store: str) -> None:
        self.port = free_port()
        self._folder, self._broker, self._store = folder, broker, store
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        config = self._folder / "collector.yaml"
        config.write_text(f"silent_s: {SILENT_S}\nshares: 2\n")
        argv = [
            sys.executable, "-c", COLLECT, "fleet", "collect", f"mqtt://127.0.0.1:{self._broker}", "--to", self._store,
            "--config", str(config), "--metrics", f"127.0.0.1:{self.port}",
        ]  # fmt: skip
        with (self._folder / "collector.log").open("ab") as log:
            self._process = subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def kill(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait(LIMIT_S)


class FleetSite:
    """All parts of the fleet. Synchronization: the test's thread."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.broker = stack.enter_context(running_broker(folder / "broker"))
        self.database = stack.enter_context(running_server())
        self.collectors = [CollectorProcess(folder, self.broker.port, self.database.url) for _ in range(2)]
        for one in self.collectors:
            one.start()
            stack.callback(one.kill)
        names = ("steady", "silent", "gone", "dropping", "skipping", "spooling", "unset", "old")
        self.gateways = FleetGateways(self.broker.port, names)
        stack.callback(self.gateways.close)

    @property
    def ports(self) -> tuple[int, ...]:
        return tuple(one.port for one in self.collectors)

    def set_faults(self, *, faulty: bool) -> None:
        """Begin or end the faults of the gateways."""
        all_ = self.gateways.all
        all_["silent"].silent = all_["gone"].offline = faulty
        all_["dropping"].dropping = all_["skipping"].skipping = all_["spooling"].spooling = faulty
        all_["unset"].clock_set, all_["old"].version = not faulty, "1.1.0" if faulty else "1.2.0"
        self.gateways.garbage = faulty

    @contextmanager
    def locked_ledger(self) -> Iterator[None]:
        """Lock the table of the ledger, so that no transaction of a collector ends."""
        import psycopg

        with psycopg.connect(self.database.url) as connection:
            connection.execute("LOCK TABLE imud_ledger IN EXCLUSIVE MODE")
            yield


@contextmanager
def fleet_site(folder: Path) -> Iterator[FleetSite]:
    folder.mkdir()
    with ExitStack() as stack:
        yield FleetSite(folder, stack)
