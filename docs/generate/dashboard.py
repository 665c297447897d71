"""Dashboard for Grafana and Prometheus, from one description: `python -m docs.generate.dashboard` writes the file."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from docs.generate.grafana import Dashboard, Panel, Row, source, variable
from tests.support.files import ROOT

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

    def target(self, kind: str) -> dict[str, Any]:
        """Return the query of a panel of this kind."""
        is_table = kind == "table"
        return {
            "datasource": SOURCE, "expr": self.expression, "legendFormat": self.legend, "instant": is_table,
            "range": not is_table, "format": {"table": "table", "heatmap": "heatmap"}.get(kind, "time_series"),
        }  # fmt: skip


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
], repeat="device")  # fmt: skip

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

DASHBOARD: Final = Dashboard(
    title="imud", uid="imud", file=ROOT / "etc/grafana/imud.json", source=SOURCE, refresh="15s", begin="now-1h",
    variables=(
        source("Prometheus", "prometheus"),
        variable("instance", SOURCE, {"query": 'label_values(up{job="imud"}, instance)', "refId": "instance"}, ".+"),
        variable("device", SOURCE, {
            "query": 'label_values(imud_device_up{instance=~"$instance"}, device)', "refId": "device",
        }, ".+"),
    ),
    rows=(FLEET, OF_DEVICE, CLIENTS),
)  # fmt: skip


def queries() -> Iterator[tuple[str, str]]:
    """Yield the title of the panel and the expression of every query."""
    for row in DASHBOARD.rows:
        for panel in row.panels:
            for query in panel.queries:
                yield panel.title, query.expression


def filled_in(expression: str, *, instance: str = ".+", device: str = ".+", window: str = "30s") -> str:
    """Return the expression as Grafana sends it, with values for its variables."""
    return expression.replace("$instance", instance).replace("$device", device).replace("$__rate_interval", window)


if __name__ == "__main__":
    DASHBOARD.write()
