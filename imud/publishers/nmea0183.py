"""Output `nmea0183`: attitude and heading of one device as sentences, each with its own rate.

    batch ─▶ is a sentence due? ─▶ newest sample, mean angular rate ──as ned-frd──▶ sentences ─▶ TCP, UDP, serial port

The rate of turn is the mean angular rate since the previous ROT sentence. Without the mean, fast vibration would appear
as a slow turn. All other values are from the newest sample. If no sample arrives, the output does not send sentences.
The instrument then shows that its source is missing.
"""

import logging
import math
from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Annotated, Final, Literal

import msgspec

from imud.contracts.link import Claim
from imud.contracts.publisher import Batch, OutputListener, PublisherContext, PublisherType
from imud.contracts.status import OutputStatus
from imud.formats import nmea0183
from imud.formats.nmea0183 import Transducer
from imud.model.host_object import ListenAddress, SerialPort
from imud.model.options import Options, is_ip_address, shown
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget
from imud.publishers.sentence_ports import (
    PEER_LIMITS,
    SentenceOutput,
    SerialOutput,
    TcpOutput,
    UdpOutput,
)
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
    tcp_address: ListenAddress = "127.0.0.1"
    """IP address of the TCP server; `0.0.0.0`: all networks of the host. There is no password."""
    tcp_port: Annotated[int, msgspec.Meta(ge=0, le=65535)] | None = 10110
    """TCP port; 0: any free port, null: no TCP server."""
    udp: list[str] = msgspec.field(default_factory=list)
    """Destinations of UDP datagrams, each as ADDRESS:PORT: a host, a multicast group, or a broadcast address such as
    `192.168.1.255:10110`."""
    serial_port: SerialPort | None = None
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
            budget = WorkBudget(PEER_LIMITS, self._context.clock.cpu_ns)
            server = TcpOutput(settings.tcp_address, settings.tcp_port, now_ns, budget)
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


def _listeners(options: Nmea0183Options) -> list[OutputListener]:
    return [] if options.tcp_port is None else [OutputListener(("tcp_port",), options.tcp_address, options.tcp_port)]


PUBLISHER = PublisherType("nmea0183", Nmea0183Options, Nmea0183, claims=_claims, listeners=_listeners)
