"""Collected and ignored samples, and the description of their time stamps."""

from argparse import Namespace
from contextlib import nullcontext
from unittest.mock import Mock

import numpy as np
import pytest

from imud.cli import sample_set as taking
from imud.cli.sample_set import Collector, LossTally, SampleSet, status_of, take_live
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceStatus
from imud.model.errors import BadArgument
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S
from tests.cli.conftest import Terminal
from tests.support.metrics import device


def sample(number: int, device: str = "bow", **more: object) -> Sample:
    t_ns = NS_PER_S + number * NS_PER_S // 10
    values: dict[str, object] = {
        "accel_m_s2": (0.0, 0.0, 9.8), "gyro_rad_s": (float(number), 0.0, 0.0), "t_dev_ns": number * NS_PER_S // 10,
        **more,
    }  # fmt: skip
    return Sample(device, number + 1, t_ns, 1000, Sync.EDGE, t_ns, t_ns, **values)  # type: ignore[arg-type]


def test_values_come_in_order_with_nan_for_what_is_absent() -> None:
    collector = Collector()
    turned = sample(1, gyro_rad_s=None, euler_rad=(0.1, 0.2, 0.3))
    collector.publish(Batch("bow", 0, [sample(0, temperature_c=20.0), turned]))
    found = collector.readings()
    assert found.t_ns.tolist() == [NS_PER_S, NS_PER_S + NS_PER_S // 10]
    assert found.gyro_rad_s is not None
    assert found.gyro_rad_s[0].tolist() == [0.0, 0.0, 0.0]
    assert np.isnan(found.gyro_rad_s[1]).all()
    assert found.temperature_c is not None
    assert found.temperature_c[0] == 20.0
    assert np.isnan(found.temperature_c[1])
    assert found.euler_rad is not None
    assert (np.isnan(found.euler_rad[0]).all(), found.euler_rad[1].tolist()) == (True, [0.1, 0.2, 0.3])
    assert collector.stamps() == "100 % edge; mean time stamp error 1 µs"
    collector = Collector()
    collector.add(sample(0, accel_m_s2=None))
    found = collector.readings()
    assert found.accel_m_s2 is None
    assert found.temperature_c is None


def test_a_part_of_the_time_more_samples_than_fit_and_other_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    collector = Collector(skip_s=1.0, for_s=2.0)
    for number in range(100):
        collector.add(sample(number))
    assert collector.done
    assert collector.readings().gyro_rad_s is not None
    taken = collector.readings().t_ns
    assert (taken[0], taken[-1]) == (2 * NS_PER_S, 4 * NS_PER_S)
    monkeypatch.setattr("imud.cli.sample_set.SAMPLES_MOST", 2)
    collector = Collector()
    collector.add(sample(0))
    collector.add(sample(1))
    with pytest.raises(BadArgument, match="at most 2 samples; select a part"):
        collector.add(sample(2))
    for name, others in (("", {"stern"}), ("bow", set())):
        collector = Collector(name)
        collector.add(sample(0))
        collector.add(sample(0, "stern"))
        assert (len(collector), collector.others) == (1, others)


def test_the_devices_own_time_and_a_live_view_that_drops_the_past() -> None:
    collector = Collector()
    collector.by_device_time = True
    collector.add(sample(7))
    assert collector.readings().t_ns.tolist() == [7 * NS_PER_S // 10]
    assert "the device's crystal" in collector.stamps()
    with pytest.raises(BadArgument, match="neither arrival times nor device times"):
        collector.add(sample(8, t_dev_ns=None))
    collector = Collector()
    for number in range(10):
        collector.add(sample(number, temperature_c=number, euler_rad=(number, 0, 0), accel_m_s2=(number, 0, 0)))
    collector.drop_before(NS_PER_S + 6 * NS_PER_S // 10)
    found = collector.readings()
    assert len(found.t_ns) == len(collector) == 4
    for values in (found.gyro_rad_s, found.accel_m_s2, found.euler_rad, found.temperature_c):
        assert values is not None
        assert values.reshape(4, -1)[:, 0].tolist() == [6.0, 7.0, 8.0, 9.0]
    with pytest.raises(BadArgument, match="bow: expected a file, or a device of the daemon"):
        status_of([], "bow")


def test_notes_about_a_replay_and_the_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    for differences, fresh, notes in ((0, [], []), (2, ["x", "y"], ["clock: x", "replay: 2 of 7 checks differ"])):
        one = Mock(driver=None, fresh_starts=fresh, different_checks=differences, checks=7)
        one.described.name = "bow"
        for name, found in (("stern", []), ("bow", notes)):
            made = SampleSet("a", name)
            taking._describe(made, Mock(all_devices=[one]), name)
            assert (made.notes, made.driver) == (found, one.described.driver if name == "bow" else "")
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    taking.progress(61.4, 1200)
    assert terminal.getvalue() == "61 s, 1200 samples\r"


def test_losses_are_those_between_the_looks_although_a_ledger_begins_anew() -> None:
    tally = LossTally()
    tally.look({"samples": 5000, "lost_crc": 7, "lost_unknown": 1})
    tally.look({"samples": 5100, "lost_crc": 9, "lost_unknown": 1})
    tally.look({"samples": 0, "lost_crc": 0, "lost_unknown": 0})
    tally.look({"samples": 100, "lost_crc": 3, "lost_unknown": 0})
    assert tally.found() == {"lost_crc": 2 + 3}
    looks: list[int] = []
    collector = Collector(skip_s=1.0, for_s=1.0)
    collector.look = lambda: looks.append(len(collector))
    for number in range(0, 60, 5):
        collector.publish(Batch("bow", 0, [sample(number + at) for at in range(5)]))
    assert looks == [5, 11]


class Live:
    """A daemon with a device that sends 10 samples per second for 8 s of virtual time, then nothing."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, count: int, *, interrupted: bool = False) -> None:
        self.now_s = 0.0
        self.dropped = {"bow": 3}
        self.notes: list[tuple[float, int]] = []
        self._left, self._count, self._interrupted = count, count, interrupted
        monkeypatch.setattr(taking, "connect", lambda _args: nullcontext(self))
        monkeypatch.setattr(taking, "statuses", lambda _client: [self.status()])
        monkeypatch.setattr(taking, "monotonic", lambda: self.now_s)

    def status(self) -> DeviceStatus:
        return device("bow", ledger={"samples": self._count - self._left, "lost_crc": (self._count - self._left) // 7})

    def watch(self, names: list[str], *, timeout_s: float, latency_ms: float) -> "Live":
        assert (names, timeout_s, latency_ms) == (["bow"], 5.0, 200.0)
        return self

    def __iter__(self) -> "Live":
        return self

    def __next__(self) -> Sample:
        if self._left:
            self._left -= 1
            self.now_s += 0.125
            return sample(self._count - self._left - 1)
        if self._interrupted:
            raise KeyboardInterrupt
        self.now_s += 5.0
        raise TimeoutError

    def take(self, **arguments: object) -> SampleSet:
        given = {"input": "bow", "skip": None, "duration": None, "socket": "/s", **arguments}
        return take_live(Namespace(**given), lambda passed_s, count: self.notes.append((passed_s, count)))


def kept(sample_set: SampleSet) -> int:
    assert sample_set.readings is not None
    return len(sample_set.readings.t_ns)


def test_a_live_device_is_taken_until_the_duration_an_interrupt_or_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    live = Live(monkeypatch, 100)
    sample_set = live.take(duration=3.0)
    assert (kept(sample_set), live.now_s) == (31, 4.0), "the sample after the duration ends it"
    assert (sample_set.device, sample_set.source, sample_set.lost) == (
        "bow", "live from /s", {"lost_crc": 4, "dropped": 3},
    )  # fmt: skip
    assert live.notes == [(1.0, 8), (2.0, 16), (3.0, 24), (4.0, 31)]
    assert kept(Live(monkeypatch, 100).take(skip=2.0, duration=1.0)) == 11
    assert kept(Live(monkeypatch, 45, interrupted=True).take()) == 45
    for skip_s, count in ((0.0, 40), (1.0, 30)):
        live = Live(monkeypatch, 40)
        assert kept(live.take(skip=skip_s or None, duration=20.0)) == count
        assert 20 + skip_s <= live.now_s < 20 + skip_s + 5.0
    with pytest.raises(BadArgument, match="bow sends no samples; find the reason with `imud status`"):
        Live(monkeypatch, 0).take(duration=20.0)
