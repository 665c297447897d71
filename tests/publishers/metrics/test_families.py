"""Metrics: each value is a value of the status in base units. Documentation and alerts use existing names."""

import re
from collections.abc import Sequence
from itertools import chain

import msgspec
import pytest
from prometheus_client.core import Metric
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse_openmetrics
from prometheus_client.parser import text_string_to_metric_families as parse_text

import imud
from imud.contracts import status as states
from imud.contracts.setting import OnDifference, SettingsState, SettingsStatus
from imud.contracts.status import FlightStatus, MqttStatus, OutputStatus, RecorderStatus
from imud.model.event import EventKind
from imud.model.ledger import LEDGER_FIELDS
from imud.model.sample import Position, Sync
from imud.publishers.metrics import families
from imud.publishers.metrics import metric as units
from imud.publishers.metrics.metric import Family, MetricType, Snapshot
from imud.publishers.metrics.publisher import ClientTotals, Renderer
from imud.publishers.metrics.rings import RingView
from imud.utc.rmc_feed import Refusal
from tests.support.files import ROOT
from tests.support.metrics import FRAME, LINES, UTC, client, device, equipped, shown, views

SAMPLES_PER_TURN = 64
Key = tuple[str, frozenset[tuple[str, str]]]


def values(metrics: Sequence[Metric]) -> dict[Key, float]:
    found: dict[Key, float] = {}
    for metric in metrics:
        for line in metric.samples:
            key = (line.name, frozenset(line.labels.items()))
            assert key not in found, key
            found[key] = line.value
    return found


def rendered(snapshot: Snapshot) -> dict[Key, float]:
    return values(list(parse_text(Renderer(pause=lambda: None).render(snapshot, "").body.decode())))


def key(name: str, **labels: str) -> Key:
    return name, frozenset(labels.items())


DEVICES = (
    device("front", 0, position=Position(0.5, 0.25, quality=0, satellites=9)),
    device(
        "rear", 1, state=states.DeviceState.MISSING, clock=states.ClockStatus(), temperature_c=None, status_bits=None,
        expected_rate_hz=0.0, identity={},
    ),
)  # fmt: skip
LEDGER_LINES = {
    "bytes_in": ("imud_bytes_in_total", {}), "bytes_in_good_frames": ("imud_bytes_total", {"fate": "good_frames"}),
    "bytes_in_bad_frames": ("imud_bytes_total", {"fate": "bad_frames"}),
    "bytes_skipped": ("imud_bytes_total", {"fate": "skipped"}), "bytes_pending": ("imud_bytes_pending", {}),
    "frames_good": ("imud_frames_good_total", {}), "frames_in_samples": ("imud_frames_total", {"fate": "samples"}),
    "frames_in_replies": ("imud_frames_total", {"fate": "replies"}),
    "frames_ignored": ("imud_frames_total", {"fate": "ignored"}), "frames_pending": ("imud_frames_pending", {}),
    "frames_bad_crc": ("imud_frames_bad_total", {"reason": "crc"}),
    "frames_bad_length": ("imud_frames_bad_total", {"reason": "length"}),
    "frames_bad_content": ("imud_frames_bad_total", {"reason": "content"}),
    "frames_not_finite": ("imud_frames_bad_total", {"reason": "not_finite"}),
    "frames_lost": ("imud_frames_lost_total", {}), "unknown_tags": ("imud_unknown_tags_total", {}),
    "samples": ("imud_samples_total", {}), "lost_gap_device": ("imud_samples_lost_total", {"cause": "gap_device"}),
    "lost_crc": ("imud_samples_lost_total", {"cause": "crc"}),
    "lost_overrun": ("imud_samples_lost_total", {"cause": "overrun"}),
    "lost_queue": ("imud_samples_lost_total", {"cause": "queue"}), "lost_unknown": ("imud_gaps_unknown_total", {}),
    "replies_late": ("imud_replies_stray_total", {"kind": "late"}),
    "replies_unsolicited": ("imud_replies_stray_total", {"kind": "unsolicited"}),
}  # fmt: skip


def test_each_ledger_counter_has_a_metric() -> None:
    shown = rendered(Snapshot(DEVICES))
    assert set(LEDGER_LINES) == set(LEDGER_FIELDS)
    for status in DEVICES:
        for field, (name, labels) in LEDGER_LINES.items():
            assert shown[key(name, device=status.name, **labels)] == status.ledger[field], field
    ledger = dict(DEVICES[0].ledger)
    ledger["bytes_in"] += 3
    ledger["frames_in_replies"] += 2
    shown = rendered(Snapshot((*DEVICES, device("leaky", 2, ledger=ledger))))
    for name in ("front", "rear"):
        assert shown[key("imud_ledger_unaccounted_bytes", device=name)] == 0
        assert shown[key("imud_ledger_unaccounted_frames", device=name)] == 0
    assert shown[key("imud_ledger_unaccounted_bytes", device="leaky")] == 3
    assert shown[key("imud_ledger_unaccounted_frames", device="leaky")] == -2


def test_values_states_and_identity() -> None:
    bare = device("front", 0, position=Position(0.5, 0.25))  # neither quality nor satellites
    assert not any(name.startswith("imud_position") for name, _ in rendered(Snapshot((bare,))))
    shown = rendered(Snapshot(DEVICES, heartbeat_age_ns=250_000_000, log_messages_dropped=3))
    front = {"device": "front"}
    expected = {
        "imud_clock_offset_seconds": 5.25, "imud_clock_skew_ratio": -4e-05, "imud_clock_steering_ratio": 5e-04,
        "imud_clock_residual_seconds": 3e-05, "imud_clock_error_seconds": 4.5e-05, "imud_clock_resets_total": 2,
        "imud_sample_rate_hertz": 999.5, "imud_sample_rate_expected_hertz": 1000.25, "imud_sample_hold_seconds": 0.005,
        "imud_sample_hold_wanted_seconds": 0.02, "imud_temperature_celsius": 36.5, "imud_status_bits": 4,
        "imud_position_quality": 0, "imud_position_satellites": 9,
        "imud_device_connects_total": 3,
    }  # fmt: skip
    for name, value in expected.items():
        assert shown[key(name, **front)] == pytest.approx(value, rel=1e-12), name
    kinds = {"overrun": 7, "framing": 8, "parity": 9, "break": 10}
    for kind, count in kinds.items():
        assert shown[key("imud_kernel_errors_total", kind=kind, **front)] == count
    assert (shown[key("imud_heartbeat_age_seconds")], shown[key("imud_log_messages_dropped_total")]) == (0.25, 3)
    for name in (
        "imud_temperature_celsius",
        "imud_status_bits",
        "imud_position_quality",
        "imud_sample_rate_expected_hertz",
    ):
        assert key(name, device="front") in shown
        assert key(name, device="rear") not in shown
    for name, state, up in (("front", "running", 1), ("rear", "missing", 0)):
        assert shown[key("imud_device_up", device=name)] == up
        for other in states.DeviceState:
            assert shown[key("imud_device_state", device=name, state=other.value)] == (other.value == state)
    for sync in Sync:
        assert shown[key("imud_clock_sync", device="front", sync=sync.value)] == (sync is Sync.REGRESSION)
    identity = {"product": "HI13", "serial_number": "00000000", "firmware": "1.7.6"}
    link = "/dev/ttyUSB0 at 115200 baud"
    assert shown[key("imud_device_info", device="front", driver="hipnuc-uart", link=link, **identity)] == 1
    (build,) = [dict(labels) for name, labels in shown if name == "imud_build_info"]
    assert build["version"] == imud.__version__
    assert shown[key("process_resident_memory_bytes")] > 1_000_000
    assert key("process_cpu_seconds_total") in shown


# All lines of the parts that only some devices have
PARTS: dict[tuple[str, tuple[tuple[str, str], ...]], float] = {
    ("imud_polls_total", ()): 1000, ("imud_polls_late_total", ()): 20, ("imud_polls_missed_total", ()): 3,
    ("imud_polls_stale_total", ()): 4, ("imud_transfers_failed_total", ()): 5, ("imud_device_vanished_total", ()): 6,
    ("imud_poll_delay_seconds_total", ()): 0.070000123, ("imud_poll_delay_worst_seconds", ()): 0.008,
    ("imud_serial_line_timeouts_total", ()): 11, ("imud_serial_line_late_bytes_total", ()): 12,
    ("imud_serial_line_strange_bytes_total", ()): 13, ("imud_serial_line_echoes_total", ()): 14,
    ("imud_clock_hold_seconds", ()): 0.016, ("imud_clock_edges_total", ()): 4998,
    ("imud_clock_edges_unpaired_total", ()): 9, ("imud_clock_samples_unpaired_total", ()): 17,
    ("imud_triggers_unanswered_total", ()): 21, ("imud_clock_reference_error_seconds", ()): 0.00025,
    ("imud_utc_problem", ()): 1, ("imud_utc_sentences_total", ()): 100, ("imud_utc_sentences_sent_total", ()): 90,
    ("imud_utc_sentences_refused_total", (("cause", "stale"),)): 7,
    ("imud_utc_sentences_refused_total", (("cause", "busy"),)): 3, ("imud_pps_pulses_total", ()): 59,
    ("imud_pps_pulses_ignored_total", ()): 1, ("imud_chrony_samples_total", (("fate", "sent"),)): 40,
    ("imud_chrony_samples_total", (("fate", "refused"),)): 19, ("imud_line_problem", (("line", "sout"),)): 0,
    ("imud_line_problem", (("line", "alarm"),)): 1, ("imud_line_problem", (("line", "pps"),)): 0,
    ("imud_line_problem", (("line", "sin"),)): 0, ("imud_line_edges_total", (("line", "sout"),)): 5000,
    ("imud_line_edges_total", (("line", "alarm"),)): 2, ("imud_line_edges_total", (("line", "pps"),)): 60,
    ("imud_line_edges_lost_total", (("line", "sout"),)): 7, ("imud_line_edges_lost_total", (("line", "alarm"),)): 0,
    ("imud_line_edges_lost_total", (("line", "pps"),)): 0, ("imud_alarm_active", ()): 1, ("imud_alarms_total", ()): 3,
    ("imud_triggers_total", ()): 400, ("imud_triggers_missed_total", ()): 8,
    ("imud_trigger_delay_seconds_total", ()): 0.012000456, ("imud_trigger_delay_worst_seconds", ()): 0.0009,
}  # fmt: skip


def parts_of(name: str, shown: dict[Key, float]) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    names = {family.name for family in (*families.POLLING_FAMILIES, *families.TIME_FAMILIES, *families.LINE_FAMILIES)}
    return {
        (metric, tuple(pair for pair in labels if pair[0] != "device")): value
        for (metric, labels), value in shown.items()
        if metric in names and ("device", name) in labels
    }


def test_every_part_is_shown_in_base_units() -> None:
    shown = parts_of("bow", rendered(Snapshot((*DEVICES, equipped("bow", 2)))))
    assert shown.keys() == PARTS.keys()
    for line, value in PARTS.items():
        assert shown[line] == pytest.approx(value, rel=1e-12), line
    means = {"late_mean_ns", "trigger_late_mean_ns"}  # sum divided by count
    before = parts_of("bow", rendered(Snapshot((equipped("bow"),))))
    for part in ("polling", "serial_line", "lines", "utc"):
        value = getattr(equipped("bow"), part)
        for field in msgspec.structs.fields(value):
            if field.type is int and field.name not in means:
                more = msgspec.structs.replace(value, **{field.name: getattr(value, field.name) + 1_000_000})
                changed = parts_of("bow", rendered(Snapshot((equipped("bow", **{part: more}),))))
                assert changed != before, f"{part}.{field.name}"


def test_missing_parts_and_settings_are_absent() -> None:
    plain = device("plain", 2)
    unsure = equipped(
        "unsure", 3, polling=None, serial_line=None,
        lines=msgspec.structs.replace(LINES, problems={}, edges={"sout": 1}, edges_lost={"sout": 0}, alarm=None,
                                      sin=False),
        utc=msgspec.structs.replace(UTC, source="", problem="", refused={}),
    )  # fmt: skip
    shown = rendered(Snapshot((plain, unsure)))
    assert {metric for metric, _ in parts_of("plain", shown)} == {"imud_clock_hold_seconds"}
    found = parts_of("unsure", shown)
    assert {metric for metric, _ in found} == {
        "imud_clock_hold_seconds", "imud_clock_edges_total", "imud_clock_edges_unpaired_total",
        "imud_clock_samples_unpaired_total", "imud_clock_reference_error_seconds", "imud_utc_problem",
        "imud_pps_pulses_total", "imud_pps_pulses_ignored_total", "imud_chrony_samples_total",
        "imud_line_problem", "imud_line_edges_total", "imud_line_edges_lost_total",
    }  # fmt: skip
    assert (found["imud_utc_problem", ()], found["imud_line_problem", (("line", "sout"),)]) == (0, 0)
    assert ("imud_line_problem", (("line", "sin"),)) not in found
    for state, number in ((SettingsState.UNDECLARED, 0), (SettingsState.UNKNOWN, 2), (SettingsState.AGREE, 3)):
        shown = rendered(Snapshot((device("bow", declared=SettingsStatus(state, OnDifference.REPORT)),)))
        names = "differ", "problem", "repairs_total"
        assert sum(key(f"imud_settings_{name}", device="bow") in shown for name in names) == number


def test_problems_of_lines_and_of_gravity_are_shown() -> None:
    lines = msgspec.structs.replace(LINES, problems={"reset": "in use", "sin": "in use"}, edges={"sout": 1})
    found = parts_of("bow", rendered(Snapshot((equipped("bow", lines=lines),))))
    problems = {labels[0][1]: value for (name, labels), value in found.items() if name == "imud_line_problem"}
    assert problems == {"sout": 0, "sin": 1, "reset": 1}
    bad = msgspec.structs.replace(FRAME, problem="upside down")
    shown = rendered(Snapshot((device("good", 0, frame=FRAME), device("bad", 1, frame=bad), device("unknown", 2))))
    assert (shown[key("imud_frame_problem", device="good")], shown[key("imud_frame_problem", device="bad")]) == (0, 1)
    assert key("imud_frame_problem", device="unknown") not in shown


def test_rings_and_motion_are_shown() -> None:
    angle = views("bow")["bow"]
    assert angle.motion is not None
    bare = angle.motion._replace(attitude_rad=None, accel_norm_m_s2=None, vibration_rms_m_s2=None)
    shown = rendered(Snapshot(views={"bow": angle, "gone": RingView(False), "bare": RingView(True, bare)}))
    rms, peak = "imud_vibration_rms_meters_per_second_squared", "imud_vibration_peak_meters_per_second_squared"
    norm = "imud_acceleration_norm_meters_per_second_squared"
    found = {name: value for name, value in shown.items() if ("device", "bow") in name[1]}
    assert found == {
        key("imud_ring_written", device="bow"): 1,
        key("imud_attitude_radians", device="bow", angle="roll"): 0.1,
        key("imud_attitude_radians", device="bow", angle="pitch"): -0.2,
        key("imud_attitude_radians", device="bow", angle="yaw"): 3.0,
        key(norm, device="bow"): 9.81,
        **{key(rms, device="bow", axis=axis): value for axis, value in (("x", 0.01), ("y", 0.02), ("z", 0.03))},
        **{key(peak, device="bow", axis=axis): value for axis, value in (("x", 0.04), ("y", 0.05), ("z", 0.06))},
        key("imud_motion_span_seconds", device="bow"): 12.5,
    }
    assert {name: value for name, value in shown.items() if ("device", "gone") in name[1]} == {
        key("imud_ring_written", device="gone"): 0
    }
    assert {name for name, labels in shown if ("device", "bare") in labels} == {
        "imud_ring_written", peak, "imud_motion_span_seconds",
    }  # fmt: skip


def test_latency_histogram_is_cumulative() -> None:
    shown = rendered(Snapshot(DEVICES))
    bounds = [f"{bound / 1e9:.6g}" for bound in states.LATENCY_BOUNDS_NS]
    counts = {
        float(dict(labels)["le"]): value
        for (name, labels), value in shown.items()
        if name == "imud_sample_latency_seconds_bucket" and ("device", "front") in labels
    }
    assert [f"{bound:.6g}" for bound in sorted(counts)] == [*bounds, "inf"]
    assert [counts[bound] for bound in sorted(counts)] == [1, 3, 6, 10, 15, 21, 28, 36, 45, 55, 66]
    assert shown[key("imud_sample_latency_seconds_count", device="front")] == 66
    assert shown[key("imud_sample_latency_seconds_sum", device="front")] == 2.5


def test_identity_with_quotes_and_newlines_stays_one_label() -> None:
    odd = 'a"b\\c\nd'
    shown = rendered(Snapshot((device("x", identity={"product": odd}),)))
    (labels,) = [dict(labels) for name, labels in shown if name == "imud_device_info"]
    assert labels["product"] == odd


def test_clients_are_summed_and_totals_never_fall() -> None:
    totals = ClientTotals()
    totals.update([client(1, sent=10, dropped=2), client(2, sent=5)])
    totals.update([client(2, sent=6, dropped=1), client(3, sent=4)])  # client 1 disconnected
    totals.update([])
    assert (totals.sent, totals.dropped) == (10 + 6 + 4, 2 + 1)
    clients: Sequence[states.ClientStatus] = [
        client(1, queue=7), client(2, "binary", queue=2), client(3, ""), client(4),
    ]  # fmt: skip
    shown = rendered(Snapshot(clients=clients))
    assert {e: shown[key("imud_clients", encoding=e)] for e in ("json", "binary", "none")} == {
        "json": 2, "binary": 1, "none": 1,
    }  # fmt: skip
    renderer = Renderer(pause=lambda: None)
    for sent in (4, 9):
        body = renderer.render(Snapshot(clients=[client(1, sent=sent, dropped=sent - 3)]), "").body
        assert b"imud_client_samples_sent_total %d.0\n" % sent in body
        assert b"imud_client_samples_dropped_total %d.0\n" % (sent - 3) in body
    assert (shown[key("imud_client_queue_samples")], shown[key("imud_client_queue_samples_max")]) == (9, 7)
    assert shown[key("imud_client_queue_bytes")] == 9 * 256


def test_both_formats_contain_the_same_values() -> None:
    renderer = Renderer(pause=lambda: None)
    plain = renderer.render(Snapshot(DEVICES), "text/html, */*;q=0.1")
    rich = renderer.render(Snapshot(DEVICES), "application/openmetrics-text; version=1.0.0, text/plain;q=0.5")
    assert plain.content_type == "text/plain; version=0.0.4; charset=utf-8"
    assert rich.content_type.startswith("application/openmetrics-text; version=1.0.0")
    assert rich.body.endswith(b"# EOF\n")
    ours = re.compile("imud_")
    from_plain, from_rich = (
        {k: v for k, v in values(list(found)).items() if ours.match(k[0])}
        # the parser of the library has no types
        for found in (parse_text(plain.body.decode()), parse_openmetrics(rich.body.decode()))  # type: ignore[no-untyped-call]
    )
    assert from_plain == from_rich


def test_rendering_pauses_often() -> None:
    pauses = 0

    def pause() -> None:
        nonlocal pauses
        pauses += 1

    devices = [equipped(f"d{n}", n) for n in range(16)]
    snapshot = Snapshot(devices, views=views(*(device.name for device in devices)))
    body = Renderer(pause).render(snapshot, "").body
    lines = sum(line.startswith(b"imud_") for line in body.splitlines())
    assert lines > 900
    assert pauses >= lines / SAMPLES_PER_TURN
    assert pauses >= sum(line.startswith(b"# HELP imud_") for line in body.splitlines()) - 2  # no event, no reason


def shown_names() -> set[str]:
    """Return the names of all families after `# HELP`."""
    recorder = states.RecorderStatus("a", "", 1, 2, 3, 4, 5, 6)
    flight = states.FlightStatus("", 1, 2, 3, 4, 5, 6, 7, 8)
    output = states.OutputStatus("tcp 127.0.0.1:10110", 1, 2, 3, "")
    mqtt = states.MqttStatus("mqtt://127.0.0.1:1883", "", "", 1, 2, 3, 4, 5, 6, 7, {"age": 8}, 9)
    snapshot = Snapshot(
        DEVICES, (client(1),), ((("front", "up"), 1),), 1, recorders=(recorder,), flights=(flight,),
        ports={"nmea0183": (output,)}, mqtts=(mqtt,), rules=(RULES,),
    )  # fmt: skip
    body = Renderer(pause=lambda: None).render(snapshot, "").body.decode()
    return set(re.findall(r"^# HELP (\S+)", body, re.MULTILINE))


def test_every_metric_and_label_value_is_documented() -> None:
    documented = set(re.findall(r"^\| `([a-z0-9_]+)`", (ROOT / "docs/metrics.md").read_text(), re.MULTILINE))
    assert documented == shown_names()
    text = (ROOT / "docs/metrics.md").read_text()
    for values_of, kind in ((states.DeviceState, "state"), (Sync, "sync"), (EventKind, "kind"), (Refusal, "cause")):
        rows = re.findall(rf"`{kind}`: ([a-z_, -]+)", text)
        assert {value.value for value in values_of} in [set(row.strip().split(", ")) for row in rows], kind


def test_names_contain_type_and_unit() -> None:
    more = (families.MQTT_FAMILIES, families.PORT_FAMILIES, families.RECORDER_FAMILIES, families.FLIGHT_FAMILIES)
    for family in chain(families.FAMILIES, families.RECORDINGS_FAMILIES, *more):
        assert family.name.startswith("imud_")
        if isinstance(family, Family):
            assert family.help.endswith(".")
            assert (family.type is MetricType.COUNTER) == family.name.endswith("_total")
            assert (family.type is MetricType.INFO) == family.name.endswith("_info")
            stem = family.name.removesuffix("_total")
            assert stem.endswith(family.unit.name)
            motion = units.ACCELERATION, units.HERTZ, units.RADIANS, units.RATIO
            for unit in (*motion, units.BYTES, units.CELSIUS, units.SECONDS):
                assert stem.endswith("_" + unit.name) == (family.unit is unit), family.name


def test_alerts_use_metrics_that_exist() -> None:
    import yaml

    rules = yaml.safe_load((ROOT / "etc/prometheus/imud.rules.yml").read_text())
    alerts = [rule for group in rules["groups"] for rule in group["rules"]]
    assert {alert["alert"] for alert in alerts} >= {
        "ImudDown", "ImudDeviceDown", "ImudSamplesLost", "ImudSyncLost",
    }  # fmt: skip
    for alert in alerts:
        used = {re.sub("_(bucket|count)$", "", name) for name in re.findall(r"\b(?:imud|process)_\w+", alert["expr"])}
        assert used <= shown_names(), alert["alert"]
        assert used or "up{" in alert["expr"]
        assert {"summary", "description"} <= set(alert["annotations"])
        assert alert["labels"]["severity"] in ("warning", "critical")


def test_each_metric_is_a_value_of_a_port() -> None:
    tcp, serial = "tcp 127.0.0.1:10110", "serial /dev/ttyUSB0"
    ports = (OutputStatus(tcp, 1, 2, 3, "", 6), OutputStatus(serial, 4, 5, 0, "No such file or directory"))
    assert shown("imud_output_", Snapshot(ports={"nmea0183": ports})) == {
        f"messages_total nmea0183 {tcp}": 1, f"messages_dropped_total nmea0183 {tcp}": 2, f"readers nmea0183 {tcp}": 3,
        f"messages_total nmea0183 {serial}": 4, f"messages_dropped_total nmea0183 {serial}": 5,
        f"readers nmea0183 {serial}": 0, f"received_discarded_total nmea0183 {tcp}": 6,
        f"received_discarded_total nmea0183 {serial}": 0,
    }  # fmt: skip
    assert shown("imud_output_", Snapshot()) == {}


def test_each_metric_is_a_value_of_the_output() -> None:
    status = MqttStatus(
        "mqtt://a:1883", "", "", 1, 2, 3, 4, 5, 6, 7, {"age": 8, "space": 9}, 10, 11, 12, {"a": "no"}, 13
    )
    assert shown("imud_mqtt_", Snapshot(mqtts=(status,))) == {
        "connected": 1, "spooling": 1, "queued_total": 1, "spooled_messages_total": 2, "sent_messages_total": 3,
        "acknowledged_messages_total": 4, "waiting_messages": 5, "refused_topics": 1, "spool_bytes": 6,
        "thinned_total": 7, "dropped_total age": 8, "dropped_total space": 9, "reconnects_total": 10,
        "commands_total": 11, "commands_refused_total": 12, "replies_lost_total": 13,
    }  # fmt: skip
    assert shown("imud_mqtt_", Snapshot()) == {}
    status = MqttStatus("", "refused", "full", 0, 0, 0, 0, 0, 0, 0, {}, 0)
    failed = shown("imud_mqtt_", Snapshot(mqtts=(status,)))
    assert (failed["connected"], failed["spooling"]) == (0, 0)


RECORDER = RecorderStatus("a", "", 1, 2, 3, 4, 5, 6)
RULES = states.RulesStatus(
    (states.RuleStatus("lean", "bow", True, 3, ""), states.RuleStatus("lean", "mast", False, 0, "no euler_rad")),
    {"lean": "busy", "hot": ""}, {"ok": 2, "failed": 1},
)  # fmt: skip
FULL = "No space left on device"


def test_each_metric_is_a_value_of_the_status() -> None:
    recorders = Snapshot(recorders=(RECORDER,))
    assert shown("imud_recorder_", recorders) == {
        "active": 1, "written_bytes_total": 1, "records_total": 2, "records_dropped_total": 3, "waiting_bytes": 4,
        "files_removed_total": 5,
    }  # fmt: skip
    assert shown("imud_recordings_", recorders) == {"bytes": 6}
    full = Snapshot(recorders=(RecorderStatus("", FULL, 1, 2, 3, 4, 5, 6),))
    assert shown("imud_recorder_", full)["active"] == 0
    for prefix in ("imud_recorder_", "imud_recordings_", "imud_flight_"):
        assert shown(prefix, Snapshot()) == {}


def test_each_metric_is_a_value_of_a_rule() -> None:
    assert shown("imud_rule_", Snapshot(rules=(RULES,))) == {
        "active bow lean": 1, "active mast lean": 0, "events_total bow lean": 3, "events_total mast lean": 0,
        "problem bow lean": 0, "problem mast lean": 1, "line_problem lean": 1, "line_problem hot": 0,
        "commands_total ok": 2, "commands_total failed": 1,
    }  # fmt: skip
    assert RULES.problems() == {"rules lean line": "busy", "rules lean mast": "no euler_rad"}


def test_each_metric_is_a_value_of_the_flight_recorder() -> None:
    flights = Snapshot(flights=(FlightStatus("", 90_500_000_000, 2, 3, 4, 5, 6, 7, 8),))
    assert shown("imud_flight_recorder_", flights) == {
        "active": 1, "kept_seconds": 90.5, "kept_bytes": 2, "records_dropped_total": 3, "snapshots_total saved": 4,
        "snapshots_total failed": 5, "snapshots_total left_out": 6, "snapshots_sent_total": 7,
    }  # fmt: skip
    assert shown("imud_recordings_", flights) == {"bytes": 8}
    both = Snapshot(recorders=(RECORDER,), flights=(FlightStatus("", 1, 2, 3, 4, 5, 6, 7, 5),))
    assert shown("imud_recordings_", both) == {"bytes": 6}  # including the open file
    full = Snapshot(flights=(FlightStatus(FULL, 0, 0, 0, 0, 0, 0, 0, 0),))
    assert shown("imud_flight_recorder_", full)["active"] == 0
