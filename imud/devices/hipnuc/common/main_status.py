"""Table: bits of MAIN_STATUS, bytes 1-2 of HI91 and HI92 and register 0x09 since firmware 1.6.9 (vendor's SDK).

No manual has them. Bits that are not listed are reserved.
"""

from collections.abc import Mapping
from typing import Final

from imud.contracts.driver import StatusBit

MAIN_STATUS: Final[Mapping[int, StatusBit]] = {
    3: StatusBit("gyroscope bias not converged", notable=True),
    4: StatusBit("magnetic disturbance", notable=True),
    5: StatusBit("accelerometer over range", notable=True),
    6: StatusBit("gyroscope over range", notable=True),
    7: StatusBit("attitude not converged", notable=True),
    9: StatusBit("at rest"),
    10: StatusBit("heading by magnetometer"),
    11: StatusBit("time not UTC"),
    12: StatusBit("frame with SOUT pulse"),
}
