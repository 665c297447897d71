"""Simulated devices with known truth: `imud demo` and the tests run the same ones."""

from imud.kit.table import Table
from imud.sim.can_module import CanSimulator
from imud.sim.simulator import Simulator

SIMULATORS: Table[Simulator] = Table(
    "simulator",
    {
        "hipnuc-uart": "imud.sim.hipnuc:SIMULATOR",
        "hipnuc-modbus": "imud.sim.hipnuc_modbus:SIMULATOR",
        "imu61x-uart": "imud.sim.imu61x_uart:SIMULATOR",
    },
)
"""Devices that stand behind a pseudo-terminal."""

CAN_SIMULATORS: Table[CanSimulator] = Table(
    "simulator on CAN",
    {
        "hipnuc-canopen": "imud.sim.hipnuc_canopen:SIMULATOR",
        "hipnuc-j1939": "imud.sim.hipnuc_j1939:SIMULATOR",
        "hipnuc-nmea2000": "imud.sim.hipnuc_nmea2000:SIMULATOR",
        "imu61x-can": "imud.sim.imu61x_can:SIMULATOR",
    },
)
"""Devices that stand on a CAN interface."""
