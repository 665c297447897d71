"""TCP and UDP sockets for an IP address, and addresses of a host name."""

import fcntl
import re
import socket
import struct
from array import array
from ipaddress import IPv4Network
from typing import TYPE_CHECKING, Final, NamedTuple

from imud.host.files import NO_ERRNO, read_regular_file
from imud.host.threads import call_in_thread
from imud.model.errors import reason_of

if TYPE_CHECKING:
    import ssl

BACKLOG: Final = 128  # number of connections that wait for `accept`


def open_socket(address: str, kind: socket.SocketKind) -> socket.socket:
    """Return a socket that does not block, of the family of an IP address. Raises OSError, also if the kernel has no
    IPv6."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    made = socket.socket(family, kind)
    made.setblocking(False)
    return made


async def resolve(host: str, port: int) -> list[str]:
    """Return the IP addresses of a host name. Raises OSError. A silent name server delays no other work."""

    def request_addresses() -> list[str]:
        try:
            entries = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except UnicodeError as error:  # a name that IDNA cannot encode
            raise OSError(f"{host}: {reason_of(error)}") from None
        addresses = [str(entry[4][0]) for entry in entries]
        return list(dict.fromkeys(addresses))

    return await call_in_thread("name server", request_addresses)


def listen(address: str, port: int) -> socket.socket:
    """Return a TCP server socket. Port 0 selects a free port. Raises OSError."""
    listener = open_socket(address, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((address, port))
        listener.listen(BACKLOG)
    except OSError:
        listener.close()
        raise
    return listener


SIOCGIFCONF: Final = 0x8912  # linux/sockios.h
SIOCGIFFLAGS: Final = 0x8913
SIOCGIFNETMASK: Final = 0x891B
IFF_UP, IFF_LOOPBACK, IFF_MULTICAST = 0x1, 0x8, 0x1000  # linux/if.h
IFREQ_BYTES: Final = 16 + struct.calcsize("LLHBBB0L")  # size of struct ifreq: a name and struct ifmap
INTERFACES_MAX: Final = 256  # maximum number of addresses of this host that imud reads


class InterfaceAddress(NamedTuple):
    """IPv4 address of a network interface that is up."""

    interface_index: int  # index of the interface in the kernel
    address: str
    network: IPv4Network
    is_loopback: bool
    has_multicast: bool


def interface_addresses() -> list[InterfaceAddress]:
    """Return all IPv4 addresses of this host, also several of one interface."""
    addresses = []
    with open_socket("127.0.0.1", socket.SOCK_DGRAM) as requester:
        buffer = array("B", bytes(IFREQ_BYTES * INTERFACES_MAX))
        pointer, size = buffer.buffer_info()
        request = struct.pack("iP", size, pointer)
        (size,) = struct.unpack_from("i", fcntl.ioctl(requester, SIOCGIFCONF, request))
        for offset in range(0, size, IFREQ_BYTES):
            entry = buffer[offset : offset + IFREQ_BYTES].tobytes()
            try:
                addresses.append(_interface_address(requester, entry))
            except OSError:  # the interface has been removed in the meantime
                continue
    return [address for address in addresses if address is not None]


def _interface_address(requester: socket.socket, entry: bytes) -> InterfaceAddress | None:
    """Return the address of an entry of SIOCGIFCONF; None if the interface is down. Raises OSError."""
    label = entry[:16].partition(b"\0")[0].decode(errors="surrogateescape")
    (flags,) = struct.unpack_from("H", fcntl.ioctl(requester, SIOCGIFFLAGS, entry), 16)
    if not flags & IFF_UP:
        return None
    # the kernel selects the address by the label and the address in the request
    mask = socket.inet_ntoa(fcntl.ioctl(requester, SIOCGIFNETMASK, entry)[20:24])
    address = socket.inet_ntoa(entry[20:24])
    return InterfaceAddress(
        socket.if_nametoindex(label.partition(":")[0]),
        address,
        IPv4Network(f"{address}/{mask}", strict=False),
        bool(flags & IFF_LOOPBACK),
        bool(flags & IFF_MULTICAST),
    )


CA_BYTES_MAX: Final = 1 << 20  # maximum length of a file with CA certificates, bytes. All CAs of Debian need 220 kB.
PEM_CERTIFICATE: Final = re.compile("-----BEGIN CERTIFICATE-----.*?-----END CERTIFICATE-----", re.DOTALL)


def tls_context(ca_file: str | None) -> "ssl.SSLContext":
    """Return a context for connections to servers with a valid certificate. Raises OSError if `ca_file` is not a
    regular file with certificates; None: the certificates that the system trusts.

    imud reads the file itself, because OpenSSL would wait for a FIFO.

    Python 3.13 rejects CA certificates without the extension "key usage". Certificates that a server made itself often
    lack it. imud accepts them, as with older versions of Python.
    """
    import ssl

    certificates = None if ca_file is None else _read_certificates(ca_file)
    try:
        context = ssl.create_default_context(cadata=certificates)
    except ssl.SSLError as error:
        raise ssl.SSLError(NO_ERRNO, f"ca_file {ca_file}: expected certificates (PEM), got an invalid one") from error
    context.verify_flags &= ~ssl.VERIFY_X509_STRICT
    return context


def certificates_of(ca_file: str | None) -> frozenset[bytes]:
    """Return the certificates of a file (DER); none for None. Raises OSError as `tls_context`."""
    import ssl

    if ca_file is None:
        return frozenset()
    return frozenset(map(ssl.PEM_cert_to_DER_cert, PEM_CERTIFICATE.findall(_read_certificates(ca_file))))


def _read_certificates(ca_file: str) -> str:
    """Return the content of a file with at least one certificate (PEM). Raises OSError."""
    import ssl

    try:
        content = read_regular_file(ca_file, CA_BYTES_MAX)
    except OSError as error:
        raise OSError(NO_ERRNO, f"cannot read ca_file {ca_file}: {reason_of(error)}") from error
    text = content.decode("latin-1").encode("ascii", "replace").decode("ascii")  # comments in UTF-8
    if PEM_CERTIFICATE.search(text) is None:  # with empty data, Python would trust all CAs of the system
        raise ssl.SSLError(NO_ERRNO, f"ca_file {ca_file}: expected certificates (PEM), got none")
    return text
