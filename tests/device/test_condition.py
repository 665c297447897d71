"""Each sentence of the condition table, its limits, the hysteresis, and the counts of the last minute."""

from typing import Any

import msgspec
import pytest

from imud import config
from imud.contracts.condition import OK, Condition, ConditionLimits, DeviceCondition, ReasonCode, Section, condition_of
from imud.contracts.setting import OnDifference, SettingDifference, SettingsState, SettingsStatus
from imud.contracts.status import DeviceState, DeviceStatus, FrameProblem, LinesStatus, RecentStatus
from imud.device import condition as device_condition
from imud.device.health import SEARCH_BEGUN, DeviceEvents
from imud.model.event import Event, EventKind
from imud.model.ledger import Ledger
from tests.support.metrics import device

S = 1_000_000_000
NOW_NS = 1000 * S
PORT = device_condition.ConfiguredPort("/dev/ttyUSB0", "uart.port", True, lambda: ["/dev/ttyUSB1", "/dev/ttyS0"])
THERE = "Ports on this host: /dev/ttyUSB1, /dev/ttyS0."
BUS = device_condition.ConfiguredPort("can0", "can.interface", False, list)
APPLY = "Apply the declared value, or change the configuration."
SAVE = "Save the settings to the device's flash."
DOCTOR = "Run `sudo imud doctor`."


def recent(rate_hz: float | None = None, **changes: Any) -> RecentStatus:
    known = {"samples": 3000, "last_sample_ns": NOW_NS - 12 * S, **changes}
    return RecentStatus(NOW_NS - 840 * S, rate_hz, **known)


def facts(state: DeviceState = DeviceState.RUNNING, problem: str = "", **changes: Any) -> device_condition.Facts:
    known = {"now_ns": NOW_NS, "place": PORT, "recent": recent(), "expected_rate_hz": 50.0, **changes}
    return device_condition.Facts(state=state, problem=problem, rate_hz=known["recent"].rate_hz, **known)


def declared(state: SettingsState = SettingsState.AGREE, **changes: Any) -> device_condition.Facts:
    return facts(declared=SettingsStatus(state, OnDifference.REPORT, **changes))


def axes(kind: FrameProblem, problem: str) -> device_condition.Facts:
    return facts(axes=kind, axes_problem=problem)


def lost_before(seconds: int, samples: int = 0, cause: str = "") -> device_condition.Facts:
    return facts(recent=recent(loss_ns=NOW_NS - seconds * S, loss_samples=samples, loss_cause=cause))


LATE = facts(t_err_ns=2_100_000)


@pytest.mark.parametrize(
    ("known", "condition", "message", "step"),
    [
        (facts(DeviceState.MISSING, "the port is missing"), "missing", "The port /dev/ttyUSB0 does not exist.",
         f"Plug in the cable, or correct uart.port in the configuration. {THERE}"),
        (facts(DeviceState.SEARCHING, "no byte arrives"), "missing", "No data arrives at /dev/ttyUSB0.",
         "Check the power supply, and check that TX and RX are not swapped."),
        (facts(DeviceState.SILENT, "no sample for 1.0 s, but the link is open"), "missing",
         "The device stopped sending 12 s ago. Its port still exists.", "Check the power supply and the connector."),
        (facts(DeviceState.FAILED, "port is in use by gpsd"), "missing", "Port is in use by gpsd.", DOCTOR),
        (facts(DeviceState.SEARCHING, SEARCH_BEGUN), "missing",
         "imud searches for the device at /dev/ttyUSB0.", "Wait for the search."),
        (facts(DeviceState.MISSING), "missing",
         "imud searches for the device at /dev/ttyUSB0.", "Wait for the search."),
        (facts(DeviceState.SEARCHING, "bytes arrive, but no valid frame", recent=recent(bytes_in=9)), "missing",
         "Bytes arrive, but no valid frame.", DOCTOR),
        (facts(DeviceState.SILENT, "it replies but sends none"), "missing", "It replies but sends none.", DOCTOR),
        (declared(SettingsState.DIFFER, differences={"mounting": SettingDifference("x up", "level")}), "attention",
         "Mounting is “level” on the device, but “x up” in the configuration.", APPLY),
        (declared(SettingsState.DIFFER, differences={"low_pass_hz": SettingDifference(20)}), "attention",
         "Low pass is not known on the device, but “20” in the configuration.", APPLY),
        (declared(unsaved=True, lost_at_power_off={"mode": "9 axes"}), "attention",
         "Mode “9 axes” is lost at power-off because it is not saved.", SAVE),
        (declared(unsaved=True, lost_at_power_off={"output": {"hi91": 50, "hi92": 0}}), "attention",
         "Output “hi91 50, hi92 0” is lost at power-off because it is not saved.", SAVE),
        (declared(SettingsState.DIFFER, differences={"bias": SettingDifference([1.5, 0], {"x": True})}), "attention",
         "Bias is “x true” on the device, but “1.5, 0” in the configuration.", APPLY),
        (declared(unsaved=True, lost_at_power_off={"mode": "9 axes"}, flash_unknown=("mode",)), "attention",
         "Mode “9 axes” is not saved, and the value in flash is unknown.", SAVE),
        (declared(unsaved=True), "attention", "A change is not saved, and the value in flash is unknown.", SAVE),
        (declared(problem="cannot read the settings: no reply"), "attention", "Cannot read the settings: no reply.",
         "Run `imud settings` with the name of the device."),
        (axes(
             FrameProblem.DECLINATION,
             "declination_deg is configured, but yaw is measured from the direction at power-on",
         ),
         "attention", "declination_deg is configured, but yaw is measured from the direction at power-on.",
         "Calibrate the magnetometer, or remove declination_deg from the configuration."),
        (axes(FrameProblem.GRAVITY, "at rest, up is +x: set frame"), "attention",
         "The measured gravity does not match the attitude.", "At rest, up is +x: set frame."),
        (axes(FrameProblem.AXES, "imud does not know urfr 9"), "attention", "imud does not know urfr 9.", DOCTOR),
        (facts(lines=LinesStatus({}, {}, {}, alarm=True)), "attention", "The ALARM pin is active.",
         "Compare the measured values with the limits of the device (docs/lines.md)."),
        (facts(lines=LinesStatus({"sout": "no chip"}, {}, {})), "attention", "Line sout: no chip.", DOCTOR),
        (facts(has_scattered_time=True), "degraded", "The device time scatters: imud cannot count lost samples.",
         DOCTOR),
        (facts(utc_problem="gpsd is down"), "attention", "gpsd is down.".capitalize(), DOCTOR),
        (facts(open_bytes=3), "attention", "The ledger does not balance: 3 bytes.",
         "Report this fault of imud with the output of `imud status --json`."),
        (facts(recent=recent(restarts=3)), "attention", "The device restarted 3 times in the last hour.",
         "Measure the supply voltage at the device."),
        (facts(recent=recent(samples=961, lost={"crc": 38, "queue": 1})), "degraded",
         "3.9 % of the samples are lost because frames are damaged.",
         "Check the cable, its length and its ground. If they are correct, use a lower bit rate."),
        (facts(recent=recent(samples=998, lost={"overrun": 2})), "degraded",
         "0.20 % of the samples are lost in kernel buffer overruns.",
         "Reduce the load of this host, or use a lower rate."),
        (facts(recent=recent(gaps=2)), "degraded",
         "Samples are lost in 2 gaps of unknown size in the last minute.", DOCTOR),
        (facts(recent=recent(45.9)), "degraded", "The device sends 45.9 samples per second instead of 50.",
         "Compare the output rate in the settings of the device with its bit rate."),
        (LATE, "degraded", "The time stamp error is ±2.1 ms.", "Connect SOUT, or reduce the latency timer."),
        (facts(recent=recent(0.79), expected_rate_hz=1.0), "degraded",
         "The device sends 0.8 samples per second instead of 1.",
         "Compare the output rate in the settings of the device with its bit rate."),
        (facts(problem="can0 is error-passive"), "degraded", "can0 is error-passive.", DOCTOR),
        (facts(DeviceState.MISSING, "can0 is down", place=BUS), "missing", "can0 is down.", DOCTOR),
        (facts(DeviceState.SEARCHING, "nothing came", place=BUS), "missing", "No data arrives at can0.",
         "Check the power supply, and check the wires and the bit rate of the bus."),
        (facts(), "ok", "No sample was lost since imud started to read this device 14 min ago.", ""),
        (lost_before(600, 19, "overrun"), "ok",
         "19 samples were lost 10 min ago in a kernel buffer overrun. No sample was lost after that.", ""),
        (lost_before(1, 1, "crc"), "ok",
         "1 sample was lost 1 s ago because frames were damaged. No sample was lost after that.", ""),
        (lost_before(1), "ok", "Samples were lost 1 s ago. No sample was lost after that.", ""),
        (lost_before(1, 2, "queue"), "ok",
         "2 samples were lost 1 s ago because imud was too late. No sample was lost after that.", ""),
        (lost_before(1, 2, "gap_device"), "ok",
         "2 samples were lost 1 s ago before they reached this host. No sample was lost after that.", ""),
        (facts(DeviceState.FINISHED, ""), "ok", "The replay is at its end.", ""),
        (facts(DeviceState.FINISHED, "no frame"), "ok", "The replay is at its end. No frame.", ""),
        (facts(DeviceState.FAILED, ""), "missing", "The reason is not known.", DOCTOR),
        (facts(DeviceState.SILENT, "no sample for 1.0 s", recent=recent(last_sample_ns=0)), "missing",
         "The device stopped sending some time ago. Its port still exists.",
         "Check the power supply and the connector."),
        (axes(FrameProblem.DECLINATION, "declination_deg is configured, but yaw is true already"), "attention",
         "declination_deg is configured, but yaw is true already.", "Remove declination_deg from the configuration."),
        (facts(open_frames=2), "attention", "The ledger does not balance: 2 frames.",
         "Report this fault of imud with the output of `imud status --json`."),
        (facts(recent=recent(samples=98, lost={"queue": 2})), "degraded",
         "2.0 % of the samples are lost because imud is too late.",
         "Reduce the load of this host, or use a lower rate."),
        (facts(recent=recent(samples=98, lost={"gap_device": 2})), "degraded",
         "2.0 % of the samples are lost before they reach this host.",
         "Use a lower output rate or a higher bit rate of the device."),
        (facts(recent=recent(gaps=1)), "degraded",
         "Samples are lost in 1 gap of unknown size in the last minute.", DOCTOR),
    ],
)  # fmt: skip
def test_each_sentence(known: device_condition.Facts, condition: str, message: str, step: str) -> None:
    limits = ConditionLimits(t_err_ms=2.0)
    reason, *more = (cause.reason() for cause in device_condition.causes_of(known, limits))
    assert (reason.message, reason.next, condition_of(reason.code)) == (message, step, condition)
    assert condition != "ok" or not more


@pytest.mark.parametrize(
    "known",
    [
        facts(recent=recent(samples=999, lost={"crc": 1})),
        facts(recent=recent(49.0)),
        facts(recent=recent(51.0)),
        facts(recent=recent(0.81), expected_rate_hz=1.0),
        facts(recent=recent(30.0), expected_rate_hz=0.0),
        facts(recent=recent(restarts=2)),
        LATE,
        declared(SettingsState.UNKNOWN),
    ],
)
def test_no_reason_within_the_limits(known: device_condition.Facts) -> None:
    causes = device_condition.causes_of(known, ConditionLimits(t_err_ms=2.1))
    assert all(cause.rule.code in OK for cause in causes)


def cause(code: ReasonCode, message: str, setting: str = "") -> device_condition.Cause:
    rule = device_condition.Rule(code, Section.LIVE, lambda _facts, _limits: True, message)
    return device_condition.Cause(rule, facts(), setting)


LOST = cause(ReasonCode.LOST, "lost")
ALARM = cause(ReasonCode.ALARM, "alarm")
SETTING = cause(ReasonCode.SETTING, "differs", "mode")
GONE = cause(ReasonCode.STOPPED, "stopped")
NONE = cause(ReasonCode.NONE_LOST, "none")


class Watched:
    """Watch of one device whose time advances by one second per update."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.now_s = 0
        events = DeviceEvents("bow", Ledger(), self.events.append)
        self.watch = device_condition.ConditionWatch(ConditionLimits(), events, 0)

    def after(self, seconds: int, *causes: device_condition.Cause) -> Condition:
        for _ in range(seconds):
            self.watch.update(self.now_s * S, causes if GONE in causes else (*causes, NONE))
            self.now_s += 1
        return self.watch.condition.condition


def test_a_reason_counts_after_5_s_and_ends_60_s_after_its_cause() -> None:
    watched = Watched()
    assert (watched.after(1), watched.after(5, LOST)) == ("ok", "ok")
    assert (watched.after(1, LOST), watched.after(60, ALARM)) == ("degraded", "attention")
    assert [reason.code for reason in watched.watch.condition.reasons] == ["alarm", "lost"]
    assert watched.after(1, ALARM) == "attention"
    assert [reason.code for reason in watched.watch.condition.reasons] == ["alarm"]
    assert (watched.after(60), watched.after(1)) == ("attention", "ok")
    assert watched.watch.condition.since_ns == (watched.now_s - 1) * S
    assert [event.detail["reasons"] for event in watched.events] == ["lost", "alarm, lost", "alarm", "none-lost"]
    assert {event.kind for event in watched.events} == {EventKind.CONDITION}
    both = facts(t_err_ns=2_100_000, has_scattered_time=True)
    watched.after(6, *device_condition.causes_of(both, ConditionLimits(t_err_ms=2.0))[:2])
    assert [reason.code for reason in watched.watch.condition.reasons] == ["time-error", "device-time"]


def test_a_short_cause_a_repaired_setting_and_a_missing_device() -> None:
    watched = Watched()
    assert watched.after(1) == watched.after(4, LOST) == watched.after(100) == "ok"
    assert watched.events == []
    watched = Watched()
    watched.after(1)
    assert (watched.after(6, SETTING), watched.after(1)) == ("attention", "ok")
    watched = Watched()
    assert watched.after(1, GONE) == "missing"  # before the first sample without a delay
    assert (watched.after(1), watched.after(6, LOST)) == ("ok", "degraded")
    assert (watched.after(5, GONE), watched.after(1, GONE)) == ("degraded", "missing")
    assert (watched.watch.condition.reasons, watched.after(1)) == ((GONE.reason(),), "ok")


def test_history_contains_the_worst_condition_of_each_minute() -> None:
    watched = Watched()
    watched.after(60)
    watched.after(10, LOST)
    watched.after(120)
    assert watched.watch.history[-4:] == ("ok", "degraded", "degraded", "ok")
    assert set(watched.watch.history[:-4]) == {None}
    watched.now_s += 130
    watched.after(1)
    assert watched.watch.history[-3:] == ("ok", None, "ok")
    watched.now_s += 100_000
    watched.after(1)
    assert (watched.watch.history[-2:], len(watched.watch.history)) == ((None, "ok"), 60)


def test_text_of_a_condition_and_status_of_another_version() -> None:
    assert str(DeviceCondition(Condition.MISSING, 0)) == "missing"
    two = msgspec.to_builtins(DeviceCondition(Condition.DEGRADED, 0, (LOST.reason(), ALARM.reason())))
    two["reasons"][0]["code"] = "of another version"  # readers accept unknown codes
    assert str(msgspec.convert(two, DeviceCondition)) == "degraded: lost alarm"
    status = msgspec.convert(msgspec.to_builtins(msgspec.structs.replace(device("bow"), condition=None)), DeviceStatus)
    assert (status.has_problem, status.word, status.reasons) == (False, "running", ())


class Judged:
    """Judge of a device that sends 50 samples per second."""

    def __init__(self) -> None:
        tree = {"devices": {"imu0": {"driver": "hipnuc-uart", "uart": {"port": "/dev/ttyUSB0", "baud": 921600}}}}
        (device_config,) = config.parse(msgspec.json.encode(tree), "test").devices
        self.ledger, self.now_ns = Ledger(), 0
        events = DeviceEvents("imu0", self.ledger, lambda _event: None)
        self.judge = device_condition.ConditionJudge(device_config, PORT.port, self.ledger, events, 0)

    def is_steady(
        self, seconds: int = 1, samples: int = 50, problem: str = "", state: DeviceState = DeviceState.RUNNING
    ) -> bool:
        """Pass seconds. Return whether no rule ran in the last second."""
        for _ in range(seconds):
            self.now_ns += S
            self.ledger.samples += samples
            known = device_condition.Known(state, problem)
            has_run = self.judge.judge(self.now_ns, 50.0, 0, self.now_ns, known, self.now_ns)
        return not has_run


def test_the_rules_run_again_after_a_change_of_a_fact_and_after_5_s() -> None:
    judged = Judged()
    assert not judged.is_steady()
    assert judged.is_steady(20)
    assert judged.judge.watch.condition.reasons[0].message.endswith("since imud started to read this device 21 s ago.")
    judged.ledger.lost_crc += 1
    assert not judged.is_steady(60)  # the loss is in the last minute
    assert judged.is_steady(2)
    assert judged.judge.watch.condition.reasons[0].message.startswith("1 sample was lost 61 s ago")
    assert not judged.is_steady(problem="the bus is error-passive")
    assert not judged.is_steady(60)  # the reason ends 60 s after its cause
    assert judged.is_steady(2)
    assert not judged.is_steady(10, samples=40)
    assert judged.judge.watch.condition.condition is Condition.DEGRADED
    judged = Judged()
    judged.is_steady(20)
    judged.ledger.lost_crc += 354
    judged.judge.add_new_losses(judged.now_ns, judged.now_ns)  # a client requests the status between two seconds
    assert judged.judge.watch.condition.reasons[0].message.startswith("354 samples were lost 0 s ago")
    assert judged.judge.counts.status(judged.now_ns).lost == {"crc": 354}
    judged = Judged()
    judged.is_steady(20)
    levels = []
    for seconds in (5, 1):
        judged.is_steady(seconds, samples=0, state=DeviceState.SILENT)
        levels.append(judged.judge.watch.level)
    assert levels == [Condition.OK, Condition.MISSING]
