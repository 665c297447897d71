"""Rules, examples and documents of monitoring, checked with the tools of Prometheus and Alertmanager."""

import re
import subprocess
import textwrap
from collections import defaultdict
from pathlib import Path

import pytest
import yaml

from docs.generate.alert_table import PARTS
from tests.monitoring.prometheus import DURATION, FLEET_RULES, RULES, UNIT_MS, alerts_of, needs, shortened
from tests.support.files import ROOT

FOLDER = RULES.parent
FILES = (RULES, FLEET_RULES)
TESTS = {rules: Path(__file__).with_name(f"{rules.stem}.test.yml") for rules in FILES}
ALERTS_OF = {rules: {alert["alert"]: alert for alert in alerts_of(rules.read_text())} for rules in FILES}
ALERTS = {name: alert for alerts in ALERTS_OF.values() for name, alert in alerts.items()}
OF_ALL = ("ImudNotScraped", "ImudFleetNotScraped", "ImudFleetShareFree", "ImudFleetVersions")
"""Alerts without a label in the summary: they have no target, or are about the whole fleet."""
pytestmark = pytest.mark.live


def run(*argv: str) -> str:
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@needs("amtool")
def test_alertmanager_accepts_its_configuration() -> None:
    file = str(FOLDER / "alertmanager.yml")
    assert "SUCCESS" in run("amtool", "check-config", file)
    for severity, receiver in (("critical", "on-call"), ("warning", "operators"), ("info", "operators")):
        labels = ("alertname=ImudDeviceDown", f"severity={severity}", "device=bow")
        assert run("amtool", "config", "routes", "test", f"--config.file={file}", *labels).strip() == receiver


@pytest.mark.parametrize("rules", FILES, ids=lambda rules: rules.name)
def test_every_alert_has_a_case_that_fires_and_others_that_do_not(rules: Path) -> None:
    outcomes = defaultdict(list)
    for case in yaml.safe_load(TESTS[rules].read_text())["tests"]:
        for check in case["promql_expr_test"]:
            (name,) = re.findall(r'alertname="(\w+)"', check["expr"])
            assert name == case["name"]
            outcomes[name].append(bool(check["exp_samples"]))
        assert outcomes[case["name"]][-3:] == [False, True, False], case["name"]
        assert len(case["input_series"]) > 1 or case["name"] == "ImudTemperature"
    assert outcomes.keys() == ALERTS_OF[rules].keys()


def test_an_alert_says_what_to_do_and_inhibitions_name_alerts() -> None:
    for name, alert in ALERTS.items():
        assert name.startswith("Imud")
        assert set(alert["annotations"]) == {"summary", *PARTS, "runbook"}, name
        assert alert["labels"]["severity"] in ("info", "warning", "critical"), name
        page, _, anchor = alert["annotations"]["runbook"].partition("#")
        assert anchor == name
        assert f'<a id="{anchor}"></a>' in (ROOT / page).read_text()
        assert "$labels" in alert["annotations"]["summary"] or name in OF_ALL
    for rule in yaml.safe_load((FOLDER / "alertmanager.yml").read_text())["inhibit_rules"]:
        for matcher in rule["source_matchers"] + rule["target_matchers"]:
            for name in re.findall(r"\bImud\w+", matcher):
                assert name in ALERTS


def test_shortened_rules_differ_in_times_only() -> None:
    fast = {alert["alert"]: alert for rules in FILES for alert in alerts_of(shortened(rules.read_text(), 60))}
    assert fast.keys() == ALERTS.keys()

    def milliseconds(text: str) -> list[int]:
        return [int(number) * UNIT_MS[unit] for number, unit in DURATION.findall(text)]

    for name, alert in ALERTS.items():
        quick = fast[name]
        assert (quick["annotations"], quick["labels"]) == (alert["annotations"], alert["labels"])
        assert quick.get("for", "0ms") == f"{sum(milliseconds(alert.get('for', '')), 0) // 60}ms"
        ranges = [time // 60 for text in re.findall(r"\[\w+\]", alert["expr"]) for time in milliseconds(text)]
        assert [int(time) for time in re.findall(r"\[(\d+)ms\]", quick["expr"])] == ranges
        assert re.sub(r"\[\w+\]", "", quick["expr"]) == re.sub(r"\[\w+\]", "", alert["expr"])


# --- the examples of the page --------------------------------------------------------------------------------

PAGE = (ROOT / "docs/monitoring.md").read_text()
MORE_PAGES = (ROOT / "docs/alerts.md", ROOT / "docs/fleet-operation.md")
EXAMPLES = dict(re.findall(r"^```yaml\n# ([\w.-]+\.yml)[^\n]*\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL))


@needs("promtool")
def test_prometheus_accepts_rules_tests_of_alerts_configuration_and_examples(tmp_path: Path) -> None:
    for rules, alerts in ALERTS_OF.items():
        assert f"{len(alerts)} rules found" in run("promtool", "check", "rules", str(rules))
        assert "SUCCESS" in run("promtool", "test", "rules", str(TESTS[rules]))
        (tmp_path / rules.name).write_text(rules.read_text())
    run("promtool", "check", "config", str(FOLDER / "prometheus.yml"))
    assert EXAMPLES.keys() == {"prometheus.yml", "imud-targets.yml", "my.rules.yml"}
    for name, text in EXAMPLES.items():
        (tmp_path / name).write_text(text)
    run("promtool", "check", "config", str(tmp_path / "prometheus.yml"))
    run("promtool", "check", "rules", str(tmp_path / "my.rules.yml"))
    for page in MORE_PAGES:
        (text,) = re.findall(r"```yaml\n( *# prometheus.yml\n.*?)^ *```", page.read_text(), re.MULTILINE | re.DOTALL)
        (tmp_path / "prometheus.yml").write_text(textwrap.dedent(text))
        run("promtool", "check", "config", str(tmp_path / "prometheus.yml"))
    for name in ("prometheus.yml", "imud-targets.yml"):
        assert yaml.safe_load(EXAMPLES[name]) == yaml.safe_load((FOLDER / name).read_text())
