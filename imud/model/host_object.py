"""Kinds of host objects that values of the configuration name: files, device nodes, directories, addresses, groups.

An option states the kind of its value with one of these types. `imud.config.host_values` has one check for each kind,
and `imud check` applies it to every value of the kind. A new option thus needs a type, and no code.
"""

from enum import Enum, auto
from typing import Annotated, Final

from msgspec import Meta

HOST_OBJECT: Final = "host_object"  # key of the kind in `Meta.extra`


class HostObject(Enum):
    """Kind of an object of the host."""

    CA_CERTIFICATES = auto()  # regular file with CA certificates (PEM)
    CLIENT_CERTIFICATE = auto()  # regular file with a certificate (PEM), and its key if there is no `key_file`
    CLIENT_KEY = auto()  # regular file with a key (PEM)
    SECRET = auto()  # regular file with a password or token in its first line
    OUTPUT_FILE = auto()  # URL `file:///PATH` of a regular file that imud writes; other URLs name no file
    DIRECTORY = auto()  # directory that imud creates
    MEMORY_DIRECTORY = auto()  # directory in memory that imud creates
    SERVER_SOCKET = auto()  # UNIX socket that imud creates
    PEER_SOCKET = auto()  # UNIX socket of another program
    SERIAL_PORT = auto()  # character device of a serial port
    SPI_PORT = auto()  # character device of spidev
    I2C_BUS = auto()  # number N of /dev/i2c-N
    GPIO_CHIP = auto()  # path, name in /dev, or label of a GPIO chip
    LISTEN_ADDRESS = auto()  # IP address of this host on which imud listens
    INTERFACE_ADDRESS = auto()  # IPv4 address of a network interface of this host
    GROUP = auto()  # name of a group of users
    PROGRAM = auto()  # list with the path of a program and its arguments


def names(kind: HostObject) -> dict[str, HostObject]:
    """Return `Meta.extra` of a value that names an object of this kind."""
    return {HOST_OBJECT: kind}


CaFile = Annotated[str, Meta(min_length=1, extra=names(HostObject.CA_CERTIFICATES))]
CertificateFile = Annotated[str, Meta(min_length=1, extra=names(HostObject.CLIENT_CERTIFICATE))]
KeyFile = Annotated[str, Meta(min_length=1, extra=names(HostObject.CLIENT_KEY))]
SecretFile = Annotated[str, Meta(min_length=1, extra=names(HostObject.SECRET))]
OutputUrl = Annotated[str, Meta(extra=names(HostObject.OUTPUT_FILE))]
Directory = Annotated[str, Meta(min_length=1, extra=names(HostObject.DIRECTORY))]
OptionalDirectory = Annotated[str, Meta(extra=names(HostObject.DIRECTORY))]
MemoryDirectory = Annotated[str, Meta(min_length=1, extra=names(HostObject.MEMORY_DIRECTORY))]
OptionalSocket = Annotated[str, Meta(extra=names(HostObject.PEER_SOCKET))]
SerialPort = Annotated[str, Meta(min_length=1, extra=names(HostObject.SERIAL_PORT))]
OptionalSerialPort = Annotated[str, Meta(extra=names(HostObject.SERIAL_PORT))]
SpiPort = Annotated[str, Meta(min_length=1, extra=names(HostObject.SPI_PORT))]
ListenAddress = Annotated[str, Meta(min_length=1, extra=names(HostObject.LISTEN_ADDRESS))]
InterfaceAddress = Annotated[str, Meta(extra=names(HostObject.INTERFACE_ADDRESS))]
GroupName = Annotated[str, Meta(extra=names(HostObject.GROUP))]
Command = Annotated[list[str], Meta(max_length=64, extra=names(HostObject.PROGRAM))]
