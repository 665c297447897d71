"""Facts in codec, driver, lines, setting and status: words, counts, defaults, and results of a plan."""

from dataclasses import replace
from random import Random
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from imud.attitude.conventions import RFU_ENU, Heading
from imud.contracts import codec, driver, lines, setting, status
from imud.contracts.codec import BadFrame, BadReason
from imud.contracts.condition import Condition, DeviceCondition, Reason, ReasonCode
from imud.contracts.driver import DataSheet, KeyProblem, ModelFigures, SentAxes, StatusBit, StreamDriver
from imud.contracts.script import ReplyFrame, TextLine
from imud.contracts.setting import AppliedSettings, DeviceReport, SettingsPlan, StepOutcome
from imud.contracts.status import Deviations, DeviceState, WorkStatus
from imud.drivers import DRIVERS
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.support.documented import check_schema
from tests.support.fake_drivers import FAKE_DRIVER, FAKE_SETTINGS, fake_can_driver, fake_can_frame
from tests.support.socket_rig import device_status

CAN = fake_can_driver()
BAD, REPLY = BadFrame(BadReason.CRC, b""), ReplyFrame(6, b"x")
UNSURE = "save to flash: sent, not verified: imud cannot read the flash"


def test_frames_of_a_wrong_length_and_of_unknown_types_and_possible_replies() -> None:
    ledger, counts = Ledger(), dict[int, int]()
    (frame,) = codec.wrong_length(ledger, 0x8A, b"abc")
    assert frame == BadFrame(BadReason.LENGTH, b"abc", 0x8A)
    assert (ledger.bytes_in_bad_frames, ledger.frames_bad_length) == (3, 1)
    words = "1 frame of a wrong length, the last of CAN identifier 08A"
    assert [codec.wrong_length_words(ledger, one) for one in (frame, None, BAD)] == [words, "", ""]
    for frame_type in (*range(9), 0):
        codec.count_unknown(counts, frame_type)
    assert counts == {0: 2, **dict.fromkeys(range(1, 8), 1)}
    events = (TextLine("OK"), REPLY, Measurement(1, 0, None), BAD)
    assert [codec.message_of(event) for event in events] == ["OK", REPLY, None, None]


def test_figures_words_and_axes_of_a_device() -> None:
    family, model = ModelFigures(source="a"), ModelFigures(source="b")
    sheet = DataSheet(models={"HI": family, "HI14": model})
    assert [sheet.figures_of(product) for product in ("HI14R2N", "HI12", "CH100")] == [model, family, None]
    bits = {0: StatusBit("first"), 9: StatusBit("tenth")}
    assert [driver.status_words(bits, value) for value in (1 << 9 | 1 << 4, None)] == [("tenth",), ()]
    words = "valid frames of unknown types (131), but no sample; select another frame type on the device"
    assert FAKE_DRIVER.unknown_words({131: 7}) == words
    assert FAKE_DRIVER.unknown_types({131: 7, 132: 1}) == "valid frames of unknown types (131: 7, 132: 1)"
    sent = SentAxes(RFU_ENU, "ZYX", "NED")
    one = replace(FAKE_DRIVER, axes_by_settings=lambda settings: sent if settings else None)
    assert [one.sent_axes(settings) for settings in ({"a": "b"}, {})] == [sent, SentAxes(RFU_ENU, "", "ENU")]


def test_problems_of_options_and_defaults_of_a_driver() -> None:
    rates = "expected a baud rate of fake-uart (9600, 115200, 230400, 256000, 460800, 921600) or auto, got 4800"
    own, wrong = KeyProblem("options", "rate", "too fast"), KeyProblem("link", "baud", rates)
    stream, can = (replace(one, check=lambda _options, _link: [own]) for one in (FAKE_DRIVER, CAN))
    found = {baud: stream.problems(None, SimpleNamespace(baud=baud)) for baud in (4800, 9600, 0, "auto")}
    assert found == {4800: [own, wrong], 9600: [own], 0: [own], "auto": [own]}
    assert can.problems(None, None) == [own]
    frames = [[fake_can_frame(node)] * 2 for node in range(12, 0, -1)]
    ignored = "the log has frames of other devices, which imud ignores: {}; --option selects one of them"
    listed = [ignored.format(", ".join(f"node {node}" for node in range(2, last + 1))) for last in (3, 9)]
    assert CAN.other_nodes(CAN.node_settings(1), frames[-3:]) == listed[0]
    assert CAN.other_nodes(CAN.node_settings(1), frames[-9:]) == listed[1]
    assert CAN.other_nodes(CAN.node_settings(1), frames) == listed[1].replace(";", " and 3 more;")
    foreign = [[fake_can_frame(0)] * 2, [fake_can_frame(7)], [fake_can_frame(1)] * 2]
    assert CAN.other_nodes(CAN.node_settings(1), foreign) == ""  # one frame does not show a device
    assert (CAN.check(None, None), CAN.heading(None, {}), driver.nothing_cyclic(None)) == ((), Heading.UNKNOWN, ())
    assert driver.of_kind([FAKE_DRIVER, CAN], StreamDriver) == [FAKE_DRIVER]
    assert DRIVERS["imu61x-i2c"].tick_modulus == 2
    assert driver.random_vector(Random(1), 2.0) == pytest.approx((2.57637, 2.898891, 0.132672), abs=1e-6)


def test_lines_have_the_documented_values_and_the_instant_of_the_measurement() -> None:
    """A frame starts 125 µs after a trigger and 80 µs after the start of the pulse."""
    assert {name: check_schema(f"Line `{name}`", schema) for name, schema in lines.LINE_SCHEMAS.items()} == {
        "sout": 7, "sout_div": 1, "sin": 5, "alarm": 0, "reset": 4, "data_ready": 3, "pps": 2,
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"^expected the key chip next to the number of a line, got no chip$"):
        lines.SoutOptions(line=17)
    given: dict[str, Any] = {"offset_us": 1.0, "bias_us": 2.0}
    assert lines.SoutOptions(line="a", width_us=3.0, **given).timing == lines.SoutTiming(width_us=3.0, **given)
    assert lines.TriggerOptions(line=17, chip="a", **given).timing == lines.TriggerTiming(**given)
    assert (lines.SoutTiming().bias_us, lines.SoutTiming().width_us, lines.TriggerTiming().bias_us) == (45, 80, 125)


def test_reports_are_joined_and_a_declaration_has_the_writable_settings() -> None:
    reports = {"a": DeviceReport({"Rate": "100"}, {"rate": 100}), "b": DeviceReport({"Mode": "6"}, {"mode": 6})}
    assert setting.combined(reports) == DeviceReport({"Rate": "100", "Mode": "6"}, {"rate": 100, "mode": 6})
    kind = FAKE_SETTINGS.declarable
    assert kind.__struct_fields__ == ("baud", "mode", "output", "mounting", "offset_deg", "secret")
    declared = msgspec.convert({"mode": "9-axis", "secret": 0}, kind)
    assert [setting.declared_values(one) for one in (declared, None)] == [{"mode": "9-axis", "secret": 0}, {}]
    assert setting.schemas_of(FAKE_SETTINGS)["secret"]["maximum"] == 9


def test_title_and_group_of_a_setting() -> None:
    for name, title, group in (
        ("tpdo1_interval_ms", "TPDO1 interval", "output"), ("sout_divisor", "SOUT divisor", "pins"),
        ("gyro_offset_deg_s", "Gyro offset", "measurement"), ("second_bus", "Second bus", "connection"),
    ):  # fmt: skip
        assert (setting.title_of(name), setting.group_of(name, setting.Setting(type=int))) == (title, group)
        assert setting.group_of(name, setting.Setting(type=int, connection=True)) == "connection"


def test_a_value_after_a_restart_verifies_a_save() -> None:
    for outcomes, saved, restarted, ends in (
        ("VERIFIED NOT_VERIFIED", True, True, ["saved to flash", "restarted"]), ("VERIFIED", True, False, [UNSURE]),
        ("VERIFIED", False, True, ["restarted"]), ("NOT_VERIFIED", True, True, [UNSURE, "restarted"]),
        ("VERIFIED NOT_APPLIED", True, True, [UNSURE, "restarted"]),
    ):  # fmt: skip
        steps = tuple(setting.AppliedStep("mode", 1, 0, StepOutcome[one]) for one in outcomes.split())
        assert AppliedSettings(steps, saved, restarted).ends == ends


def test_the_failure_is_the_problem_or_else_all_missing_values_and_a_plan_can_be_empty() -> None:
    differences = {"mode": setting.SettingDifference("9-axis", "6-axis")}
    applied = AppliedSettings(left_out={"baud": "needs save"}, differences=differences)
    assert applied.failure == "baud needs save; mode: expected 9-axis, got 6-axis"
    assert msgspec.structs.replace(applied, problem="It is gone.").failure == "It is gone."
    plans = (SettingsPlan(), SettingsPlan((setting.PlannedStep("mode", 1),)), SettingsPlan(save=True))
    assert [plan.empty for plan in plans] == [True, False, False]


def test_words_of_running_work_known_deviations_and_bounds_of_the_latency_histogram() -> None:
    work, words = WorkStatus("save", 5_000_000_000, "uid 1000", ""), "save is running, started 7 s ago by uid 1000"
    assert work.words(12_000_000_000) == words
    assert msgspec.structs.replace(work, stop="stop it").words(12_000_000_000) == f"{words}; stop it"
    new = Deviations(gyro_rad_s=1.0, mag_t=2.0).updated(Deviations(gyro_rad_s=3.0, accel_m_s2=4.0))
    assert new == Deviations(gyro_rad_s=3.0, mag_t=2.0, accel_m_s2=4.0)
    assert check_schema("Noise of a device", Deviations) == 6
    bounds_us = (50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000)
    assert tuple(1000 * bound for bound in bounds_us) == status.LATENCY_BOUNDS_NS


def test_the_condition_of_a_device_and_its_state_without_a_condition() -> None:
    reasons, found = (Reason(ReasonCode.LOST, "Lost."),), []
    for condition in (None, DeviceCondition(Condition.OK, 0), DeviceCondition(Condition.DEGRADED, 0, reasons)):
        bow = msgspec.structs.replace(device_status("bow", 1), state=DeviceState.FINISHED, condition=condition)
        found.append((bow.has_problem, bow.reasons, bow.word))
    assert found == [(False, (), "finished"), (False, (), "ok"), (True, reasons, "degraded")]
