"""Motion of one device as messages of NMEA 2000, each with its own rate.

    batch ─▶ is a message due? ─▶ newest sample, mean angular rate ──as ned-frd──▶ messages ─▶ node ─▶ CAN interface

All messages of one sample have the same SID. The rate of turn is the mean angular rate since the previous message. If
no sample arrives, the output sends no heading, rate of turn and attitude. It still sends the heartbeat.
"""

import hashlib
import math
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from imud import __version__
from imud.contracts.publisher import Batch, PublisherContext
from imud.contracts.status import OutputStatus
from imud.formats import nmea2000
from imud.formats.nmea2000 import ATTITUDE, HEADING, PRIORITIES, RATE_OF_TURN, SID_MOST, Reference
from imud.model.sample import Sample
from imud.model.units import NS_PER_S
from imud.publishers.nmea2000 import MessageName, Nmea2000Options
from imud.publishers.nmea2000.node import Node, NodeIdentity
from imud.publishers.nmea2000.port import NodePort
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

WHO: Final = "nmea2000"  # name of this output
PGNS: Final[Mapping[MessageName, int]] = {"heading": HEADING, "rate_of_turn": RATE_OF_TURN, "attitude": ATTITUDE}
MACHINE_ID: Final = Path("/etc/machine-id")  # identifier of the host (machine-id(5))


def unique_number(machine_id: Path = MACHINE_ID) -> int:
    """Return the unique number of the NAME: 21 bits of a hash of the host's identifier, or of its name without it.
    machine-id(5) asks programs to publish only a hash."""
    try:
        host = machine_id.read_bytes().strip()
    except OSError:
        host = b""
    digest = hashlib.sha256(b"imud nmea2000 " + (host or socket.gethostname().encode())).digest()
    return int.from_bytes(digest[:4], "little") % (1 << nmea2000.UNIQUE_BITS)


def pack(pgn: int, sid: int, sample: Sample, reference: HeadingReference) -> bytes:
    """Return the message of a sample in `ned-frd`. Unknown values are "not available".

    The heading is magnetic with the variation if both are known, otherwise the known heading. The yaw of 127257 is "not
    available", because the message has no reference for it.
    """
    if pgn == HEADING:
        return _heading(sid, sample, reference)
    if pgn == RATE_OF_TURN:
        return nmea2000.pack_rate_of_turn(sid, turn_rate_rad_s(sample))
    return nmea2000.pack_attitude(sid, *(roll_pitch_rad(sample) or (None, None)))


def _heading(sid: int, sample: Sample, reference: HeadingReference) -> bytes:
    magnetic, true = magnetic_rad(sample, reference), true_rad(sample, reference)
    if magnetic is not None:
        declination_deg = reference.declination_deg
        variation = None if declination_deg is None else math.radians(declination_deg)
        return nmea2000.pack_heading(sid, magnetic, Reference.MAGNETIC, variation)
    return nmea2000.pack_heading(sid, true, Reference.UNKNOWN if true is None else Reference.TRUE)


class Nmea2000:
    """Output of the messages of one device. Synchronization: the event loop's thread only."""

    def __init__(self, settings: Nmea2000Options, context: PublisherContext) -> None:
        self._settings, self._context = settings, context
        self._paces = {PGNS[name]: Pace(rate_hz) for name, rate_hz in settings.messages.items()}
        self._device = VesselDevice(WHO, settings.device, round(NS_PER_S / max(settings.messages.values())), context)
        first_address = context.kept.get(WHO, settings.address)
        self._node = node = Node(self._identity(), first_address, context.clock.cpu_ns)
        loopback = not settings.share_interface
        self._port = NodePort(node, settings.interface, context.clock.now_ns, loopback=loopback)
        self._newest_ns = 0
        self._rate = MeanRate()
        self._sid = 0

    def start(self) -> None:
        """Report the state. The first `tick` opens the interface."""
        self._context.outputs.ports[WHO] = self.status

    def add_device(self, name: str, device_id: int) -> None:
        """Add a device. The output uses the configured device, or the only device."""
        self._device.add(name)

    def remove_device(self, name: str) -> None:
        self._device.remove(name)

    event: Final = None  # no message describes an event

    def publish(self, batch: Batch) -> None:
        """Send the due messages with the values of the newest sample. Ignore the batches of other devices."""
        if batch.device != self._device.name:
            return
        if RATE_OF_TURN in self._paces:
            self._rate.add(batch.samples)
        newest = batch.samples[-1]
        t_ns = newest.t_ns
        step_ns, self._newest_ns = t_ns - self._newest_ns, t_ns
        due = [pgn for pgn, pace in self._paces.items() if t_ns >= pace.due_ns and pace.is_due(t_ns, step_ns)]
        if not due:
            return
        if RATE_OF_TURN in due:
            newest = msgspec.structs.replace(newest, gyro_rad_s=self._rate.take())
        sample = turned(batch, newest)
        now_ns, sid, reference = self._context.clock.now_ns(), self._sid, self._device.reference
        self._sid = (sid + 1) % (SID_MOST + 1)
        message = self._node.message
        self._port.put([message(pgn, PRIORITIES[pgn], pack(pgn, sid, sample, reference), now_ns) for pgn in due])

    def tick(self, now_ns: int) -> None:
        """Check the interface, send the heartbeat and read the heading reference."""
        self._port.tick(now_ns)
        self._device.tick(now_ns)
        if self._node.address(now_ns) is None:
            self._context.owner.tick_soon()  # the claim ends after 250 ms

    def close(self) -> None:
        """Close the interface and withdraw the latency request. A second call does nothing."""
        self._context.kept[WHO] = self._node.preferred
        self._port.close()
        self._device.close()
        self._context.outputs.ports.pop(WHO, None)

    def status(self) -> list[OutputStatus]:
        """Return the state of the interface."""
        return [self._port.status()]

    def _identity(self) -> NodeIdentity:
        unique, settings = unique_number(), self._settings
        return NodeIdentity(
            name=nmea2000.pack_name(unique, settings.instance),
            product=nmea2000.pack_product("imud", __version__, f"{unique:06X}"),
            configuration=nmea2000.pack_configuration(settings.device or "", "", "imud; not certified by NMEA"),
            sent=[PGNS[name] for name in settings.messages],
        )
