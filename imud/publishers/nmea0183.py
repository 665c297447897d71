"""The output of NMEA 0183: attitude and heading of one device as sentences, each at its own rate.

    batch ─▶ is a sentence due? ─▶ newest sample, mean angular rate ──as ned-frd──▶ sentences ─▶ TCP, UDP, serial port

The rate of turn is that of the angular rates averaged since the last such sentence, so that vibration above its rate
does not come back as a slow turn. All other values are those of the newest sample; without samples nothing is sent, so
that an instrument shows that its source is gone.
"""

import asyncio
import logging
import math
import os
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final, Literal, Protocol

import msgspec
import serial

from imud.attitude.conventions import Convention, Heading
from imud.contracts.publisher import Batch, PublisherContext, PublisherType
from imud.contracts.status import OutputStatus
from imud.formats import nmea0183
from imud.formats.nmea0183 import Transducer
from imud.model.errors import ServerError, reason_of
from imud.model.event import Event
from imud.model.options import Options, is_ip_address, shown
from imud.model.sample import Sample, Vector3
from imud.model.units import NS_PER_S
from imud.publishers.thinning import MeanRate, Pace

log = logging.getLogger(__name__)

BACKLOG: Final = 8
CLIENTS_MAX: Final = 32
"""Plotters and instruments of one vessel; one more is refused, so that those that are there go on."""
STUCK_NS: Final = 30 * NS_PER_S
"""A client that takes nothing for so long is disconnected."""
RECV_BYTES: Final = 4096
RETRY_FIRST_NS: Final = NS_PER_S
RETRY_MOST_NS: Final = 30 * NS_PER_S
ACCEPT_PAUSE_S: Final = 1.0
"""After the process ran out of descriptors."""


class SentenceOutput(Protocol):
    """A way out."""

    def put(self, sentences: bytes) -> None:
        """Send whole sentences, or drop them."""
        ...

    def tick(self, now_ns: int) -> None:
        """Look after connections; called ten times a second."""
        ...

    def status(self) -> OutputStatus:
        """What was sent."""
        ...

    def close(self) -> None:
        """Close; may be called twice."""
        ...


class TcpClient:
    """One client that reads."""

    def __init__(self, sock: socket.socket, peer: str) -> None:
        self.sock = sock
        self.peer = peer
        self._rest = b""
        """Of sentences that were taken in part."""
        self.full_ns: int | None = None
        """Since when it has no room for what is sent; None while it has, and while nothing is sent."""

    def put(self, sentences: bytes, now_ns: int) -> bool:
        """Send, or drop; return whether they were sent. Raises OSError when the connection has ended."""
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
    """A TCP server: each client gets all sentences from now on. What clients send is read and ignored."""

    def __init__(self, address: str, port: int, now_ns: Callable[[], int]) -> None:
        self._address = address
        self.port = port
        """The bound port once open, also where 0 was asked for."""
        self._now_ns = now_ns
        self._clients: dict[int, TcpClient] = {}
        self._listener: socket.socket | None = None
        self._sent = self._dropped = 0

    def open(self) -> None:
        """Listen. Raises ServerError when address and port cannot be had."""
        family = socket.AF_INET6 if ":" in self._address else socket.AF_INET
        listener = socket.socket(family, socket.SOCK_STREAM)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((self._address, self.port))
            listener.listen(BACKLOG)
        except OSError as error:
            listener.close()
            raise ServerError(
                f"NMEA 0183 cannot be served at {self._address} port {self.port}: {reason_of(error)}; "
                f"set nmea0183.tcp_port to another port, or to null"
            ) from error
        listener.setblocking(False)
        self.port = listener.getsockname()[1]
        self._listener = listener
        asyncio.get_running_loop().add_reader(listener, self._accept)

    def put(self, sentences: bytes) -> None:
        """Send to every client that has room."""
        now_ns, count = self._now_ns(), sentences.count(b"\n")
        for number, client in list(self._clients.items()):
            try:
                if client.put(sentences, now_ns):
                    self._sent += count
                    continue
            except OSError:  # reset by the peer
                self._drop_client(number)
            self._dropped += count

    def tick(self, now_ns: int) -> None:
        """Disconnect clients that take nothing."""
        for number, client in list(self._clients.items()):
            if client.full_ns is not None and now_ns - client.full_ns > STUCK_NS:
                log.info(
                    "nmea0183: %s is disconnected: it has read nothing for %d s", client.peer, STUCK_NS // NS_PER_S
                )
                self._drop_client(number)

    def status(self) -> OutputStatus:
        """What was sent."""
        name = f"tcp {self._address}:{self.port}"
        return OutputStatus(name, self._sent, self._dropped, len(self._clients), "")

    def close(self) -> None:
        """Stop listening and disconnect everybody; may be called twice."""
        for number in list(self._clients):
            self._drop_client(number)
        listener, self._listener = self._listener, None
        if listener is not None:
            asyncio.get_running_loop().remove_reader(listener)
            listener.close()

    def _accept(self) -> None:
        listener = self._listener
        if listener is None:
            return
        try:
            sock, address = listener.accept()
        except (BlockingIOError, ConnectionError):
            return
        except OSError:  # out of descriptors: the listener stays readable, an immediate retry would be a busy loop
            loop = asyncio.get_running_loop()
            loop.remove_reader(listener)
            loop.call_later(ACCEPT_PAUSE_S, self._listen_again)
            return
        peer = f"{address[0]} port {address[1]}"
        if len(self._clients) >= CLIENTS_MAX:
            log.info("nmea0183: %s is refused: there are %d clients already", peer, CLIENTS_MAX)
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        number = sock.fileno()
        self._clients[number] = TcpClient(sock, peer)
        asyncio.get_running_loop().add_reader(sock, self._read, number)

    def _listen_again(self) -> None:
        if self._listener is not None:
            asyncio.get_running_loop().add_reader(self._listener, self._accept)

    def _read(self, number: int) -> None:
        client = self._clients.get(number)
        if client is None:
            return
        try:
            if client.sock.recv(RECV_BYTES):
                return
        except BlockingIOError:
            return
        except OSError:
            pass  # reset by the peer
        self._drop_client(number)

    def _drop_client(self, number: int) -> None:
        client = self._clients.pop(number)
        asyncio.get_running_loop().remove_reader(client.sock)
        client.sock.close()


class UdpOutput:
    """Datagrams to one address: a host, a network's broadcast address or a multicast group."""

    def __init__(self, address: str, port: int) -> None:
        self._address = (address, port)
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        self._sock = socket.socket(family, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        if family == socket.AF_INET:
            self._sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._sent = self._dropped = 0
        self._problem = ""

    def put(self, sentences: bytes) -> None:
        """Send them as one datagram."""
        count = sentences.count(b"\n")
        try:
            self._sock.sendto(sentences, self._address)
        except OSError as error:  # no route, network down, or nobody there: the next one may arrive
            self._dropped += count
            problem = reason_of(error)
            if problem != self._problem:
                log.warning("nmea0183: datagrams to %s port %d: %s", *self._address, problem)
            self._problem = problem
        else:
            self._sent += count
            self._problem = ""

    def tick(self, _now_ns: int) -> None:
        """No-op: there is no connection."""

    def status(self) -> OutputStatus:
        """What was sent."""
        address, port = self._address
        return OutputStatus(f"udp {address}:{port}", self._sent, self._dropped, int(not self._problem), self._problem)

    def close(self) -> None:
        """Close; may be called twice."""
        self._sock.close()


def open_serial(port: str, baud: int) -> int:
    """Open a serial port for writing without waiting, 8N1; return its descriptor. Raises OSError."""
    made = serial.Serial(port, baud, timeout=0, write_timeout=0, exclusive=True)
    try:
        fd = os.dup(made.fileno())
    finally:
        made.close()
    os.set_blocking(fd, False)
    return fd


class SerialOutput:
    """A serial port, opened again after it was away."""

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
        """Write, or drop while the port is away or its queue is full."""
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
        """Open the port when that is due."""
        if self._fd is None and self._opening is None and now_ns >= self._due_ns:
            loop = asyncio.get_running_loop()
            self._opening = loop.run_in_executor(None, self._open_port, self._port, self._baud)
            self._opening.add_done_callback(self._opened)

    def status(self) -> OutputStatus:
        """What was sent."""
        is_open = self._fd is not None
        return OutputStatus(f"serial {self._port}", self._sent, self._dropped, int(is_open), self._problem)

    def close(self) -> None:
        """Close; may be called twice."""
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
            log.info("nmea0183: sentences go to %s at %d baud", self._port, self._baud)
        elif isinstance(error, (OSError, ValueError)):  # ValueError: a rate that the driver does not have
            self._lose(reason_of(error))
        else:
            raise error

    def _lose(self, problem: str) -> None:
        self._close_port()
        if problem != self._problem:
            log.warning("nmea0183: %s: %s; it is opened again when it can be", self._port, problem)
        self._problem = problem
        self._due_ns = self._now_ns() + self._wait_ns
        self._wait_ns = min(2 * self._wait_ns, RETRY_MOST_NS)

    def _close_port(self) -> None:
        fd, self._fd, self._rest = self._fd, None, b""
        if fd is not None:
            os.close(fd)


def _close_late(opening: "asyncio.Future[int]") -> None:
    """Close a port that was opened while the output was closed."""
    if not opening.cancelled() and opening.exception() is None:
        os.close(opening.result())


PA_PER_BAR: Final = 100_000.0
LEVEL_COS: Final = 0.1
"""Below this cosine of pitch (84°) heading and roll turn about nearly the same axis: there is no rate of turn."""


class Formatter(StrEnum):
    """Sentences by their formatters."""

    HDT = "HDT"
    HDG = "HDG"
    HDM = "HDM"
    ROT = "ROT"
    XDR = "XDR"
    PASHR = "PASHR"


TALKERS: Final[Mapping[Formatter, str]] = {
    Formatter.HDT: "HC",
    Formatter.HDG: "HC",
    Formatter.HDM: "HC",
    Formatter.ROT: "TI",
    Formatter.XDR: "YX",
    Formatter.PASHR: "",
}
"""HC: magnetic compass, also where its heading is corrected to a true one, TI: rate of turn, YX: transducer.

gpsd 3.22 knows HC and II as talkers of a heading, and neither HE nor HN, gyroscopic compasses. PASHR has no talker."""


@dataclass(frozen=True, slots=True)
class HeadingReference:
    """What the yaw of samples counts from."""

    heading: Heading = Heading.UNKNOWN
    declination_deg: float | None = None
    """What was added to a magnetic heading to make it a true one; None for nothing."""


def make(kind: Formatter, sample: Sample, reference: HeadingReference, talker: str = "") -> bytes | None:
    """The sentence of a sample whose axes and angles are those of `ned-frd`; None where the sample has not its values.

    `talker` takes the place of the one in TALKERS; empty keeps that.
    """
    return _MAKERS[kind](talker or TALKERS[kind], sample, reference)


def _hdt(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = _true_rad(sample, reference)
    return None if heading_rad is None else nmea0183.hdt(talker, heading_rad)


def _hdg(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = _magnetic_rad(sample, reference)
    declination_deg = reference.declination_deg
    variation_rad = None if declination_deg is None else math.radians(declination_deg)
    return None if heading_rad is None else nmea0183.hdg(talker, heading_rad, variation_rad)


def _hdm(talker: str, sample: Sample, reference: HeadingReference) -> bytes | None:
    heading_rad = _magnetic_rad(sample, reference)
    return None if heading_rad is None else nmea0183.hdm(talker, heading_rad)


def _rot(talker: str, sample: Sample, _reference: HeadingReference) -> bytes | None:
    rate_rad_s = turn_rate_rad_s(sample)
    return None if rate_rad_s is None else nmea0183.rot(talker, rate_rad_s)


def _xdr(talker: str, sample: Sample, _reference: HeadingReference) -> bytes | None:
    found = []
    roll_pitch = _roll_pitch_rad(sample)
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
    roll_pitch = _roll_pitch_rad(sample)
    if roll_pitch is None:
        return None
    return nmea0183.pashr(sample.utc_ns, _true_rad(sample, reference), *roll_pitch)


_MAKERS: Final[Mapping[Formatter, Callable[[str, Sample, HeadingReference], bytes | None]]] = {
    Formatter.HDT: _hdt,
    Formatter.HDG: _hdg,
    Formatter.HDM: _hdm,
    Formatter.ROT: _rot,
    Formatter.XDR: _xdr,
    Formatter.PASHR: _pashr,
}


def turn_rate_rad_s(sample: Sample) -> float | None:
    """Rate of change of the heading, positive to starboard; None without an angular rate, or with the bow straight up.

    With roll φ and pitch θ it is (q sin φ + r cos φ) / cos θ of the angular rates q about y and r about z, so that
    rolling and pitching do not show in it. Without an attitude the body is taken for level.
    """
    gyro = sample.gyro_rad_s
    if gyro is None or not all(map(math.isfinite, gyro)):
        return None
    roll_rad, pitch_rad = _roll_pitch_rad(sample) or (0.0, 0.0)
    if math.cos(pitch_rad) < LEVEL_COS:
        return None
    return (gyro[1] * math.sin(roll_rad) + gyro[2] * math.cos(roll_rad)) / math.cos(pitch_rad)


def _true_rad(sample: Sample, reference: HeadingReference) -> float | None:
    return _yaw_rad(sample.euler_rad) if reference.heading is Heading.TRUE else None


def _magnetic_rad(sample: Sample, reference: HeadingReference) -> float | None:
    yaw_rad = _yaw_rad(sample.euler_rad)
    if yaw_rad is None or reference.heading is Heading.MAGNETIC:
        return yaw_rad
    if reference.heading is Heading.TRUE and reference.declination_deg is not None:
        return yaw_rad - math.radians(reference.declination_deg)
    return None


def _yaw_rad(euler_rad: Vector3 | None) -> float | None:
    return euler_rad[2] if euler_rad is not None and math.isfinite(euler_rad[2]) else None


def _roll_pitch_rad(sample: Sample) -> tuple[float, float] | None:
    euler_rad = sample.euler_rad
    if euler_rad is None or not (math.isfinite(euler_rad[0]) and math.isfinite(euler_rad[1])):
        return None
    return euler_rad[0], euler_rad[1]


REFERENCE_NS: Final = NS_PER_S
"""What the heading counts from is looked up so often: a device says it when it was asked."""
WHO: Final = "nmea0183"
"""Who asks for a latency."""
BITS_PER_BYTE: Final = 10
"""8N1 on a serial line."""
USUAL_BYTES: Final = {
    Formatter.HDT: 19, Formatter.HDG: 27, Formatter.HDM: 19, Formatter.ROT: 22, Formatter.XDR: 82, Formatter.PASHR: 57,
}  # fmt: skip
"""Size of each sentence with all that it can have, for the load of a serial line."""
FormatterName = Literal["HDT", "HDG", "HDM", "ROT", "XDR", "PASHR"]
Talker = Annotated[str, msgspec.Meta(pattern="^([A-Z]{2})?$", extra={"words": "two capital letters, or nothing"})]
RateHz = Annotated[float, msgspec.Meta(ge=0.01, le=100)]


class Nmea0183Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the NMEA 0183 output."""

    enabled: bool = False
    """Whether sentences are sent."""
    device: str | None = None
    """Name of the device whose attitude is sent; null where there is only one."""
    sentences: dict[FormatterName, RateHz] = msgspec.field(
        default_factory=lambda: {"HDT": 10.0, "HDG": 10.0, "ROT": 10.0, "XDR": 2.0}
    )
    """Sentences and how many of each are sent in a second; those that are left out are not sent."""
    talker: Talker = ""
    """Talker of all sentences; empty: HC for headings, TI for ROT, YX for XDR."""
    tcp_address: Annotated[str, msgspec.Meta(min_length=1)] = "127.0.0.1"
    """IP address on which plotters connect; `0.0.0.0` is every network of this machine. There is no password."""
    tcp_port: Annotated[int, msgspec.Meta(ge=0, le=65535)] | None = 10110
    """TCP port; 0 takes any free one, null: there is no server."""
    udp: list[str] = msgspec.field(default_factory=list)
    """Where datagrams go, each as ADDRESS:PORT: a host, a multicast group, or a broadcast address such as
    `192.168.1.255:10110`."""
    serial_port: str | None = None
    """Serial port on which sentences are written; null for none."""
    serial_baud: Annotated[int, msgspec.Meta(ge=4800, le=921600)] = 38400
    """Its rate, bit/s; the standard has 4800 and 38400."""

    def __post_init__(self) -> None:
        """Raise ValueError for what is no address, and for sentences that the serial line cannot carry."""
        if not is_ip_address(self.tcp_address):
            raise ValueError(f"tcp_address: expected an IP address such as 127.0.0.1, got {shown(self.tcp_address)}")
        for text in self.udp:
            if address_of(text) is None:
                raise ValueError(f"udp: expected IP address and port such as 192.168.1.255:10110, got {shown(text)}")
        if not self.sentences:
            raise ValueError("sentences: expected one at least, got none")
        needed = sum(rate_hz * USUAL_BYTES[Formatter(name)] for name, rate_hz in self.sentences.items())
        room = self.serial_baud / BITS_PER_BYTE
        if self.serial_port is not None and needed > room:
            raise ValueError(
                f"sentences: expected what {self.serial_baud} bit/s can carry, {room:.0f} bytes a second, got "
                f"{needed:.0f}; lower their rates, or set serial_baud"
            )


def address_of(text: str) -> tuple[str, int] | None:
    """IP address and port of `192.168.1.255:10110` or `[fe80::1]:10110`; None for another text."""
    address, _, port = text.rpartition(":")
    if address.startswith("[") and address.endswith("]"):
        address = address[1:-1]
    elif ":" in address:
        return None
    if not is_ip_address(address) or not (port.isascii() and port.isdecimal()) or not 0 < int(port) < 1 << 16:
        return None
    return address, int(port)


class Nmea0183:
    """Sends the sentences of one device. Synchronization: the event loop's thread only."""

    def __init__(self, settings: Nmea0183Options, context: PublisherContext) -> None:
        self._settings = settings
        self._context = context
        self._paces: Mapping[Formatter, Pace] = {
            Formatter(name): Pace(rate) for name, rate in settings.sentences.items()
        }
        self._outputs: list[SentenceOutput] = []
        self._names: dict[str, None] = {}
        self._device: str | None = None
        self._reference = HeadingReference()
        self._looked_ns = self._newest_ns = 0
        self._rate = MeanRate()
        self._warned = ""

    def start(self) -> None:
        """Open the ways out. Raises ServerError when the TCP port cannot be had."""
        settings, now_ns = self._settings, self._context.clock.now_ns
        if settings.tcp_port is not None:
            server = TcpOutput(settings.tcp_address, settings.tcp_port, now_ns)
            server.open()
            self._outputs.append(server)
            log.info("NMEA 0183 at %s port %d", settings.tcp_address, server.port)
        self._outputs += [UdpOutput(*found) for text in settings.udp if (found := address_of(text)) is not None]
        if settings.serial_port is not None:
            self._outputs.append(SerialOutput(settings.serial_port, settings.serial_baud, now_ns))
        self._context.outputs.sentences.append(self.status)

    def add_device(self, name: str, device_id: int) -> None:
        """Note the device; it is the one whose attitude is sent if it is named, or the only one."""
        self._names[name] = None
        self._choose()

    def remove_device(self, name: str) -> None:
        """Forget a device that left the configuration."""
        self._names.pop(name, None)
        self._choose()

    def publish(self, batch: Batch) -> None:
        """Send the sentences that are due."""
        if batch.device != self._device:
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
        rotation = batch.frame.rotation_to(Convention.NED_FRD)
        turned = newest if rotation is None else rotation.sample(newest)
        made = [make(kind, turned, self._reference, self._settings.talker) for kind in due]
        sentences = b"".join([one for one in made if one is not None])
        if sentences:
            for output in self._outputs:
                output.put(sentences)

    def event(self, event: Event) -> None:
        """No-op: there is no sentence for it."""

    def tick(self, now_ns: int) -> None:
        """Look after the ways out, and look up what the heading counts from."""
        for output in self._outputs:
            output.tick(now_ns)
        if self._device is not None and now_ns - self._looked_ns >= REFERENCE_NS:
            self._looked_ns = now_ns
            self._look_up(self._device)

    def close(self) -> None:
        """Close the ways out; may be called twice."""
        for output in self._outputs:
            output.close()
        self._outputs.clear()
        self._context.latencies.release(WHO)
        if self.status in self._context.outputs.sentences:
            self._context.outputs.sentences.remove(self.status)

    def status(self) -> list[OutputStatus]:
        """Return the state of every way out."""
        return [output.status() for output in self._outputs]

    def _choose(self) -> None:
        """Choose the device, and ask for the latency that the fastest sentence needs."""
        wanted = self._settings.device
        if wanted is None and len(self._names) == 1:
            (wanted,) = self._names
        device = wanted if wanted in self._names else None
        if device is None and self._names:
            self._warn(
                f"nmea0183.device: expected the name of one device ({', '.join(self._names)}), got "
                f"{wanted or 'none'}; nothing is sent"
            )
        if device == self._device:
            return
        self._device, self._looked_ns, self._reference = device, 0, HeadingReference()
        latencies = self._context.latencies
        if device is None:
            latencies.release(WHO)
        else:
            latencies.ask(WHO, round(NS_PER_S / max(self._settings.sentences.values())), (device,))

    def _look_up(self, device: str) -> None:
        """Look up what the heading of the device counts from."""
        found = next((status for status in self._context.devices.status() if status.name == device), None)
        if found is None or found.frame is None:
            return
        self._reference = HeadingReference(found.frame.heading, found.frame.declination_deg)

    def _warn(self, message: str) -> None:
        if message != self._warned:
            self._warned = message
            log.warning("%s", message)


PUBLISHER = PublisherType("nmea0183", Nmea0183Options, Nmea0183, required=False)
