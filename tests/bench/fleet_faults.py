"""`make fleet-faults`: a gateway, a broker and all faults between them, as a table.

`python -m tests.bench.fleet_faults [--seconds 20] [--tls] [--postgres] [FAULT …]`. A gateway is the output `mqtt` in a
process of its own, with one device at 1 kHz that sends every sample as a slot, and statistics of 10 Hz. Each fault
starts when samples arrive and lasts `--seconds`. The catch-up time is the time from the end of the fault until no
message older than three seconds is in the spool. Then SIGKILL ends the gateway. The ledger balances if each sequence
number in the spool's file has arrived or is still in the spool. The exit status is 1 if a sequence number is missing or
a ledger does not balance.

With `--tls`, gateway and broker use TLS with certificates on both sides.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic
from typing import Final, NamedTuple

from imud.fleet.messages import Stream
from tests.fleet.authority import Authority
from tests.fleet.gateways import KilledGateway, closes, in_spool
from tests.fleet.mosquitto import NO_MOSQUITTO, Collector, Mosquitto
from tests.fleet.proxy import Proxy
from tests.support.results import ProgramRun, Row, Table, add_json, printed
from tests.support.surroundings import free_port

CAUGHT_UP: Final = 30
"""Maximum number of messages in the spool of an up-to-date gateway: three transactions of ten messages."""
LIMIT_S: Final = 300.0  # time to catch up, or to fill the spool
SMALL_MB: Final = 1.0  # spool of kill-full


class Scene:
    def __init__(self, folder: Path, *lines: str, spool_mb: float = 256.0, tls: bool = False) -> None:
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
        self.collector = Collector(self.broker.port)
        self.spool = folder / "spool"
        self.epoch = 0
        self.high_water = 0
        self.gateway: KilledGateway
        self.start_gateway()

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
            raise TimeoutError(
                f"expected an up-to-date gateway within {LIMIT_S:g} s after the fault; older messages are in the spool"
            )
        return took

    def close(self) -> None:
        self.gateway.kill()
        self.collector.close()
        self.proxy.close()
        self.broker.stop()


Fault = Callable[[Scene, float], object]


def during(begin: Callable[[Scene], object], end: Callable[[Scene], object]) -> Fault:
    def fault(scene: Scene, seconds: float) -> None:
        begin(scene)
        scene.watch(seconds)
        end(scene)

    return fault


restart = during(lambda scene: scene.broker.stop(), lambda scene: scene.broker.start())


def give_rights(scene: Scene, rights: str) -> None:
    (scene.folder / "rights").write_text(f"topic {rights} #\n")
    scene.broker.reload()


def limit_network(scene: Scene, bytes_s: float | None) -> None:
    scene.proxy.bytes_s = bytes_s


def kill_gateway(scene: Scene, seconds: float, full: int = 0) -> None:
    """Kill the gateway three times while the network is cut, after the spool has `full` bytes."""
    scene.proxy.cut()
    end = monotonic() + LIMIT_S
    while scene.high_water < full:
        scene.watch(1.0)
        if monotonic() > end:
            raise TimeoutError(f"expected {full} bytes in the spool within {LIMIT_S:g} s, got {scene.high_water}")
    for _ in range(3):
        scene.watch(seconds / 3)
        scene.gateway.kill()
        scene.start_gateway()
    scene.proxy.restore()


def kill_full(scene: Scene, seconds: float) -> None:
    # 95 % of the size limit, because the spool stays below the limit
    kill_gateway(scene, seconds, round(SMALL_MB * 950_000))


# by name: function and description in the table
FAULTS: Final[Mapping[str, tuple[Fault, str]]] = {
    "none": (lambda scene, seconds: scene.watch(seconds), "none"),
    "restart": (restart, "the broker restarts"),
    "freeze": (
        during(lambda scene: scene.broker.freeze(), lambda scene: scene.broker.thaw()),
        "the broker's process is stopped (SIGSTOP)",
    ),
    "refuse": (
        during(lambda scene: give_rights(scene, "read"), lambda scene: give_rights(scene, "readwrite")),
        "the broker rejects the messages of the gateway",
    ),
    "half-open": (
        during(lambda scene: scene.proxy.stall(), lambda scene: scene.proxy.restore()),
        "the network drops all data, and the connection stays open",
    ),
    "cut": (during(lambda scene: scene.proxy.cut(), lambda scene: scene.proxy.restore()), "the network is cut"),
    "slow-network": (
        during(lambda scene: limit_network(scene, 20_000.0), lambda scene: limit_network(scene, None)),
        "the network is limited to 20 kB/s",
    ),
    "kill": (kill_gateway, "SIGKILL of the gateway, three times, while the network is cut"),
    "kill-full": (kill_full, "SIGKILL of the gateway, three times, with a full spool of 1 MB"),
}


COLUMNS: Final = (
    "numbered", "whole", "thinned", "dropped", "waiting", "duplicates", "lost", "spool, bytes", "catch-up, s",
)  # fmt: skip


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

    @property
    def closes(self) -> bool:
        came = self.whole + self.thinned + self.dropped + self.waiting
        return not self.missing and self.numbered == came


def play(name: str, folder: Path, seconds: float, *, tls: bool) -> Result:
    fault, _ = FAULTS[name]
    rights = folder / "rights"
    rights.write_text("topic readwrite #\n")
    # with an ACL, mosquitto 2.0.11 stores no messages for readers that are offline since its restart (docs/fleet.md)
    lines = ("allow_anonymous true", *((f"acl_file {rights}",) if name == "refuse" else ()))
    spool_mb = SMALL_MB if name == "kill-full" else 256.0
    scene = Scene(folder, *lines, spool_mb=spool_mb, tls=tls)
    try:
        scene.collector.wait_for(lambda: len(scene.collector.fresh) > 5, 60.0)
        fault(scene, seconds)
        catch_up_s = scene.catch_up()
        # 2 s for the last messages that are on their way to the collector
        scene.watch(2.0)
        scene.gateway.kill()
        counts = [one for (_, stream), one in closes(scene.collector, scene.spool).items() if stream == Stream.SAMPLES]
    finally:
        scene.close()
    numbered = last_numbers(scene.spool)
    came = sum(one.newest - one.begin + 1 for one in counts)
    return Result(
        numbered, sum(one.whole for one in counts), sum(one.thinned for one in counts),
        sum(sum(one.dropped.values()) for one in counts), numbered - came, sum(one.duplicates for one in counts),
        sum(one.missing for one in counts), scene.high_water, catch_up_s,
    )  # fmt: skip


def last_numbers(spool: Path) -> int:
    """Return the number of samples that the spool of an ended gateway has numbered, over all its boots."""
    _, positions = in_spool(spool)
    return sum(one.last - one.begin + 1 for one in positions if one.stream == Stream.SAMPLES)


def main() -> int:
    parser = argparse.ArgumentParser(prog="make fleet-faults")
    parser.add_argument("faults", nargs="*", choices=[[], *FAULTS], metavar="FAULT", help=", ".join(FAULTS))
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of each fault, s (default: %(default)g)")
    parser.add_argument("--tls", action="store_true", help="use TLS between gateway and broker")
    add_json(parser)
    args, program_run = parser.parse_args(), ProgramRun()
    if NO_MOSQUITTO:
        print(NO_MOSQUITTO)
        return 1
    problems, rows = list[str](), list[Row]()
    for name in args.faults or FAULTS:
        with tempfile.TemporaryDirectory(prefix="imud-faults-") as folder:
            try:
                one = play(name, Path(folder), args.seconds, tls=args.tls)
            except (AssertionError, TimeoutError) as error:
                problems.append(f"{name}: {error}")
                print(problems[-1], flush=True)
                continue
        if not one.closes:
            problems.append(f"{name}: the ledger does not balance, {one.missing} samples are missing")
        rows.append({"fault": FAULTS[name][1], **dict(zip(COLUMNS, one, strict=True))})
        print(printed(rows[-1]), flush=True)
    program_run.save(args.json, [Table("", rows)], problems)
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
