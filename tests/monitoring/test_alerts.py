"""Every alert in a real Prometheus: inactive without a fault, active with it, and inactive after it.

Prometheus scrapes two daemons:

    site    in this process, a device per fault (`tests.monitoring.faults`)
    spare   `imud run`, which is killed and started again, has no devices, and can open few files

The test divides all times of the rules, by 90 on an idle host: 15 minutes become 10 s.
tests/monitoring/imud.rules.test.yml tests the undivided times. The test prints the time of each alert (`pytest -s`).
"""

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

import pytest

from tests.fleet.mosquitto import NO_MOSQUITTO
from tests.monitoring import prometheus as monitoring_prometheus
from tests.monitoring.faults import WIRES, Wire, site
from tests.support.daemon_process import wait_until, write_config
from tests.support.surroundings import free_port

DEVICE_OF: Final = {
    "ImudDeviceDown": "gone", "ImudReconnects": "flapping", "ImudDeviceDegraded": "lossy", "ImudSamplesLost": "lossy",
    "ImudLossHigh": "lossy", "ImudGapsUnknown": "lossy", "ImudFramesDamaged": "noisy", "ImudBusErrors": "quiet",
    "ImudBusOff": "mute", "ImudTransfersFail": "boom", "ImudTemperature": "hot",
    "ImudDeviceAttention": "tilted",
    "ImudClockErrorLarge": "late", "ImudLatencyHigh": "late", "ImudSyncLost": "jumping",
    "ImudClockResets": "jumping", "ImudLineProblem": "late", "ImudEdgesLost": "lines",
    "ImudPulsesMissing": "lines", "ImudRingStopped": "quiet",
}  # fmt: skip
SITE_ALERTS: Final = (
    "ImudLoopLate", "ImudLogMessagesDropped", "ImudClientsTooSlow", "ImudRecordingStopped", "ImudRecordsLost",
    "ImudBrokerLost", "ImudSpoolStopped",
)  # fmt: skip
SPARE_ALERTS: Final = ("ImudDown", "ImudRestarts", "ImudNoDevices", "ImudFilesNearLimit")


STARTS: Final = 4
WHEN_TOLD: Final = "import sys, imud.cli, imud.daemon; sys.stdin.readline(); sys.exit(imud.cli.main())"
"""Program that imports imud and waits for a line on standard input, so that a start is fast on a slow host."""
STUCK_S: Final = 1.5  # blocked event loop


class Spare:
    """`imud run` with one wire or without a device. The test kills and starts it at most STARTS times."""

    def __init__(self, folder: Path, port: int) -> None:
        self.folder = folder
        self.port = port
        self.wire = Wire(folder / "port")
        self._waiting = [self._prepared() for _ in range(STARTS)]
        self.process: subprocess.Popen[bytes] | None = None

    def _prepared(self) -> subprocess.Popen[bytes]:
        argv = [sys.executable, "-c", WHEN_TOLD, "run", "--config", str(self.folder / "imud.yaml")]
        time.sleep(0.05)  # the start time of a process has a resolution of 10 ms
        with (self.folder / "log").open("ab") as log:
            return subprocess.Popen(argv, stdin=subprocess.PIPE, stderr=log)

    def start(self, *, devices: bool = True) -> None:
        uart = {"port": str(self.wire.name), "baud": 115200}
        entries = {"spare": {"driver": "hipnuc-uart", "identify": False, "uart": uart}} if devices else {}
        write_config(self.folder, entries, metrics={"port": self.port}, log_level="error")
        if self.process is not None:
            self.process.send_signal(signal.SIGHUP)
        else:
            self.process = self._waiting.pop(0)
            assert self.process.stdin is not None
            self.process.stdin.write(b"\n")
            self.process.stdin.flush()

    def kill(self) -> None:
        assert self.process is not None
        _end(self.process)
        self.process = None

    def limit_files(self, spare: int) -> None:
        assert self.process is not None
        held = len(os.listdir(f"/proc/{self.process.pid}/fd"))
        _, most = resource.prlimit(self.process.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(self.process.pid, resource.RLIMIT_NOFILE, (held + spare, most))

    def close(self) -> None:
        for process in (*self._waiting, *([self.process] if self.process else [])):
            _end(process)
        self.wire.unplug()


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait(monitoring_prometheus.LIMIT_S)
    if process.stdin is not None:
        process.stdin.close()


@contextmanager
def spare_daemon(folder: Path, port: int) -> Iterator[Spare]:
    folder.mkdir()
    one = Spare(folder, port)
    try:
        one.start()
        yield one
    finally:
        one.close()


class Watcher:
    def __init__(self, prometheus: monitoring_prometheus.RealPrometheus, expected: dict[str, tuple[str, str]]) -> None:
        self._prometheus = prometheus
        self._expected = expected
        """Device and instance by alert."""
        self.texts: dict[str, monitoring_prometheus.Alert] = {}
        """The newest active alert of each kind."""
        self.begin(firing=True)

    def begin(self, *, firing: bool) -> None:
        self._firing = firing
        self._begin = time.monotonic()
        self.after_s: dict[str, float] = {}

    def look(self) -> set[str]:
        fire = set()
        for alert in self._prometheus.alerts():
            if alert.state == "firing" and (alert.device, alert.instance) == self._expected[alert.name]:
                fire.add(alert.name)
                self.texts[alert.name] = alert
        for name in self._expected:
            if (name in fire) == self._firing:
                self.after_s.setdefault(name, time.monotonic() - self._begin)
        return fire

    def wait(self, *names: str) -> None:
        """Wait until all alerts in `names` have fired, or cleared, in this phase."""
        while missing := set(names) - self.after_s.keys():
            late = f"not yet {'fired' if self._firing else 'cleared'}: {sorted(missing)}; {self.after_s}"
            assert time.monotonic() < self._begin + 2 * monitoring_prometheus.LIMIT_S, late
            time.sleep(0.1)
            self.look()


def wait_scraped(prometheus: monitoring_prometheus.RealPrometheus, watcher: Watcher, spare: Spare) -> None:
    port = spare.port
    before = prometheus.query(f'max_over_time(process_start_time_seconds{{instance="127.0.0.1:{port}"}}[10m])')

    def seen() -> bool:
        watcher.look()
        now = prometheus.query(f'process_start_time_seconds{{instance="127.0.0.1:{port}"}}')
        return bool(now) and float(now[0]["value"][1]) > float(before[0]["value"][1])

    wait_until(seen, "a scrape of the new daemon", monitoring_prometheus.LIMIT_S)


def break_spare(prometheus: monitoring_prometheus.RealPrometheus, watcher: Watcher, spare: Spare) -> None:
    spare.kill()
    watcher.wait("ImudDown")
    for devices in (True, True, False):
        if spare.process is not None:
            spare.kill()
        spare.start(devices=devices)
        wait_scraped(prometheus, watcher, spare)
    spare.limit_files(4)


def mend_spare(spare: Spare) -> None:
    spare.limit_files(200)
    spare.start()


@monitoring_prometheus.needs("prometheus")
@pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO)
@pytest.mark.skipif("IMUD_ALERTS" not in os.environ, reason="takes more than a minute of real time: make alerts")
@pytest.mark.live
@pytest.mark.timeout(1500)
def test_every_alert_fires_and_clears(tmp_path: Path) -> None:
    site_port, spare_port = free_port(), free_port()
    text = monitoring_prometheus.RULES.read_text()
    at_site, at_spare = (f"127.0.0.1:{port}" for port in (site_port, spare_port))
    expected = {name: (device, at_site) for name, device in DEVICE_OF.items()}
    expected |= dict.fromkeys(SITE_ALERTS, ("", at_site)) | dict.fromkeys(SPARE_ALERTS, ("", at_spare))
    expected["ImudNotScraped"] = ("", "")
    assert set(expected) == {alert["alert"] for alert in monitoring_prometheus.alerts_of(text)}
    with ExitStack() as stack:
        (tmp_path / "site").mkdir()
        spare = stack.enter_context(spare_daemon(tmp_path / "spare", spare_port))
        one = stack.enter_context(site(tmp_path / "site", site_port, beside=[spare.wire]))
        pace = monitoring_prometheus.Pace.of(one.scrape_s())
        prometheus = stack.enter_context(
            monitoring_prometheus.real_prometheus(tmp_path, monitoring_prometheus.shortened(text, pace.divisor), pace)
        )
        watcher = Watcher(prometheus, expected)
        watcher.wait("ImudNotScraped")
        fired = dict(watcher.after_s)
        watcher.begin(firing=False)
        prometheus.scrape(site_port, spare_port)
        watcher.wait("ImudNotScraped")
        cleared = {"ImudNotScraped": watcher.after_s["ImudNotScraped"]}
        wait_calm(prometheus)

        watcher.begin(firing=True)
        begin = time.monotonic()
        while "ImudLoopLate" not in watcher.after_s:  # only this alert: scrapes fail while the loop is blocked
            block_s = max(STUCK_S, 1.5 * pace.interval_ms / 1000)
            one.block_loop(block_s)
            time.sleep(2.17 * block_s)  # out of step with the scrapes: one scrape must be in time
            watcher.look()
            assert time.monotonic() < begin + monitoring_prometheus.LIMIT_S
        fired["ImudLoopLate"] = watcher.after_s["ImudLoopLate"]

        watcher.begin(firing=True)
        one.queue_is_full = True
        watcher.wait("ImudRecordsLost")
        one.queue_is_full = False
        fired["ImudRecordsLost"] = watcher.after_s["ImudRecordsLost"]

        watcher.begin(firing=True)
        one.break_everything()
        break_spare(prometheus, watcher, spare)
        watcher.wait(*(expected.keys() - fired.keys()))
        fired = watcher.after_s | fired

        watcher.begin(firing=False)
        one.mend_everything()
        mend_spare(spare)
        watcher.wait(*(expected.keys() - {"ImudNotScraped"}))
        cleared = watcher.after_s | cleared
        wait_calm(prometheus)
    print(table(fired, cleared, watcher, pace))
    for alert in watcher.texts.values():
        for text in alert.annotations.values():
            # Prometheus shows template errors with <error>, and missing values with <no value>
            assert "<" not in text, text


def wait_calm(prometheus: monitoring_prometheus.RealPrometheus) -> None:
    end = time.monotonic() + 2 * monitoring_prometheus.LIMIT_S
    while wrong := unrest(prometheus):
        assert time.monotonic() < end, wrong
        time.sleep(0.2)


def unrest(prometheus: monitoring_prometheus.RealPrometheus) -> list[str]:
    firing = [f"{alert.name} {alert.device}" for alert in prometheus.alerts() if alert.state == "firing"]
    up = {one["metric"]["device"]: one["value"][1] == "1" for one in prometheus.query("imud_device_up")}
    return firing + [f"expected {name} to be up" for name in (*WIRES, "boom", "module", "spare") if not up.get(name)]


def table(
    fired: dict[str, float], cleared: dict[str, float], watcher: Watcher, pace: monitoring_prometheus.Pace
) -> str:
    rows = [f"\n{'alert':24} {'fires after':>12} {'clears after':>13}  ({pace})"]
    for name in sorted(fired):
        summary = watcher.texts[name].annotations["summary"]
        rows.append(f"{name:24} {fired[name]:10.1f} s {cleared[name]:11.1f} s  {summary}")
    return "\n".join(rows)
