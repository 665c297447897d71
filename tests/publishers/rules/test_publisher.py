"""Output `rules`: events, lines, commands and snapshots of rules; rules of ticks; rules without values."""

from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import msgspec
import pytest

from imud.cli.run import rules_without_values
from imud.config import parse
from imud.contracts.driver import CanDriver
from imud.contracts.publisher import Batch
from imud.drivers import DRIVERS
from imud.model.errors import ConfigError
from imud.model.event import Event, EventKind
from imud.model.ledger import NOTHING_LOST, Ledger
from imud.model.sample import Measurement, Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.rules.commands import CommandEnd, Result
from imud.publishers.rules.publisher import Rules
from imud.publishers.rules.settings import RulesOptions
from tests.support.event_loops import VirtualClock
from tests.support.publisher_context import FakeLatencies, publisher_context


class FakeLine:
    problem = ""

    def __init__(self, *_: object) -> None:
        self.did: list[object] = []

    def tick(self, now_ns: int) -> None: ...

    def set(self, active: bool) -> None:
        self.did.append(active)

    def close(self) -> None:
        self.did.append("closed")


class Rig:
    def __init__(self, devices: Sequence[str] = ("bow",), **rules: dict[str, Any]) -> None:
        self.clock, self.asked = VirtualClock(), FakeLatencies()
        self.events: list[Event] = []
        self.lines: list[FakeLine] = []
        self.lost = 0
        self.commands: list[tuple[list[str], dict[str, str], Callable[[CommandEnd], None]]] = []
        self.context = publisher_context(
            now_ns=self.clock.now_ns, latencies=self.asked, raise_event=self.events.append, drive_line=self._drive,
            losses=lambda _name: (self.lost, *NOTHING_LOST[1:]),
        )  # fmt: skip
        given = {name: {"hold_s": 0, **rule} for name, rule in rules.items()}
        self.rules = Rules(msgspec.convert({"rules": given}, RulesOptions), self.context)
        self.rules._runner.run = lambda argv, facts, on_end: self.commands.append((list(argv), dict(facts), on_end))  # type: ignore[method-assign]  # fmt: skip
        for number, name in enumerate(devices):
            self.rules.add_device(name, number)
        self.rules.start()
        self.seq = 0

    def _drive(self, *_: object) -> FakeLine:
        self.lines.append(FakeLine())
        return self.lines[-1]

    def publish(self, count: int = 1, device: str = "bow", step_ns: int = 100 * NS_PER_MS, **values: Any) -> None:
        samples = []
        for _ in range(count):
            self.seq += 1
            self.clock.advance(step_ns)
            now_ns = self.clock.now_ns()
            samples.append(
                msgspec.structs.replace(Sample(device, self.seq, now_ns, 0, Sync.ARRIVAL, now_ns, 0), **values)
            )
        self.rules.publish(Batch(device, 0, samples))

    def tick(self, count: int = 1, seconds: float = 0.5) -> None:
        for _ in range(count):
            self.clock.advance(round(seconds * NS_PER_S))
            self.rules.tick(self.clock.now_ns())

    @property
    def said(self) -> list[str]:
        found = [event.message for event in self.events]
        self.events.clear()
        return found


HOT: dict[str, Any] = {"measure": "temperature_c", "above": 50, "hysteresis": 5}


def test_a_rule_begins_and_ends_with_events_a_line_a_snapshot_and_commands() -> None:
    full = {**HOT, "line": {"line": "GPIO4"}, "snapshot": True, "command": ["/bin/a", "{device}", "a{rule}"], "end_command": ["/bin/b"]}  # fmt: skip  # noqa: E501
    rig = Rig(("bow", "stern"), hot=full)
    assert rig.asked.asked == {"rules": (100 * NS_PER_MS, ("bow", "stern"))}
    rig.publish(temperature_c=50.0)
    rig.publish(device="other", temperature_c=99.0)
    assert rig.said == []
    rig.publish(temperature_c=50.5)
    (event,) = rig.events
    assert (event.kind, event.device, event.t_ns) == (EventKind.RULE, "bow", rig.clock.now_ns())
    assert rig.said == ["rule hot: temperature 50.5 °C, above 50 °C"]
    assert event.detail == {
        "rule": "hot", "active": True, "measure": "temperature_c", "value": 50.5, "t_ns": rig.clock.now_ns(),
        "limit": 50.0, "snapshot": True,
    }  # fmt: skip
    argv, facts, on_end = rig.commands.pop()
    assert argv == ["/bin/a", "bow", "a{rule}"]
    assert facts == {
        "IMUD_RULE": "hot", "IMUD_DEVICE": "bow", "IMUD_ACTIVE": "1", "IMUD_MEASURE": "temperature_c",
        "IMUD_VALUE": "50.5", "IMUD_MESSAGE": "rule hot: temperature 50.5 °C, above 50 °C",
    }  # fmt: skip
    on_end(CommandEnd(Result.OK, "exit status 0"))
    assert rig.said == []
    on_end(CommandEnd(Result.FAILED, "exit status 3", "no mail"))
    assert rig.said == ["command of rule hot: exit status 3; last line: no mail"]
    rig.publish(device="stern", temperature_c=60.0)
    rig.publish(11, temperature_c=45.0)
    assert rig.said == ["rule hot: temperature 60 °C, above 50 °C", "rule hot ended: temperature 45 °C"]
    assert [argv for argv, *_ in rig.commands] == [["/bin/a", "stern", "a{rule}"], ["/bin/b"]]
    assert rig.lines[0].did == [True, True, True], "the line stays active for the other device"
    assert [(one.device, one.active, one.begins) for one in rig.rules.status().rules] == [
        ("bow", False, 1),
        ("stern", True, 1),
    ]
    rig.rules.remove_device("stern")
    assert rig.said == ["rule hot ended: the device was removed or restarted by a new configuration"]
    rig.publish(temperature_c=60.0)
    rig.events.clear()
    rig.rules.close()
    rig.rules.close()
    assert rig.said == ["rule hot ended: the output rules ended"]
    assert rig.lines[0].did == [True, True, True, False, True, False, "closed"]
    assert (rig.asked.asked, rig.context.outputs.rules, len(rig.commands)) == ({}, [], 3), "no command at the end"


def test_silence_begins_without_samples_but_not_while_the_host_stands_still() -> None:
    rig = Rig(quiet={"measure": "silence_s", "above": 2})
    rig.publish(step_ns=0)
    rig.tick(5)
    assert rig.said == [], "2 s after the tick that found the last sample"
    rig.tick()
    assert rig.said == ["rule quiet: silence 2.5 s, above 2 s"]
    for _ in range(3):
        rig.publish(step_ns=0)
        rig.tick()
    assert rig.said == ["rule quiet ended: silence 0 s"]
    rig.tick(seconds=600)
    assert rig.said == []


def test_the_sample_rate_is_by_time_stamps_and_zero_without_samples() -> None:
    rig = Rig(slow={"measure": "sample_rate_hz", "below": 90, "window_s": 1})

    def second(rate: int) -> None:
        for _ in range(2):
            if rate:
                rig.publish(rate // 2, step_ns=NS_PER_S // rate)
            else:
                rig.clock.advance(NS_PER_S // 2)
            rig.tick(seconds=0)

    for rate in (100, 100, 100, 80, 80):
        second(rate)
    assert rig.said == ["rule slow: sample rate 80 Hz, below 90 Hz"]
    for rate in (100, 100, 100, 0, 0):
        second(rate)
    assert rig.said == ["rule slow ended: sample rate 100 Hz", "rule slow: sample rate 0 Hz, below 90 Hz"]


def test_lost_samples_are_counted_in_a_sliding_window() -> None:
    rig = Rig(loss={"measure": "lost_samples", "above": 3, "window_s": 10})
    rig.lost = 100
    rig.tick()
    rig.lost = 104
    rig.tick()
    assert rig.said == ["rule loss: number of lost samples 4, above 3"]
    rig.tick(18)
    assert rig.said == []
    rig.tick(4)
    assert rig.said == ["rule loss ended: number of lost samples 0"]
    rig.lost = 0
    rig.tick(5)
    assert rig.said == [], "a new ledger"


TILT: dict[str, Any] = {"measure": "tilt_deg", "above": 5}
BAND: dict[str, Any] = {"measure": "rms_accel_m_s2", "above": 1, "band_hz": [1, 8]}
VECTOR = (0.0, 0.0, 9.8)


@pytest.mark.parametrize(
    ("rule", "values", "step_ms", "words"),
    [
        (TILT, {}, 100, "not evaluated: the samples of bow do not contain euler_rad; select a frame type"),
        (TILT, {"euler_rad": (float("nan"), 0.0, 0.0)}, 100, "not evaluated: values of euler_rad are not finite"),
        (BAND, {"accel_m_s2": VECTOR}, 100, "not evaluated: expected band_hz below half the sample rate (5 Hz)"),
        (BAND, {"accel_m_s2": VECTOR}, 20, ""),
        ({**HOT, "snapshot": True}, {"temperature_c": 1.0}, 100, "snapshot: the flight recorder does not run"),
    ],
)  # fmt: skip
def test_a_rule_without_values_is_visible(
    rule: dict[str, Any], values: dict[str, Any], step_ms: int, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig(one=rule)
    for _ in range(40):
        rig.publish(500 // step_ms, step_ns=step_ms * NS_PER_MS, **values)
        rig.tick(seconds=0)
    problems = rig.context.outputs.problems()
    assert [text.startswith(words) for text in problems.values()] == [True] * bool(words)
    assert list(problems) == ["rules one bow"] * bool(words)
    assert len(caplog.messages) == words.startswith("not evaluated")
    if rule is TILT:
        for _ in range(2):
            rig.publish(euler_rad=VECTOR)
            rig.tick()
        assert rig.context.outputs.problems() == {}


def test_gaps_that_always_restart_the_filter_are_visible() -> None:
    rig = Rig(one=BAND)
    for turn in range(80):
        rig.publish(24, step_ns=20 * NS_PER_MS, accel_m_s2=VECTOR)
        rig.clock.advance((turn > 4) * 40 * NS_PER_MS)
        rig.tick(seconds=0)
    assert rig.context.outputs.problems()["rules one bow"].startswith("not evaluated: the band filter starts again")


def test_imud_check_names_rules_without_values() -> None:
    rules = "a: {measure: peak_accel_m_s2, above: 1}, b: {measure: temperature_c, above: 1, devices: [mast]}"
    settings = parse(
        f"rules: {{rules: {{{rules}}}}}\ndevices:\n"
        "  bow: {driver: hipnuc-nmea2000, socketcan: {interface: can0}}\n"
        "  mast: {driver: hipnuc-canopen, socketcan: {interface: can1}, options: {node: 8}}\n", "f",
    )  # fmt: skip
    assert list(rules_without_values(settings)) == [
        "rules.rules.a: bow never sends accel_m_s2; the rule has no effect for it",
        "rules.rules.b: mast never sends temperature_c; the rule has no effect for it",
    ]


def test_no_example_contains_a_field_that_the_driver_never_sends() -> None:
    found = 0
    for driver in (DRIVERS[name] for name in DRIVERS):
        if isinstance(driver, CanDriver) and driver.never_sends:
            codec, random = driver.make_codec(Ledger(), driver.settings()), Random(1)
            frames = [frame for _ in range(50) for frame in driver.example_frames(random)]
            events = [one for n, it in enumerate(frames) for one in codec.feed_frame(it.can_id, it.extended, it.data, n * 10**7) or ()]  # fmt: skip  # noqa: E501
            measured = [one for one in events if isinstance(one, Measurement)]
            assert measured
            assert all(getattr(one, name) is None for one in measured for name in driver.never_sends)
            found += 1
    assert found == 2


def test_names_lines_and_devices_of_the_configuration() -> None:
    text = """
rules:
  enabled: true
  rules:
    a: {measure: silence_s, above: 3, devices: [bow], line: {line: GPIO4}}
    b: {measure: silence_s, above: 3, devices: [bow, mast], line: {line: GPIO%d, chip: gpiochip0}}
recorder: {flight: {enabled: true, line: {line: GPIO5}}}
devices:
  bow: {driver: hipnuc-uart, uart: {port: /dev/ttyUSB0}, lines: {sout: {line: GPIO6}}}
"""
    options = parse(text % 7, "f").publishers["rules"]
    assert isinstance(options, RulesOptions)
    assert options.devices == ["bow", "mast"]
    owners = {4: "rules.rules.a.line (line 5)", 5: "recorder.flight.line (line 7)", 6: "bow.lines.sout (line 9)"}
    for number, owner in owners.items():
        with pytest.raises(ConfigError, match="expected an unused line") as error:
            parse(text % number, "f")
        assert "GPIO" in str(error.value)
        assert owner in str(error.value) or "rules.rules.b.line (line 6)" in str(error.value)
    many = ", ".join(f"r{n}: {{measure: silence_s, above: 3}}" for n in range(65))
    for names, words in ((many, "at most 64 rules, got 65"), ("A: {measure: silence_s, above: 3}", 'got "A"')):
        with pytest.raises(ConfigError, match=words):
            parse(f"rules: {{rules: {{{names}}}}}\ndevices: {{}}\n", "f")
