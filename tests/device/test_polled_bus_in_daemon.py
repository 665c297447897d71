"""The daemon with a polled device, a thread and real time."""

import asyncio
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from time import monotonic_ns
from typing import Any, NoReturn

import pytest

from imud.config.model import Config
from imud.daemon import Daemon
from imud.host.threads import SWITCH_INTERVAL_S, BusThread
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.support.event_loops import in_loop
from tests.support.polled_bus_bench import PolledBusBench

pytestmark = pytest.mark.live
LIMIT_S = 60


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PolledBusBench:
    return PolledBusBench(tmp_path, monkeypatch)


def wait_until_running(daemon: Daemon, then: Callable[[], None]) -> Coroutine[Any, Any, None]:
    async def watch() -> None:
        while sum(device.ledger["samples"] for device in daemon.status()) < 5:
            await asyncio.sleep(0.005)
        then()

    return watch()


@in_loop
async def test_daemon_serves_a_polled_device(bench: PolledBusBench) -> None:
    bench.spi.device = Imu61xRegisters(monotonic_ns).spi
    daemon = Daemon(Config("info", "", {}, (bench.on_spi(),)))
    watching = asyncio.create_task(wait_until_running(daemon, daemon.stop))
    await asyncio.wait_for(daemon.run(), LIMIT_S)
    await watching
    assert daemon.status()[0].driver == "imu61x-spi"
    assert not bench.spi.opened


def test_an_internal_error_in_the_bus_thread_ends_the_daemon(bench: PolledBusBench) -> None:
    def mistake(_selections: Any, _mode: int) -> list[bytes]:
        raise ZeroDivisionError("a mistake")

    bench.spi.device = mistake

    async def body() -> None:
        await asyncio.wait_for(Daemon(Config("info", "", {}, (bench.on_spi(),))).run(), LIMIT_S)

    with pytest.raises(ZeroDivisionError, match="a mistake"):
        asyncio.run(body())


class SleepingJob:
    def do_round(self) -> int:
        return 1_000_000_000

    def round_failed(self, error: BaseException) -> NoReturn:
        raise error


@pytest.mark.parametrize(("before_s", "after_s"), [(0.005, SWITCH_INTERVAL_S), (0.0001, 0.0001)])
def test_the_daemon_shortens_the_switch_interval_for_a_bus_thread(before_s: float, after_s: float) -> None:
    """Reads at 1 kHz next to a busy loop. A shorter switch interval stays."""
    kept = sys.getswitchinterval()
    try:
        sys.setswitchinterval(before_s)
        BusThread("bus", SleepingJob()).end()
        assert sys.getswitchinterval() == pytest.approx(after_s, abs=2e-6)
    finally:
        sys.setswitchinterval(kept)
