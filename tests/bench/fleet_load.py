"""`make fleet-load`: CPU time, memory and delays with many simulated gateways, a broker and one collector.

`python -m tests.bench.fleet_load [--gateways 1000] [--seconds 30] [--postgres] [--cluster]`. Each simulated gateway
sends the messages of the output `mqtt` for two devices with `rate_hz: 10` and `batch_s: 1`: one message per second and
device, with ten intervals of acceleration, rotation rate and angles. The collector is `FleetCollector` in a process of
its own. With `--postgres` it writes rows. At the end, the gateways stop, and all numbered samples must arrive. The exit
status is 1 if a sample is missing.

With `--cluster` (`make fleet-cluster`), the broker is a cluster of three NATS servers with JetStream and MQTT 3.1.1:
each session and each message is on three servers. OUTPUTS further gateways are the output `mqtt` in processes of their
own, each with a device at 1 kHz that sends every sample as a slot. After a third of the time, SIGKILL ends the server
that the collector uses. Gateways and collector connect to the next server of their lists. Gateways send all messages
without an acknowledgment again.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from time import monotonic, time_ns
from typing import Final, NamedTuple
from urllib.request import urlopen

from imud.fleet.messages import FleetMessage, Interval, Measures, MessageKind, Stream, encode_message, topic_of
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.bench.fleet_collector import END_S, CollectorProcess
from tests.bench.mqtt_clients import Clients, MqttClient
from tests.bench.rig import cpu_ns, rss_mb
from tests.fleet.gateways import KilledGateway, in_spool
from tests.fleet.mosquitto import NO_MOSQUITTO, running_broker
from tests.fleet.postgres_server import NO_POSTGRES, running_postgres
from tests.support.daemon_process import wait_until
from tests.support.results import ProgramRun, Table, add_json
from tests.support.surroundings import free_port

DEVICES: Final = ("bow", "mast")
SAMPLES: Final = 100  # per second and device
INTERVALS: Final = 10  # per message: rate_hz 10
NATS: Final = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin:/sbin")
NATS_SERVERS: Final = 3
OUTPUTS: Final = 3  # number of gateways of `--cluster` that run the output `mqtt`
LIMIT_S: Final = 60.0  # end of a spool
LOST: Final = "lost"
OPEN: Final = "streams with an open ledger"


class SimulatedGateway:
    def __init__(self, number: int, ports: Sequence[int], due_s: float) -> None:
        self.name = f"gw-{number}"
        self.client = MqttClient(self.name, ports, first=number)
        self.due_s = due_s
        self.seq = 0

    def second(self) -> None:
        first, last = self.seq + 1, self.seq + SAMPLES
        self.seq = last
        for device in DEVICES:
            message = FleetMessage(
                v=1, gateway=self.name, boot="1", device=device, kind=MessageKind.INTERVALS, begin=1, first=first,
                last=last, count=SAMPLES, utc_ns=time_ns(), intervals=intervals_of(first),
            )  # fmt: skip
            self.client.give(topic_of("load", self.name, device, Stream.STATISTICS), encode_message(message))


_MADE: dict[int, list[Interval]] = {}


def intervals_of(first: int) -> list[Interval]:
    found = _MADE.get(first)
    if found is None:
        size = SAMPLES // INTERVALS
        # all gateways of a second share the intervals: encoding must not limit the load
        found = [_interval(begin, begin + size - 1) for begin in range(first, first + SAMPLES, size)]
        _MADE[first] = found
        # forget intervals of 100 s ago
        _MADE.pop(first - 100 * SAMPLES, None)
    return found


def _interval(first: int, last: int) -> Interval:
    def vector(scale: float) -> Measures:
        value = (scale * first * 0.1234567, scale * 0.7654321, scale * 9.8066512)
        return Measures(value, value, value, value)

    t_ns = first * 10 * NS_PER_MS
    return Interval(
        first, last, last - first + 1, t_ns, t_ns + 90 * NS_PER_MS, t_ns, t_ns + 90 * NS_PER_MS, 1000, Sync.REGRESSION,
        {"accel_m_s2": vector(1.0), "gyro_rad_s": vector(0.01), "euler_rad": vector(0.1)},
    )  # fmt: skip


class GatewayFleet:
    def __init__(self, number: int, ports: Sequence[int]) -> None:
        # 5 s for the connections; the gateways send at different moments of a second
        begin_s = monotonic() + 5.0
        self.gateways = [SimulatedGateway(one, ports, begin_s + one / number) for one in range(number)]
        self.clients = Clients([one.client for one in self.gateways])
        self.late_s = 0.0

    def run(self, seconds: float) -> None:
        begin_s = monotonic()
        while monotonic() - begin_s < seconds:
            self.clients.round(0.005)
            now_s = monotonic()
            for gateway in self.gateways:
                if now_s >= gateway.due_s:
                    self.late_s = max(self.late_s, now_s - gateway.due_s)
                    gateway.due_s += 1.0
                    gateway.second()
                    if gateway.client.is_ready:
                        self.clients.write(gateway.client)

    def drain(self) -> float:
        begin_s = monotonic()
        while self.waiting and monotonic() - begin_s < END_S:
            self.clients.round(0.02)
        return monotonic() - begin_s

    @property
    def waiting(self) -> int:
        return sum(len(one.client.waiting) for one in self.gateways)

    @property
    def numbered(self) -> int:
        return len(DEVICES) * sum(one.seq for one in self.gateways)


class Servers(NamedTuple):
    version: str
    ports: Sequence[int]
    pids: Sequence[int]


@contextmanager
def mosquitto(folder: Path) -> Iterator[Servers]:
    with running_broker(folder / "broker", "allow_anonymous true", "log_type error", "log_type information") as broker:
        yield Servers("5", [broker.port], [broker.pid])


@contextmanager
def nats_cluster(folder: Path) -> Iterator[Servers]:
    assert NATS is not None
    ports, monitors, routes = ([free_port() for _ in range(NATS_SERVERS)] for _ in range(3))
    others = ", ".join(f'"nats://127.0.0.1:{route}"' for route in routes)
    with ExitStack() as stack:
        pids = []
        for at, (port, monitor, route) in enumerate(zip(ports, monitors, routes, strict=True)):
            config = folder / f"nats-{at}.conf"
            config.write_text(f"""server_name: n{at}
listen: "127.0.0.1:{free_port()}"
http: "127.0.0.1:{monitor}"
jetstream {{ store_dir: "{folder}/store-{at}" }}
cluster {{ name: fleet, listen: "127.0.0.1:{route}", routes: [{others}] }}
mqtt {{ listen: "127.0.0.1:{port}" }}
""")
            log = folder / f"nats-{at}.log"
            process = stack.enter_context(subprocess.Popen([NATS, "-c", str(config), "-l", str(log)]))
            stack.callback(process.kill)
            pids.append(process.pid)
        wait_until(lambda: all(map(is_healthy, monitors)), f"a NATS cluster; see the logs in {folder}")
        yield Servers("3.1.1", ports, pids)


def is_healthy(monitor: int) -> bool:
    """Return whether a server has joined the cluster and JetStream is ready."""
    with suppress(OSError), urlopen(f"http://127.0.0.1:{monitor}/healthz", timeout=2) as answer:
        return bool(answer.status == 200)
    return False


class Output:
    def __init__(self, spool: Path, servers: Servers, name: str) -> None:
        self._spool = spool
        self.gateway = KilledGateway(servers.ports, spool, 1, name=name, version=servers.version)

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


def measure(
    servers: Servers, collector: CollectorProcess, fleet: GatewayFleet, seconds: float, outputs: Sequence[Output]
) -> Iterator[tuple[str, float, str]]:
    # 8 s until all gateways are connected and send
    fleet.run(8.0)
    # the last server is not killed
    pids = {"broker": servers.pids[-1], "collector": collector.popen.pid, "gateways": os.getpid()}
    before, acknowledged = {name: cpu_ns(pid) for name, pid in pids.items()}, acknowledged_by(fleet)
    begin_s, fleet.late_s = monotonic(), 0.0
    fleet.run(seconds / 3)
    if len(servers.pids) > 1:
        # the collector connects to the first server of the list
        os.kill(servers.pids[0], signal.SIGKILL)
    fleet.run(seconds * 2 / 3)
    elapsed_s = monotonic() - begin_s
    used = {name: (cpu_ns(pid) - before[name]) / NS_PER_S / elapsed_s for name, pid in pids.items()}
    memory = {name: rss_mb(pid) for name, pid in pids.items()}
    yield "messages acknowledged", (acknowledged_by(fleet) - acknowledged) / elapsed_s, "1/s"
    yield "messages waiting at the end", float(fleet.waiting), ""
    yield "maximum delay of a gateway", fleet.late_s, "s"
    yield "time until all acknowledged", fleet.drain(), "s"
    numbered = fleet.numbered + sum(one.end() for one in outputs)
    account = collector.end(numbered)
    fleet.clients.close()
    for name in pids:
        yield f"CPU of the {name}", used[name], "cores"
        yield f"memory of the {name}", memory[name], "MB"
    for name in ("p50_ms", "p99_ms", "max_ms"):
        yield f"delay {name[:-3]}", account[name], "ms"
    for name in ("streams", "connects"):
        yield name, float(account[name]), ""
    yield "duplicates", float(account["duplicates"]), "samples"
    yield "numbered", float(numbered), "samples"
    yield LOST, float(numbered - account["came"]), "samples"
    yield OPEN, float(account["open"]), ""


def acknowledged_by(fleet: GatewayFleet) -> int:
    return sum(one.client.acknowledged for one in fleet.gateways)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-load")
    parser.add_argument("--gateways", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--postgres", action="store_true", help="let the collector write rows into PostgreSQL")
    parser.add_argument("--cluster", action="store_true", help="use three NATS servers, and kill one of them")
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    no_nats = "" if NATS else "cannot find nats-server; try make mqtt-deps"
    if missing := (no_nats if args.cluster else NO_MOSQUITTO) or (NO_POSTGRES if args.postgres else ""):
        print(missing)
        return 1
    load = f"load {os.getloadavg()[0]:.1f} before"
    print(f"{args.gateways} gateways of {len(DEVICES)} devices, {args.seconds:g} s, {os.cpu_count()} cores, {load}")
    with tempfile.TemporaryDirectory(prefix="imud-load-") as name, ExitStack() as stack:
        folder = Path(name)
        to = stack.enter_context(running_postgres()) if args.postgres else ""
        servers = stack.enter_context((nats_cluster if args.cluster else mosquitto)(folder))
        # a message before the first connection of the collector would be lost
        collector = CollectorProcess(servers.ports, version=servers.version, to=to)
        outputs = [Output(folder / f"spool-{n}", servers, f"imud-{n}") for n in range(OUTPUTS * args.cluster)]
        for one in outputs:
            stack.callback(one.gateway.kill)
            one.gateway.wait_until(0)
        found = {}
        for row, value, unit in measure(
            servers, collector, GatewayFleet(args.gateways, servers.ports), args.seconds, outputs
        ):
            print(f"  {row:32} {value:12.2f} {unit}", flush=True)
            found[row] = value, unit
    rows = [{"figure": row, "value": value, "unit": unit} for row, (value, unit) in found.items()]
    problems = [f"{row}: {found[row][0]:g}" for row in (LOST, OPEN) if found[row][0]]
    program_run.save(args.json, [Table(f"{args.gateways} gateways", rows)], problems)
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
