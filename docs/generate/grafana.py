"""Dashboards of Grafana from descriptions: rows, panels, variables, and their JSON.

A row has a title and panels. A panel has a title, a unit of Grafana, and queries. This module computes the places and
the other parts of the JSON.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Generic, Protocol, TypeVar

COLUMNS: Final = 24
"""Width of a dashboard in Grafana."""
Json = dict[str, Any]


class PanelQuery(Protocol):
    """Query of a panel."""

    def target(self, kind: str) -> Json:
        """Return the JSON of the query in a panel of this kind, without `refId`."""
        ...


Q = TypeVar("Q", bound=PanelQuery)


@dataclass(frozen=True, slots=True)
class Panel(Generic[Q]):
    """A panel. `kind`, `unit` and `overrides` use the names of Grafana."""

    title: str
    unit: str
    queries: Sequence[Q]
    kind: str = "timeseries"
    width: int = 8
    height: int = 7
    help: str = ""
    overrides: Sequence[Json] = ()


@dataclass(frozen=True, slots=True)
class Row(Generic[Q]):
    """A row. Grafana draws one row for every selected value of the variable `repeat`; empty: one row."""

    title: str
    panels: Sequence[Panel[Q]]
    repeat: str = ""


@dataclass(frozen=True, slots=True)
class Dashboard(Generic[Q]):
    """A dashboard. `source`: data source of its panels. `refresh`, `begin` (start of the time range): as in Grafana."""

    title: str
    uid: str
    file: Path
    source: Json
    refresh: str
    begin: str
    variables: Sequence[Json]
    rows: Sequence[Row[Q]]

    def document(self) -> Json:
        """Return the JSON of the whole dashboard."""
        panels, y = [], 0
        for row in self.rows:
            made, height = self._row(row, y)
            panels += made
            y += height
        for number, panel in enumerate(panels, 1):
            panel["id"] = number
        return {
            "title": self.title, "uid": self.uid, "tags": ["imud"], "schemaVersion": 38, "editable": True,
            "refresh": self.refresh, "time": {"from": self.begin, "to": "now"}, "timezone": "browser",
            "templating": {"list": [*self.variables]}, "panels": panels,
        }  # fmt: skip

    def _row(self, row: Row[Q], y: int) -> tuple[list[Json], int]:
        """Return a row with its panels from left to right, line by line, and its height."""
        head: Json = {
            "type": "row", "title": row.title, "collapsed": False, "panels": [],
            "gridPos": {"x": 0, "y": y, "w": COLUMNS, "h": 1},
        }  # fmt: skip
        if row.repeat:
            head["repeat"] = row.repeat
        made, x, top, high = [head], 0, y + 1, 0
        for panel in row.panels:
            if x + panel.width > COLUMNS:
                x, top, high = 0, top + high, 0
            made.append(self._panel(panel, x, top))
            x, high = x + panel.width, max(high, panel.height)
        return made, top + high - y

    def _panel(self, panel: Panel[Q], x: int, y: int) -> Json:
        targets = [
            {"refId": chr(ord("A") + number)} | query.target(panel.kind) for number, query in enumerate(panel.queries)
        ]
        return {
            "type": panel.kind, "title": panel.title, "description": panel.help, "datasource": self.source,
            "gridPos": {"x": x, "y": y, "w": panel.width, "h": panel.height},
            "fieldConfig": {"defaults": {"unit": panel.unit}, "overrides": [*panel.overrides]}, "options": {},
            "targets": targets,
        }  # fmt: skip

    def text(self) -> str:
        """Return the text of the file."""
        return json.dumps(self.document(), indent=1, ensure_ascii=False) + "\n"

    def write(self) -> None:
        self.file.write_text(self.text())


def source(label: str, kind: str) -> Json:
    """Return the variable that selects the data source."""
    return {"name": "source", "label": label, "type": "datasource", "query": kind}


def variable(name: str, data_source: Mapping[str, str], query: Any, every: str = "") -> Json:
    """Return a variable. Its values are the result of `query`, in the form of the data source. With `every`, the user
    can select several values, or all: `every` then replaces the variable."""
    words = query if isinstance(query, str) else query["query"]
    chosen: Json = {}
    if every:
        chosen = {"allValue": every, "current": {"text": "All", "value": "$__all"}}
    return {
        "name": name, "type": "query", "datasource": data_source, "query": query, "definition": words, "refresh": 2,
        "multi": bool(every), "includeAll": bool(every), "sort": 1, **chosen,
    }  # fmt: skip
