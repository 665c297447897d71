"""Sample rate of eight Modbus devices on one RS-485 bus at 115200 baud, compared with the limit of the bus.

A request has 8 bytes, a reply has 57 bytes (26 registers), and a byte has 10 bits. A silence of 1.75 ms precedes each
of them. The limit is 5.642 ms + 3.5 ms = 9.142 ms per sample if the devices reply immediately. The simulated devices
need 0.3 ms for a reply. A process simulates the bus and delivers each byte at the end of its wire time.
"""

import tempfile
from contextlib import ExitStack
from pathlib import Path
from time import monotonic, sleep
from typing import NamedTuple

import msgspec

from imud.formats.modbus import frame_gap_ns
from imud.model.units import NS_PER_S, uart_byte_ns
from tests.bench.rig import START_LIMIT_S, Process, ask, cpu_ns, wait_for
from tests.bench.rows import Row, at_least, at_most

BAUD = 115200
MODULES = 8
REQUEST_BYTES, REPLY_BYTES = 8, 57
# sum of wire time and silences, without the reply time of a device
LIMIT_HZ = NS_PER_S / ((REQUEST_BYTES + REPLY_BYTES) * uart_byte_ns(BAUD) + 2 * frame_gap_ns(BAUD))


class Outcome(NamedTuple):
    rates_hz: list[float]
    cpu_us_per_sample: float
    lost: int


def measured(seconds: float, alive: int, configured: int) -> Outcome:
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-bench-") as name, ExitStack() as stack:
        folder = Path(name)
        addresses = [str(address) for address in range(1, alive + 1)]
        line = stack.enter_context(Process(set(range(64)), "-m", "tests.bench.modbus_line", str(BAUD), *addresses))
        port = line.line()
        devices = {
            f"d{address}": {"driver": "hipnuc-modbus", "rs485": {"line": port, "baud": BAUD, "address": address}}
            for address in range(1, configured + 1)
        }
        tree = {
            "log_level": "error", "state_dir": name, "socket": {"path": str(folder / "s")},
            "shm": {"directory": name}, "metrics": {"port": 0}, "devices": devices,
        }  # fmt: skip
        (folder / "imud.yaml").write_bytes(msgspec.json.encode(tree))
        daemon = stack.enter_context(Process(set(range(64)), "-m", "imud", "run", "-c", str(folder / "imud.yaml")))
        wait_for(folder / "s")
        end = monotonic() + START_LIMIT_S
        while sum(status.state == "running" for status in ask(folder / "s")) < alive:
            if monotonic() > end:
                raise TimeoutError(f"expected {alive} running devices within {START_LIMIT_S:g} s")
            sleep(0.05)
        # 1 s until the rates are stable
        sleep(1.0)
        before, begun, cpu = ask(folder / "s"), monotonic(), cpu_ns(daemon.popen.pid)
        sleep(seconds)
        after, elapsed, cpu = ask(folder / "s"), monotonic() - begun, cpu_ns(daemon.popen.pid) - cpu
        counts = [b.ledger["samples"] - a.ledger["samples"] for a, b in zip(before, after, strict=True)][:alive]
        lost = sum(
            b.ledger[key] - a.ledger[key]
            for a, b in zip(before[:alive], after[:alive], strict=True)
            for key in a.ledger
            if key.startswith("lost_")
        )
    return Outcome([count / elapsed for count in counts], cpu / 1e3 / sum(counts), lost)


def rows(*, quick: bool = False) -> list[Row]:
    seconds = 5.0 if quick else 20.0
    all_eight = measured(seconds, MODULES, MODULES)
    seven = measured(seconds, MODULES - 1, MODULES - 1)
    one_dead = measured(seconds, MODULES - 1, MODULES)
    share = min(all_eight.rates_hz) / (LIMIT_HZ / MODULES)
    cost = 1 - sum(one_dead.rates_hz) / sum(seven.rates_hz)
    return [
        Row(f"Modbus, {MODULES} modules at {BAUD} baud: computed limit of each", LIMIT_HZ / MODULES, "Hz"),
        Row("Modbus, rate of the slowest device", min(all_eight.rates_hz), "Hz"),
        Row("Modbus, rate of the fastest device", max(all_eight.rates_hz), "Hz"),
        at_least("Modbus, slowest device / limit", share, "", 0.8),
        Row("Modbus, samples lost", all_eight.lost, ""),
        Row("Modbus, CPU of the daemon per sample", all_eight.cpu_us_per_sample, "us"),
        Row("Modbus, rate of each of seven devices", sum(seven.rates_hz) / len(seven.rates_hz), "Hz"),
        Row(
            "Modbus, rate of each of seven devices and a dead one",
            sum(one_dead.rates_hz) / len(one_dead.rates_hz),
            "Hz",
        ),
        at_most("Modbus, loss of rate due to the dead device", 100 * cost, "%", 20),
    ]
