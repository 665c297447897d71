"""The dashboard: its file is that of its description, and a real Prometheus has data for every query."""

import json
import re
import subprocess
from pathlib import Path

import pytest

from tests.monitoring import dashboard
from tests.monitoring.prometheus import needs
from tests.support.files import ROOT


def test_the_file_is_that_of_the_description() -> None:
    assert dashboard.FILE.read_text() == dashboard.text(), "run python -m tests.monitoring.dashboard"


def test_panels_stand_beside_each_other() -> None:
    taken: set[tuple[int, int]] = set()
    panels = json.loads(dashboard.text())["panels"]
    for panel in panels:
        place = panel["gridPos"]
        cells = {(x, y) for x in range(place["x"], place["x"] + place["w"])
                 for y in range(place["y"], place["y"] + place["h"])}  # fmt: skip
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < dashboard.COLUMNS
        taken |= cells
    assert len({panel["id"] for panel in panels}) == len(panels)


def test_what_an_operator_looks_for_is_there() -> None:
    text = " ".join(expression for _, expression in dashboard.queries())
    for metric in (
        "sample_rate", "samples_lost", "clock_error", "sample_latency_seconds_bucket", "temperature", "attitude",
        "vibration_rms", "line_edges", "kernel_errors", "clients",
    ):  # fmt: skip
        assert f"imud_{metric}" in text


@needs("promtool")
@pytest.mark.timeout(300)
def test_prometheus_reads_every_query(tmp_path: Path) -> None:
    rules = [
        {"record": f"query:{number}", "expr": dashboard.filled_in(expression)}
        for number, (_, expression) in enumerate(dashboard.queries())
    ]
    file = tmp_path / "rules.yml"
    file.write_text(json.dumps({"groups": [{"name": "queries", "rules": rules}]}))
    done = subprocess.run(
        ["promtool", "check", "rules", file], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{len(rules)} rules found" in done.stdout


def test_queries_use_metrics_that_exist() -> None:
    documented = set(re.findall(r"^\| `([a-z_]+)`", (ROOT / "docs/metrics.md").read_text(), re.MULTILINE))
    for title, expression in dashboard.queries():
        for metric in re.findall(r"\b(?:imud|process)_[a-z_]+", expression):
            assert re.sub("_(bucket|count|sum)$", "", metric) in documented, title
