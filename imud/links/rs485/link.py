"""An RS-485 line with Modbus slaves, as one of its devices sees it. All devices of a line share its port and thread.

A transfer's bytes are function and data; the line adds address and CRC (`imud.formats.modbus`) and returns whole
replies.
"""

from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from imud.contracts.claims import Claim
from imud.contracts.link import LinkType
from imud.contracts.polling import Transfer
from imud.contracts.settings import Settings
from imud.contracts.status import KernelCounters, SerialLineCounters
from imud.errors import LinkError, LinkMissing
from imud.links.device_node import CABLE, PROC, DeviceNode
from imud.links.rs485.line import SHARED_PORTS, LineCounters, PortSetup, Rs485Line, SharedPorts
from imud.units import NS_PER_MS


class Rs485Settings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an RS-485 line. All but `address`, `rate_hz` and `reply_ms` must be the same for all its devices."""

    line: Annotated[str, Meta(min_length=1)]
    """Path of the port. Several devices may have the same one."""
    baud: Annotated[int, Meta(ge=300, le=4_000_000)] = 115200
    """Rate in bit/s of the line."""
    address: Annotated[int, Meta(ge=1, le=247)] | Literal["auto"] = "auto"
    """Modbus address, or `auto`: ask at every address. Give it where a line has more than one device."""
    rate_hz: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    """Rate of reads, per second; 0 for as often as the line allows, in turns with the other devices."""
    reply_ms: Annotated[int, Meta(ge=1, le=1000)] = 20
    """Longest delay of the device before it answers. Time on the wire is added."""
    direction: Literal["auto", "kernel", "none"] = "auto"
    """Control of the direction: `kernel` by its driver (RTS), `none` by the adapter, `auto` by the driver if
    it can."""
    echo: Literal["auto"] | bool = "auto"
    """Whether the adapter receives what it sends; `auto` detects it."""


class Rs485Link:
    """A `PolledLink` on a serial port that others may share."""

    def __init__(
        self,
        settings: Rs485Settings,
        *,
        ports: SharedPorts = SHARED_PORTS,
        sys: Path = Path("/sys"),
        proc: Path = PROC,
    ) -> None:
        self._settings = settings
        self._ports, self._sys, self._proc = ports, sys, proc
        self._line: Rs485Line | None = None
        self._node = DeviceNode(settings.line, CABLE)
        self._address = 0
        self._reply_ns = settings.reply_ms * NS_PER_MS
        self.title = settings.line
        self.writable = True
        self.bus = settings.line
        self.target: int | None = None if settings.address == "auto" else settings.address
        self.shared = True
        self.rate_hz = settings.rate_hz
        self.bit_rate = settings.baud

    @property
    def heard(self) -> LineCounters:
        """Bytes other than replies, received on the line since it was opened."""
        return self._line.counters if self._line else LineCounters()

    def absence(self) -> str:
        """Return why the port cannot be opened now; empty when it is there."""
        return self._node.absence()

    async def wait_present(self) -> None:
        """Return when the port is there."""
        await self._node.wait_present()

    def open(self) -> None:
        """Open the port exclusively, or share it. Raises LinkMissing, LinkDenied, LinkBusy, LinkError."""
        self._line = self._ports.share(_setup(self._settings), self._sys, self._proc)

    def select(self, target: int) -> None:
        """Address the next transfers; 0 is a broadcast, which has no reply."""
        self._address = target

    def place(self, target: int) -> str:
        """An address in messages, as the vendor's documents and programs write it."""
        return f"address {target}"

    def transfer(self, transfer: Transfer) -> bytes:
        """Return the whole reply to a request, an exception or a damaged reply. Raises TransferError, LinkError."""
        line, (request,) = self._line, transfer.sends
        if line is None:
            raise LinkError(f"{self.title} is not open")
        try:
            reply_ns = max(self._reply_ns, transfer.reply_ms * NS_PER_MS)
            return line.transfer(self._address, request, transfer.read_bytes, reply_ns)
        except LinkMissing:
            self._ports.discard(line)
            raise

    def write(self, data: bytes) -> None:
        """Raises LinkError: bytes are sent in transfers only."""
        raise LinkError(f"{self.title} cannot send {len(data)} bytes outside of a transfer")

    def kernel_counters(self) -> KernelCounters:
        """Errors the kernel counted on the line since it was opened."""
        return self._line.counted.read() if self._line else KernelCounters()

    def serial_line(self) -> SerialLineCounters:
        """Bytes other than replies, received on the line since it was opened, for any of its devices."""
        heard = self.heard
        return SerialLineCounters(heard.timeouts, heard.late, heard.strange, heard.echoed)

    def close(self) -> None:
        """Leave the line, whose last user closes the port; may be called twice."""
        line, self._line = self._line, None
        if line is not None:
            self._ports.release(line)


def _claims(settings: Rs485Settings) -> list[Claim]:
    address = None if settings.address == "auto" else settings.address
    terms = _setup(settings).terms
    return [Claim(place=settings.line, key="line", shared=True, part=address, part_key="address", terms=terms)]


def _setup(settings: Rs485Settings) -> PortSetup:
    return PortSetup(settings.line, settings.baud, settings.direction, settings.echo)


LINK = LinkType("rs485", Rs485Settings, make_polled=Rs485Link, claims=_claims, bus_of=lambda settings: settings.line)
