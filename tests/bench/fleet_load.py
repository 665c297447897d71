"""`make fleet-load`: CPU time, memory and delays with many simulated gateways, one broker and one collector.

`python -m tests.bench.fleet_load [--gateways 1000] [--seconds 30] [--postgres]`. Each simulated gateway sends the
messages of the output `mqtt` for two devices with `rate_hz: 10` and `batch_s: 1`: one message per second and device,
with ten intervals of acceleration, rotation rate and angles. The collector is `FleetCollector` in a process of its own.
With `--postgres` it writes rows. At the end, the gateways stop, and all numbered samples must arrive. The exit status
is 1 if a sample is missing.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from time import monotonic, time_ns
from typing import Final

from imud.fleet.messages import FleetMessage, Interval, Measures, MessageKind, Stream, encode_message, topic_of
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.bench.fleet_collector import END_S, CollectorProcess
from tests.bench.mqtt_clients import Clients, MqttClient
from tests.bench.rig import cpu_ns, rss_mb
from tests.fleet.mosquitto import NO_MOSQUITTO, running_broker
from tests.fleet.postgres_server import NO_POSTGRES, running_postgres

DEVICES: Final = ("bow", "mast")
SAMPLES: Final = 100  # per second and device
INTERVALS: Final = 10  # per message: rate_hz 10


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

    def run(self, seconds: float, tick: Callable[[float], None] = lambda _at_s: None) -> None:
        begin_s = monotonic()
        while (at_s := monotonic() - begin_s) < seconds:
            tick(at_s)
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


def measure(number: int, seconds: float, *, to: str = "") -> Iterator[tuple[str, float, str]]:
    with tempfile.TemporaryDirectory(prefix="imud-load-") as folder, running_broker(
        Path(folder) / "broker", "allow_anonymous true", "log_type error", "log_type information"
    ) as broker:  # fmt: skip
        collector = CollectorProcess([broker.port], version="5", to=to)
        fleet = GatewayFleet(number, [broker.port])
        # 6 s until all gateways are connected and send
        fleet.run(6.0)
        pids = {"broker": broker.pid, "collector": collector.popen.pid, "gateways": os.getpid()}
        before, acknowledged = {name: cpu_ns(pid) for name, pid in pids.items()}, acknowledged_by(fleet)
        begin_s, fleet.late_s = monotonic(), 0.0
        fleet.run(seconds)
        elapsed_s = monotonic() - begin_s
        used = {name: (cpu_ns(pid) - before[name]) / NS_PER_S / elapsed_s for name, pid in pids.items()}
        memory = {name: rss_mb(pid) for name, pid in pids.items()}
        yield "messages acknowledged", (acknowledged_by(fleet) - acknowledged) / elapsed_s, "1/s"
        yield "messages waiting at the end", float(fleet.waiting), ""
        yield "maximum delay of a gateway", fleet.late_s, "s"
        yield "time until all acknowledged", fleet.drain(), "s"
        account = collector.end(fleet.numbered)
        fleet.clients.close()
    for name in pids:
        yield f"CPU of the {name}", used[name], "cores"
        yield f"memory of the {name}", memory[name], "MB"
    for name in ("p50_ms", "p99_ms", "max_ms"):
        yield f"delay {name[:-3]}", account[name], "ms"
    yield "streams", float(account["streams"]), ""
    yield "duplicates", float(account["duplicates"]), "samples"
    yield "lost", float(fleet.numbered - account["came"]), "samples"


def acknowledged_by(fleet: GatewayFleet) -> int:
    return sum(one.client.acknowledged for one in fleet.gateways)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-load")
    parser.add_argument("--gateways", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--postgres", action="store_true", help="let the collector write rows into PostgreSQL")
    args = parser.parse_args()
    if missing := NO_MOSQUITTO or (NO_POSTGRES if args.postgres else ""):
        print(missing)
        return 1
    load = f"load {os.getloadavg()[0]:.1f} before"
    print(f"{args.gateways} gateways of {len(DEVICES)} devices, {args.seconds:g} s, {os.cpu_count()} cores, {load}")
    lost = 1.0
    with running_postgres() if args.postgres else nullcontext("") as to:
        for name, value, unit in measure(args.gateways, args.seconds, to=to):
            print(f"  {name:32} {value:12.2f} {unit}", flush=True)
            lost = value if name == "lost" else lost
    return int(lost != 0)


if __name__ == "__main__":
    sys.exit(main())
