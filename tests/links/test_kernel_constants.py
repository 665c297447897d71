"""Numbers of the kernel's interfaces, by their names in the headers of Linux. Most tests replace the kernel."""

import socket

import pytest

from imud.host import netlink
from imud.links import cyclic_sender, device_node, i2c, rs485, serial_port, socketcan, spi


def write_ioctl(letter: str, number: int, size: int) -> int:
    """Return `_IOW(letter, number, size)` of asm-generic/ioctl.h: direction 1 in bits 30 and 31, size from bit 16."""
    return 1 << 30 | size << 16 | ord(letter) << 8 | number


EXPECTED = {
    # linux/can/bcm.h and linux/can/raw.h, in the module `socket`; the kernel counts the options of raw from 1
    cyclic_sender: {
        "TX_SETUP": socket.CAN_BCM_TX_SETUP,
        "SETTIMER": socket.CAN_BCM_SETTIMER,
        "STARTTIMER": socket.CAN_BCM_STARTTIMER,
    },
    # linux/can/error.h; linux/can/raw.h; asm-generic/socket.h
    socketcan: {
        "CLASS_CONTROLLER": 0x04, "CLASS_BUS_OFF": 0x40, "CLASS_RESTARTED": 0x100, "RECEIVE_OVERFLOW": 0x01,
        "WARNING": 0x0C, "PASSIVE": 0x30, "ACTIVE": 0x40, "CAN_RAW_ERR_FILTER": socket.CAN_RAW_FILTER + 1,
        "SO_RXQ_OVFL": 40, "SO_TIMESTAMPNS_NEW": 64, "SO_RCVBUFFORCE": 33,
    },
    # linux/inotify.h
    device_node: {
        "IN_ATTRIB": 1 << 2, "IN_MOVED_TO": 1 << 7, "IN_CREATE": 1 << 8, "IN_DELETE": 1 << 9, "IN_DELETE_SELF": 1 << 10,
        "IN_MOVE_SELF": 1 << 11, "IN_ONLYDIR": 1 << 24,
    },
    # linux/rtnetlink.h, linux/netlink.h, linux/if_link.h, linux/can/netlink.h, linux/if.h, linux/if_arp.h
    netlink: {
        "RTMGRP_LINK": 1, "RTM_NEWLINK": 16, "RTM_GETLINK": 18, "NLM_F_REQUEST": 1, "IFLA_LINKINFO": 18,
        "IFLA_INFO_DATA": 2, "IFLA_CAN_BITTIMING": 1, "IFLA_CAN_STATE": 4, "IFF_UP": 1, "ARPHRD_CAN": 280,
    },
    # linux/spi/spidev.h
    spi: {
        "WR_MODE": write_ioctl("k", 1, 1), "WR_BITS_PER_WORD": write_ioctl("k", 3, 1),
        "WR_MAX_SPEED_HZ": write_ioctl("k", 4, 4),
    },
    # linux/i2c-dev.h
    i2c: {"I2C_TIMEOUT": 0x0702},
    # asm-generic/ioctls.h; linux/serial.h: flags, and the number of counters; asm-generic/termbits.h: 44 bytes
    rs485: {"TIOCGRS485": 0x542E, "TIOCSRS485": 0x542F, "ENABLED": 1, "RTS_ON_SEND": 2},
    serial_port: {"TIOCGICOUNT": 0x545D, "ICOUNTER_INTS": 20, "TERMIOS2_INTS": 44 // 4},
}  # fmt: skip


@pytest.mark.parametrize("module", EXPECTED, ids=lambda module: module.__name__)
def test_numbers_of_the_kernel(module: object) -> None:
    expected = EXPECTED[module]  # type: ignore[index]  # a module is a key
    assert {name: getattr(module, name) for name in expected} == expected
