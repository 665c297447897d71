"""Output `nmea0183`: attitude and heading of one device as sentences, each with its own rate.

    batch ─▶ is a sentence due? ─▶ newest sample, mean angular rate ──as ned-frd──▶ sentences ─▶ TCP, UDP, serial port

The rate of turn is the mean angular rate since the previous ROT sentence. Without the mean, fast vibration would appear
as a slow turn. All other values are from the newest sample. If no sample arrives, the output does not send sentences.
The instrument then shows that its source is missing.
"""

import asyncio
import logging
import math
import os
import socket
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Annotated, Final, Literal, Protocol

import msgspec
import serial

from imud.contracts.link import Claim
from imud.contracts.publisher import Batch, PublisherContext, PublisherType
from imud.contracts.status import OutputStatus
from imud.formats import nmea0183
from imud.formats.nmea0183 import Transducer
from imud.host.network import listen, open_socket
from imud.model.errors import ServerError, reason_of
from imud.model.options import Options, is_ip_address, shown
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.publishers.thinning import MeanRate, Pace
from imud.publishers.vessel import (
    HeadingReference,
    VesselDevice,
    magnetic_rad,
    roll_pitch_rad,
    true_rad,
    turn_rate_rad_s,
    turned,
)

log = logging.getLogger(__name__)

CLIENTS_MAX: Final = 32  # maximum number of clients: plotters and instruments of one vessel
STUCK_NS: Final = 30 * NS_PER_S  # time without progress after which imud disconnects a client, ns
RECV_BYTES: Final = 4096
RETRY_FIRST_NS: Final = NS_PER_S
RETRY_MOST_NS: Final = 30 * NS_PER_S
ACCEPT_PAUSE_S: Final = 1.0  # pause of accept after the process ran out of descriptors, s


class SentenceOutput(Protocol):
    """Port for sentences."""

    def put(self, sentences: bytes) -> None:
        """Send complete sentences, or drop them."""
        ...

    def tick(self, now_ns: int) -> None:
        """Check connections. The output calls this method ten times a second."""
        ...

    def status(self) -> OutputStatus:
        """Return the counters and the problem of the port."""
        ...

    def close(self) -> None:
        """Close the port. A second call does nothing."""
        ...


class TcpClient:
    def __init__(self, sock: socket.socket, peer: str) -> None:
        self.sock = sock
        self.peer = peer
        self._rest = b""  # rest of a sentence that the kernel accepted in part
        # Time since which the socket buffer is full; None if it has room or imud sends nothing
        self.full_ns: int | None = None
        self.is_half_closed = False  # whether the client has shut down its sending direction, or closed the connection

    def put(self, sentences: bytes, now_ns: int) -> bool:
        """Send or drop sentences. Return whether imud sent them. Raises OSError if the connection ended."""
        try:
            if self._rest:
                count = self.sock.send(self._rest)
                self._rest = self._rest[count:]
                self.full_ns = None
            if self._rest:
                return False
            self._rest = sentences[self.sock.send(sentences) :]
            self.full_ns = None
        except BlockingIOError:
            if self.full_ns is None:
                self.full_ns = now_ns
            return False
        return True


class TcpOutput:
    """TCP server. Each client receives all sentences. imud reads and ignores data from clients."""

    def __init__(self, address: str, port: int, now_ns: Callable[[], int]) -> None:
        self._address = address
        self.port = port  # bound port after `open`, also if the configured port is 0
        self._now_ns = now_ns
        self._clients: dict[int, TcpClient] = {}
        self._listener: socket.socket | None = None
        self._sent = self._dropped = 0

    def open(self) -> None:
        """Listen. Raises ServerError if address and port cannot be used."""
        try:
            listener = listen(self._address, self.port)
        except OSError as error:
            raise ServerError(
                f"cannot open the NMEA 0183 server at {self._address} port {self.port}: {reason_of(error)}; "
                f"set nmea0183.tcp_address to an address of the host, or nmea0183.tcp_port to another port or null"
            ) from error
        self.port = listener.getsockname()[1]
        self._listener = listener
        asyncio.get_running_loop().add_reader(listener, self._accept, listener)

    def put(self, sentences: bytes) -> None:
        """Send sentences to each client with room in its socket buffer."""
        now_ns, count = self._now_ns(), sentences.count(b"\n")
        for number, client in list(self._clients.items()):
            try:
                if client.put(sentences, now_ns):
                    self._sent += count
                    continue
            except OSError:  # the client reset the connection
                self._drop_client(number)
            self._dropped += count

    def tick(self, now_ns: int) -> None:
        """Disconnect clients without progress."""
        for number, client in list(self._clients.items()):
            if client.full_ns is not None and now_ns - client.full_ns > STUCK_NS:
                log.info("nmea0183: disconnecting %s, which did not read for %d s", client.peer, STUCK_NS // NS_PER_S)
                self._drop_client(number)

    def status(self) -> OutputStatus:
        name = f"tcp {self._address}:{self.port}"
        return OutputStatus(name, self._sent, self._dropped, len(self._clients), "")

    def close(self) -> None:
        """Stop listening and disconnect all clients. A second call does nothing."""
        for number in list(self._clients):
            self._drop_client(number)
        listener, self._listener = self._listener, None
        if listener is not None:
            asyncio.get_running_loop().remove_reader(listener)
            listener.close()

    def _accept(self, listener: socket.socket) -> None:
        try:
            sock, address = listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError:  # out of descriptors: the listener stays readable, so an immediate retry would be a busy loop
            loop = asyncio.get_running_loop()
            loop.remove_reader(listener)
            loop.call_later(ACCEPT_PAUSE_S, self._listen_again)
            return
        peer = f"{address[0]} port {address[1]}"
        half_closed = [number for number, client in self._clients.items() if client.is_half_closed]
        if len(self._clients) >= CLIENTS_MAX and half_closed:  # without sentences, imud does not see which are closed
            self._drop_client(half_closed[0])
        if len(self._clients) >= CLIENTS_MAX:
            log.info("nmea0183: rejecting %s: the limit of %d clients is reached", peer, CLIENTS_MAX)
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        number = sock.fileno()
        self._clients[number] = TcpClient(sock, peer)
        asyncio.get_running_loop().add_reader(sock, self._read, number)

    def _listen_again(self) -> None:
        if self._listener is not None:
            asyncio.get_running_loop().add_reader(self._listener, self._accept, self._listener)

    def _read(self, number: int) -> None:
        client = self._clients.get(number)
        if client is None:
            return
        try:
            if not client.sock.recv(RECV_BYTES):  # the next sentences show whether the client still reads
                client.is_half_closed = True
                asyncio.get_running_loop().remove_reader(client.sock)
        except BlockingIOError:
            return
        except OSError:  # the client reset the connection
            self._drop_client(number)

    def _drop_client(self, number: int) -> None:
        client = self._clients.pop(number)
        asyncio.get_running_loop().remove_reader(client.sock)
        client.sock.close()


class UdpOutput:
    """Datagrams to one address: a host, a broadcast address or a multicast group."""

    def __init__(self, address: str, port: int) -> None:
        self._address = (address, port)
        self._sock: socket.socket | None = None
        self._sent = self._dropped = 0
        self._problem = ""

    def put(self, sentences: bytes) -> None:
        """Send sentences as one datagram."""
        count = sentences.count(b"\n")
        try:
            self._opened().sendto(sentences, self._address)
        except OSError as error:  # no IPv6, no route, network down, or no receiver: the next datagram can arrive
            self._dropped += count
            problem = reason_of(error)
            if problem != self._problem:
                log.warning("nmea0183: datagrams to %s port %d: %s", *self._address, problem)
            self._problem = problem
        else:
            self._sent += count
            self._problem = ""

    def tick(self, _now_ns: int) -> None:
        """Do nothing: UDP has no connection."""

    def status(self) -> OutputStatus:
        address, port = self._address
        return OutputStatus(f"udp {address}:{port}", self._sent, self._dropped, int(not self._problem), self._problem)

    def close(self) -> None:
        """Close the socket. A second call does nothing."""
        if self._sock is not None:
            self._sock.close()

    def _opened(self) -> socket.socket:
        if self._sock is None:
            self._sock = open_socket(self._address[0], socket.SOCK_DGRAM)
            if self._sock.family == socket.AF_INET:
                self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        return self._sock


def open_serial(port: str, baud: int) -> int:
    """Open a serial port for writing without waiting, 8N1. Return its descriptor. Raises OSError."""
    made = serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True)
    try:
        fd = os.dup(made.fileno())
    finally:
        made.close()
    os.set_blocking(fd, False)
    return fd


class SerialOutput:
    """Serial port. imud opens it again after a loss."""

    def __init__(
        self, port: str, baud: int, now_ns: Callable[[], int], open_port: Callable[[str, int], int] = open_serial
    ) -> None:
        self._port, self._baud = port, baud
        self._now_ns = now_ns
        self._open_port = open_port
        self._fd: int | None = None
        self._opening: asyncio.Future[int] | None = None
        self._due_ns = 0
        self._wait_ns = RETRY_FIRST_NS
        self._rest = b""
        self._sent = self._dropped = 0
        self._problem = "not open yet"

    def put(self, sentences: bytes) -> None:
        """Write sentences. Drop them if the port is missing or its queue is full."""
        count = sentences.count(b"\n")
        if self._fd is None:
            self._dropped += count
            return
        try:
            if self._rest:
                self._rest = self._rest[os.write(self._fd, self._rest) :]
            if self._rest:
                self._dropped += count
                return
            self._rest = sentences[os.write(self._fd, sentences) :]
            self._sent += count
        except BlockingIOError:
            self._dropped += count
        except OSError as error:
            self._dropped += count
            self._lose(reason_of(error))

    def tick(self, now_ns: int) -> None:
        """Open the port if an attempt is due."""
        if self._fd is None and self._opening is None and now_ns >= self._due_ns:
            loop = asyncio.get_running_loop()
            self._opening = loop.run_in_executor(None, self._open_port, self._port, self._baud)
            self._opening.add_done_callback(self._opened)

    def status(self) -> OutputStatus:
        is_open = self._fd is not None
        return OutputStatus(f"serial {self._port}", self._sent, self._dropped, int(is_open), self._problem)

    def close(self) -> None:
        """Close the port. A second call does nothing."""
        opening, self._opening = self._opening, None
        if opening is not None:
            opening.remove_done_callback(self._opened)
            opening.add_done_callback(_close_late)
        self._close_port()

    def _opened(self, opening: "asyncio.Future[int]") -> None:
        self._opening = None
        error = opening.exception()
        if error is None:
            self._fd, self._wait_ns, self._problem = opening.result(), RETRY_FIRST_NS, ""
            log.info("nmea0183: sending to %s at %d baud", self._port, self._baud)
        elif isinstance(error, (OSError, ValueError)):  # ValueError: the driver does not support the baud rate
            self._lose(reason_of(error))
        else:
            raise error

    def _lose(self, problem: str) -> None:
        self._close_port()
        if problem != self._problem:
            log.warning("nmea0183: %s: %s; trying again", self._port, problem)
        self._problem = problem
        self._due_ns = self._now_ns() + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, RETRY_MOST_NS)

    def _close_port(self) -> None:
        fd, self._fd, self._rest = self._fd, None, b""
        if fd is not None:
            os.close(fd)


def _close_late(opening: "asyncio.Future[int]") -> None:
    """Close a port that a thread opened after the output was closed."""
    if not opening.cancelled() and opening.exception() is None:
        os.close(opening.result())


PA_PER_BAR: Final = 100_000.0


class Formatter(StrEnum):
    """Sentence formatters."""

    HDT = "HDT"
    HDG = "HDG"
    HDM = "HDM"
    ROT = "ROT"
    XDR = "XDR"
    PASHR = "PASHR"


# Talkers: HC magnetic compass, also for a corrected true heading; TI rate of turn; YX transducer. PASHR has no talker.
# gpsd 3.22 accepts HC and II as talkers of a heading, but not HE and HN (gyrocompasses).
TALKERS: Final[Mapping[Formatter, str]] = {
    Formatter.HDT: "HC",
    Formatter.HDG: "HC",
    Formatter.HDM: "HC",
    Formatter.ROT: "TI",
    Formatter.XDR: "YX",
    Formatter.PASHR: "",
}


def make(kind: Formatter, sample: Sample, reference: HeadingReference, talker: str = "") -> bytes | None:
    """Return the sentence of a sample in `ned-frd`; None if the sample does not contain the values. A non-empty
    `talker` replaces the talker of TALKERS."""
    return _MAKERS[kind](talker or TALKERS[kind], sample, reference)


def _hdt(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = true_rad(sample, reference)
    return None if heading_rad is None else nmea0183.hdt(talker, heading_rad)


def _hdg(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = magnetic_rad(sample, reference)
    declination_deg = reference.declination_deg
    variation_rad = None if declination_deg is None else math.radians(declination_deg)
    return None if heading_rad is None else nmea0183.hdg(talker, heading_rad, variation_rad)


def _hdm(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = magnetic_rad(sample, reference)
    return None if heading_rad is None else nmea0183.hdm(talker, heading_rad)


def _rot(talker: str, sample: Sample, _reference: HeadingReference) -> bytes | None:
    rate_rad_s = turn_rate_rad_s(sample)
    return None if rate_rad_s is None else nmea0183.rot(talker, rate_rad_s)


def _xdr(talker: str, sample: Sample, _reference: HeadingReference) -> bytes | None:
    found = []
    roll_pitch = roll_pitch_rad(sample)
    if roll_pitch is not None:
        roll_rad, pitch_rad = roll_pitch
        found.append(Transducer("A", math.degrees(pitch_rad), "D", "PTCH"))
        found.append(Transducer("A", math.degrees(roll_rad), "D", "ROLL"))
    if sample.temperature_c is not None and math.isfinite(sample.temperature_c):
        found.append(Transducer("C", sample.temperature_c, "C", "TEMP", decimals=1))
    if sample.pressure_pa is not None and math.isfinite(sample.pressure_pa):
        found.append(Transducer("P", sample.pressure_pa / PA_PER_BAR, "B", "BARO", decimals=5))
    return nmea0183.xdr(talker, found) if found else None


def _pashr(_talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    roll_pitch = roll_pitch_rad(sample)
    if roll_pitch is None:
        return None
    return nmea0183.pashr(sample.utc_ns, true_rad(sample, reference), *roll_pitch)


_MAKERS: Final[Mapping[Formatter, Callable[[str, Sample, HeadingReference], bytes | None]]] = {
    Formatter.HDT: _hdt,
    Formatter.HDG: _hdg,
    Formatter.HDM: _hdm,
    Formatter.ROT: _rot,
    Formatter.XDR: _xdr,
    Formatter.PASHR: _pashr,
}


WHO: Final = "nmea0183"  # name of this output
BITS_PER_BYTE: Final = 10  # bits per byte of a serial port with 8N1
# Maximum usual length of each sentence, bytes, for the load of a serial port
USUAL_BYTES: Final = {
    Formatter.HDT: 19, Formatter.HDG: 27, Formatter.HDM: 19, Formatter.ROT: 22, Formatter.XDR: 82, Formatter.PASHR: 57,
}  # fmt: skip
FormatterName = Literal["HDT", "HDG", "HDM", "ROT", "XDR", "PASHR"]
Talker = Annotated[str, msgspec.Meta(pattern="^([A-Z]{2})?$", extra={"words": "two capital letters, or nothing"})]
RateHz = Annotated[float, msgspec.Meta(ge=0.01, le=100)]


class Nmea0183Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the NMEA 0183 output."""

    enabled: bool = False
    """Send sentences."""
    device: str | None = None
    """Name of the device; null: the only device of the configuration."""
    sentences: dict[FormatterName, RateHz] = msgspec.field(
        default_factory=lambda: {"HDT": 10.0, "HDG": 10.0, "ROT": 10.0, "XDR": 2.0}
    )
    """Sentences and their rates, Hz. imud sends only the listed sentences."""
    talker: Talker = ""
    """Talker of all sentences; empty: HC for headings, TI for ROT, YX for XDR."""
    tcp_address: Annotated[str, msgspec.Meta(min_length=1)] = "127.0.0.1"
    """IP address of the TCP server; `0.0.0.0`: all networks of the host. There is no password."""
    tcp_port: Annotated[int, msgspec.Meta(ge=0, le=65535)] | None = 10110
    """TCP port; 0: any free port, null: no TCP server."""
    udp: list[str] = msgspec.field(default_factory=list)
    """Destinations of UDP datagrams, each as ADDRESS:PORT: a host, a multicast group, or a broadcast address such as
    `192.168.1.255:10110`."""
    serial_port: str | None = None
    """Serial port for the sentences; null: no serial port."""
    serial_baud: Annotated[int, msgspec.Meta(ge=4800, le=921600)] = 38400
    """Baud rate of the serial port, bit/s. The standard specifies 4800 and 38400."""

    def __post_init__(self) -> None:
        """Raise ValueError if an address is invalid, or if the serial port is too slow for the sentences."""
        if not is_ip_address(self.tcp_address):
            raise ValueError(f"tcp_address: expected an IP address such as 127.0.0.1, got {shown(self.tcp_address)}")
        for text in self.udp:
            if address_of(text) is None:
                raise ValueError(f"udp: expected IP address and port such as 192.168.1.255:10110, got {shown(text)}")
        if not self.sentences:
            raise ValueError("sentences: expected at least one sentence, got none")
        needed = sum(rate_hz * USUAL_BYTES[Formatter(name)] for name, rate_hz in self.sentences.items())
        room = self.serial_baud / BITS_PER_BYTE
        if self.serial_port is not None and needed > room:
            raise ValueError(
                f"sentences: expected at most {room:.0f} bytes per second at {self.serial_baud} bit/s, got "
                f"{needed:.0f}; reduce the rates, or set serial_baud"
            )


def address_of(text: str) -> tuple[str, int] | None:
    """Return IP address and port of `192.168.1.255:10110` or `[fe80::1]:10110`; None if the text is not an address."""
    address, _, port = text.rpartition(":")
    if address.startswith("[") and address.endswith("]"):
        address = address[1:-1]
    elif ":" in address:
        return None
    if not is_ip_address(address) or not (port.isascii() and port.isdecimal()) or not 0 < int(port) < 1 << 16:
        return None
    return address, int(port)


class Nmea0183:
    """Output of the sentences of one device. Synchronization: the event loop's thread only."""

    def __init__(self, settings: Nmea0183Options, context: PublisherContext) -> None:
        self._settings = settings
        self._context = context
        self._paces: Mapping[Formatter, Pace] = {
            Formatter(name): Pace(rate) for name, rate in settings.sentences.items()
        }
        self._outputs: list[SentenceOutput] = []
        latency_ns = round(NS_PER_S / max(settings.sentences.values()))
        self._device = VesselDevice(WHO, settings.device, latency_ns, context)
        self._newest_ns = 0
        self._rate = MeanRate()
        self._not_made = 0  # number of sentences that would exceed the length limit of the standard

    def start(self) -> None:
        """Open the ports. Raises ServerError if the TCP port cannot be used."""
        settings, now_ns = self._settings, self._context.clock.now_ns
        if settings.tcp_port is not None:
            server = TcpOutput(settings.tcp_address, settings.tcp_port, now_ns)
            server.open()
            self._outputs.append(server)
            log.info("NMEA 0183 at %s port %d", settings.tcp_address, server.port)
        self._outputs += [UdpOutput(*found) for text in settings.udp if (found := address_of(text)) is not None]
        if settings.serial_port is not None:
            self._outputs.append(SerialOutput(settings.serial_port, settings.serial_baud, now_ns))
        self._context.outputs.ports[WHO] = self.status

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. The output uses the configured device, or the only device."""
        self._device.add(name)

    def remove_device(self, name: str) -> None:
        self._device.remove(name)

    event: Final = None  # no sentence describes an event

    def publish(self, batch: Batch) -> None:
        """Send the due sentences with the values of the newest sample. Ignore the batches of other devices."""
        if batch.device != self._device.name:
            return
        if Formatter.ROT in self._paces:
            self._rate.add(batch.samples)
        newest = batch.samples[-1]
        t_ns = newest.t_ns
        step_ns, self._newest_ns = t_ns - self._newest_ns, t_ns
        due = [kind for kind, pace in self._paces.items() if t_ns >= pace.due_ns and pace.is_due(t_ns, step_ns)]
        if not due:
            return
        if Formatter.ROT in due:
            newest = msgspec.structs.replace(newest, gyro_rad_s=self._rate.take())
        sample = turned(batch, newest)
        sentences = b"".join([self._made(kind, sample) for kind in due])
        if sentences:
            for output in self._outputs:
                output.put(sentences)

    def tick(self, now_ns: int) -> None:
        """Check the ports and read the heading reference."""
        for output in self._outputs:
            output.tick(now_ns)
        self._device.tick(now_ns)

    def close(self) -> None:
        """Close all ports and withdraw the latency request. A second call does nothing."""
        for output in self._outputs:
            output.close()
        self._outputs.clear()
        self._device.close()
        self._context.outputs.ports.pop(WHO, None)

    def status(self) -> list[OutputStatus]:
        """Return the state of each port."""
        found = [output.status() for output in self._outputs]
        return [msgspec.structs.replace(one, dropped=one.dropped + self._not_made) for one in found]

    def _made(self, kind: Formatter, sample: Sample) -> bytes:
        """Return the sentence of a sample; empty without values, or with values that do not fit into a sentence."""
        try:
            return make(kind, sample, self._device.reference, self._settings.talker) or b""
        except ValueError as error:
            self._not_made += 1
            self._device.warn(f"NMEA 0183: cannot make a {kind} sentence: {error}")
            return b""


def _claims(settings: Nmea0183Options) -> list[Claim]:
    used = settings.serial_port if settings.enabled else None
    return [] if used is None else [Claim(place=used, key="serial_port")]


PUBLISHER = PublisherType("nmea0183", Nmea0183Options, Nmea0183, claims=_claims)
