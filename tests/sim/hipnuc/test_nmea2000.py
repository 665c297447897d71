"""The simulated NMEA 2000 sensor compared with its true values. imud's codec decodes its frames."""

import itertools

import pytest

from imud.drivers.hipnuc.nmea2000 import HipnucNmea2000Codec, HipnucNmea2000Options
from imud.formats.j1939 import split
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.hipnuc.nmea2000 import SIMULATOR, HipnucNmea2000Module, Nmea2000Hardware
from imud.sim.sensor import SimulatorOptions

BEGIN_NS = 5_000_000_000
SECOND_NS = 1_000_000_000


def made(**options: object) -> HipnucNmea2000Module:
    given = {"rate_hz": 20.0, "noise": "none", "boot_ms": 0, **options}
    module = SIMULATOR.make(SimulatorOptions(**given), BEGIN_NS)  # type: ignore[arg-type]  # a mapping of options
    assert isinstance(module, HipnucNmea2000Module)
    return module


def test_values_are_the_truth_of_the_sample_instant() -> None:
    module = made()
    codec = HipnucNmea2000Codec(Ledger(), HipnucNmea2000Options())
    found, frames = 0, module.advance(BEGIN_NS + 5 * SECOND_NS)
    instants = {frame.due_ns: frame.sample_ns for frame in frames}
    for frame in frames:
        for event in codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.due_ns):
            assert isinstance(event, Measurement)
            sample_ns = instants[event.t_first_ns or 0]
            assert sample_ns is not None
            truth = module.hardware.motion.at((sample_ns - module.epoch_ns) / 1e9)
            assert event.euler_rad == pytest.approx(truth.euler_rad, abs=5.1e-5)
            assert event.gyro_rad_s is not None
            assert event.gyro_rad_s[2] == pytest.approx(truth.gyro_rad_s[2], abs=1.6e-8)
            found += 1
    assert found == 100
    assert codec.ledger.lost() == 0


@pytest.mark.parametrize(
    ("message", "pgns"), [("", [127250, 127251, 127257]), ("heading", [127250]), ("attitude", [127257])]
)
def test_what_it_sends(message: str, pgns: list[int]) -> None:
    module = made(message=message, node=5)
    frames = module.advance(BEGIN_NS + 20 * SECOND_NS)
    assert [split(f.can_id).pgn for f in frames[: len(pgns)]] == pgns
    assert {split(f.can_id).source for f in frames} == {5}
    sids = [f.data[0] for f in frames[:: len(pgns)]]
    assert sids[250:255] == [250, 251, 252, 0, 1]
    assert all(f.data[0] == sids[n // len(pgns)] for n, f in enumerate(frames))


def test_the_wire_the_crystal_and_power() -> None:
    module = HipnucNmea2000Module(BEGIN_NS, Nmea2000Hardware(boot_ms=0, skew_ppm=1000))
    frames = module.advance(BEGIN_NS + 2 * SECOND_NS)
    assert [b.due_ns - a.due_ns for a, b in itertools.pairwise(frames[:3])] == [560_000] * 2  # 140 bits
    assert module.counters() == {"samples_sent": 21, "frames_sent": 63}
    module.reboot(BEGIN_NS + 2 * SECOND_NS)
    due_ns = module.next_ns()
    assert due_ns is not None
    assert module.advance(due_ns)[0].data[0] == 0
