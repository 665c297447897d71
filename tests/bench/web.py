"""CPU time of `imud web` and of the daemon with 0, 1 and 20 browsers, on a device at 1 kHz.

A browser is a WebSocket that displays the page of the device at 20 Hz and acknowledges messages like the page. It does
not draw: drawing costs CPU time only in a browser. The figure of the daemon without browsers is also without any client
on its socket. The three loads alternate, and the rows show the median of the rounds, because other load changes.
"""

import asyncio
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from time import monotonic

from aiohttp import ClientSession, ClientWebSocketResponse

from tests.bench.rig import cpu_ns, rss_mb
from tests.bench.rows import Row, at_most
from tests.support.daemon_process import RunningDaemon, running_daemon, wait_until

RATE_HZ = 1000
LOOK_HZ = 20  # display rate that a browser requests
BROWSERS = (0, 1, 20)
ACKNOWLEDGE_S = 0.25  # the page acknowledges at this interval
WARM_S = 3.0  # time before the measurement
SECONDS, QUICK_SECONDS = 8.0, 5.0
ROUNDS, QUICK_ROUNDS = 5, 1


async def browse(socket: ClientWebSocketResponse, end_s: float) -> int:
    """Receive messages like a page. Return the number of samples in the received buckets."""
    look = {"look": "device", "device": "bow", "rate_hz": LOOK_HZ}
    samples = handled = 0
    due_s = monotonic()
    while monotonic() < end_s:
        if monotonic() >= due_s:
            await socket.send_str(json.dumps({**look, "acknowledged": handled}))
            handled, due_s = 0, monotonic() + ACKNOWLEDGE_S
        try:
            message = json.loads(await socket.receive_str(timeout=ACKNOWLEDGE_S))
        except TimeoutError:
            continue
        handled += 1
        if message["kind"] == "samples":
            samples += sum(bucket["count"] for bucket in message["buckets"])
    return samples


async def share(url: str, browsers: int, pids: Sequence[int], seconds: float) -> tuple[list[float], list[int]]:
    """Return the CPU time of each process per elapsed time, and the samples of each browser, after a warm-up."""
    async with ClientSession() as session:
        sockets = [await session.ws_connect(f"{url}api/stream", headers={"Origin": url[:-1]}) for _ in range(browsers)]
        await asyncio.gather(asyncio.sleep(WARM_S), *(browse(socket, monotonic() + WARM_S) for socket in sockets))
        before = [cpu_ns(pid) for pid in pids]
        begin_s = monotonic()
        _, *counts = await asyncio.gather(
            asyncio.sleep(seconds), *(browse(socket, begin_s + seconds) for socket in sockets)
        )
        took_ns = (monotonic() - begin_s) * 1e9
        used = [(cpu_ns(pid) - cpu) / took_ns for pid, cpu in zip(pids, before, strict=True)]
        for socket in sockets:
            await socket.close()
    return used, [count for count in counts if count is not None]


def end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    process.communicate()


def start(stack: ExitStack, folder: Path) -> tuple[RunningDaemon, str, int]:
    port = str(folder / "port")
    simulator = [sys.executable, "-m", "imud.sim", "--path", port, "--rate", str(RATE_HZ)]
    module = stack.enter_context(subprocess.Popen(simulator, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
    stack.callback(end, module)
    assert module.stdout is not None
    module.stdout.readline()
    devices = {"bow": {"driver": "hipnuc-uart", "uart": {"port": port, "baud": 921600}}}
    daemon = stack.enter_context(running_daemon(folder, devices, python=(), log_level="warning"))
    daemon.wait_for("bow", "running")
    wait_until(lambda: daemon.statuses()["bow"].rate_hz > 0.9 * RATE_HZ, "the module sends at its rate")
    argv = [sys.executable, "-m", "imud", "web", "--socket", str(daemon.socket), "--port", "0"]
    web = stack.enter_context(subprocess.Popen(argv, stdout=subprocess.PIPE, text=True))
    stack.callback(end, web)
    assert web.stdout is not None
    return daemon, web.stdout.readline().strip(), web.pid


def rows(*, quick: bool) -> Iterator[Row]:
    seconds = QUICK_SECONDS if quick else SECONDS
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-bench-")))
        daemon, url, web = start(stack, folder)
        used: dict[int, list[list[float]]] = {browsers: [] for browsers in BROWSERS}
        least_hz = dict.fromkeys(BROWSERS[1:], float("inf"))
        for _ in range(QUICK_ROUNDS if quick else ROUNDS):
            for browsers in BROWSERS:
                shares, counts = asyncio.run(share(url, browsers, (daemon.process.pid, web), seconds))
                used[browsers].append(shares)
                if counts:
                    least_hz[browsers] = min(least_hz[browsers], min(counts) / seconds)
        of_daemon = {browsers: median(one[0] for one in rounds) for browsers, rounds in used.items()}
        of_web = {browsers: median(one[1] for one in rounds) for browsers, rounds in used.items()}
        for browsers in BROWSERS:
            yield Row(f"daemon, {browsers} browsers at {LOOK_HZ} Hz", 100 * of_daemon[browsers], "% of a core")
            yield Row(f"imud web, {browsers} browsers at {LOOK_HZ} Hz", 100 * of_web[browsers], "% of a core")
        for browsers, hz in least_hz.items():
            yield Row(f"samples a second in each of {browsers} browsers, minimum", hz, "Hz")
        yield Row("daemon, 1 browser / 0 browsers", of_daemon[1] / of_daemon[0], "times")
        yield at_most("daemon, 20 browsers / 1 browser", of_daemon[20] / of_daemon[1], "times", 1.1)
        yield Row("imud web, 20 browsers / 1 browser", of_web[20] / of_web[1], "times")
        yield Row("memory of imud web", rss_mb(web), "MB")
        yield Row("load of the host, one minute", os.getloadavg()[0], "processes")
