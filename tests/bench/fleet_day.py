"""`make fleet-day`: a spool with what a day without a network makes, and how long the broker then takes to get it.

`python -m tests.bench.fleet_day [--hours 24] [--devices 2]`. Each device has statistics of 1 Hz in messages of 1 s,
as by default. The spool is filled as fast as the disk takes it, by the output's own parts; then the output, mosquitto
and a collector start, and the time is measured until the spool is empty. It ends with 1 where a number is missing, or
came out of its order.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, time_ns
from typing import Final

from imud.formats.fleet.topics import Stream
from imud.publishers.mqtt.settings import DeviceSending
from imud.publishers.mqtt.spool import Spool
from imud.publishers.mqtt.streams import DeviceStreams, Gateway
from imud.sample import Sample, Sync
from imud.units import NS_PER_S
from tests.publishers.mqtt.gateways import LiveGateway
from tests.publishers.mqtt.mosquitto import NO_MOSQUITTO, Collector, running_broker

RATE_HZ: Final = 4
"""Samples a second: a message of statistics has the same size for any rate."""
TOGETHER_S: Final = 60
"""Seconds that are written in one transaction."""
LIMIT_S: Final = 1800.0
SPOOL_BYTES: Final = 4 << 30


def fill(folder: Path, hours: float, devices: int) -> tuple[int, int]:
    """Write what so many hours make; return messages, and bytes of the spool."""
    spool = Spool(folder, SPOOL_BYTES, 1 << 62)
    spool.open()
    streams = [DeviceStreams(Gateway("default", "gw", "1"), f"d{one}", one, DeviceSending()) for one in range(devices)]
    seconds = round(hours * 3600)
    begin_utc_ns = time_ns() - seconds * NS_PER_S
    for begin_s in range(0, seconds, TOGETHER_S):
        end_s = min(begin_s + TOGETHER_S, seconds)
        rows = [row for number, one in enumerate(streams) for row in one.add(list(samples(number, begin_s, end_s)))]
        spool.commit(rows, (), begin_s * NS_PER_S, begin_utc_ns + begin_s * NS_PER_S)
    spool.commit([row for one in streams for row in one.flush()], (), seconds * NS_PER_S, time_ns())
    found = spool.messages, spool.used_bytes
    spool.close()
    return found


def samples(device: int, begin_s: int, end_s: int) -> Iterator[Sample]:
    """Samples of a time, numbered on from its begin."""
    for at in range(begin_s * RATE_HZ, end_s * RATE_HZ):
        t_ns = (at + 1) * NS_PER_S // RATE_HZ
        value = (at % 977) / 977
        yield Sample(
            f"d{device}", at + 1, t_ns, 0, Sync.REGRESSION, t_ns, t_ns, accel_m_s2=(value, -value, 9.8 + value / 100),
            gyro_rad_s=(value / 50, 0.001, -0.002), euler_rad=(value / 10, value / 9, value), temperature_c=30 + value,
        )  # fmt: skip


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(prog="make fleet-day")
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--devices", type=int, default=2)
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
        collector = Collector(broker.port)
        begin_s = monotonic()
        live = LiveGateway(spool, broker.port, spool_mb=SPOOL_BYTES / 1e6)
        live.wait_for(lambda: live.output.status().waiting == 0, LIMIT_S)
        took_s = monotonic() - begin_s
        last = round(args.hours * 3600) * RATE_HZ
        collector.wait_for(lambda: all(one.newest == last for one in collector.ledger.counts.values()), 60.0)
        live.output.close()
        collector.close()
    newest: dict[str, int] = {}
    out_of_order = 0
    for message in collector.fresh:
        out_of_order += message.first != newest.get(message.device, 0) + 1
        newest[message.device] = message.last
    counts = [one for key, one in collector.ledger.counts.items() if key.stream == Stream.STATISTICS]
    missing, duplicates = sum(one.missing for one in counts), sum(one.duplicates for one in counts)
    print(
        f"  replayed in {took_s:.0f} s, {messages / took_s:.0f} messages/s, {args.hours * 3600 / took_s:.0f} times live"
    )
    print(f"  missing {missing}, duplicates {duplicates}, out of order {out_of_order}, streams {len(counts)}")
    return int(bool(missing or out_of_order) or len(counts) != args.devices)


if __name__ == "__main__":
    sys.exit(main())
