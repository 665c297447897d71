"""The picture of the dashboard: it matches the dashboard, with numbers and names in the format of Grafana."""

import re
from html import unescape

import pytest

from docs.generate import dashboard
from docs.generate import dashboard_picture as picture
from tests.support.files import ROOT


def test_the_picture_is_of_the_dashboard_as_it_is() -> None:
    drawn = {unescape(words) for words in re.findall(r">([^<]+)</text>", picture.FILE.read_text())}
    titles = {panel["title"].replace("$device", picture.CHOSEN) for panel in dashboard.dashboard()["panels"]}
    assert titles <= drawn, "run python -m docs.generate.dashboard_picture"
    assert f"]({picture.FILE.relative_to(ROOT / 'docs')})" in (ROOT / "docs/monitoring.md").read_text()


@pytest.mark.parametrize(
    ("value", "unit", "words"),
    [
        (0.0123, "s", "12.3 ms"), (2e-6, "s", "2 µs"), (1.5, "s", "1.5 s"), (0.0, "s", "0"),
        (3 * 2**20, "bytes", "3 MiB"),
        (0.07, "percentunit", "7 %"), (-67.2, "degree", "-67.2 °"), (2, "none", "2"),
    ],
)  # fmt: skip
def test_a_value_has_its_unit(value: float, unit: str, words: str) -> None:
    assert picture.shown(value, unit) == words


def test_values_and_legends_are_as_in_grafana() -> None:
    labels = {"device": "bow", "cause": "crc", "driver": "hipnuc-uart"}
    assert picture.named("{{device}}: {{cause}}", labels) == "bow: crc"
    assert picture.named("", labels).split() == ["bow", "hipnuc-uart"]
    assert {panel.unit for row in dashboard.ROWS for panel in row.panels} <= picture.UNITS.keys()
