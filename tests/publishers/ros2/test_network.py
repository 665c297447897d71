"""Sockets of a participant: memberships of the multicast group, and the networks to which imud sends."""

import errno
import os
import socket
import struct
import subprocess
import sys
from typing import Any, cast

import pytest

from imud.host.network import InterfaceAddress
from imud.publishers.ros2.network import GROUP, RtpsNetwork
from tests.support.rtps import FakeSocket, interface


class Memberships(FakeSocket):
    """Socket with the memberships of the kernel: by interface, not by address."""

    def __init__(self) -> None:
        super().__init__()
        self.indexes: set[int] = set()
        self.error = 0

    def setsockopt(self, *arguments: Any) -> None:
        _level, option, value = arguments
        if option not in (socket.IP_ADD_MEMBERSHIP, socket.IP_DROP_MEMBERSHIP):
            return
        group, _address, index = struct.unpack("4s4si", value)
        assert group == socket.inet_aton(GROUP)
        if option == socket.IP_DROP_MEMBERSHIP:
            self.indexes.remove(index)
            return
        if self.error or index in self.indexes:
            raise OSError(self.error or errno.EADDRINUSE, "Address already in use")
        self.indexes.add(index)


class Host:
    """Host with interfaces that change."""

    def __init__(self, *interfaces: InterfaceAddress, address: str | None = None) -> None:
        self.interfaces = list(interfaces)
        self.memberships = Memberships()
        self.network = RtpsNetwork(
            0, address, lambda: 0, lambda: self.interfaces, lambda *_arguments: cast("Any", self.memberships)
        )
        self.network.open()

    def change(self, *interfaces: InterfaceAddress) -> bool:
        self.interfaces = list(interfaces)
        return self.network.refresh()

    @property
    def addresses(self) -> list[str]:
        return [locator.address for locator in self.network.locators]


LOOPBACK = interface("127.0.0.1/8", 1, is_loopback=True)


def test_a_membership_stays_with_its_interface() -> None:
    """A new address on the same interface gave "Address already in use" for ever, and imud did not announce it."""
    host = Host(LOOPBACK, interface("192.0.2.1/24"))
    assert host.addresses == ["192.0.2.1"]
    assert not host.change(LOOPBACK, interface("192.0.2.1/24"))
    assert host.change(LOOPBACK, interface("192.0.2.5/24"))
    assert (host.addresses, host.network.problem(0)) == (["192.0.2.5"], "")
    assert host.change(LOOPBACK, interface("192.0.2.5/24"), interface("192.0.2.6/24"))
    assert host.addresses == ["192.0.2.5", "192.0.2.6"]
    assert host.memberships.indexes == {2}


def test_a_membership_that_imud_does_not_know_is_no_problem() -> None:
    host = Host()
    host.memberships.indexes.add(2)
    assert host.change(interface("192.0.2.1/24"))
    assert (host.addresses, host.network.problem(0)) == (["192.0.2.1"], "")


def test_memberships_of_removed_interfaces_end() -> None:
    """The kernel permits 20 memberships of one socket: a USB adapter gets a new index each time."""
    host = Host(LOOPBACK)
    for index in range(2, 30):
        host.change(LOOPBACK, interface("192.0.2.1/24", index))
        assert host.memberships.indexes == {index}
    assert host.change(LOOPBACK)
    assert (host.addresses, host.memberships.indexes) == (["127.0.0.1"], {1})


def test_an_error_of_a_membership_is_a_problem_until_it_succeeds() -> None:
    host = Host()
    assert "expected a network interface" in host.network.problem(0)
    host.memberships.error = errno.ENOBUFS
    host.change(interface("192.0.2.1/24"))
    assert "cannot receive multicast at 192.0.2.1" in host.network.problem(0)
    assert host.addresses == []
    host.memberships.error = 0
    assert host.network.refresh()
    assert (host.addresses, host.network.problem(0)) == (["192.0.2.1"], "")


@pytest.mark.parametrize(
    ("address", "reachable", "unreachable"),
    [
        (None, ["192.0.2.9", "192.0.2.1"], ["127.0.0.1", "192.0.3.9", "192.0.2.0", "192.0.2.255", "0.0.0.0", "x", ""]),
        ("127.0.0.1", ["127.0.0.1", "127.9.9.9"], ["192.0.2.9", "127.255.255.255", "128.0.0.1", "239.255.0.1"]),
        ("127.0.0.5", ["127.0.0.1"], ["192.0.2.9"]),
        ("198.51.100.1", ["198.51.100.1"], ["198.51.100.2", "192.0.2.9"]),
        ("203.0.113.1", [], ["203.0.113.1", "192.0.2.9"]),
    ],
)
def test_networks_of_imud(address: str | None, reachable: list[str], unreachable: list[str]) -> None:
    host = Host(LOOPBACK, interface("192.0.2.1/24"), interface("198.51.100.1/32", 3), address=address)
    if address is None:
        host.change(LOOPBACK, interface("192.0.2.1/24"))
    assert [text for text in reachable + unreachable if host.network.is_reachable(text)] == reachable
    assert ("ros2.address" in host.network.problem(0)) == (address == "203.0.113.1")


def test_results_for_addresses_are_bounded() -> None:
    host = Host(interface("192.0.2.1/24"))
    for number in range(5000):
        host.network.is_reachable(f"10.0.{number // 250}.{number % 250}")
    assert len(host.network._reachable_addresses) <= 1024


PROGRAM = """
import subprocess
from imud.publishers.ros2.network import RtpsNetwork

network = RtpsNetwork(0, None)
network.open()
for old, new in (("192.0.2.1", "192.0.2.5"), ("192.0.2.5", "198.51.100.7")):
    subprocess.run(["ip", "addr", "del", f"{old}/24", "dev", "net0"], check=True)
    subprocess.run(["ip", "addr", "add", f"{new}/24", "dev", "net0"], check=True)
    has_changed = network.refresh()
    network.multicast(b"")
    print(has_changed, [locator.address for locator in network.locators], repr(network.problem(0)))
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root for a network of its own")
def test_a_change_of_the_address_with_the_kernel() -> None:
    """The kernel keeps the membership of an interface that loses its address."""
    setup = "ip link add net0 type veth peer net1 && ip addr add 192.0.2.1/24 dev net0 && ip link set net0 up"
    command = ["unshare", "-n", "sh", "-c", f'{setup} && exec "$0" -c "$1"', sys.executable, PROGRAM]
    output = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if output.returncode and "net0" not in output.stdout and "Traceback" not in output.stderr:
        pytest.skip(f"cannot create a network: {output.stderr.strip()}")
    assert output.stdout.splitlines() == ["True ['192.0.2.5'] ''", "True ['198.51.100.7'] ''"], output.stderr
