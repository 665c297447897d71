"""Counts of the last minute, restarts of the last hour, and the rate by time stamps."""

from imud.contracts.status import RecentStatus
from imud.device.recent_counts import RecentCounts
from imud.model.ledger import Ledger

S = 1_000_000_000


class Counted:
    """Counts of a device that sends 50 samples per second."""

    def __init__(self, *, timed: bool = True) -> None:
        self.ledger, self.now_s, self.resets, self.expected_hz = Ledger(), 0, 0, 50.0
        self.newest_ns = 0  # time stamp of the newest sample, if it differs from the present time
        self.counts = RecentCounts(self.ledger, 0, timed=timed)

    def pass_seconds(self, seconds: int, samples: int = 50, **lost: int) -> RecentStatus:
        for _ in range(seconds):
            self.now_s += 1
            self.ledger.samples += samples
            for name, count in lost.items():
                setattr(self.ledger, name, getattr(self.ledger, name) + count)
            self.counts.add(self.now_s * S, self.expected_hz, self.resets, self.newest_ns or self.now_s * S)
        return self.counts.status(self.now_s * S)


def test_losses_of_the_last_minute_by_cause_and_restarts_of_the_last_hour() -> None:
    counted = Counted()
    counted.pass_seconds(30, lost_crc=2, lost_queue=1)
    found = counted.pass_seconds(29, lost_unknown=1)
    assert (found.samples, found.lost, found.gaps) == (59 * 50, {"crc": 60, "queue": 30}, 29)
    assert (found.loss_ns, found.loss_samples, found.loss_cause) == (59 * S, 90, "crc")
    counted.pass_seconds(59)
    assert counted.pass_seconds(1, lost_queue=1).loss_samples == 91  # 60 s after the previous loss
    later = counted.pass_seconds(61)
    assert (later.samples, later.lost, later.gaps) == (60 * 50, {}, 0)
    assert (later.loss_ns, later.loss_samples) == (119 * S, 91)
    again = counted.pass_seconds(1, lost_overrun=1)
    assert (again.loss_samples, again.loss_cause) == (1, "overrun")
    counted = Counted()
    counted.resets = 2
    assert counted.pass_seconds(1).restarts == 2
    counted.now_s += 3599
    assert counted.pass_seconds(1).restarts == 0
    counted.resets = 1000
    assert counted.pass_seconds(1).restarts == 60


def test_the_rate_contains_lost_samples_and_the_short_rate_falls_to_zero() -> None:
    counted = Counted()
    assert counted.pass_seconds(9).rate_hz is None
    counted.pass_seconds(5, samples=45, lost_crc=5)
    assert counted.pass_seconds(11, samples=45).rate_hz == 45.0
    assert counted.pass_seconds(1, lost_unknown=1).rate_hz is None
    counted.pass_seconds(12)
    for counted.expected_hz, rate_hz in ((50.4, 50.0), (50.6, None), (25.0, None)):  # the device changed its rate
        assert counted.pass_seconds(1).rate_hz == rate_hz
    assert counted.pass_seconds(9, samples=25).rate_hz is None
    assert counted.pass_seconds(2, samples=25).rate_hz == 25.0
    assert Counted(timed=False).pass_seconds(30).rate_hz is None
    counted = Counted()
    assert counted.counts.rate_hz() == 0.0
    counted.pass_seconds(4)
    assert counted.counts.rate_hz() == 50.0
    counted.pass_seconds(1, samples=25)
    assert counted.counts.rate_hz() == 37.5
    counted.pass_seconds(2, samples=0)
    assert counted.counts.rate_hz() == 0.0


def test_rate_after_a_pause_of_the_event_loop() -> None:
    counted = Counted()
    counted.pass_seconds(15)
    counted.newest_ns = 15 * S + 600_000_000  # imud did not run for 0.4 s: 20 samples wait in the kernel
    assert counted.pass_seconds(1, samples=30).rate_hz == 50.0
    counted.newest_ns = 0
    assert counted.pass_seconds(1, samples=70).rate_hz == 50.0
    assert [counted.pass_seconds(1).rate_hz for _ in range(12)] == [50.0] * 12


def test_status_contains_the_losses_of_the_ledger_at_once() -> None:
    counted = Counted()
    counted.pass_seconds(5)
    assert not counted.counts.add_new_losses(5 * S)
    counted.ledger.lost_queue += 354
    assert counted.counts.add_new_losses(5 * S + 1)
    recent = counted.counts.status(5 * S)
    assert (recent.lost, recent.loss_samples, recent.loss_ns) == ({"queue": 354}, 354, 5 * S + 1)
