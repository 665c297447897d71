"""Network without sockets for a DDS participant, and messages of another participant."""

import struct
from collections.abc import Callable, Sequence
from ipaddress import IPv4Interface
from typing import Any, cast

from imud.formats import rtps
from imud.formats.rtps import Locator
from imud.host.network import InterfaceAddress
from imud.publishers.ros2.network import RtpsNetwork

NETWORK = "192.0.2.1/24"
ROBOT = Locator("192.0.2.9", 7411)
PREFIX = bytes(range(12))
READER = b"\0\0\1\4"  # entity of the reader of a robot
TOPIC, TYPE = "rt/a", "b"


def interface(address: str, interface_index: int = 2, *, is_loopback: bool = False) -> InterfaceAddress:
    """Return an interface, for example of `192.0.2.1/24`."""
    network = IPv4Interface(address)
    return InterfaceAddress(
        interface_index, str(network.ip), network.network, is_loopback=is_loopback, has_multicast=True
    )


class FakeSocket:
    """UDP socket that stores datagrams, and refuses them while `is_full`. It can have an endless queue of datagrams."""

    def __init__(self) -> None:
        self.datagrams: list[tuple[bytes, Any]] = []
        self.is_full = False
        self.flood = b""  # datagram that each read returns
        self.reads = 0

    def setsockopt(self, *_arguments: Any) -> None:
        pass

    def bind(self, _address: Any) -> None:
        pass

    def getsockname(self) -> tuple[str, int]:
        return "0.0.0.0", 7410

    def fileno(self) -> int:
        return id(self)

    def sendto(self, datagram: bytes, where: Any) -> None:
        if self.is_full:
            raise BlockingIOError
        self.datagrams.append((datagram, where))

    def recvfrom(self, _size: int) -> tuple[bytes, tuple[str, int]]:
        if not self.flood:
            raise BlockingIOError
        self.reads += 1
        return self.flood, ROBOT

    def close(self) -> None:
        pass


class FakeNetwork(RtpsNetwork):
    """Network of a host with one interface, and with a fake socket. `interfaces` can change."""

    def __init__(self, cpu_ns: Callable[[], int] = lambda: 0, address: str = NETWORK) -> None:
        self.interfaces = [interface(address)]
        self.socket = FakeSocket()
        super().__init__(0, None, cpu_ns, lambda: self.interfaces, lambda *_arguments: cast("Any", self.socket))
        self.open()

    @property
    def sent(self) -> list[tuple[bytes, Any]]:
        """Datagrams to one address, without multicast."""
        return [(datagram, where) for datagram, where in self.socket.datagrams if where != self._group]

    def take(self) -> list[bytes]:
        """Remove and return the submessages of all datagrams."""
        submessages = [datagram[rtps.HEADER_BYTES :] for datagram, _ in self.socket.datagrams]
        self.socket.datagrams.clear()
        return submessages


def announcement(
    prefix: bytes = PREFIX, locators: Sequence[Locator] = (ROBOT,), *, lease_s: int = 20, ended: bool = False
) -> bytes:
    """Return the datagram in which a participant announces itself, or its end."""
    guid = prefix + rtps.PARTICIPANT
    if ended:
        key = rtps.key_of(guid, is_participant=True)
        return rtps.header(prefix) + rtps.data(rtps.PARTICIPANT_WRITER, 2, key, key=guid, ended=True)
    values = [
        (rtps.P_PARTICIPANT_GUID, guid),
        *((rtps.P_META_UNICAST, rtps.locator(where)) for where in locators),
        *((rtps.P_DEFAULT_UNICAST, rtps.locator(where)) for where in locators),
        (rtps.P_LEASE, struct.pack("<iI", lease_s, 0)),
    ]
    payload = rtps.PL_CDR_LE + rtps.parameters(values)
    return rtps.header(prefix) + rtps.data(rtps.PARTICIPANT_WRITER, 1, payload, key=guid)


def subscription(
    entity: bytes = READER, seq: int = 1, *, prefix: bytes = PREFIX, topic: str = TOPIC, is_reliable: bool = True,
    locators: Sequence[Locator] = (),
) -> bytes:  # fmt: skip
    """Return the submessage that describes a reader."""
    guid = prefix + entity
    values = [
        (rtps.P_ENDPOINT_GUID, guid),
        (rtps.P_TOPIC, rtps.text(topic)),
        (rtps.P_TYPE, rtps.text(TYPE)),
        (rtps.P_RELIABILITY, struct.pack("<I8x", rtps.RELIABLE if is_reliable else rtps.BEST_EFFORT)),
        *((rtps.P_UNICAST, rtps.locator(where)) for where in locators),
    ]
    return rtps.data(rtps.SUBSCRIPTIONS_WRITER, seq, rtps.PL_CDR_LE + rtps.parameters(values), key=guid)


def end_of_reader(entity: bytes, seq: int = 1, prefix: bytes = PREFIX) -> bytes:
    """Return the submessage that ends a reader."""
    guid = prefix + entity
    key = rtps.key_of(guid, is_participant=False)
    return rtps.data(rtps.SUBSCRIPTIONS_WRITER, seq, key, key=guid, ended=True)


def request(writer: bytes, base: int, missing: Sequence[int], reader: bytes = READER) -> bytes:
    """Return the submessage that requests samples again."""
    return rtps.acknack(reader, writer, base, missing, 1)


def subscriptions_heartbeat(first: int, last: int, *, final: bool = False) -> bytes:
    """Return the submessage that announces descriptions of readers."""
    return rtps.heartbeat(rtps.SUBSCRIPTIONS_WRITER, first, last, 1, final=final)
