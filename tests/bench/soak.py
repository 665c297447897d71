"""`make soak`: 100 devices at 1 … 400 Hz, 20 clients, scrapes, all recorded. Memory must not grow, and ledgers balance.

The run passes if all of these conditions are true:

- Anonymous memory grows by less than SLOPE_LIMIT_MB_PER_H after the first ten minutes. A shorter run limits the growth
  in its second half.
- The samples of each device are the frames that its pty accepted. The lost samples are the frames that its pty rejected
  (±1).
- imud received at most as many good frames as the Modbus devices sent, and each deadline is a sample or a loss.
- Every ledger balances. Clients only miss samples that the daemon reports as dropped.
- The numbers of descriptors and threads do not grow.
- The files of the recorder are complete and agree with its counters and the run (`soak_recordings`).

The frames and the noise are the same in each run. In the first minutes, the clients do not read for BEHIND_S, so that
imud drops samples. The memory of the full queues is thus included before the memory must not grow. The shared memory of
the rings is a separate figure: its pages become resident at the first write, which takes more than an hour at 1 Hz.
`socket.history` is off: it uses 0.7 MB for each device after one hour, and its limit has a test in tests/publishers.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from signal import SIGCONT, SIGSTOP
from statistics import linear_regression
from time import monotonic, sleep
from typing import Any, Final
from urllib.request import urlopen

import msgspec

from imud.client.connection import Client
from imud.contracts.status import DeviceStatus
from imud.model.ledger import bytes_open, frames_open, lost
from tests.bench import soak_recordings
from tests.bench.fleet_writer import hi91_frames
from tests.bench.rig import REST_CORES, SERVER_CORE, START_LIMIT_S, Process, cpu_ns, wait_for
from tests.bench.soak_recordings import Recordings
from tests.support.files import CaptureWriter
from tests.support.results import ProgramRun, Table, add_json
from tests.support.surroundings import free_port

RATES: Final = ((1.0, 34), (10.0, 22), (20.0, 14), (50.0, 8), (100.0, 3), (400.0, 1))
"""Pairs of (rate in Hz, number of ptys). Every second device is an IMU61x."""
MODULES: Final = 8  # Number of Modbus devices on one bus behind a pty. imud polls each at MODULE_HZ.
MODULE_HZ: Final = 5.0
MODULE_BAUD: Final = 115200
LINE_SEED: Final = 25
DEADLINE_TOLERANCE: Final = 2
"""Tolerance in deadlines. The status may describe a moment shortly before or after the request."""
REPLAYS: Final = 10
REPLAY_HZ: Final = 10.0
CLIENTS: Final = 20  # clients on the socket
SCRAPE_S: Final = 5.0  # interval of Prometheus in the test
MINUTE_S: Final = 60.0
SETTLE_S: Final = 600.0  # start-up is not part of the slope
SLOPE_MIN_S: Final = 600.0  # Minimum duration for a slope, s. The slope of a shorter run is mainly noise.
SLOPE_LIMIT_MB_PER_H: Final = 1.0  # goal for a run with a slope
GROWTH_LIMIT_MB: Final = 1.0  # goal for a shorter run
BEHIND_AT_S: Final = 60.0  # start of the pause of the clients
BEHIND_S: Final = 10.0  # Time in which the clients do not read, s. The queues of some clients overflow in this time.
TAIL_S: Final = 1.0  # last samples on their way to the outputs
END_LIMIT_S: Final = 20.0  # maximum time until the daemon has written its data and ended, s
LOST_TOLERANCE: Final = 1  # frames, if the pty rejected any


@dataclass(frozen=True)
class Fleet:
    written: tuple[str, ...]
    configuration: Path


def written_devices() -> tuple[str, ...]:
    rates = [rate for rate, count in RATES for _ in range(count)]
    return tuple(f"{('hipnuc-uart', 'imu61x-uart')[n % 2]}:{rate:g}" for n, rate in enumerate(rates))


def write_capture(path: Path, seconds: float) -> None:
    make = hi91_frames(REPLAY_HZ)
    with path.open("wb") as file:
        capture = CaptureWriter(file, driver="hipnuc-uart", baud=921600)
        for number in range(int(seconds * REPLAY_HZ)):
            capture.write(make(number), int((number + 1) * 1e9 / REPLAY_HZ))


def write_configuration(folder: Path, ports: list[str], line: str, port: int) -> Fleet:
    written = written_devices()
    devices: dict[str, Any] = {
        f"{name.partition(':')[0]}-{n}": {
            "driver": name.partition(":")[0], "identify": False, "uart": {"port": path, "baud": 921600},
        }
        for n, (name, path) in enumerate(zip(written, ports, strict=True))
    }  # fmt: skip
    for n in range(REPLAYS):
        replay = {"path": str(folder / "capture"), "speed": "recorded"}
        devices[f"replay-{n}"] = {"driver": "hipnuc-uart", "identify": False, "replay": replay}
    for address in range(1, MODULES + 1):
        link = {"line": line, "baud": MODULE_BAUD, "address": address, "rate_hz": MODULE_HZ}
        devices[f"modbus-{address}"] = {"driver": "hipnuc-modbus", "rs485": link}
    tree = {
        "log_level": "error", "state_dir": str(folder), "socket": {"path": str(folder / "s"), "history": False},
        "shm": {"directory": str(folder)}, "metrics": {"port": port},
        "recorder": soak_recordings.settings(folder / "recordings"), "devices": devices,
    }  # fmt: skip
    file = folder / "imud.yaml"
    file.write_bytes(msgspec.json.encode(tree))
    return Fleet(tuple(name for name in devices if not name.startswith(("replay", "modbus"))), file)


class Watched:
    def __init__(self, pid: int, socket: Path, metrics_port: int) -> None:
        self.points: list[tuple[float, float]] = []
        """Pairs of (time, s; resident anonymous memory, MB), one for each scrape."""
        self.usage: list[tuple[int, int]] = []
        self.unanswered = 0
        """Number of failed scrapes and late replies to status requests. A starved daemon replies 503."""
        self._pid, self._socket, self._port = pid, socket, metrics_port
        self._scrape_ms = self._scrape_kb = self._shared_mb = 0.0
        self._cpu_ns, self._samples = cpu_ns(pid), 0

    def scrape(self, elapsed_s: float) -> None:
        proc = Path(f"/proc/{self._pid}")
        self.usage.append((len(os.listdir(proc / "fd")), len(os.listdir(proc / "task"))))
        begin = monotonic()
        try:
            with urlopen(f"http://127.0.0.1:{self._port}/metrics", timeout=SCRAPE_S) as answer:
                self._scrape_kb = len(answer.read()) / 1e3
        except OSError:  # 503 from a starved daemon, or no reply
            self.unanswered += 1
        self._scrape_ms = max(self._scrape_ms, (monotonic() - begin) * 1e3)
        anonymous_mb, self._shared_mb = resident_mb(self._pid)
        self.points.append((elapsed_s, anonymous_mb))

    def minute(self, elapsed_s: float, over_s: float) -> None:
        try:
            statuses, dropped = ask_all(self._socket)
        except TimeoutError:  # the checks use the status at the end, so a busy host may skip this one
            self.unanswered += 1
            print(f"{elapsed_s:5.0f} s  no reply to the status request within {START_LIMIT_S:g} s", flush=True)
            return
        samples = sum(status.ledger["samples"] for status in statuses.values())
        missing = sum(count for status in statuses.values() for name, count in status.ledger.items() if "lost_" in name)
        used_ns = cpu_ns(self._pid)
        share = (used_ns - self._cpu_ns) / over_s / 1e9
        print(
            f"{elapsed_s:5.0f} s  RSS {self.points[-1][1]:6.2f} + {self._shared_mb:6.2f} MB shared  CPU {share:3.0%}  "
            f"{(samples - self._samples) / over_s:6.0f} samples/s  lost {missing}  dropped {dropped}  "
            f"fds {self.usage[-1][0]} threads {self.usage[-1][1]}  "
            f"scrape {self._scrape_ms:.0f} ms, {self._scrape_kb:.0f} kB",
            flush=True,
        )
        self._cpu_ns, self._samples, self._scrape_ms = used_ns, samples, 0.0


def resident_mb(pid: int) -> tuple[float, float]:
    """Return anonymous and shared resident memory, MB (10⁶ bytes)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    kb = {name: value.split()[0] for name, _, value in (line.partition(":") for line in lines) if "Rss" in name}
    return int(kb["RssAnon"]) * 1024 / 1e6, int(kb["RssShmem"]) * 1024 / 1e6


def ask_all(path: Path) -> tuple[dict[str, DeviceStatus], int]:
    with Client(path, timeout_s=START_LIMIT_S) as client:
        status = client.status()
    devices = msgspec.convert(status["devices"], list[DeviceStatus])
    return {device.name: device for device in devices}, sum(c["dropped"] for c in status["socket"]["clients"])


def judge(
    fleet: Fleet, counts: list[tuple[int, int]], statuses: Mapping[str, DeviceStatus], dropped: int, gaps: int
) -> list[str]:
    found = []
    for name, (taken, refused) in zip(fleet.written, counts, strict=True):
        ledger = statuses[name].ledger
        missing = sum(count for key, count in ledger.items() if key.startswith("lost_"))
        if ledger["samples"] != taken:
            found.append(f"{name}: expected {taken} samples, the frames that its pty accepted, got {ledger['samples']}")
        if abs(missing - refused) > LOST_TOLERANCE * (refused > 0):
            found.append(f"{name}: expected {refused} lost samples, the frames that its pty rejected, got {missing}")
    for name, status in statuses.items():
        if bytes_open(status.ledger) or frames_open(status.ledger):
            found.append(f"{name}: the ledger does not balance: {status.ledger}")
        if name.startswith("replay") and any(count for key, count in status.ledger.items() if key.startswith("lost_")):
            found.append(f"{name}: expected no lost samples in a replay, got {status.ledger}")
    if gaps > dropped:
        found.append(
            f"clients: expected at most {dropped} missing samples, the dropped samples of the daemon, got {gaps}"
        )
    return found


def start_line(stack: ExitStack) -> Process:
    addresses = ",".join(map(str, range(1, MODULES + 1)))
    argv = ["--device", "hipnuc-modbus", "--message", addresses, "--baud", str(MODULE_BAUD), "--seed", str(LINE_SEED)]
    return stack.enter_context(Process(REST_CORES, "-m", "imud.sim", *argv))


@dataclass(frozen=True)
class LineState:
    asked_s: float
    answered_s: float
    ledgers: Mapping[str, Mapping[str, int]]
    failed: Mapping[str, int]
    """Polls without a sample, by device. A status may not yet count the loss of a failed poll."""
    replies: int  # Replies that the devices had sent. Read after the status of imud.


def ask_line(path: Path, line: Process) -> LineState:
    asked_s, statuses, answered_s = monotonic(), ask_all(path)[0], monotonic()
    modules = {name: status for name, status in statuses.items() if name.startswith("modbus")}
    failed = {name: status.polling.failed if status.polling else 0 for name, status in modules.items()}
    line.say("stats")
    replies: int = json.loads(line.line())["answered"]
    return LineState(asked_s, answered_s, {name: s.ledger for name, s in modules.items()}, failed, replies)


def judge_line(begin: LineState, end: LineState) -> list[str]:
    """Return the errors of the bus: each deadline must be a sample or a loss, and each good frame must be a sent reply.

    After a detection, the ledger may contain a gap of unknown size. The sum of this device is then not checked.
    """
    found = []
    for name, before in begin.ledgers.items():
        after, failed = end.ledgers[name], end.failed[name] - begin.failed[name]
        counted = after["samples"] + lost(after) - before["samples"] - lost(before)
        due_min = MODULE_HZ * (end.asked_s - begin.answered_s) - failed - DEADLINE_TOLERANCE
        due_max = MODULE_HZ * (end.answered_s - begin.asked_s) + failed + DEADLINE_TOLERANCE
        if counted > due_max or (counted < due_min and after["lost_unknown"] == before["lost_unknown"]):
            found.append(f"{name}: expected {due_min:.0f} to {due_max:.0f} samples and losses, got {counted}")
    good = sum(ledger["frames_good"] for ledger in end.ledgers.values())
    if good > end.replies:
        found.append(f"modbus: expected at most {end.replies} good frames, the replies of the devices, got {good}")
    return found


def judge_memory(points: list[tuple[float, float]], seconds: float) -> tuple[str, bool]:
    """Return the memory growth as text, and whether it is within its limit."""
    settled = [(t, mb) for t, mb in points if t > SETTLE_S]
    if seconds >= SETTLE_S + SLOPE_MIN_S:
        slope = 3600 * linear_regression(*zip(*settled, strict=True)).slope
        return (
            f"RSS {slope:+.3f} MB/h after {SETTLE_S:g} s (limit {SLOPE_LIMIT_MB_PER_H:g})",
            slope < SLOPE_LIMIT_MB_PER_H,
        )
    half = [mb for t, mb in points if t >= seconds / 2]
    growth = half[-1] - half[0] if half else 0.0
    words = f"RSS {growth:+.2f} MB in the second half (limit {GROWTH_LIMIT_MB:g}; too short for a slope)"
    return words, growth < GROWTH_LIMIT_MB


def watch_for(watched: Watched, recordings: Recordings, readers: Process, seconds: float) -> None:
    """Scrape, check the recordings and print until `seconds` have passed."""
    begin = monotonic()
    next_scrape, minute = 0.0, 0.0
    behind_s = min(BEHIND_AT_S, seconds / 4)
    signals = [(behind_s, SIGSTOP), (behind_s + BEHIND_S, SIGCONT)]
    while (elapsed := monotonic() - begin) < seconds:
        while signals and elapsed >= signals[0][0]:
            # SIGSTOP and SIGCONT: the clients do not read in between
            readers.popen.send_signal(signals.pop(0)[1])
        if elapsed >= next_scrape:
            watched.scrape(elapsed)
            next_scrape += SCRAPE_S
            recordings.look()
        if elapsed - minute >= MINUTE_S:
            watched.minute(elapsed, elapsed - minute)
            minute = elapsed
        sleep(max(min(next_scrape, seconds) - (monotonic() - begin), 0.01))
    readers.popen.send_signal(SIGCONT)  # a short run ends before the signal
    watched.scrape(elapsed)
    watched.minute(elapsed, elapsed - minute)


def run_fleet(seconds: float, metrics_port: int, json_file: Path | None) -> int:
    program_run = ProgramRun()
    written = written_devices()
    print(
        f"soak: {len(written)} devices behind ptys, {MODULES} Modbus devices on a bus and {REPLAYS} replays, "
        f"{sum(r * n for r, n in RATES):g} + {MODULES * MODULE_HZ:g} + {REPLAYS * REPLAY_HZ:g} samples/s, "
        f"{CLIENTS} clients, a scrape every {SCRAPE_S:g} s, all recorded, {seconds:g} s"
    )
    print("soak: without CAN, I2C and SPI, because they need buses of the kernel; see `make chaos` in the lab")
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-soak-") as name, ExitStack() as stack:
        folder = Path(name)
        # longer than the run, so that no replay ends
        write_capture(folder / "capture", seconds + START_LIMIT_S)
        writer = stack.enter_context(
            Process(REST_CORES, "-m", "tests.bench.fleet_writer", "--seconds", str(seconds), *written)
        )
        line = start_line(stack)
        fleet = write_configuration(folder, writer.line().split(), line.line(), metrics_port)
        server = stack.enter_context(Process(SERVER_CORE, "-m", "imud", "run", "-c", str(fleet.configuration)))
        wait_for(folder / "s")
        wait_open(folder / "s", fleet)
        names = list(ask_all(folder / "s")[0])
        limit_s = seconds + 10 * START_LIMIT_S  # the end of the input ends the readers before this limit
        argv = ["--socket", str(folder / "s"), "--clients", str(CLIENTS), "--seconds", str(limit_s), "--devices"]
        readers = stack.enter_context(Process(REST_CORES, "-m", "tests.bench.readers", *argv, *names))
        readers.line()
        watched, recordings = Watched(server.popen.pid, folder / "s", metrics_port), Recordings(folder / "recordings")
        begin = ask_line(folder / "s", line)
        writer.say("go")
        watch_for(watched, recordings, readers, seconds)
        counts = [tuple(pair) for pair in json.loads(writer.line())]
        # wait until the last samples have arrived
        sleep(TAIL_S)
        statuses, dropped = ask_all(folder / "s")
        found = judge_line(begin, ask_line(folder / "s", line))
        found += recordings.close_account(metrics_port)
        readers.say("end")
        figures = json.loads(readers.line())
        server.popen.terminate()
        server.popen.wait(END_LIMIT_S)
        recorded = recordings.finish()
    found += recordings.problems + judge(fleet, counts, statuses, dropped, figures["gaps"])
    words, flat = judge_memory(watched.points, seconds)
    if not flat:
        found.append(words)
    if any(a > b for a, b in zip(watched.usage[-1], watched.usage[0], strict=True)):
        found.append(f"descriptors and threads {watched.usage[-1]}, at the start {watched.usage[0]}")
    taken, refused = (sum(column) for column in zip(*counts, strict=True))
    seen = f"clients {figures['samples']} samples, {figures['gaps']} missing, dropped {dropped}"
    scrapes = f"scrapes {len(watched.points)}, failed requests {watched.unanswered}"
    print(f"frames accepted by ptys {taken}, rejected {refused}; {seen}; {scrapes}; {recorded}; {words}")
    print("\n".join(found or ["passed"]))
    row = {
        "devices": len(statuses), "clients": CLIENTS, "duration, s": seconds, "samples": taken,
        "rejected by ptys": refused, "samples of clients": figures["samples"], "missing at clients": figures["gaps"],
        "dropped": dropped, "memory": words,
    }  # fmt: skip
    program_run.save(json_file, [Table("", [row])], found)
    return 1 if found else 0


def wait_open(path: Path, fleet: Fleet) -> None:
    end = monotonic() + START_LIMIT_S
    while True:
        states = {name: status.state for name, status in ask_all(path)[0].items()}
        modules = [state for name, state in states.items() if name.startswith("modbus")]
        if all(states[name] == "searching" for name in fleet.written) and set(modules) == {"running"}:
            return
        if monotonic() > end:
            raise TimeoutError(f"expected all ports open and all Modbus devices running within {START_LIMIT_S:g} s")
        sleep(0.2)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make soak")
    parser.add_argument("--seconds", type=float, default=3600.0, help="duration, s")
    add_json(parser)
    args = parser.parse_args()
    return run_fleet(args.seconds, free_port(), args.json)


if __name__ == "__main__":
    sys.exit(main())
