"""Wire protocols, one file each: codecs without I/O, encoders, and the row that names them."""

from imud.kit.driver import StreamDriver
from imud.kit.table import Table

DRIVERS: Table[StreamDriver] = Table("driver", {"hipnuc-uart": "imud.devices.hipnuc.frames:DRIVER"})
