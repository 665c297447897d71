"""The simulated NMEA 2000 sensor compared with its true values. imud's codec decodes its frames."""

import pytest

from imud.formats.j1939 import split
from imud.sim.hipnuc.nmea2000 import SIMULATOR, HipnucNmea2000Module
from imud.sim.sensor import SimulatorOptions

BEGIN_NS = 5_000_000_000
SECOND_NS = 1_000_000_000


def made(**options: object) -> HipnucNmea2000Module:
    given = {"rate_hz": 20.0, "noise": "none", "boot_ms": 0, **options}
    module = SIMULATOR.make(SimulatorOptions(**given), BEGIN_NS)  # type: ignore[arg-type]  # a mapping of options
    assert isinstance(module, HipnucNmea2000Module)
    return module


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
    module.reboot(BEGIN_NS + 20 * SECOND_NS)
    due_ns = module.next_ns()
    assert due_ns is not None
    assert module.advance(due_ns)[0].data[0] == 0
