"""Wire protocols, a folder each: codec, session, actions, and `driver.py` with the row that names them. No I/O."""

from imud.contracts.driver import Driver
from imud.contracts.table import Table

DRIVERS: Table[Driver] = Table(
    "driver",
    {
        "hipnuc-uart": "imud.devices.hipnuc.uart.driver:DRIVER",
        "hipnuc-modbus": "imud.devices.hipnuc.modbus.driver:DRIVER",
        "hipnuc-canopen": "imud.devices.hipnuc.canopen.driver:DRIVER",
        "hipnuc-j1939": "imud.devices.hipnuc.j1939.driver:DRIVER",
        "hipnuc-nmea2000": "imud.devices.hipnuc.nmea2000.driver:DRIVER",
        "imu61x-uart": "imud.devices.imu61x.uart.driver:DRIVER",
        "imu61x-i2c": "imud.devices.imu61x.i2c.driver:DRIVER",
        "imu61x-spi": "imud.devices.imu61x.spi.driver:DRIVER",
        "imu61x-can": "imud.devices.imu61x.can.driver:DRIVER",
    },
)
