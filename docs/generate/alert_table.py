"""Tables of alerts in docs/monitoring.md and docs/fleet-operation.md (`python -m docs.generate.references`)."""

import re
from pathlib import Path
from typing import Final

from tests.monitoring.prometheus import alerts_of

PARTS: Final = ("description", "cause", "next_step")
"""Annotations that are columns of the table."""


def alert_table(rules: Path) -> str:
    """Return the table with one row per alert of a file of rules."""
    rows = ["| alert | severity, after | meaning | likely causes | next step |", "|---|---|---|---|---|"]
    for alert in alerts_of(rules.read_text()):
        name, wait = alert["alert"], alert.get("for", "")
        severity = alert["labels"]["severity"] + (f", {wait}" if wait else "")
        cells = [_cell(alert["annotations"][part]) for part in PARTS]
        rows.append(f'| <a id="{name}"></a>`{name}` | {severity} | {" | ".join(cells)} |')
    return "\n".join(rows)


def _cell(text: str) -> str:
    """Return the text for one cell, with links to pages of docs/."""
    linked = re.sub(r"docs/(\w+\.md)", r"[\1](\1)", " ".join(text.split()))
    return linked.replace("|", "\\|")
