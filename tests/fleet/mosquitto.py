"""Real broker on loopback (mosquitto of Debian), and a collector with a session.

The collector is a client of paho-mqtt in a thread. Its session outlives a restart of the broker, which stores messages
in the meantime. mosquitto reports on standard error that it listens, so the tests need no sleep.
"""

import gc
import os
import shutil
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from imud.fleet.accounts import FleetLedger
from imud.fleet.messages import FleetMessage, Stream, decode_message, parse_topic
from tests.support.daemon_process import LIMIT_S
from tests.support.surroundings import free_port

PROGRAM: Final = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin:/sbin")
NO_MOSQUITTO: Final = "" if PROGRAM else "mosquitto is not installed (make mqtt-deps)"
RUNNING: Final = " running"  # end of the line that mosquitto writes when it listens


class Mosquitto:
    """Broker process. `lines` are added to its configuration."""

    def __init__(self, folder: Path, lines: Sequence[str] = ("allow_anonymous true",), port: int | None = None) -> None:
        self.folder, self.lines = folder, tuple(lines)
        self.port = port or free_port()
        self.log: list[str] = []
        self._process: subprocess.Popen[str] | None = None
        self._reader: threading.Thread | None = None

    def start(self) -> None:
        assert PROGRAM is not None
        own = os.geteuid() == 0
        config = self.folder / "mosquitto.conf"
        lines = (
            "per_listener_settings false", f"listener {self.port} 127.0.0.1", "persistence true",
            f"persistence_location {self.folder}/", "max_queued_messages 0", "log_dest stderr",
            *(() if any(line.startswith("log_type") for line in self.lines) else ("log_type all",)),
            *(("user root",) if own else ()), *self.lines, "",
        )  # fmt: skip
        config.write_text("\n".join(lines))
        self._process = subprocess.Popen(
            [PROGRAM, "-c", str(config)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        running = threading.Event()
        self._reader = threading.Thread(target=self._read, args=(self._process, running), daemon=True)
        self._reader.start()
        assert running.wait(LIMIT_S), "\n".join(self.log)
        assert any(line.endswith(RUNNING) for line in self.log), "\n".join(self.log)

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def _read(self, process: "subprocess.Popen[str]", running: threading.Event) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self.log.append(line.rstrip())
            if line.rstrip().endswith(RUNNING):
                running.set()
        running.set()  # the broker ended, perhaps before it listened

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Stop the broker. With SIGTERM it stores sessions. Do nothing if it does not run."""
        process, self._process = self._process, None
        if process is not None:
            process.send_signal(signal.SIGCONT)
            process.send_signal(number)
            process.wait(LIMIT_S)
            assert self._reader is not None
            self._reader.join(LIMIT_S)
            assert process.stdout is not None
            process.stdout.close()

    def reload(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGHUP)

    def freeze(self) -> None:
        """Stop the process with SIGSTOP: the connections stay open without replies."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)


@contextmanager
def running_broker(folder: Path, *lines: str, port: int | None = None) -> Iterator[Mosquitto]:
    """Run a broker during the block. Without `lines` it accepts every client."""
    folder.mkdir(exist_ok=True)
    broker = Mosquitto(folder, lines or ("allow_anonymous true",), port)
    broker.start()
    try:
        yield broker
    finally:
        broker.stop()


class Collector:
    """Reader of all gateways with its ledger. Synchronization: the test's thread may call `wait_for`."""

    def __init__(self, port: int, topic: str = "imud/#", prepare: Callable[[Any], None] = lambda client: None) -> None:
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        self.ledger = FleetLedger(from_begin=True)
        self.messages: list[tuple[str, bytes]] = []  # all received messages in their order
        self.fresh: list[FleetMessage] = []  # received messages of streams without duplicates
        self.subscribes_again = True  # whether the collector subscribes at each connection
        self._changed = threading.Condition()
        self._topic = topic
        self._client = Client(CallbackAPIVersion.VERSION2, "collector", protocol=MQTTv5)
        self._client.on_connect, self._client.on_message = self._on_connect, self._on_message
        self._subscribed = threading.Event()
        self._client.on_subscribe = lambda *_: self._subscribed.set()
        self._client.reconnect_delay_set(1, 1)
        prepare(self._client)
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]  # the library has no types here
        properties.SessionExpiryInterval = 3600
        self._client.connect("127.0.0.1", port, clean_start=False, properties=properties)
        self._client.loop_start()
        assert self._subscribed.wait(LIMIT_S)

    def _on_connect(self, client: Any, *_: object) -> None:
        if self.subscribes_again:
            client.subscribe(self._topic, qos=1)

    def _on_message(self, _client: object, _data: object, message: Any) -> None:
        with self._changed:
            self.messages.append((message.topic, message.payload))
            parts = parse_topic(message.topic)
            assert parts is not None, message.topic
            if parts.leaf in Stream.__members__.values():
                fresh = self.ledger.take(decode_message(message.payload), Stream(parts.leaf))
                if fresh is not None:
                    self.fresh.append(fresh)
            self._changed.notify_all()

    def wait_for(self, true: Callable[[], bool], limit_s: float = LIMIT_S) -> None:
        """Wait until `true` returns True. Check it after each message."""
        with self._changed:
            assert self._changed.wait_for(true, limit_s), self.ledger.counts

    def subscribe(self) -> None:
        """Subscribe now and at each connection."""
        self.subscribes_again = True
        self._client.subscribe(self._topic, qos=1)

    def close(self) -> None:
        if not hasattr(self, "_client"):
            return  # `closes` (gateways.py) has closed it
        self._client.disconnect()
        self._client.loop_stop()
        del self._client  # only its destructor closes the socket pair of its thread
        gc.collect()
