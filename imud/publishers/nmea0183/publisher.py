"""The output of NMEA 0183: attitude and heading of one device as sentences, each at its own rate.

    batch ─▶ is a sentence due? ─▶ newest sample, mean angular rate ──as ned-frd──▶ sentences ─▶ TCP, UDP, serial port

The rate of turn is that of the angular rates averaged since the last such sentence, so that vibration above its rate
does not come back as a slow turn. All other values are those of the newest sample; without samples nothing is sent, so
that an instrument shows that its source is gone.
"""

import logging
from collections.abc import Mapping
from typing import Annotated, Final, Literal

import msgspec

from imud.contracts.publisher import Batch, PublisherContext, PublisherType
from imud.contracts.settings import Settings, is_ip_address, shown
from imud.contracts.status import OutputStatus
from imud.event import Event
from imud.frames.conventions import Convention
from imud.publishers.nmea0183.outputs import SentenceOutput, SerialOutput, TcpOutput, UdpOutput
from imud.publishers.nmea0183.sentences import Formatter, HeadingReference, make
from imud.publishers.thinning import MeanRate, Pace
from imud.units import NS_PER_S

log = logging.getLogger(__name__)

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


class Nmea0183Settings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the NMEA 0183 output."""

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

    def __init__(self, settings: Nmea0183Settings, context: PublisherContext) -> None:
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
        settings, now_ns = self._settings, self._context.now_ns
        if settings.tcp_port is not None:
            server = TcpOutput(settings.tcp_address, settings.tcp_port, now_ns)
            server.open()
            self._outputs.append(server)
            log.info("NMEA 0183 at %s port %d", settings.tcp_address, server.port)
        self._outputs += [UdpOutput(*found) for text in settings.udp if (found := address_of(text)) is not None]
        if settings.serial_port is not None:
            self._outputs.append(SerialOutput(settings.serial_port, settings.serial_baud, now_ns))
        self._context.output_sources.append(self.status)

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
        if self.status in self._context.output_sources:
            self._context.output_sources.remove(self.status)

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
        found = next((status for status in self._context.status() if status.name == device), None)
        if found is None or found.frame is None:
            return
        self._reference = HeadingReference(found.frame.heading, found.frame.declination_deg)

    def _warn(self, message: str) -> None:
        if message != self._warned:
            self._warned = message
            log.warning("%s", message)


PUBLISHER = PublisherType("nmea0183", Nmea0183Settings, Nmea0183, required=False)
