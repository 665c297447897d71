"""Options of `python -m imud.sim`: each option arrives at the simulated device."""

from argparse import ArgumentTypeError
from dataclasses import replace

import pytest

from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.sim.control import make_parser, module_options, simulated
from imud.sim.sensor import SimulatorOptions

GIVEN = SimulatorOptions(
    rate_hz=50.0, baud=921600, message="HI92", motion="still", gravity_m_s2=9.7, noise="none", skew_ppm=-3.0,
    firmware=169, boot_ms=250, processing_ns=12_500, seed=5, node=9, at_once=True, variant="slow flash",
)  # fmt: skip
ARGUMENTS = (
    "--rate 50 --baud 921600 --message HI92 --motion still --gravity 9.7 --no-noise --skew-ppm -3 --firmware 169 "
    "--boot 0.25 --processing-us 12.5 --seed 5 --node 9 --at-once"
)


def test_options_arrive_in_their_units() -> None:
    options = make_parser().parse_args([*ARGUMENTS.split(), "--variant", "slow flash"])
    assert make_parser().parse_args(["--rest"]).motion == "still"
    assert module_options(options, 0) == GIVEN
    assert module_options(options, 12) == replace(GIVEN, node=12)
    assert module_options(make_parser().parse_args([]), 0) == SimulatorOptions()


@pytest.mark.parametrize("name", [*SIMULATORS, *CAN_SIMULATORS])
def test_a_device_is_a_name_with_or_without_a_node(name: str) -> None:
    assert simulated(name) == (name, 0)
    assert simulated(f"{name}:17") == (name, 17)
    for text in (f"{name}:x", f"{name}x", ":1", ""):
        with pytest.raises(ArgumentTypeError, match="expected one of"):
            simulated(text)
