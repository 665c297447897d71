"""Wire protocols, one folder or module each: codec, commands, settings and the registry row in `driver.py`. No I/O."""

from imud.contracts.driver import Driver
from imud.contracts.registry import PluginGroup, Registry

DRIVERS: Registry[Driver] = Registry(
    "driver",
    {
        "hipnuc-uart": "imud.drivers.hipnuc.uart.driver:DRIVER",
        "hipnuc-modbus": "imud.drivers.hipnuc.modbus.driver:DRIVER",
        "hipnuc-canopen": "imud.drivers.hipnuc.canopen.driver:DRIVER",
        "hipnuc-j1939": "imud.drivers.hipnuc.j1939.driver:DRIVER",
        "hipnuc-canfd": "imud.drivers.hipnuc.canfd:DRIVER",
        "hipnuc-nmea2000": "imud.drivers.hipnuc.nmea2000:DRIVER",
        "imu61x-uart": "imud.drivers.imu61x.uart.driver:DRIVER",
        "imu61x-i2c": "imud.drivers.imu61x.i2c:DRIVER",
        "imu61x-spi": "imud.drivers.imu61x.spi:DRIVER",
        "imu61x-can": "imud.drivers.imu61x.can:DRIVER",
    },
    PluginGroup("imud.drivers", Driver, reserved=("auto",), guard="imud.drivers.foreign:guarded_driver"),
)
