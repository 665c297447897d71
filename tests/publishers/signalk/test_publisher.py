"""Deltas: values, signs and units by hand, choice of the device, rates and time stamps."""

from math import inf, nan, radians
from typing import Any
from unittest.mock import Mock

import msgspec
import pytest

from imud.attitude.conventions import Convention, Heading
from imud.attitude.published import PublishedAxes, published_frame
from imud.contracts.lines import UtcReference
from imud.contracts.publisher import AS_SENT, Batch
from imud.contracts.status import FrameStatus, OutputStatus
from imud.model.sample import Sample, Sync, Vector3
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.signalk import publisher
from imud.publishers.signalk.settings import SignalKOptions
from tests.support.event_loops import VirtualClock
from tests.support.publisher_context import FakeLatencies, publisher_context
from tests.support.socket_rig import device_status

# Attitude in the axes of HiPNUC: right side down by 10°, bow up by 5°, heading 45°
LEFT_45: Vector3 = (radians(10), radians(5), radians(-45))
UTC_NS = 1_795_841_501_454_999_999  # 2026-11-28T04:51:41.454999999Z


class Deltas:
    """Output whose server notes the deltas."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, heading: Heading = Heading.TRUE, declination_deg: float | None = 3.0,
        *, utc: UtcReference | None = None, **settings: Any,
    ) -> None:  # fmt: skip
        self.clock, self.asked = VirtualClock(), FakeLatencies()
        frame = FrameStatus("", "device", "", "", heading, declination_deg, {})
        statuses = [msgspec.structs.replace(device_status(name, 0), frame=frame) for name in ("bow", "mast")]
        self.context = publisher_context(
            lambda: statuses, 1, self.clock.now_ns, latencies=self.asked, utc_reference=lambda: utc
        )
        status = OutputStatus("http://127.0.0.1:3000", 0, 0, 1, "")
        self.server = Mock(status=lambda: status, connections=1, is_open=True)
        monkeypatch.setattr(publisher, "SignalKServer", Mock(return_value=self.server))
        self.output = publisher.SignalK(SignalKOptions(**settings), self.context)
        self.output.start()
        self.output.add_device("bow", 0)
        self.output.tick(self.clock.now_ns())
        self.seq = 0

    def publish(self, count: int = 1, device: str = "bow", frame: PublishedAxes = AS_SENT, **values: Any) -> None:
        """Publish samples at 1 kHz."""
        samples = []
        for _ in range(count):
            self.seq += 1
            t_ns = self.seq * NS_PER_MS
            samples.append(Sample(device, self.seq, t_ns, 0, Sync.ARRIVAL, t_ns, UTC_NS, **values))
        self.output.publish(Batch(device, 0, samples, frame))

    def taken(self) -> list[tuple[str, str, dict[str, Any]]]:
        """Return path, source and update of all deltas since the last call."""
        found = [(path, source, *msgspec.json.decode(delta)["updates"]) for path, source, delta in self._arguments()]
        self.server.put.reset_mock()
        return found

    def _arguments(self) -> list[tuple[str, str, str]]:
        return [one.args for one in self.server.put.call_args_list]

    def values(self) -> dict[str, Any]:
        """Return the values of the only delta since the last call."""
        ((path, source, update),) = self.taken()
        assert (update.pop("$source"), path) == (source, update["values"][0]["path"])
        return {one["path"]: one["value"] for one in update["values"]}


def near(degrees: float) -> Any:
    return pytest.approx(radians(degrees))


def test_a_delta_has_all_values_in_si_units(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Deltas(monkeypatch)
    bench.publish(
        euler_rad=LEFT_45, gyro_rad_s=(0.0, 0.0, radians(-2)), temperature_c=25.0, pressure_pa=101325.0, heave_m=0.25
    )
    assert bench.values() == {
        "navigation.attitude": {"roll": near(10), "pitch": near(5), "yaw": near(45)},
        "navigation.headingTrue": near(45), "navigation.headingMagnetic": near(42),
        # 2°/s about the z axis of the body: cos 10° / cos 5°
        "navigation.rateOfTurn": near(2 * 0.984807753 / 0.996194698), "navigation.magneticVariation": near(3),
        "environment.heave": 0.25, "environment.inside.imu.temperature": pytest.approx(298.15),
        "environment.outside.pressure": 101325.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("heading", "declination_deg", "values", "expected"),
    [
        (Heading.MAGNETIC, None, {"euler_rad": (0.0, 0.0, radians(90))},
         {"navigation.attitude": {"roll": 0, "pitch": 0, "yaw": near(-90)}, "navigation.headingMagnetic": near(270)}),
        (Heading.RELATIVE, None, {"euler_rad": (0.0, 0.0, radians(90))},
         {"navigation.attitude": {"roll": 0, "pitch": 0, "yaw": near(-90)}}),
        (Heading.TRUE, None, {"euler_rad": (nan, radians(-5), 1e-17)},
         {"navigation.attitude": {"pitch": near(-5), "yaw": pytest.approx(0)}, "navigation.headingTrue": 0}),
        (Heading.TRUE, -3.5, {"gyro_rad_s": (0.0, 0.0, -0.1), "temperature_c": inf, "pressure_pa": nan, "heave_m": nan},
         {"navigation.rateOfTurn": pytest.approx(0.1), "navigation.magneticVariation": near(-3.5)}),
    ],
)  # fmt: skip
def test_only_known_finite_values_are_sent(
    monkeypatch: pytest.MonkeyPatch, heading: Heading, declination_deg: float | None, values: Any, expected: Any
) -> None:
    bench = Deltas(monkeypatch, heading, declination_deg)
    bench.publish(**values)
    assert bench.values() == expected


def test_a_device_without_values_sends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Deltas(monkeypatch, declination_deg=None)
    bench.publish(1000, accel_m_s2=(0.0, 0.0, 9.8))
    assert bench.taken() == []


@pytest.mark.parametrize("convention", [None, *Convention])
def test_signs_do_not_depend_on_the_published_axes(
    monkeypatch: pytest.MonkeyPatch, convention: Convention | None
) -> None:
    frame = published_frame(None, convention, None, AS_SENT.device)
    sample = Sample("bow", 1, 0, 0, Sync.ARRIVAL, 0, 0, euler_rad=LEFT_45, gyro_rad_s=(0.0, 0.0, radians(-2)))
    if frame.rotation is not None:
        sample = frame.rotation.sample(sample)
    bench = Deltas(monkeypatch)
    bench.publish(frame=frame, euler_rad=sample.euler_rad, gyro_rad_s=sample.gyro_rad_s)
    values = bench.values()
    assert values["navigation.attitude"] == {"roll": near(10), "pitch": near(5), "yaw": near(45)}
    assert values["navigation.rateOfTurn"] == pytest.approx(radians(2), rel=0.02)


def test_rates_mean_angular_rate_and_slow_values(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Deltas(monkeypatch, rate_hz=10.0)
    for n in range(2000):
        bench.publish(gyro_rad_s=(0.0, 0.0, -0.5 if n % 2 else 0.1), temperature_c=20.0)
    deltas = [{one["path"]: one["value"] for one in update["values"]} for _, _, update in bench.taken()]
    assert len(deltas) == 20
    assert [n for n, one in enumerate(deltas) if "environment.inside.imu.temperature" in one] == [0, 10]
    # the mean of 0.5 and -0.1
    assert [one["navigation.rateOfTurn"] for one in deltas[1:]] == [pytest.approx(0.2, abs=0.01)] * 19
    assert bench.asked.asked == {"signalk": (100 * NS_PER_MS, ("bow",))}


@pytest.mark.parametrize("utc", [None, UtcReference(0, 1000)])
def test_time_stamps_need_a_synchronized_clock(monkeypatch: pytest.MonkeyPatch, utc: UtcReference | None) -> None:
    bench = Deltas(monkeypatch, utc=utc)
    bench.publish(euler_rad=LEFT_45)
    ((_, source, update),) = bench.taken()
    assert update.get("timestamp") == (None if utc is None else "2026-11-28T04:51:41.454Z")
    assert (source, update["$source"]) == ("imud.bow", "imud.bow")
    assert publisher.source_of("côte 1.x") == "imud.c_te_1_x"


def test_the_output_uses_one_device_and_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Deltas(monkeypatch)
    bench.publish(device="mast", euler_rad=LEFT_45)
    assert bench.taken() == []
    bench.output.add_device("mast", 1)
    bench.publish(euler_rad=LEFT_45)
    assert bench.taken() == [], "two devices, and no name"
    bench.output.remove_device("bow")
    bench.publish(device="mast", euler_rad=LEFT_45)
    assert [source for _, source, _ in bench.taken()] == ["imud.mast"]
    assert [one.name for one in bench.context.outputs.ports["signalk"]()] == ["http://127.0.0.1:3000"]
    bench.output.close()
    bench.output.close()
    assert (bench.asked.asked, bench.context.outputs.ports) == ({}, {})
    bench.server.close.assert_called()


def advance(bench: Deltas, seconds: float) -> None:
    """Let time pass with ticks at 2 Hz."""
    for _ in range(round(seconds * 2)):
        bench.clock.advance(NS_PER_S // 2)
        bench.output.tick(bench.clock.now_ns())


def test_stale_values_are_null_once_on_each_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Deltas(monkeypatch, declination_deg=None)
    bench.publish(euler_rad=LEFT_45, temperature_c=25.0)
    assert set(bench.values()) == {
        "navigation.attitude",
        "navigation.headingTrue",
        "environment.inside.imu.temperature",
    }
    advance(bench, 1.0)
    assert bench.taken() == []
    advance(bench, 1.0)
    assert bench.values() == {"navigation.attitude": None, "navigation.headingTrue": None}
    advance(bench, 3.0)  # the temperature follows once per second
    assert bench.values() == {"environment.inside.imu.temperature": None}
    advance(bench, 10.0)
    assert bench.taken() == []
    bench.server.connections += 1  # the server restarted
    advance(bench, 10.0)
    assert len(bench.values()) == 3
    bench.seq += 100
    bench.publish(euler_rad=LEFT_45)
    assert bench.values()["navigation.headingTrue"] == near(45)
    advance(bench, 2.0)
    assert bench.values() == {"navigation.attitude": None, "navigation.headingTrue": None}


def test_values_that_the_device_stops_sending(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Deltas(monkeypatch, declination_deg=None)
    for index in range(8):
        bench.seq += 499
        bench.publish(euler_rad=LEFT_45, heave_m=0.1 if index < 2 else None)
        advance(bench, 0.5)
    bench.output.remove_device("bow")
    values = [value for _, _, update in bench.taken() for value in update["values"]]
    assert [value["value"] for value in values if value["path"] == "environment.heave"] == [0.1, 0.1, None]
    advance(bench, 5.0)
    assert bench.values() == {"navigation.attitude": None, "navigation.headingTrue": None}


def test_without_a_connection_null_follows_later(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Deltas(monkeypatch, declination_deg=None)
    bench.publish(gyro_rad_s=(0.0, 0.0, 0.0))
    bench.taken()
    bench.server.is_open = False
    advance(bench, 10.0)
    assert bench.taken() == []
    bench.server.is_open = True
    bench.server.connections += 1
    advance(bench, 0.5)
    assert bench.values() == {"navigation.rateOfTurn": None}


@pytest.mark.parametrize(("rate_hz", "timeout_s"), [(10.0, 1), (1.0, 3), (0.1, 30)])
def test_timeout_follows_the_period(monkeypatch: pytest.MonkeyPatch, rate_hz: float, timeout_s: int) -> None:
    bench = Deltas(monkeypatch, rate_hz=rate_hz)
    samples = round(1000 / rate_hz)
    for _ in range(3):
        bench.publish(samples, gyro_rad_s=(0.0, 0.0, 0.0))
    metas = [update.get("meta", []) for _, _, update in bench.taken()]
    expected = {"navigation.rateOfTurn": timeout_s, "navigation.magneticVariation": max(timeout_s, 3)}
    assert {meta["path"]: meta["value"]["timeout"] for meta in metas[0]} == expected
    assert not any(metas[1:]), "the server knows the timeouts"
    bench.server.connections += 1
    bench.publish(samples, gyro_rad_s=(0.0, 0.0, 0.0))
    ((_, _, update),) = bench.taken()
    assert update["meta"][0] == {"path": "navigation.rateOfTurn", "value": {"timeout": timeout_s}}


def test_timeout_of_a_slow_device(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Deltas(monkeypatch, declination_deg=None, rate_hz=10.0)
    for _ in range(5):
        bench.seq += 1999  # 0.5 Hz
        bench.publish(gyro_rad_s=(0.0, 0.0, 0.0))
    metas = [meta for _, _, update in bench.taken() for meta in update.get("meta", [])]
    assert [meta["value"]["timeout"] for meta in metas] == [1, 6]
    advance(bench, 5.5)
    assert bench.taken() == []
    advance(bench, 1.0)
    assert bench.values() == {"navigation.rateOfTurn": None}
