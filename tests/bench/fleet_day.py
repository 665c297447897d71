"""`make fleet-day`: fill a spool with the messages of a day without a network, and measure the time of its replay.

`python -m tests.bench.fleet_day [--hours 24] [--devices 2] [--messages-per-s 200] [--newest-first] [--live-hz 100]`.
Each device has statistics of 1 Hz in messages of 1 s, like the default. The classes of the output fill the spool as
fast as the disk allows. Then the output, mosquitto and a collector start. The program measures the time until the
collector has received the whole day.

With `--live-hz`, a further device publishes whole samples in messages of 1 s at the same time. The program prints the
delay from the newest sample of a message to its arrival. The exit status is 1 if a sequence number is missing or if the
order is wrong.
"""

import argparse
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, time_ns
from typing import Final

from imud.contracts.publisher import Batch
from imud.fleet.settings import DeviceSending
from imud.fleet.spool import Spool
from imud.fleet.streams import DeviceStreams, Gateway
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S
from tests.fleet.gateways import LiveGateway
from tests.fleet.mosquitto import NO_MOSQUITTO, Collector, running_broker

RATE_HZ: Final = 4
"""Sample rate, Hz. A message of statistics has the same size at each rate."""
TOGETHER_S: Final = 60  # samples per transaction of the spool
LIMIT_S: Final = 1800.0  # limit of the replay
SPOOL_BYTES: Final = 4 << 30  # 4 GiB, larger than a day
LIVE: Final = "bow"
# configuration of the replayed devices and of the live device
DAY: Final = {"whole": "none", "rate_hz": 1, "batch_s": 1}
NOW: Final = {"whole": "slots", "rate_hz": None, "batch_s": 1}


def fill(folder: Path, hours: float, devices: int) -> tuple[int, int]:
    spool = Spool(folder, SPOOL_BYTES, 1 << 62)
    spool.open()
    streams = [DeviceStreams(Gateway("default", "gw", "1"), f"d{one}", one, DeviceSending()) for one in range(devices)]
    seconds = round(hours * 3600)
    begin_utc_ns = time_ns() - seconds * NS_PER_S
    for begin_s in range(0, seconds, TOGETHER_S):
        end_s = min(begin_s + TOGETHER_S, seconds)
        # commit 60 s in one transaction, so that the disk is not the limit
        rows = [row for number, one in enumerate(streams) for row in one.add(list(samples(number, begin_s, end_s)))]
        spool.commit(rows, (), begin_s * NS_PER_S, begin_utc_ns + begin_s * NS_PER_S)
    spool.commit([row for one in streams for row in one.flush()], (), seconds * NS_PER_S, time_ns())
    found = spool.messages, spool.used_bytes
    spool.close()
    return found


def samples(device: int, begin_s: int, end_s: int) -> Iterator[Sample]:
    for at in range(begin_s * RATE_HZ, end_s * RATE_HZ):
        t_ns = (at + 1) * NS_PER_S // RATE_HZ
        value = (at % 977) / 977
        yield Sample(
            f"d{device}", at + 1, t_ns, 0, Sync.REGRESSION, t_ns, t_ns, accel_m_s2=(value, -value, 9.8 + value / 100),
            gyro_rad_s=(value / 50, 0.001, -0.002), euler_rad=(value / 10, value / 9, value), temperature_c=30 + value,
        )  # fmt: skip


class LiveData:
    def __init__(self, rate_hz: float) -> None:
        self.delays_s: list[float] = []
        """Delays from the newest sample of a message to its arrival, s, in order of arrival. The resolution is 20 ms,
        the time between two calls of `look`."""
        self._looked = 0
        self._rate_hz, self._begin_s, self._seq = rate_hz, monotonic(), 0

    def publish(self, gateway: LiveGateway) -> None:
        made = []
        while (self._seq + 1) / self._rate_hz < monotonic() - self._begin_s:
            self._seq += 1
            t_ns = round((self._begin_s + self._seq / self._rate_hz) * NS_PER_S)
            made.append(Sample(LIVE, self._seq, t_ns, 0, Sync.EDGE, t_ns, t_ns, accel_m_s2=(self._seq / 7, 0, 9.8)))
        if made:
            gateway.output.publish(Batch(LIVE, 0, made))

    def look(self, collector: Collector) -> None:
        """Store the delays of new messages. `utc_ns` of these samples contains CLOCK_MONOTONIC."""
        fresh, now_s = collector.fresh, monotonic()
        end = len(fresh)
        found = [one.utc_ns / NS_PER_S for one in fresh[self._looked : end] if one.device == LIVE]
        self._looked = end
        self.delays_s += [now_s - newest_s for newest_s in found]


def has_all(collector: Collector, devices: int, last: int) -> bool:
    newest = {key.device: one.newest for key, one in list(collector.ledger.counts.items()) if key.device != LIVE}
    return len(newest) == devices and all(one == last for one in newest.values())


def replay(args: argparse.Namespace, spool: Path, port: int, messages: int) -> int:
    data = LiveData(args.live_hz or 1.0)
    collector = Collector(port)
    begin_s, last = monotonic(), round(args.hours * 3600) * RATE_HZ
    settings = {"messages_per_s": args.messages_per_s, "newest_first": args.newest_first}
    devices = {LIVE: NOW, "*": DAY}
    live = LiveGateway(spool, port, spool_mb=SPOOL_BYTES / 1e6, devices=devices, **settings)
    pause = threading.Event()
    took_s = 0.0
    # without live data, stop after the replay; with live data, also wait for a first delay
    while monotonic() - begin_s < LIMIT_S and not (took_s and (data.delays_s or not args.live_hz)):
        if not took_s and has_all(collector, args.devices, last):
            took_s = monotonic() - begin_s
        if args.live_hz:
            data.publish(live)
            data.look(collector)
        live.output.tick(live.host.now_ns())
        pause.wait(0.02)
    live.output.close()
    collector.close()
    return report(args, collector, data, messages, took_s)


def report(args: argparse.Namespace, collector: Collector, data: LiveData, messages: int, took_s: float) -> int:
    newest: dict[str, int] = {}
    out_of_order = 0
    for message in collector.fresh:
        out_of_order += message.first != newest.get(message.device, 0) + 1
        newest[message.device] = message.last
    days = [one for key, one in collector.ledger.counts.items() if key.device != LIVE]
    missing, duplicates = sum(one.missing for one in days), sum(one.duplicates for one in days)
    took_s = took_s or LIMIT_S
    times = args.hours * 3600 / took_s
    print(f"  replayed in {took_s:.0f} s, {messages / took_s:.0f} messages/s, {times:.0f} times live")
    print(f"  missing {missing}, duplicates {duplicates}, out of order {out_of_order}, streams {len(days)}")
    if delays_s := sorted(data.delays_s):
        p50_s, p99_s = delays_s[len(delays_s) // 2], delays_s[len(delays_s) * 99 // 100]
        late = f"delay median {p50_s:.1f} s, p99 {p99_s:.1f} s, largest {delays_s[-1]:.1f} s"
        print(f"  live device: {len(delays_s)} messages, {late}")
    return int(bool(missing or out_of_order) or len(days) != args.devices)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-day")
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--devices", type=int, default=2)
    parser.add_argument("--messages-per-s", type=float, help="limit of the replay, like mqtt.messages_per_s")
    parser.add_argument(
        "--newest-first", action="store_true", help="send live data before the replayed day, like mqtt.newest_first"
    )
    parser.add_argument("--live-hz", type=float, default=0.0, help="rate of a further live device; 0 for no device")
    args = parser.parse_args()
    if NO_MOSQUITTO:
        print(NO_MOSQUITTO)
        return 1
    print(f"{args.hours:g} h of {args.devices} devices, load {os.getloadavg()[0]:.1f} before", flush=True)
    with tempfile.TemporaryDirectory(dir=".", prefix=".imud-day-") as name, running_broker(
        Path(name) / "broker", "allow_anonymous true", "log_type error", "log_type information"
    ) as broker:  # fmt: skip
        spool = Path(name) / "spool"
        begin_s = monotonic()
        messages, used_bytes = fill(spool, args.hours, args.devices)
        print(f"  {messages} messages, {used_bytes / 1e6:.0f} MB, filled in {monotonic() - begin_s:.0f} s", flush=True)
        return replay(args, spool, broker.port, messages)


if __name__ == "__main__":
    sys.exit(main())
