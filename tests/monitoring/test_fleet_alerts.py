"""Every alert of a fleet in a real Prometheus: inactive without a fault, active with it, and inactive after it.

Prometheus scrapes two collectors of a small fleet (`tests.monitoring.fleet_site`). The test divides all times of the
rules, by 180 on an idle host. tests/monitoring/imud-fleet.rules.test.yml tests the undivided times.
"""

import os
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fleet.mosquitto import NO_MOSQUITTO
from tests.fleet.postgres_server import NO_POSTGRES
from tests.monitoring.fleet_site import FleetSite, fleet_site
from tests.monitoring.prometheus import (
    FLEET_RULES,
    LIMIT_S,
    Alert,
    Pace,
    RealPrometheus,
    alerts_of,
    needs,
    real_prometheus,
    shortened,
)

OF_GATEWAYS = {
    "ImudFleetGatewaySilent", "ImudFleetSamplesDropped", "ImudFleetSamplesMissing", "ImudFleetBacklogGrows",
    "ImudFleetMessagesRejected", "ImudFleetClockNotSet", "ImudFleetVersions",
}  # fmt: skip
OF_PROCESSES = {"ImudFleetCollectorDown", "ImudFleetBrokerLost", "ImudFleetDatabaseDown", "ImudFleetShareFree"}


class FleetWatcher:
    """Alerts of a Prometheus, with the time until each alert fires or clears."""

    def __init__(self, prometheus: RealPrometheus) -> None:
        self._prometheus = prometheus
        self.texts: dict[str, Alert] = {}  # newest active alert of each kind
        self.times: list[str] = []

    def firing(self) -> list[Alert]:
        found = [alert for alert in self._prometheus.alerts() if alert.state == "firing"]
        self.texts |= {alert.name: alert for alert in found}
        return found

    def wait_fired(self, names: set[str]) -> None:
        self._wait("fires", names, lambda firing: names & firing)

    def wait_cleared(self, names: set[str]) -> None:
        self._wait("clears", names, lambda firing: names - firing)

    def _wait(self, word: str, names: set[str], done_of: Callable[[set[str]], set[str]]) -> None:
        begin, seen = time.monotonic(), set[str]()
        while names - seen:
            assert time.monotonic() < begin + 2 * LIMIT_S, f"no alert {word} of {names - seen}; {self.times}"
            for name in done_of({alert.name for alert in self.firing()}) - seen:
                seen.add(name)
                self.times.append(f"{name:28} {word} after {time.monotonic() - begin:5.1f} s")
            time.sleep(0.1)

    def wait_calm(self) -> None:
        """Wait until no alert fires and Prometheus knows all gateways."""
        end = time.monotonic() + 2 * LIMIT_S
        while (firing := self.firing()) or self._online() != 8:
            assert time.monotonic() < end, (firing, self._online(), self.times)
            time.sleep(0.2)

    def _online(self) -> int:
        found = self._prometheus.query('max by (site) (imud_fleet_gateways{state="online"})')
        return int(found[0]["value"][1]) if found else 0


def scrape_s(one: FleetSite) -> float:
    """Return the longest of three scrape times, s."""
    times: list[float] = []
    while len(times) < 3:
        begin = time.monotonic()
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{one.ports[0]}/metrics", timeout=LIMIT_S) as answer:
                answer.read()
            times.append(time.monotonic() - begin)
        except OSError:  # the collector starts
            time.sleep(0.1)
    return max(times)


@needs("prometheus")
@pytest.mark.skipif(bool(NO_MOSQUITTO or NO_POSTGRES), reason=NO_MOSQUITTO or NO_POSTGRES)
@pytest.mark.skipif("IMUD_ALERTS" not in os.environ, reason="takes a minute of real time: make alerts")
@pytest.mark.live
@pytest.mark.timeout(900)
def test_every_alert_of_a_fleet_fires_and_clears(tmp_path: Path) -> None:
    text = FLEET_RULES.read_text()
    expected = {"ImudFleetNotScraped", "ImudFleetTransactionsSlow"} | OF_GATEWAYS | OF_PROCESSES
    assert expected == {alert["alert"] for alert in alerts_of(text)}
    with fleet_site(tmp_path / "site") as one:
        pace = Pace.of(scrape_s(one))
        pace = pace._replace(divisor=2 * pace.divisor)
        with real_prometheus(tmp_path, shortened(text, pace.divisor), pace, job="imud-fleet") as prometheus:
            watcher = FleetWatcher(prometheus)
            watcher.wait_fired({"ImudFleetNotScraped"})
            prometheus.scrape(*one.ports)
            watcher.wait_calm()

            one.set_faults(faulty=True)
            watcher.wait_fired(OF_GATEWAYS)
            states = {alert.labels["state"] for alert in watcher.firing() if alert.name == "ImudFleetGatewaySilent"}
            assert states == {"silent", "offline"}
            one.set_faults(faulty=False)

            with one.locked_ledger():
                watcher.wait_fired({"ImudFleetTransactionsSlow"})

            one.collectors[1].kill()
            one.broker.stop()
            watcher.wait_fired({"ImudFleetCollectorDown", "ImudFleetBrokerLost"})
            one.database.kill()
            watcher.wait_fired({"ImudFleetDatabaseDown", "ImudFleetShareFree"})

            one.database.start()
            one.broker.start()
            one.collectors[1].start()
            watcher.wait_cleared(expected)
            watcher.wait_calm()
    print("\n".join(["", f"({pace})", *watcher.times]))
    assert watcher.texts.keys() == expected
    for alert in watcher.texts.values():
        for annotation in alert.annotations.values():
            # Prometheus shows template errors with <error>, and missing values with <no value>
            assert "<" not in annotation, annotation
