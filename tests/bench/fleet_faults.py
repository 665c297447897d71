"""`make fleet-faults`: a gateway, a broker and everything that can happen between them, as a table.

`python -m tests.bench.fleet_faults [--seconds 20] [--tls] [--postgres] [FAULT …]`. A gateway is the output `mqtt` in a
process of its own, with one device at 1 kHz, every sample as a slot and statistics of 10 Hz. Each fault begins once
samples arrive, and lasts `--seconds`; catching up is from its end until nothing waits that is older than three seconds.
At the end the gateway is killed with SIGKILL, and the ledger has to close: what its spool's file has given numbers to
is what came, or what still waits. It ends with 1 where a number is missing, or the ledger does not close.

With --tls the gateway speaks TLS, with certificates of both sides. With --postgres `imud fleet collect` writes rows
meanwhile, of which there have to be as many as whole samples that came.
"""

import argparse
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from time import monotonic
from typing import Any, Final, NamedTuple

from imud.fleet.messages import Stream
from tests.bench.fleet_rows import RowCollector
from tests.fleet.authority import Authority
from tests.fleet.gateways import KilledGateway, closes, in_spool
from tests.fleet.mosquitto import NO_MOSQUITTO, Collector, Mosquitto
from tests.fleet.postgres_server import NO_POSTGRES, running_postgres
from tests.fleet.proxy import Proxy
from tests.support.surroundings import free_port

CAUGHT_UP: Final = 30
"""Messages in the spool of a gateway that is up to date: those of three transactions, ten in each."""
LIMIT_S: Final = 300.0
UP_S: Final = 3.0
"""Between two restarts: a mosquitto that is ended while it starts does not end."""
SMALL_MB: Final = 1.0


class Scene:
    def __init__(
        self, folder: Path, *lines: str, spool_mb: float = 256.0, tls: bool = False, database: str = ""
    ) -> None:
        self.folder, self.spool_mb = folder, spool_mb
        (folder / "broker").mkdir(parents=True)
        self.authority: Authority | None = None
        port = free_port()
        if tls:
            (folder / "certificates").mkdir()
            self.authority = Authority(folder / "certificates")
            lines = (*lines, *(line for line in self.authority.listener(port) if line not in lines))
        self.broker = Mosquitto(folder / "broker", lines, free_port())
        self.broker.start()
        self.proxy = Proxy(port if tls else self.broker.port)
        self.rows: RowCollector | None = None
        if database:
            self.rows = RowCollector(f"mqtt://127.0.0.1:{self.broker.port}", database, folder / "collector.log")
        self.held = threading.Event()
        self.collector = Collector(self.broker.port, prepare=self._prepare)
        self.spool = folder / "spool"
        self.epoch = 0
        self.high_water = 0
        self.gateway: KilledGateway
        self.start_gateway()

    def _prepare(self, client: Any) -> None:
        take = client.on_message

        def slowly(*args: object) -> None:
            if self.held.is_set():
                threading.Event().wait(0.2)
            take(*args)

        client.on_message = slowly

    def start_gateway(self) -> None:
        self.epoch += 1
        self.gateway = KilledGateway(self.proxy.port, self.spool, self.epoch, self.spool_mb, self.authority)

    def watch(self, seconds: float, until: Callable[[int], bool] = lambda waiting: False) -> float:
        begin = monotonic()
        while (rest := begin + seconds - monotonic()) > 0:
            state = self.gateway.state(rest)
            if state is None:
                continue
            self.high_water = max(self.high_water, state.spool_bytes)
            if until(state.waiting):
                break
        return monotonic() - begin

    def catch_up(self) -> float:
        took = self.watch(LIMIT_S, lambda waiting: waiting <= CAUGHT_UP)
        if took >= LIMIT_S:
            raise TimeoutError(f"still not up to date after {LIMIT_S:g} s")
        return took

    def close(self) -> None:
        self.gateway.kill()
        self.collector.close()
        if self.rows is not None:
            self.rows.end(signal.SIGKILL)
        self.proxy.close()
        self.broker.stop()


Fault = Callable[[Scene, float], None]


def nothing(scene: Scene, seconds: float) -> None:
    scene.watch(seconds)


def restart(scene: Scene, seconds: float) -> None:
    scene.broker.stop()
    scene.watch(seconds)
    scene.broker.start()


def kill_broker(scene: Scene, seconds: float) -> None:
    for _ in range(3):
        restart(scene, seconds / 3)
        scene.watch(UP_S)


def freeze(scene: Scene, seconds: float) -> None:
    scene.broker.freeze()
    scene.watch(seconds)
    scene.broker.thaw()


def refuse(scene: Scene, seconds: float) -> None:
    rights = scene.folder / "rights"
    rights.write_text("topic read #\n")
    scene.broker.reload()
    scene.watch(seconds)
    rights.write_text("topic readwrite #\n")
    scene.broker.reload()


def half_open(scene: Scene, seconds: float) -> None:
    scene.proxy.stall()
    scene.watch(seconds)
    scene.proxy.restore()


def cut(scene: Scene, seconds: float) -> None:
    scene.proxy.cut()
    scene.watch(seconds)
    scene.proxy.restore()


def slow_network(scene: Scene, seconds: float) -> None:
    scene.proxy.bytes_s = 20_000.0
    scene.watch(seconds)
    scene.proxy.bytes_s = None


def slow_collector(scene: Scene, seconds: float) -> None:
    scene.held.set()
    scene.watch(seconds)
    scene.held.clear()


def kill_gateway(scene: Scene, seconds: float) -> None:
    scene.proxy.cut()
    for _ in range(3):
        scene.watch(seconds / 3)
        scene.gateway.kill()
        scene.start_gateway()
    scene.proxy.restore()


def kill_full(scene: Scene, seconds: float) -> None:
    scene.proxy.cut()
    full = round(SMALL_MB * 950_000)
    end = monotonic() + LIMIT_S
    while scene.high_water < full:
        scene.watch(1.0)
        if monotonic() > end:
            raise TimeoutError(f"the spool has {scene.high_water} bytes after {LIMIT_S:g} s")
    for _ in range(3):
        scene.watch(seconds / 3)
        scene.gateway.kill()
        scene.start_gateway()
    scene.proxy.restore()


def kill_collector(scene: Scene, seconds: float) -> None:
    for _ in range(3):
        scene.watch(seconds / 6)
        if scene.rows is not None:
            scene.rows.end(signal.SIGKILL)
        scene.watch(seconds / 6)
        if scene.rows is not None:
            scene.rows.start()


FAULTS: Final[Mapping[str, tuple[Fault, str]]] = {
    "none": (nothing, "none"),
    "restart": (restart, "the broker is ended and comes back"),
    "restarts": (kill_broker, "the same three times"),
    "freeze": (freeze, "the broker's process is stopped (SIGSTOP)"),
    "refuse": (refuse, "the broker refuses what the gateway sends"),
    "half-open": (half_open, "nothing passes, and no end learns of it"),
    "cut": (cut, "the network is cut"),
    "slow-network": (slow_network, "20 kB/s pass"),
    "slow-collector": (slow_collector, "the collector takes 5 messages a second"),
    "kill": (kill_gateway, "SIGKILL three times while the network is cut"),
    "kill-full": (kill_full, "the same with a spool of 1 MB that is full"),
    "kill-collector": (kill_collector, "SIGKILL three times of the collector that writes rows"),
}


class Result(NamedTuple):
    numbered: int
    whole: int
    thinned: int
    dropped: int
    waiting: int
    duplicates: int
    missing: int
    high_water: int
    catch_up_s: float
    rows: int | None
    """In the database; None without one."""

    @property
    def closes(self) -> bool:
        came = self.whole + self.thinned + self.dropped + self.waiting
        return not self.missing and self.numbered == came and self.rows in (None, self.whole)


def play(name: str, folder: Path, seconds: float, *, tls: bool, database: str) -> Result:
    fault, _ = FAULTS[name]
    rights = folder / "rights"
    rights.write_text("topic readwrite #\n")
    # with rights, mosquitto 2.0.11 keeps nothing for readers that are away since its restart (docs/fleet.md)
    lines = ("allow_anonymous true", *((f"acl_file {rights}",) if name == "refuse" else ()))
    spool_mb = SMALL_MB if name == "kill-full" else 256.0
    scene = Scene(folder, *lines, spool_mb=spool_mb, tls=tls, database=database)
    try:
        scene.collector.wait_for(lambda: len(scene.collector.fresh) > 5, 60.0)
        fault(scene, seconds)
        catch_up_s = scene.catch_up()
        scene.watch(2.0)
        scene.gateway.kill()
        counts = [one for (_, stream), one in closes(scene.collector, scene.spool).items() if stream == Stream.SAMPLES]
        rows = None if scene.rows is None else scene.rows.rows_after(sum(one.whole for one in counts))
        if scene.rows is not None and (missing := scene.rows.missing()):
            raise AssertionError(f"the ledger in the database misses {missing}")
    finally:
        scene.close()
    numbered = last_numbers(scene.spool)
    came = sum(one.newest - one.begin + 1 for one in counts)
    return Result(
        numbered, sum(one.whole for one in counts), sum(one.thinned for one in counts),
        sum(sum(one.dropped.values()) for one in counts), numbered - came, sum(one.duplicates for one in counts),
        sum(one.missing for one in counts), scene.high_water, catch_up_s, rows,
    )  # fmt: skip


def last_numbers(spool: Path) -> int:
    """Samples that the spool of a gateway that has ended gave numbers to, in all its boots."""
    _, positions = in_spool(spool)
    return sum(one.last - one.begin + 1 for one in positions if one.stream == Stream.SAMPLES)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-faults")
    parser.add_argument("faults", nargs="*", choices=[[], *FAULTS], metavar="FAULT", help=", ".join(FAULTS))
    parser.add_argument("--seconds", type=float, default=20.0, help="how long each fault lasts (default: %(default)g)")
    parser.add_argument("--tls", action="store_true", help="between gateway and broker")
    parser.add_argument("--postgres", action="store_true", help="count the rows that `imud fleet collect` writes")
    args = parser.parse_args()
    if missing := NO_MOSQUITTO or (NO_POSTGRES if args.postgres else ""):
        print(missing)
        return 1
    failed = False
    head = "| fault | numbered | whole | thinned | dropped | waiting | duplicate | lost | spool, kB | catching up, s |"
    print(f"{head} rows |\n{'|---' * 11}|")
    for name in args.faults or FAULTS:
        with ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-faults-"))
            database = stack.enter_context(running_postgres()) if args.postgres else ""
            try:
                one = play(name, Path(folder), args.seconds, tls=args.tls, database=database)
            except (AssertionError, TimeoutError) as error:
                failed = True
                print(f"| {name} | FAILED: {error} |", flush=True)
                continue
        failed |= not one.closes
        print(
            f"| {FAULTS[name][1]} | {one.numbered} | {one.whole} | {one.thinned} | {one.dropped} |"
            f" {one.waiting} | {one.duplicates} | {one.missing} | {one.high_water / 1000:.0f} | {one.catch_up_s:.1f} |"
            f" {'-' if one.rows is None else one.rows} |",
            flush=True,
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
