"""The dashboards: files and picture match their description, and a real Prometheus has data for every query."""

import json
import re
import subprocess
import time
from html import unescape
from pathlib import Path
from types import ModuleType

import pytest

from docs.generate import dashboard, fleet_dashboard, grafana
from docs.generate import dashboard_picture as picture
from tests.monitoring.faults import Site, site
from tests.monitoring.prometheus import LIMIT_S, Pace, RealPrometheus, needs, real_prometheus
from tests.support.files import ROOT
from tests.support.surroundings import free_port


@pytest.mark.parametrize("module", [dashboard, fleet_dashboard])
def test_panels_stand_beside_each_other(module: ModuleType) -> None:
    one = module.DASHBOARD
    assert one.file.read_text() == one.text(), f"run python -m {module.__name__}"
    taken: set[tuple[int, int]] = set()
    panels = json.loads(one.text())["panels"]
    for panel in panels:
        place = panel["gridPos"]
        cells = {(x, y) for x in range(place["x"], place["x"] + place["w"])
                 for y in range(place["y"], place["y"] + place["h"])}  # fmt: skip
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < grafana.COLUMNS
        taken |= cells
    assert len({panel["id"] for panel in panels}) == len(panels)
    names = {variable["name"] for variable in one.variables}
    assert set(re.findall(r"\$\{?([a-z]+)", one.text())) <= names


def test_panels_are_in_the_picture() -> None:
    drawn = {unescape(words) for words in re.findall(r">([^<]+)</text>", picture.FILE.read_text())}
    titles = {panel["title"].replace("$device", picture.CHOSEN) for panel in dashboard.DASHBOARD.document()["panels"]}
    assert titles <= drawn, "run python -m docs.generate.dashboard_picture"
    assert f"]({picture.FILE.relative_to(ROOT / 'docs')})" in (ROOT / "docs/monitoring.md").read_text()


@needs("promtool")
@pytest.mark.live
def test_prometheus_reads_every_query(tmp_path: Path) -> None:
    rules = [
        {"record": f"query:{number}", "expr": dashboard.filled_in(expression)}
        for number, (_, expression) in enumerate(dashboard.queries())
    ]
    file = tmp_path / "rules.yml"
    file.write_text(json.dumps({"groups": [{"name": "queries", "rules": rules}]}))
    done = subprocess.run(["promtool", "check", "rules", file], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{len(rules)} rules found" in done.stdout


def test_queries_use_metrics_that_exist() -> None:
    documented = set(re.findall(r"^\| `([a-z_]+)`", (ROOT / "docs/metrics.md").read_text(), re.MULTILINE))
    for title, expression in dashboard.queries():
        for metric in re.findall(r"\b(?:imud|process)_[a-z_]+", expression):
            assert re.sub("_(bucket|count|sum)$", "", metric) in documented, title
    text = " ".join(expression for _, expression in dashboard.queries())
    for metric in (
        "sample_rate", "samples_lost", "clock_error", "sample_latency_seconds_bucket", "temperature", "attitude",
        "vibration_rms", "line_edges", "kernel_errors", "clients",
    ):  # fmt: skip
        assert f"imud_{metric}" in text


def without_data(prometheus: RealPrometheus) -> list[str]:
    return [
        f"{title}: {expression}"
        for title, expression in dashboard.queries()
        if not prometheus.query(dashboard.filled_in(expression))
    ]


@needs("prometheus")
@pytest.mark.live
def test_every_query_has_data(tmp_path: Path) -> None:
    """The daemon has a device on RS-485, a device with lines, and other devices."""
    port = free_port()
    (tmp_path / "site").mkdir()
    with site(tmp_path / "site", port) as one, real_prometheus(tmp_path, pace=Pace.of(one.scrape_s())) as prometheus:
        prometheus.scrape(port)
        end = time.monotonic() + 2 * LIMIT_S
        while missing := without_data(prometheus):
            assert time.monotonic() < end, missing
            time.sleep(0.2)
        assert_devices_are_told_apart(prometheus, one)


def assert_devices_are_told_apart(prometheus: RealPrometheus, one: Site) -> None:
    for title, expression in dashboard.queries():
        if "$device" in expression:
            for series in prometheus.query(dashboard.filled_in(expression, device="quiet")):
                assert series["metric"].get("device", "quiet") == "quiet", title
    devices = prometheus.query("count(max_over_time(imud_device_up[5m]))")  # also if the last scrape was late
    assert devices[0]["value"][1] == str(len(one.wires) + 2)
