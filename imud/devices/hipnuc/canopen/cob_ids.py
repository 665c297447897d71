"""Identifiers and network management of a CANopen node: CiA 301, and manual "IMU配置手冊" V1.5.9, section 5.2.

An identifier is a function (upper four bits) plus the node's number; two functions are the whole bus's:

    NMT 0x000   SYNC 0x080   EMCY 0x080+n   SDO reply 0x580+n   SDO request 0x600+n   heartbeat 0x700+n
    TPDO1 0x180+n   TPDO2 0x280+n   TPDO3 0x380+n   TPDO4 0x480+n   TPDO6 0x680+n   TPDO7 0x780+n

The last two TPDOs are the vendor's choice; they do not collide with what CiA 301 predefines.
"""

from enum import Enum
from typing import Final

NODE_MAX: Final = 127
NODE_DEFAULT: Final = 8
NODE_MASK: Final = 0x7F
FUNCTION_MASK: Final = 0x780

NMT: Final = 0x000
SYNC: Final = 0x080
EMERGENCY: Final = 0x080
SDO_REPLY: Final = 0x580
SDO_REQUEST: Final = 0x600
HEARTBEAT: Final = 0x700
TPDO_FUNCTIONS: Final = {1: 0x180, 2: 0x280, 3: 0x380, 4: 0x480, 6: 0x680, 7: 0x780}
"""Functions of the TPDOs by their number."""


class NmtCommand(Enum):
    """What a node can be told; one byte, followed by the node's number (CiA 301, 7.2.8.2)."""

    START = 0x01
    """Operational: TPDOs are sent."""
    STOP = 0x02
    """Only NMT and heartbeat remain."""
    PRE_OPERATIONAL = 0x80
    """SDO remains, TPDOs do not."""
    RESET_NODE = 0x81
    """Restart, as by power-on."""
    RESET_COMMUNICATION = 0x82
    """Restart of the communication with what is saved."""


class NmtState(Enum):
    """What a heartbeat tells (CiA 301, 7.2.8.3.2.2)."""

    BOOT_UP = 0x00
    """Sent once after a restart."""
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


def state_name(code: int) -> str:
    """A state in words, for example `pre-operational`; unknown ones as their number."""
    try:
        return NmtState(code).name.lower().replace("_", "-")
    except ValueError:
        return f"unknown (0x{code:02X})"
