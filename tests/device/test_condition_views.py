"""Each view shows the same condition of a device: state, sentences and next steps."""

import json
import re
from collections.abc import Mapping
from functools import partial
from unittest.mock import MagicMock, Mock

import msgspec
import pytest

from imud.bridges.channel import DiagnosisLevel, LiveDiagnosis
from imud.cli import top
from imud.cli.doctor.daemon import device_states
from imud.cli.events import as_json, as_text, printed
from imud.cli.status import block
from imud.contracts.condition import DOCTOR, Condition, ConditionLimits
from imud.contracts.setting import OnDifference, SettingDifference, SettingsState, SettingsStatus
from imud.contracts.status import DeviceState, DeviceStatus
from imud.daemon import Daemon
from imud.device.condition import ConditionWatch, Facts, causes_of
from imud.device.health import DeviceEvents
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger
from imud.publishers.metrics.metric import Snapshot
from imud.web.hub import row_of, status_message
from tests.cli.conftest import Cli, cli
from tests.device.test_condition import NOW_NS, facts, lost_before, recent
from tests.fleet.test_publisher_home_assistant import parts, rendered
from tests.monitoring.prometheus import RULES, alerts_of
from tests.support.metrics import device, shown

__all__ = ["cli"]
LIMITS = ConditionLimits(t_err_ms=2.0, begin_s=0, end_s=0)
UNSAVED = SettingsStatus(
    SettingsState.DIFFER, OnDifference.REPORT, differences={"mounting": SettingDifference("x up", "level")},
    unsaved=True, lost_at_power_off={"mode": "9 axes"}, flash_unknown=("mode",),
)  # fmt: skip
LOSSY = recent(samples=961, lost={"crc": 39})
BY_STATE = {  # severity of `imud doctor`, level for Foxglove, alert
    "missing": ("error", DiagnosisLevel.ERROR, {"ImudDeviceDown"}),
    "attention": ("warning", DiagnosisLevel.WARN, {"ImudDeviceAttention"}),
    "degraded": ("warning", DiagnosisLevel.WARN, {"ImudDeviceDegraded"}),
    "ok": ("ok", DiagnosisLevel.OK, set()),
}
STATE_ONLY = {"imud devices", "imud top", "systemd", "metrics"}  # `imud status` has the sentences


def watched(known: Facts) -> tuple[DeviceStatus, Event]:
    """Return the status with the condition from these facts, and the event of this condition."""
    events: list[Event] = []
    watch = ConditionWatch(LIMITS, DeviceEvents("bow", Ledger(), events.append), 0)
    for one in (facts() if known.state is not DeviceState.RUNNING else facts(DeviceState.FAILED, "busy"), known):
        watch.update(NOW_NS, causes_of(one, LIMITS))
    (event,) = events
    return device("bow", state=known.state, condition=watch.condition), event


def fired(metrics: Mapping[str, float], codes: set[str]) -> set[str]:
    """Return the alerts about the condition that these metrics cause."""
    rules = {
        one["alert"]: one["expr"] for one in alerts_of(RULES.read_text()) if "imud_device_condition{" in one["expr"]
    }
    found = {name: re.findall(r'imud_device_condition\{condition="(\w+)"\}', expr) for name, expr in rules.items()}
    needs_reason = {name for name, expr in rules.items() if expr.startswith("imud_device_reason == 1 and")}
    return {
        name for name, (state,) in found.items()
        if metrics[f"condition {state} bow"] == 1 and (codes or name not in needs_reason)
    }  # fmt: skip


@pytest.mark.parametrize(
    ("known", "state", "codes"),
    [
        (facts(DeviceState.SILENT, "no sample for 1.0 s"), "missing", "stopped"),
        (facts(DeviceState.FAILED, "port is in use by gpsd"), "missing", "failed"),
        (facts(declared=UNSAVED, recent=LOSSY), "attention", "lost setting unsaved"),
        (facts(recent=LOSSY, t_err_ns=2_100_000, problem="can0 is error-passive"), "degraded", "link lost time-error"),
        (facts(), "ok", "none-lost"),
        (lost_before(600, 19, "overrun"), "ok", "lost-before"),
    ],
)  # fmt: skip
def test_each_view_shows_the_same_condition(
    known: Facts, state: str, codes: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    status, event = watched(known)
    assert status.condition is not None
    assert (sorted(one.code for one in status.reasons), event.kind) == (codes.split(), EventKind.CONDITION)
    client = MagicMock(**{"status.return_value": {"devices": [msgspec.to_builtins(status)]}})
    client.__enter__.return_value = client
    for module in ("status", "devices"):
        monkeypatch.setattr(f"imud.cli.{module}.connect", lambda _args: client)
    payload = msgspec.json.encode(status)
    template = {name: partial(rendered, one["value_template"]) for name, one in parts().items()}
    attributes = json.loads(rendered(parts()["condition"]["json_attributes_template"], payload))
    metrics = shown("imud_device_", Snapshot((status,)))
    severity, level, alerts = BY_STATE[state]
    findings = list(device_states(Mock(status=[status])))
    (diagnosis,) = LiveDiagnosis().of([status], 0).devices
    words = {
        "imud status": cli("status", status=state != "ok").out,
        "imud devices": cli("devices", status=state == "missing").out,
        "page in imud top": block(status),
        "imud top": top.row(top.DeviceHistory(status), top.VIEWS["motion"], NOW_NS),
        "web overview": msgspec.json.encode(row_of(status, None, NOW_NS)).decode(),
        "web page": msgspec.json.encode(status_message("bow", status, NOW_NS)).decode(),
        "MQTT": payload.decode(),
        "Home Assistant": f"{template['condition'](payload)} {json.dumps(attributes, ensure_ascii=False)}",
        "metrics": " ".join(name for name, value in metrics.items() if name.startswith("condition ") and value),
        "Foxglove": f"{diagnosis.message} {diagnosis.values.get('next', '')}",
        "systemd": Daemon._status_line(Mock(_devices={"bow": Mock(condition=status.condition.condition)})),
        "imud events": as_text(printed(event, 0)),
        "imud events --json": as_json(printed(event, 0)),
    }  # fmt: skip
    for view, text in words.items():
        line = " ".join(text.replace("1 device is OK.", "ok").split())
        assert {one for one in Condition if re.search(rf"\b{one}\b", line)} == {state}, (view, line)
        if view not in STATE_ONLY:
            assert [one.message for one in status.reasons if one.message not in line] == [], view
        if view not in (*STATE_ONLY, "imud events"):  # `imud events` prints no details
            assert [one.next for one in status.reasons if one.next not in line] == [], view
    own = "see the findings about its port, bus and lines"  # `imud doctor` does not name itself as the next step
    assert [(one.severity, one.seen, one.advice) for one in findings] == [
        (severity, f"bow: {one.message}", own if one.next == DOCTOR else one.next) for one in status.reasons
    ]
    assert (diagnosis.level, template["problem"](payload)) == (level, "OFF" if state == "ok" else "ON")
    reasons = {name.split()[1] for name in metrics if name.startswith("reason ")}
    assert (reasons, fired(metrics, reasons)) == (set() if state == "ok" else set(codes.split()), alerts)
