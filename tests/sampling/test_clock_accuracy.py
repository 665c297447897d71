"""Time stamp errors compared with the truth: at least 95 of 100 samples are within twice their error, in each profile.

`python -m tests.bench.clock` prints the whole table.
"""

from itertools import product

import pytest

from imud.sim.ports.arrival import LOADED, PROFILES, USB_1MS, USB_16MS, ArrivalModel, ArrivalProfile, Crystal
from tests.bench.clock import BAUD_OF_RATE, accuracy, run

CRYSTALS = {
    "exact": Crystal(0.0), "5 % fast": Crystal(50_000.0), "50 ppm slow": Crystal(-50.0),
    "drifting": Crystal(20.0, 0.1),
}  # fmt: skip


USUAL = [*product(PROFILES, ("5 % fast",)), (USB_1MS, "50 ppm slow"), (LOADED, "exact"), (USB_16MS, "drifting")]
CELLS = [
    pytest.param(*cell, marks=() if cell in USUAL else pytest.mark.thorough) for cell in product(PROFILES, CRYSTALS)
]


@pytest.mark.parametrize(("profile", "crystal"), CELLS, ids=lambda v: getattr(v, "name", v))
def test_the_error_covers_the_truth(profile: ArrivalProfile, crystal: str) -> None:
    for rate_hz, seconds in ((100, 30), (1, 100)):
        model = ArrivalModel(profile, rate_hz, 7, CRYSTALS[crystal], BAUD_OF_RATE[rate_hz])
        got = accuracy(run(model, rate_hz * seconds), settle_ns=20_000_000_000)
        assert got.share >= 0.95
        assert got.share_settling >= 0.95


def test_uneven_ticks_cause_no_error() -> None:
    """400 Hz in milliseconds: the time stamps do not contain the truncation of up to 0.5 ms."""
    model = ArrivalModel(PROFILES[1], 400, 1, Crystal(0.0), 921_600)
    assert accuracy(run(model, 8000), settle_ns=5_000_000_000).rms_ns < 60_000


@pytest.mark.parametrize("rate_hz", [200, pytest.param(1000, marks=pytest.mark.thorough)])
def test_bursts_behind_a_slow_timer(rate_hz: int) -> None:
    """Each read contains frames of 16 ms. The time stamp depends on the bytes after the frame and on the timer."""
    model = ArrivalModel(USB_16MS, rate_hz, 3, CRYSTALS["50 ppm slow"], BAUD_OF_RATE[rate_hz])
    got = accuracy(run(model, 20 * rate_hz), settle_ns=10_000_000_000)
    assert got.share >= 0.95
    assert got.rms_ns < 1_500_000
    assert got.mean_t_err_ns < 4 * got.rms_ns
