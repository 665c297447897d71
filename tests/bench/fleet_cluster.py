"""`make fleet-cluster`: three NATS servers with JetStream and MQTT; one server is killed while gateways publish.

`python -m tests.bench.fleet_cluster [--gateways 200] [--seconds 30] [--postgres]`. The servers are Debian's nats-server
with MQTT 3.1.1. Each session and each message is on three servers. `--gateways` gateways are simulated. OUTPUTS further
gateways are the output `mqtt` in processes of their own, each with a device at 1 kHz that sends every sample as a slot.
The collector is `FleetCollector`. With `--postgres` it writes rows.

After a third of the time, SIGKILL ends the server that the collector uses. Gateways and collector connect to the next
server of their lists. Gateways send all messages without an acknowledgment again. The exit status is 1 if a sequence
number is missing at the end.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

from tests.bench.fleet_collector import CollectorProcess
from tests.bench.fleet_load import GatewayFleet, acknowledged_by
from tests.fleet.gateways import KilledGateway, in_spool
from tests.fleet.postgres_server import NO_POSTGRES, running_postgres
from tests.support.surroundings import free_port

PROGRAM: Final = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin:/sbin")
SERVERS: Final = 3
OUTPUTS: Final = 3
"""Number of gateways that run the output `mqtt`."""
LIMIT_S: Final = 60.0  # start of the cluster, or the end of a spool
ACCOUNT_WORDS: Final = ("p50_ms", "p99_ms", "max_ms", "duplicates", "missing", "open")


class Cluster:
    def __init__(self, folder: Path) -> None:
        self.ports = [free_port() for _ in range(SERVERS)]
        self.monitors = [free_port() for _ in range(SERVERS)]
        routes = [free_port() for _ in range(SERVERS)]
        self.processes: list[subprocess.Popen[bytes]] = []
        for at in range(SERVERS):
            config = folder / f"nats-{at}.conf"
            config.write_text(configuration(at, folder, self.ports[at], self.monitors[at], routes))
            assert PROGRAM is not None
            log = folder / f"nats-{at}.log"
            self.processes.append(subprocess.Popen([PROGRAM, "-c", str(config), "-l", str(log)]))
        end_s = time.monotonic() + LIMIT_S
        while not all(map(is_healthy, self.monitors)):
            if time.monotonic() > end_s:
                raise TimeoutError(f"expected a NATS cluster within {LIMIT_S:g} s; see the logs in {folder}")
            time.sleep(0.2)

    def kill(self, at: int) -> None:
        self.processes[at].send_signal(signal.SIGKILL)
        self.processes[at].wait(10)

    def close(self) -> None:
        for process in self.processes:
            if process.poll() is None:
                process.kill()
                process.wait(10)


def configuration(at: int, folder: Path, port: int, monitor: int, routes: Sequence[int]) -> str:
    others = ", ".join(f'"nats://127.0.0.1:{route}"' for route in routes)
    return f"""server_name: n{at}
listen: "127.0.0.1:{free_port()}"
http: "127.0.0.1:{monitor}"
jetstream {{ store_dir: "{folder}/store-{at}" }}
cluster {{ name: fleet, listen: "127.0.0.1:{routes[at]}", routes: [{others}] }}
mqtt {{ listen: "127.0.0.1:{port}" }}
"""


def is_healthy(monitor: int) -> bool:
    """Return whether a server has joined the cluster and JetStream is ready."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{monitor}/healthz", timeout=2) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-cluster")
    parser.add_argument("--gateways", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--postgres", action="store_true", help="let the collector write rows into PostgreSQL")
    args = parser.parse_args()
    missing = "" if PROGRAM else "cannot find nats-server; try apt-get install nats-server"
    if missing := missing or (NO_POSTGRES if args.postgres else ""):
        print(missing)
        return 1
    print(
        f"{args.gateways} gateways, {OUTPUTS} outputs, {args.seconds:g} s, load {os.getloadavg()[0]:.1f} before",
        flush=True,
    )
    with tempfile.TemporaryDirectory(prefix="imud-cluster-") as name, ExitStack() as stack:
        folder = Path(name)
        cluster = stack.enter_context(closing(Cluster(folder)))
        to = stack.enter_context(running_postgres()) if args.postgres else ""
        collector = CollectorProcess(cluster.ports, version="3.1.1", to=to)
        outputs = [Output(folder / f"spool-{n}", cluster.ports, f"imud-{n}") for n in range(OUTPUTS)]
        for one in outputs:
            stack.callback(one.gateway.kill)
        return play(cluster, collector, GatewayFleet(args.gateways, cluster.ports), outputs, args.seconds)


class Output:
    def __init__(self, spool: Path, ports: Sequence[int], name: str) -> None:
        self._spool = spool
        self.gateway = KilledGateway(ports, spool, 1, name=name, version="3.1.1")

    def end(self) -> int:
        """Send the rest of the spool and end the gateway. Return the number of used sequence numbers.

        Raises TimeoutError if messages remain in the spool.
        """
        drained = self.gateway.drain(LIMIT_S)
        self.gateway.kill()
        rows, positions = in_spool(self._spool)
        if not drained or rows:
            raise TimeoutError(f"expected an empty spool within {LIMIT_S:g} s, got {len(rows)} messages")
        return sum(one.last - one.begin + 1 for one in positions)


def play(
    cluster: Cluster, collector: CollectorProcess, fleet: GatewayFleet, outputs: Sequence[Output], seconds: float
) -> int:
    """Publish for `seconds`, kill a server, and print the result. Return 1 if samples are missing, otherwise 0."""
    # 8 s until all gateways are connected
    fleet.run(8.0)
    killed = False

    def tick(at_s: float) -> None:
        nonlocal killed
        if not killed and at_s > seconds / 3:
            killed = True
            # the collector connects to the first server of the list
            cluster.kill(0)

    acknowledged = acknowledged_by(fleet)
    fleet.run(seconds, tick)
    print(f"  acknowledged {(acknowledged_by(fleet) - acknowledged) / seconds:.0f} messages/s")
    print(f"  waiting at the end: {fleet.waiting} messages; all acknowledged after {fleet.drain():.1f} s", flush=True)
    own = sum(one.end() for one in outputs)
    numbered = fleet.numbered + own
    account = collector.end(numbered)
    fleet.clients.close()
    print(
        f"  numbered {numbered}, {own} of them by outputs; received {account['came']}, "
        f"connections of the collector {account['connects']}"
    )
    print("  " + ", ".join(f"{word} {account[word]:.0f}" for word in ACCOUNT_WORDS))
    return int(numbered != account["came"] or bool(account["open"]))


if __name__ == "__main__":
    sys.exit(main())
