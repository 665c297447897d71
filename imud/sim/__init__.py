"""Simulated devices with known truth: `imud demo` and the tests run the same ones."""

from imud.kit.table import Table
from imud.sim.simulator import Simulator

SIMULATORS: Table[Simulator] = Table("simulator", {"hipnuc-uart": "imud.sim.hipnuc:SIMULATOR"})
