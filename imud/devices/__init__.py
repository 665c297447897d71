"""Wire protocols, one file each: codecs without I/O, encoders, and the row that names them."""

from imud.kit.driver import Driver
from imud.kit.table import Table

DRIVERS: Table[Driver] = Table(
    "driver",
    {
        "hipnuc-uart": "imud.devices.hipnuc.frames:DRIVER",
        "hipnuc-modbus": "imud.devices.hipnuc.modbus:DRIVER",
        "hipnuc-canopen": "imud.devices.hipnuc.canopen:DRIVER",
        "hipnuc-j1939": "imud.devices.hipnuc.j1939:DRIVER",
        "hipnuc-nmea2000": "imud.devices.hipnuc.nmea2000:DRIVER",
        "imu61x-uart": "imud.devices.imu61x.serial:DRIVER",
        "imu61x-i2c": "imud.devices.imu61x.i2c:DRIVER",
        "imu61x-spi": "imud.devices.imu61x.spi:DRIVER",
        "imu61x-can": "imud.devices.imu61x.can:DRIVER",
    },
)
