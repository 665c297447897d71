"""Simulated devices with known truth, for `imud demo` and the tests."""

from imud.contracts.registry import PluginGroup, Registry
from imud.sim.can_module import CanSimulator
from imud.sim.sensor import Simulator

# Simulated devices on a pseudo-terminal.
SIMULATORS: Registry[Simulator] = Registry(
    "simulator",
    {
        "hipnuc-uart": "imud.sim.hipnuc.uart:SIMULATOR",
        "hipnuc-modbus": "imud.sim.hipnuc.modbus:SIMULATOR",
        "imu61x-uart": "imud.sim.imu61x.uart:SIMULATOR",
    },
    PluginGroup("imud.simulators", Simulator),
)

# Simulated devices on a CAN interface.
CAN_SIMULATORS: Registry[CanSimulator] = Registry(
    "simulator on CAN",
    {
        "hipnuc-canopen": "imud.sim.hipnuc.canopen:SIMULATOR",
        "hipnuc-canfd": "imud.sim.hipnuc.j1939:CANFD_SIMULATOR",
        "hipnuc-j1939": "imud.sim.hipnuc.j1939:SIMULATOR",
        "hipnuc-nmea2000": "imud.sim.hipnuc.nmea2000:SIMULATOR",
        "imu61x-can": "imud.sim.imu61x.can:SIMULATOR",
    },
    PluginGroup("imud.can_simulators", CanSimulator),
)
