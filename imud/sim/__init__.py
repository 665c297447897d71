"""Simulated devices with known truth, for `imud sim`, `imud demo` and tests.

`SIMULATORS` and `CAN_SIMULATORS` make devices from `SimulatorOptions`. `Faults` damages their bytes. `SimulatedPort`
connects a device to a pseudo-terminal. `__all__` is the public interface (docs/simulators.md).
"""

from imud.contracts.registry import PluginGroup, Registry
from imud.sim.can_module import CanModule, CanModules, CanSimulator, FrameWire, PeriodicCanModule, SentFrame
from imud.sim.physics import MOTIONS, Motion, Noise, NoiseLevels, Sine, Still, Swing, Truth
from imud.sim.ports.arrival import BARE_UART, USB_1MS, USB_16MS, ArrivalProfile
from imud.sim.ports.faults import Fault, FaultKind, FaultRates, Faults, rates_from
from imud.sim.ports.pty import Adapter, PtyCounters, PtyNode, SimulatedPort
from imud.sim.ports.uart_wire import Transmitter
from imud.sim.sensor import (
    Burst,
    Pin,
    PinEdge,
    SensorHardware,
    Simulator,
    SimulatorOptions,
    StreamModule,
    sensor_of,
)

__all__ = [
    "BARE_UART", "CAN_SIMULATORS", "MOTIONS", "SIMULATORS", "USB_1MS", "USB_16MS", "Adapter", "ArrivalProfile",
    "Burst", "CanModule", "CanModules", "CanSimulator", "Fault", "FaultKind", "FaultRates", "Faults", "FrameWire",
    "Motion", "Noise", "NoiseLevels", "PeriodicCanModule", "Pin", "PinEdge", "PtyCounters", "PtyNode",
    "SensorHardware", "SentFrame", "SimulatedPort", "Simulator", "SimulatorOptions", "Sine", "Still",
    "StreamModule", "Swing", "Transmitter", "Truth", "rates_from", "sensor_of",
]  # fmt: skip

# Simulators of devices on a serial port, by the name of the driver, also of other packages.
SIMULATORS: Registry[Simulator] = Registry(
    "simulator",
    {
        "hipnuc-uart": "imud.sim.hipnuc.uart:SIMULATOR",
        "hipnuc-modbus": "imud.sim.hipnuc.modbus:SIMULATOR",
        "imu61x-uart": "imud.sim.imu61x.uart:SIMULATOR",
    },
    PluginGroup("imud.simulators", Simulator),
)

# Simulators of devices on a CAN interface, by the name of the driver, also of other packages.
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
