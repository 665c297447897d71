"""Real cluster of NATS servers with JetStream and MQTT 3.1.1 on loopback. A test can kill and start each server."""

import json
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final
from urllib.request import urlopen

from tests.support.daemon_process import LIMIT_S, wait_until
from tests.support.surroundings import free_port

PROGRAM: Final = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin:/sbin")
NO_NATS: Final = "" if PROGRAM else "nats-server is not installed (make mqtt-deps)"
# Version 2.9.10 of Debian 12 can skip messages of a session after SIGKILL: they stay in the stream and do not arrive.
RELIABLE: Final = (2, 10)
SERVERS: Final = 3
MESSAGES: Final = "$MQTT_msgs"  # stream of the messages with QoS 1


def program_version() -> str:
    """Return the version of the server, for example 2.10.27."""
    assert PROGRAM is not None
    done = subprocess.run([PROGRAM, "--version"], capture_output=True, text=True, check=True, timeout=LIMIT_S)
    return done.stdout.rpartition("v")[2].strip()


def is_reliable() -> bool:
    """Return whether a session of this version survives SIGKILL of a server."""
    return tuple(map(int, program_version().split(".")[:2])) >= RELIABLE


class NatsCluster:
    """Processes of the servers. Synchronization: one thread."""

    def __init__(self, folder: Path, mqtt: str = "", jetstream: str = "") -> None:
        """`mqtt` and `jetstream` are further lines of these sections of the configuration."""
        self.ports, self._monitors, routes = ([free_port() for _ in range(SERVERS)] for _ in range(3))
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._configurations = [folder / f"nats-{at}.conf" for at in range(SERVERS)]
        self.stores = [folder / f"store-{at}" for at in range(SERVERS)]
        others = ", ".join(f'"nats://127.0.0.1:{route}"' for route in routes)
        for at, configuration in enumerate(self._configurations):
            configuration.write_text(f"""server_name: n{at}
listen: "127.0.0.1:{free_port()}"
http: "127.0.0.1:{self._monitors[at]}"
jetstream {{ store_dir: "{self.stores[at]}"
{jetstream} }}
cluster {{ name: fleet, listen: "127.0.0.1:{routes[at]}", routes: [{others}] }}
mqtt {{ listen: "127.0.0.1:{self.ports[at]}"
{mqtt} }}
""")

    @property
    def pids(self) -> list[int]:
        return [process.pid for process in self._processes.values()]

    def start(self, *numbers: int) -> None:
        """Start these servers. Do not wait."""
        assert PROGRAM is not None
        for at in numbers:
            configuration = self._configurations[at]
            log = configuration.with_suffix(".log")
            self._processes[at] = subprocess.Popen([PROGRAM, "-c", str(configuration), "-l", str(log)])

    def kill(self, number: int) -> None:
        """Kill a server with SIGKILL."""
        process = self._processes.pop(number)
        process.send_signal(signal.SIGKILL)
        process.wait(LIMIT_S)

    def is_healthy(self) -> bool:
        """Return whether all servers run, have joined the cluster, and have all messages of their streams."""
        return len(self._processes) == SERVERS and all(
            self._monitored(at, "healthz").get("status") == "ok" for at in self._processes
        )

    def streams(self) -> dict[str, dict[str, Any]]:
        """Return the state of each stream with its consumers, from its leader, by name."""
        found = {}
        for at in self._processes:
            answer = self._monitored(at, "jsz?streams=1&consumers=1&config=1")
            for account in answer.get("account_details", []):
                for stream in account.get("stream_detail", []):
                    if stream.get("cluster", {}).get("leader") == f"n{at}":
                        found[stream["name"]] = stream
        return found

    def filters(self) -> list[str]:
        """Return the subject of each consumer of the messages with QoS 1: one for each topic of each session."""
        consumers = self.streams().get(MESSAGES, {}).get("consumer_detail", ())
        return [str(one["config"]["filter_subject"]) for one in consumers]

    def _monitored(self, number: int, path: str) -> dict[str, Any]:
        """Return a reply of the monitoring port; empty if the server does not reply or reports an error."""
        with suppress(OSError), urlopen(f"http://127.0.0.1:{self._monitors[number]}/{path}", timeout=5) as answer:
            return dict(json.load(answer))
        return {}


@contextmanager
def running_cluster(folder: Path, mqtt: str = "", jetstream: str = "") -> Iterator[NatsCluster]:
    cluster = NatsCluster(folder, mqtt, jetstream)
    try:
        cluster.start(*range(SERVERS))
        wait_until(cluster.is_healthy, f"a healthy cluster; see the logs in {folder}")
        yield cluster
    finally:
        for at in range(SERVERS):
            with suppress(KeyError):
                cluster.kill(at)
