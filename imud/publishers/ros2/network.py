"""UDP sockets of a DDS participant: multicast groups, addresses of this host, and limits of sent datagrams.

    interfaces of the host ──each second──▶ memberships, announced addresses, networks to which imud sends

imud sends to addresses in its own networks only: the network of `ros2.address`, otherwise the networks of the
interfaces on which it joined the multicast group. All sockets are nonblocking.
"""

import errno
import os
import socket
import struct
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from ipaddress import AddressValueError, IPv4Address
from typing import Final

from imud.formats import rtps
from imud.formats.rtps import Locator
from imud.host.network import InterfaceAddress, interface_addresses, open_socket
from imud.model.errors import ServerError, reason_of
from imud.model.work_budget import WorkBudget, WorkLimits
from imud.publishers.ros2.options import PORT_BASE, PORT_STEP

UNICAST_PORT: Final = 10  # first unicast port after the multicast port; two ports for each participant of a host
PARTICIPANTS_MAX: Final = 100  # participants of one host with a well-known port, as in the default of Fast DDS
GROUP: Final = "239.255.0.1"
IP_MULTICAST_ALL: Final = 49  # linux/in.h
SEND_BUFFER_BYTES: Final = 1 << 20
CHECKED_ADDRESSES_MAX: Final = 1024  # maximum number of addresses with a stored result of `is_reachable`

# Work that other participants cause. A turn of the event loop reads both sockets, so that each has half of 2 ms.
INPUT_LIMITS: Final = WorkLimits(turn_cpu_ns=1_000_000, turn_replies=32)
# Datagrams with samples. Each costs about 12 us. 1000 Hz need 4000 per second for the four topics of a device, so that
# two programs of a robot can receive all samples.
SAMPLES_PER_S: Final = 10_000  # for one address; all addresses together have four times this number
SAMPLE_LIMITS: Final = WorkLimits(turn_replies=1 << 30, second_replies=SAMPLES_PER_S)


class RtpsNetwork:
    """Sockets of a participant. Synchronization: the event loop's thread only."""

    def __init__(
        self,
        domain: int,
        address: str | None,
        cpu_ns: Callable[[], int] = time.thread_time_ns,
        interfaces: Callable[[], Sequence[InterfaceAddress]] = interface_addresses,
        make_socket: Callable[[str, socket.SocketKind], socket.socket] = open_socket,
    ) -> None:
        """`cpu_ns` returns the CPU time of the event loop's thread, ns. `make_socket` as `open_socket`."""
        self._own_address = address
        self._interfaces = interfaces
        self._make_socket = make_socket
        self._group = (GROUP, PORT_BASE + PORT_STEP * domain)
        self._unicast: socket.socket | None = None
        self._multicast: socket.socket | None = None
        self.prefix = rtps.VENDOR + os.urandom(rtps.PREFIX_BYTES - len(rtps.VENDOR))
        self._header = rtps.header(self.prefix)
        self._used: list[InterfaceAddress] = []  # addresses of this participant
        self._members: set[int] = set()  # indexes of the interfaces on which the socket is a member of the group
        self._reachable_addresses: dict[str, bool] = {}  # results of `is_reachable`
        self.port = 0
        self.budget = WorkBudget(INPUT_LIMITS, cpu_ns)
        self._samples = WorkBudget(SAMPLE_LIMITS, cpu_ns)
        self.turn = 0  # number of the turn: a reader gets each repeated sample once per turn
        self._join_problem = ""
        self._send_problem = ""

    @property
    def locators(self) -> list[Locator]:
        """Addresses of this participant."""
        return [Locator(interface.address, self.port) for interface in self._used]

    @property
    def networks(self) -> str:
        """The networks to which imud sends, for a message."""
        return ", ".join(str(interface.network) for interface in self._used) or "no network"

    def problem(self, now_ns: int) -> str:
        """Return the reason why imud cannot announce itself or send all samples, one sentence; empty without."""
        if self._join_problem or self._send_problem:
            return self._join_problem or self._send_problem
        if self._samples.problem(now_ns):
            return (
                f"cannot send each sample: expected at most {SAMPLES_PER_S} datagrams per second to one address, "
                "got more readers; set a lower ros2.devices.rate_hz or end readers"
            )
        return self.budget.problem(now_ns)

    def start_turn(self, now_ns: int) -> None:
        """Start the budgets of a turn of the event loop."""
        self.turn += 1
        self.budget.start_turn(now_ns)
        self._samples.start_turn(now_ns)

    def open(self) -> tuple[socket.socket, socket.socket]:
        """Open both sockets, join the multicast group, and return the sockets. Raises ServerError."""
        try:
            self._multicast = shared = self._make_socket("0.0.0.0", socket.SOCK_DGRAM)
            shared.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            # otherwise the groups of other programs on other interfaces arrive too
            shared.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)
            shared.bind(("", self._group[1]))
            self._unicast = own = self._make_socket("0.0.0.0", socket.SOCK_DGRAM)
            own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
            self.port = self._bind(own)
        except OSError as error:
            self.close()
            raise ServerError(f"ros2: cannot use the UDP port {self._group[1]}: {reason_of(error)}") from error
        self.refresh()
        return shared, own

    def _bind(self, own: socket.socket) -> int:
        host = self._own_address or ""
        for number in range(PARTICIPANTS_MAX):
            try:
                own.bind((host, self._group[1] + UNICAST_PORT + 2 * number))
                break
            except OSError:  # another participant of this host has this port
                continue
        else:
            own.bind((host, 0))
        return int(own.getsockname()[1])

    def refresh(self) -> bool:
        """Read the addresses of this host and join the multicast group. Return whether the addresses changed."""
        previous = self._used
        self._join_problem = ""
        interfaces = self._select_interfaces()
        for index in self._members - {interface.interface_index for interface in interfaces}:
            self._leave(index)
        self._used = [interface for interface in interfaces if self._join(interface)]
        if not interfaces:
            self._join_problem = "expected a network interface with an IPv4 address, got none; connect a network"
            if self._own_address is not None:
                self._join_problem = (
                    f"expected a network interface with the address {self._own_address}, got none; change ros2.address"
                )
        if self._used == previous:
            return False
        self._reachable_addresses.clear()
        return True

    def _select_interfaces(self) -> list[InterfaceAddress]:
        """Return the interfaces for multicast: with the address of the configuration, otherwise all; loopback only if
        no other interface exists."""
        interfaces = self._interfaces()
        own_address = self._own_address
        if own_address is not None:
            matches = [interface for interface in interfaces if interface.address == own_address]
            # each address of its network belongs to a loopback interface
            return matches or [
                interface._replace(address=own_address)
                for interface in interfaces
                if interface.is_loopback and IPv4Address(own_address) in interface.network
            ]
        multicast = [interface for interface in interfaces if interface.has_multicast and not interface.is_loopback]
        return multicast or [interface for interface in interfaces if interface.is_loopback]

    def _join(self, interface: InterfaceAddress) -> bool:
        """Return whether the socket is a member of the group on this interface. A membership belongs to the interface:
        it stays if the address changes."""
        if interface.interface_index in self._members or self._multicast is None:
            return True
        try:
            self._multicast.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, _member(interface))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:  # otherwise the socket is already a member
                self._join_problem = f"cannot receive multicast at {interface.address}: {reason_of(error)}"
                return False
        self._members.add(interface.interface_index)
        return True

    def _leave(self, index: int) -> None:
        self._members.discard(index)
        if self._multicast is not None:
            with suppress(OSError):  # the kernel has already removed the interface
                member = struct.pack("4s4si", socket.inet_aton(GROUP), bytes(4), index)
                self._multicast.setsockopt(socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, member)

    def is_reachable(self, address: str) -> bool:
        """Return whether an address is a host address in a network of imud."""
        is_reachable = self._reachable_addresses.get(address)
        if is_reachable is None:
            if len(self._reachable_addresses) >= CHECKED_ADDRESSES_MAX:
                self._reachable_addresses.clear()
            is_reachable = self._reachable_addresses[address] = self._check(address)
        return is_reachable

    def is_own(self, address: str) -> bool:
        """Return whether this participant has this address."""
        return any(interface.address == address for interface in self._used)

    def _check(self, address: str) -> bool:
        try:
            host = IPv4Address(address)
        except AddressValueError:
            return False
        for interface in self._used:
            network = interface.network
            if host in network:
                # networks of 31 and 32 bits have no broadcast address
                return network.prefixlen > 30 or host not in (network.network_address, network.broadcast_address)
        return False

    def send(self, submessages: bytes, where: Locator) -> bool:
        """Send submessages. Return False if imud does not send to the address, or if the kernel does not accept the
        datagram now."""
        if self._unicast is None or not self.is_reachable(where.address):
            return False
        try:
            self._unicast.sendto(self._header + submessages, where)
        except OSError:
            return False
        return True

    def send_sample(self, submessages: bytes, where: Locator) -> bool:
        """Send a sample. Return False as `send`, and above the limit of samples."""
        return self._samples.take_reply(where.address) and self.send(submessages, where)

    def reply(self, submessages: bytes, where: Locator) -> None:
        """Send submessages that the participant at this address caused, if its budget permits them. UDP can lose each
        datagram, so that the participant repeats its request."""
        if self.budget.take_reply(where.address):
            self.send(submessages, where)

    def multicast(self, submessages: bytes) -> None:
        """Send submessages to all participants of the domain, on each interface."""
        self._send_problem = ""
        for interface in self._used:
            if self._unicast is not None:
                try:
                    self._unicast.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, _member(interface))
                    self._unicast.sendto(self._header + submessages, self._group)
                except OSError as error:
                    self._send_problem = f"cannot send multicast at {interface.address}: {reason_of(error)}"

    def close(self) -> None:
        """Close both sockets. A second call does nothing."""
        for udp_socket in (self._unicast, self._multicast):
            if udp_socket is not None:
                udp_socket.close()
        self._unicast = None
        self._multicast = None
        self._used = []
        self._members.clear()
        self._reachable_addresses.clear()


def _member(interface: InterfaceAddress) -> bytes:
    """Return struct ip_mreqn: the group, the address, and the index of the interface."""
    return struct.pack("4s4si", socket.inet_aton(GROUP), socket.inet_aton(interface.address), interface.interface_index)
