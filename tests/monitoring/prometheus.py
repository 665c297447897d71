"""A real Prometheus for tests: configuration, process and HTTP API, and the alerting rules with shorter times."""

import json
import re
import shutil
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest
import yaml

from tests.support.daemon_process import wait_until
from tests.support.files import ROOT
from tests.support.surroundings import free_port

RULES: Final = ROOT / "etc/prometheus/imud.rules.yml"
FLEET_RULES: Final = ROOT / "etc/prometheus/imud-fleet.rules.yml"
LIMIT_S: Final = 120.0
INTERVAL_MS: Final = 250
"""Time between scrapes and between evaluations of the rules, ms. `Pace` makes it longer if a scrape takes long."""
DURATION: Final = re.compile(r"\b(\d+)([smh])\b")
UNIT_MS: Final = {"s": 1000, "m": 60_000, "h": 3_600_000}


def needs(*programs: str) -> pytest.MarkDecorator:
    missing = [program for program in programs if shutil.which(program) is None]
    return pytest.mark.skipif(bool(missing), reason=f"cannot find {', '.join(missing)}; try make monitoring-deps")


def alerts_of(text: str) -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(text)["groups"] for rule in group["rules"]]


def shortened(text: str, divisor: int) -> str:
    def shorter(found: re.Match[str]) -> str:
        return f"{int(found[1]) * UNIT_MS[found[2]] // divisor}ms"

    lines = []
    for line in text.splitlines():
        if re.match(r"\s+for: ", line):
            line = DURATION.sub(shorter, line)  # noqa: PLW2901 - the changed line
        elif "[" in line and "next_step" not in line:
            line = re.sub(r"\[(\d+[smh])\]", lambda found: f"[{DURATION.sub(shorter, found[1])}]", line)  # noqa: PLW2901
        lines.append(line)
    return "\n".join(lines) + "\n"


class Pace(NamedTuple):
    """Speed at which a test lets the time of the rules pass on this host."""

    interval_ms: int = INTERVAL_MS
    divisor: int = 90
    """Divisor of the times of the rules: 15 minutes become 10 s."""

    @classmethod
    def of(cls, scrape_s: float) -> "Pace":
        """Return a pace at which a scrape may take four times as long as this one; at most 16 times slower."""
        slower = min(max(4000 * scrape_s / cls().interval_ms, 1.0), 16.0)
        return cls(round(cls().interval_ms * slower), round(cls().divisor / slower))


class Alert(NamedTuple):
    name: str
    device: str
    instance: str
    state: str
    labels: Mapping[str, str]
    annotations: Mapping[str, str]


class RealPrometheus:
    """A running Prometheus. Synchronization: none required."""

    def __init__(self, folder: Path, port: int) -> None:
        self._targets = folder / "targets.json"
        self._url = f"http://127.0.0.1:{port}"

    def scrape(self, *ports: int) -> None:
        fresh = self._targets.with_suffix(".new")
        fresh.write_text(json.dumps([{"targets": [f"127.0.0.1:{port}" for port in ports]}]))
        fresh.rename(self._targets)

    def get(self, path: str, **parameters: str) -> Any:
        query = f"?{urllib.parse.urlencode(parameters)}" if parameters else ""
        with urllib.request.urlopen(f"{self._url}/api/v1/{path}{query}", timeout=LIMIT_S) as answer:
            found = json.load(answer)
        assert found["status"] == "success", found
        return found["data"]

    def ready(self) -> bool:
        try:
            with urllib.request.urlopen(f"{self._url}/-/ready", timeout=LIMIT_S) as answer:
                return bool(answer.status == 200)
        except OSError:
            return False

    def alerts(self) -> list[Alert]:
        found = []
        for alert in self.get("alerts")["alerts"]:
            labels = alert["labels"]
            names = labels["alertname"], labels.get("device", ""), labels.get("instance", "")
            found.append(Alert(*names, alert["state"], labels, alert["annotations"]))
        return found

    def query(self, expression: str) -> list[dict[str, Any]]:
        result: list[dict[str, Any]] = self.get("query", query=expression)["result"]
        return result

    def query_range(self, expression: str, start_s: float, end_s: float, step_s: float) -> list[dict[str, Any]]:
        times = {"start": f"{start_s:.3f}", "end": f"{end_s:.3f}", "step": f"{step_s:.3f}"}
        result: list[dict[str, Any]] = self.get("query_range", query=expression, **times)["result"]
        return result


def configuration(folder: Path, interval_ms: int, rules: Sequence[str], job: str = "imud") -> str:
    """Return prometheus.yml with one job. Its targets are in a file."""
    names = ("scrape_interval", "scrape_timeout", "evaluation_interval")
    times = json.dumps(dict.fromkeys(names, f"{interval_ms}ms"))
    return f"""\
global: {times}
rule_files: {json.dumps(list(rules))}
scrape_configs:
  - job_name: {job}
    file_sd_configs: [{{files: [{folder}/targets.json], refresh_interval: 1s}}]
"""


@contextmanager
def real_prometheus(
    folder: Path, rules: str = "", pace: Pace | None = None, job: str = "imud"
) -> Iterator[RealPrometheus]:
    """Run Prometheus in a folder with these rules. It has no targets at first."""
    port = free_port()
    running = RealPrometheus(folder, port)
    running.scrape()
    (folder / "rules.yml").write_text(rules or "groups: []\n")
    file = folder / "prometheus.yml"
    file.write_text(configuration(folder, (pace or Pace()).interval_ms, [str(folder / "rules.yml")], job))
    argv = [
        "prometheus", f"--config.file={file}", f"--storage.tsdb.path={folder / 'tsdb'}", "--log.level=warn",
        f"--web.listen-address=127.0.0.1:{port}",
    ]  # fmt: skip
    with (
        (folder / "prometheus.log").open("w") as log,
        subprocess.Popen(argv, stdin=subprocess.DEVNULL, stdout=log, stderr=log) as process,
    ):
        try:
            wait_until(lambda: running.ready() or process.poll() is not None, "Prometheus is ready", LIMIT_S)
            assert process.poll() is None, (folder / "prometheus.log").read_text()
            yield running
        finally:
            process.terminate()
            process.wait(LIMIT_S)
