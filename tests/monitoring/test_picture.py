"""The picture of the dashboard matches the dashboard."""

import re
from html import unescape

from docs.generate import dashboard
from docs.generate import dashboard_picture as picture
from tests.support.files import ROOT


def test_the_picture_is_of_the_dashboard_as_it_is() -> None:
    drawn = {unescape(words) for words in re.findall(r">([^<]+)</text>", picture.FILE.read_text())}
    titles = {panel["title"].replace("$device", picture.CHOSEN) for panel in dashboard.dashboard()["panels"]}
    assert titles <= drawn, "run python -m docs.generate.dashboard_picture"
    assert f"]({picture.FILE.relative_to(ROOT / 'docs')})" in (ROOT / "docs/monitoring.md").read_text()
