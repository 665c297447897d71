"""CAN in the guest: virtual and emulated controllers, seen by can-utils, python-can and the kernel's J1939."""

import json
import socket
from pathlib import Path

import can

from tests.lab.can_interface import CanInterface, virtual_can
from tests.lab.tool import running, tool
from tests.lab.waiting import wait_until

RECEIVE_LIMIT_S = 10.0


def test_cansend_reaches_python_can(vcan: CanInterface) -> None:
    with can.Bus(vcan.name, interface="socketcan") as bus:
        tool("cansend", vcan.name, "123#DEADBEEF")
        frame = bus.recv(RECEIVE_LIMIT_S)
    assert frame is not None
    assert (frame.arbitration_id, frame.is_extended_id, bytes(frame.data)) == (0x123, False, b"\xde\xad\xbe\xef")
    assert vcan.statistic("rx_packets") == 1


def test_candump_sees_python_can(vcan: CanInterface) -> None:
    with (
        can.Bus(vcan.name, interface="socketcan") as bus,
        running("candump", "-L", "-n", "1", vcan.name) as dump,
    ):
        assert dump.stdout is not None
        _wait_for_raw_sockets(vcan, 2)
        bus.send(can.Message(arbitration_id=0x18FEE9AA, is_extended_id=True, data=b"\1\2\3"))
        assert dump.stdout.readline().split()[1:] == [vcan.name, "18FEE9AA#010203"]


def _wait_for_raw_sockets(interface: CanInterface, count: int) -> None:
    """Waits until `count` raw sockets listen on the interface."""
    listing = Path("/proc/net/can/rcvlist_all")  # a line per socket, its first word the interface

    def listen() -> bool:
        lines = listing.read_text(encoding="ascii").splitlines()
        return sum(line.split()[:1] == [interface.name] for line in lines) >= count

    wait_until(listen, f"{count} sockets on {interface.name}")


def test_interfaces_are_separate_buses(vcan: CanInterface) -> None:
    with virtual_can("vcan1") as other, can.Bus(other.name, interface="socketcan") as far:
        tool("cansend", vcan.name, "001#00")
        tool("cansend", other.name, "002#00")
        frame = far.recv(RECEIVE_LIMIT_S)
    assert frame is not None
    assert frame.arbitration_id == 2


def test_kernel_j1939_receives(vcan: CanInterface) -> None:
    """PGN 65257 (0xFEE9), priority 6, from address 0xAA."""
    with socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939) as receiver:
        receiver.settimeout(RECEIVE_LIMIT_S)
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        receiver.bind((vcan.name, socket.J1939_NO_NAME, socket.J1939_NO_PGN, socket.J1939_NO_ADDR))
        tool("cansend", vcan.name, "18FEE9AA#0102030405060708")
        data, (_name, _device_name, pgn, address) = receiver.recvfrom(64)
    assert (data, pgn, address) == (bytes(range(1, 9)), 0xFEE9, 0xAA)


def test_emulated_controllers_share_a_bus(can_pair: tuple[CanInterface, CanInterface]) -> None:
    first, second = can_pair
    with can.Bus(second.name, interface="socketcan") as bus:
        tool("cansend", first.name, "321#C0FFEE")
        frame = bus.recv(RECEIVE_LIMIT_S)
    assert frame is not None
    assert (frame.arbitration_id, bytes(frame.data)) == (0x321, b"\xc0\xff\xee")
    (details,) = json.loads(tool("ip", "-details", "-json", "link", "show", first.name))
    assert details["linkinfo"]["info_data"]["bittiming"]["bitrate"] == 500_000
    assert details["linkinfo"]["info_data"]["state"] == "ERROR-ACTIVE"
