"""The dashboard for Grafana, from one description: `python -m docs.generate.dashboard` writes etc/grafana/imud.json.

A row has a title and panels. A panel has a title, a unit of Grafana, and queries with their legends. The module
computes the places and the other parts of Grafana's JSON. `QUERIES` contains every query as Grafana sends it, for the
test.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from tests.support.files import ROOT

FILE: Final = ROOT / "etc/grafana/imud.json"
COLUMNS: Final = 24
"""Width of a dashboard in Grafana."""
SOURCE: Final = {"type": "prometheus", "uid": "${source}"}
DEVICE: Final = '{instance=~"$instance", device=~"$device"}'
DAEMON: Final = '{instance=~"$instance"}'
RATE: Final = "[$__rate_interval]"
LATENCY: Final = f"imud_sample_latency_seconds_bucket{DEVICE}"


@dataclass(frozen=True, slots=True)
class Query:
    """An expression and the legend of its lines."""

    expression: str
    legend: str = ""


@dataclass(frozen=True, slots=True)
class Panel:
    """A panel. `kind`, `unit` and `options` use the names of Grafana."""

    title: str
    unit: str
    queries: Sequence[Query]
    kind: str = "timeseries"
    width: int = 8
    height: int = 7
    help: str = ""


@dataclass(frozen=True, slots=True)
class Row:
    """A row. With `repeat`, Grafana draws one row for every selected device."""

    title: str
    panels: Sequence[Panel]
    repeat: bool = False


def device(metric: str, legend: str, wrap: str = "{}", labels: str = "") -> Query:
    """Return a metric of the selected device. `wrap` is an expression around the metric."""
    return Query(wrap.format(metric + DEVICE.replace("}", f"{labels}}}")), legend)


def rate(metric: str, legend: str, labels: str = "") -> Query:
    """Return the rate of a counter of the selected device."""
    return device(metric, legend, f"rate({{}}{RATE})", labels)


FLEET: Final = Row("Fleet", [
    Panel("Daemons", "none", [Query('sum(up{job="imud", instance=~"$instance"})', "up")], "stat", 3, 4),
    Panel("Devices", "none", [
        Query(f"sum(imud_device_up{DAEMON})", "running"), Query(f"count(imud_device_up{DAEMON})", "configured"),
    ], "stat", 5, 4),
    Panel("Active alerts", "none", [
        Query('count(ALERTS{alertname=~"Imud.+", alertstate="firing"}) or vector(0)', "alerts"),
    ], "stat", 4, 4),
    Panel("Samples", "cps", [Query(f"sum(rate(imud_samples_total{DAEMON}{RATE}))", "per second")], "stat", 6, 4),
    Panel("Lost samples", "cps", [Query(f"sum(rate(imud_samples_lost_total{DAEMON}{RATE}))", "per second")], "stat",
          6, 4),
    Panel("State", "none", [Query(f"imud_device_state{DAEMON} == 1", "{{instance}} {{device}}: {{state}}")],
          "timeseries", 12, 8, "State of each device."),
    Panel("Device information", "none", [Query(f"imud_device_info{DAEMON}")], "table", 12, 8),
])  # fmt: skip

OF_DEVICE: Final = Row("$device", [
    Panel("Rate", "hertz", [
        device("imud_sample_rate_hertz", "seen"), device("imud_sample_rate_expected_hertz", "by the device's time"),
    ]),
    Panel("Lost samples by cause", "cps", [rate("imud_samples_lost_total", "{{cause}}")]),
    Panel("Damaged frames by reason", "cps", [rate("imud_frames_bad_total", "{{reason}}")]),
    Panel("Time stamp error", "s", [
        device("imud_clock_error_seconds", "error, one sigma"), device("imud_clock_residual_seconds", "spread"),
    ]),
    Panel("Time stamp source", "none", [device("imud_clock_sync", "{{sync}}")]),
    Panel("Rate error of the device clock", "ppm", [
        device("imud_clock_skew_ratio", "gains", "1e6 * {}"),
    ]),
    Panel("Latency", "s", [
        Query(f"sum by (le) (increase({LATENCY}{RATE}))", "{{le}}"),
    ], "heatmap", help="Time from the measurement to the publication."),
    Panel("Latency, 50 % and 99 %", "s", [
        Query(f"histogram_quantile(0.5, sum by (le) (rate({LATENCY}{RATE})))", "50 %"),
        Query(f"histogram_quantile(0.99, sum by (le) (rate({LATENCY}{RATE})))", "99 %"),
    ]),
    Panel("Temperature", "celsius", [device("imud_temperature_celsius", "sensor")]),
    Panel("Attitude", "degree", [device("imud_attitude_radians", "{{angle}}", "deg({})")]),
    Panel("Vibration, RMS", "accMS2", [device("imud_vibration_rms_meters_per_second_squared", "{{axis}}")],
          help="Deviation of the acceleration from its mean of each second."),
    Panel("Vibration, peak", "accMS2", [device("imud_vibration_peak_meters_per_second_squared", "{{axis}}")]),
    Panel("Acceleration", "accMS2", [device("imud_acceleration_norm_meters_per_second_squared", "mean of a second")]),
    Panel("Edges on GPIO lines", "cps", [rate("imud_line_edges_total", "{{line}}"),
                                    rate("imud_line_edges_lost_total", "{{line}} lost")]),
    Panel("Problems of GPIO lines, and ALARM", "none", [
        device("imud_line_problem", "{{line}}"), device("imud_alarm_active", "ALARM active"),
    ]),
    Panel("Bus errors", "cps", [
        rate("imud_kernel_errors_total", "{{kind}}"), rate("imud_transfers_failed_total", "failed transfers"),
        rate("imud_serial_line_timeouts_total", "requests without reply"),
    ]),
    Panel("Reads of a polled device", "cps", [
        rate("imud_polls_total", "made"), rate("imud_polls_late_total", "late"),
        rate("imud_polls_missed_total", "missed"),
    ]),
    Panel("Ring of shared memory written", "none", [device("imud_ring_written", "written")]),
], repeat=True)  # fmt: skip

CLIENTS: Final = Row("Clients and daemon", [
    Panel("Clients", "none", [Query(f"imud_clients{DAEMON}", "{{instance}} {{encoding}}")]),
    Panel("Samples sent to clients, and dropped", "cps", [
        Query(f"rate(imud_client_samples_sent_total{DAEMON}{RATE})", "{{instance}} sent"),
        Query(f"rate(imud_client_samples_dropped_total{DAEMON}{RATE})", "{{instance}} dropped"),
    ]),
    Panel("Queued samples of the slowest client", "none", [
        Query(f"imud_client_queue_samples_max{DAEMON}", "{{instance}}"),
    ]),
    Panel("CPU", "percentunit", [
        Query(f'rate(process_cpu_seconds_total{{job="imud", instance=~"$instance"}}{RATE})', "{{instance}}"),
    ]),
    Panel("Memory", "bytes", [
        Query('process_resident_memory_bytes{job="imud", instance=~"$instance"}', "{{instance}}"),
    ]),
    Panel("Delay of the event loop", "s", [Query(f"imud_heartbeat_age_seconds{DAEMON}", "{{instance}}")]),
])  # fmt: skip

ROWS: Final = (FLEET, OF_DEVICE, CLIENTS)


def queries() -> Iterator[tuple[str, str]]:
    """Yield the title of the panel and the expression of every query."""
    for row in ROWS:
        for panel in row.panels:
            for query in panel.queries:
                yield panel.title, query.expression


def filled_in(expression: str, *, instance: str = ".+", device: str = ".+", window: str = "30s") -> str:
    """Return the expression as Grafana sends it, with values for its variables."""
    return expression.replace("$instance", instance).replace("$device", device).replace("$__rate_interval", window)


# --- the JSON of Grafana ----------------------------------------------------------------------------------------------


def dashboard() -> dict[str, Any]:
    """Return the whole dashboard."""
    panels, y = [], 0
    for row in ROWS:
        made, height = _row(row, y)
        panels += made
        y += height
    for number, panel in enumerate(panels, 1):
        panel["id"] = number
    return {
        "title": "imud", "uid": "imud", "tags": ["imud"], "schemaVersion": 38, "editable": True, "refresh": "15s",
        "time": {"from": "now-1h", "to": "now"}, "timezone": "browser",
        "templating": {"list": [
            {"name": "source", "label": "Prometheus", "type": "datasource", "query": "prometheus"},
            _variable("instance", 'label_values(up{job="imud"}, instance)'),
            _variable("device", 'label_values(imud_device_up{instance=~"$instance"}, device)'),
        ]},
        "panels": panels,
    }  # fmt: skip


def _variable(name: str, query: str) -> dict[str, Any]:
    return {
        "name": name, "type": "query", "datasource": SOURCE, "query": {"query": query, "refId": name},
        "definition": query, "refresh": 2, "multi": True, "includeAll": True, "allValue": ".+", "sort": 1,
        "current": {"text": "All", "value": "$__all"},
    }  # fmt: skip


def _row(row: Row, y: int) -> tuple[list[dict[str, Any]], int]:
    """Return a row with its panels from left to right, line by line, and its height."""
    head: dict[str, Any] = {
        "type": "row", "title": row.title, "collapsed": False, "panels": [],
        "gridPos": {"x": 0, "y": y, "w": COLUMNS, "h": 1},
    }  # fmt: skip
    if row.repeat:
        head["repeat"] = "device"
    made, x, top, high = [head], 0, y + 1, 0
    for panel in row.panels:
        if x + panel.width > COLUMNS:
            x, top, high = 0, top + high, 0
        made.append(_panel(panel, x, top))
        x, high = x + panel.width, max(high, panel.height)
    return made, top + high - y


def _panel(panel: Panel, x: int, y: int) -> dict[str, Any]:
    is_table = panel.kind == "table"
    targets = [
        {
            "refId": chr(ord("A") + number), "datasource": SOURCE, "expr": query.expression,
            "legendFormat": query.legend, "instant": is_table, "range": not is_table,
            "format": {"table": "table", "heatmap": "heatmap"}.get(panel.kind, "time_series"),
        }
        for number, query in enumerate(panel.queries)
    ]  # fmt: skip
    return {
        "type": panel.kind, "title": panel.title, "description": panel.help, "datasource": SOURCE,
        "gridPos": {"x": x, "y": y, "w": panel.width, "h": panel.height},
        "fieldConfig": {"defaults": {"unit": panel.unit}, "overrides": []}, "options": {}, "targets": targets,
    }  # fmt: skip


def text() -> str:
    """Return the text of the file."""
    return json.dumps(dashboard(), indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    FILE.write_text(text())
