"""CPU time of the daemon and bytes on the disk with the output `mqtt` at 1 kHz, for different states of the broker.

The brokers are: Debian's mosquitto; no server at the port; mosquitto that rejects the user; a server that accepts the
connection and reads 1 kB per second; mosquitto stopped with SIGSTOP. A run without the output precedes and follows each
run with the output. The ratio is relative to the mean of both, and the rows show the median of all rounds. The output
sends all samples as slots, and statistics of 1 Hz.

Samples wait only for the thread of the event loop. The CPU time of the daemon also includes the two threads of the
output. These threads use a second core if one exists. The written bytes are `write_bytes` of /proc/PID/io, on the file
system of the working directory.
"""

import socket
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

from tests.bench.rig import Load, Outcome, run
from tests.bench.rows import Row, at_most
from tests.fleet.mosquitto import NO_MOSQUITTO, running_broker
from tests.support.surroundings import free_port

LOOP_RATIO_LIMIT: Final = 1.05
"""Maximum CPU ratio of the event loop's thread. With the output, the thread also puts each batch into a queue."""
SAMPLES: Final[Mapping[str, object]] = {"whole": "slots", "rate_hz": 1}
READ_BYTES: Final = 1000  # 1 kB per second
QUICK: Final = ("present", "gone", "stopped")  # brokers of the short form
HOUR_S: Final = 3600
Place = Callable[[Path], AbstractContextManager[int]]


class Pair(NamedTuple):
    outcome: Outcome
    before: Outcome
    after: Outcome

    def ratio(self, part: str) -> float:
        without = (getattr(self.before, part) + getattr(self.after, part)) / 2
        return float(getattr(self.outcome, part) / without)


def middle(outcomes: Sequence[Outcome], part: str) -> float:
    return float(median(getattr(one, part) for one in outcomes))


def rows(*, quick: bool = False) -> Iterator[Row]:
    if NO_MOSQUITTO:
        print(f"skipped: {NO_MOSQUITTO}")
        return
    rounds, seconds = (1, 2.0) if quick else (5, 6.0)
    brokers = {name: BROKERS[name] for name in QUICK} if quick else BROKERS
    plain = [run(Load(seconds=seconds))]
    pairs: dict[str, list[Pair]] = {name: [] for name in brokers}
    for _ in range(rounds):
        for name, place in brokers.items():
            outcome = run_with(place, Load(seconds=seconds), SAMPLES)
            plain.append(run(Load(seconds=seconds)))
            # the run without the output before and after this run
            pairs[name].append(Pair(outcome, plain[-2], plain[-1]))
    yield Row("1 kHz, no output mqtt: CPU of the event loop per sample", middle(plain, "loop_us_per_sample"), "us")
    yield Row("1 kHz, no output mqtt: latency of samples, p99", middle(plain, "p99_us"), "us")
    for name, found in pairs.items():
        loop, daemon = (
            median(one.ratio(part) for one in found) for part in ("loop_us_per_sample", "cpu_us_per_sample")
        )
        yield at_most(f"1 kHz, broker {name}: CPU ratio of the event loop", loop, "x", LOOP_RATIO_LIMIT)
        yield Row(f"1 kHz, broker {name}: CPU ratio of the daemon", daemon, "x")
        outcomes = [one.outcome for one in found]
        yield Row(f"1 kHz, broker {name}: latency of samples, p99", middle(outcomes, "p99_us"), "us")
        lost = max(one.lost for one in outcomes)
        yield at_most(f"1 kHz, broker {name}: samples lost", float(lost), "samples", 0)
    yield from wear_rows(5.0, ("present",)) if quick else wear_rows(60.0, ("present", "gone"))


def wear_rows(seconds: float, brokers: Sequence[str]) -> Iterator[Row]:
    for words, sending, rate_hz in (
        ("statistics of 1 Hz of 100 Hz", {"rate_hz": 1}, 100.0),
        ("statistics of 10 Hz of 1 kHz", {"rate_hz": 10}, 1000.0),
        ("all samples of 1 kHz as slots", {"whole": "slots", "rate_hz": None}, 1000.0),
    ):
        for name in brokers:
            outcome = run_with(BROKERS[name], Load(seconds=seconds, rate_hz=rate_hz), sending)
            yield Row(f"{words}, broker {name}: written per hour", outcome.written_bytes_s * HOUR_S / 1e6, "MB")


def run_with(place: Place, load: Load, sending: Mapping[str, object]) -> Outcome:
    with tempfile.TemporaryDirectory(dir=".", prefix=".imud-bench-") as name, place(Path(name) / "broker") as port:
        settings = {
            "enabled": True, "brokers": [f"mqtt://127.0.0.1:{port}"], "gateway": "bench", "retry_max_s": 1,
            "spool_directory": str(Path(name).absolute() / "spool"), "devices": {"*": sending},
        }  # fmt: skip
        return run(replace(load, mqtt=settings))


@contextmanager
def present(folder: Path) -> Iterator[int]:
    with running_broker(folder) as broker:
        yield broker.port


@contextmanager
def gone(_folder: Path) -> Iterator[int]:
    yield free_port()


@contextmanager
def refusing(folder: Path) -> Iterator[int]:
    """Run a broker that rejects the user."""
    with running_broker(folder, "allow_anonymous false") as broker:
        yield broker.port


@contextmanager
def stopped(folder: Path) -> Iterator[int]:
    """Run a broker that does not reply. The kernel still accepts connections for it."""
    with running_broker(folder) as broker:
        broker.freeze()
        yield broker.port


@contextmanager
def slow(_folder: Path) -> Iterator[int]:
    """Run a server that accepts each connection and reads READ_BYTES per second."""
    ended = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(0.2)
        thread = threading.Thread(target=_serve_slowly, args=(listener, ended))
        thread.start()
        try:
            yield int(listener.getsockname()[1])
        finally:
            ended.set()
            thread.join(10)


def _serve_slowly(listener: socket.socket, ended: threading.Event) -> None:
    while not ended.is_set():
        with suppress(TimeoutError), listener.accept()[0] as peer:
            # a small receive buffer, so that the kernel does not accept much more than the server reads
            peer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            peer.recv(4096)
            peer.sendall(bytes.fromhex("2003000000"))  # CONNACK: accepted, no properties
            with suppress(OSError):
                while not ended.wait(1.0) and peer.recv(READ_BYTES):
                    pass


BROKERS: Final[Mapping[str, Place]] = {
    "present": present, "gone": gone, "refusing": refusing, "slow": slow, "stopped": stopped,
}  # fmt: skip
