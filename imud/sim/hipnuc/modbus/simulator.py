"""HiPNUC modules on one RS-485 line at the far end of a serial port. IMU configuration manual V1.5.9, chapter 4.

Without I/O and without a clock of its own. What the line does as a real one does:

- Every byte takes its time on the wire, in both directions. A frame ends with a silence of 3.5 characters; a module
  answers `processing_ns` later. With `chunk_bytes` a reply arrives in pieces of so many bytes, each when it is through.
- Two modules with the same ID answer at the same time: what arrives is the AND of both, as on a line that either pulls.
- Requests to address 0 are obeyed by all and answered by none. A frame with a wrong CRC is not answered.
- A new ID is in force at once, a new baud rate too (assumed; the confirmation has the old one). What is not saved is
  lost at a restart.
"""

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from random import Random

from imud.devices.hipnuc.common.registers import BAUD_RATES, FACTORY_BAUD
from imud.devices.hipnuc.modbus.frames import FACTORY_ID
from imud.formats.modbus import BROADCAST, CRC_BYTES, SLAVES, frame_gap_ns, framed, is_whole
from imud.sim.hipnuc.modbus.slave import NEW_FIRMWARE, Slave, SlaveSettings
from imud.sim.physics.motion import MOTIONS
from imud.sim.physics.noise import Noise
from imud.sim.ports.uart_wire import heard
from imud.sim.simulator import Burst, Simulator, SimulatorOptions
from imud.units import uart_byte_ns


class ModbusLine:
    """The line and its modules, as a `StreamModule`: what it sends is what the host's port hears."""

    def __init__(
        self, now_ns: int, slaves: Sequence[Slave], *, echo: bool = False, chunk_bytes: int = 0, seed: int = 1
    ) -> None:
        """`echo`: the host's adapter hears what it sends. `chunk_bytes`: 0 for whole frames."""
        self.slaves = list(slaves)
        self.epoch_ns = now_ns
        self.echo, self.chunk_bytes = echo, chunk_bytes
        self.requests = self.damaged = 0
        self._baud = slaves[0].settings.baud if slaves else FACTORY_BAUD
        self._random = Random(seed)
        self._heard = b""
        self._heard_ns = now_ns
        self._free_ns = now_ns
        self._waiting: list[Burst] = []
        for slave in self.slaves:
            slave.since_ns = now_ns

    @property
    def baud(self) -> int:
        """Rate of most modules: the first one's. Those of another rate hear and say garbage."""
        return self._baud

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take bytes that the host sent."""
        self._finish(now_ns)
        begin_ns = max(now_ns, self._heard_ns)
        self._heard_ns = begin_ns + len(data) * uart_byte_ns(self.baud)
        self._heard += data
        if self.echo:
            self._send(data, begin_ns, None)

    def advance(self, now_ns: int) -> list[Burst]:
        """Return what has crossed the wire since the last call."""
        self._finish(now_ns)
        through = [burst for burst in self._waiting if burst.due_ns <= now_ns]
        del self._waiting[: len(through)]
        return through

    def next_ns(self) -> int | None:
        """When there is something next."""
        times = [self._waiting[0].due_ns] if self._waiting else []
        if self._heard:
            times.append(self._heard_ns + frame_gap_ns(self.baud))
        return min(times, default=None)

    def counters(self) -> dict[str, int]:
        """Requests heard whole, damaged ones, and those answered."""
        answered = sum(slave.answered for slave in self.slaves)
        return {"requests": self.requests, "damaged": self.damaged, "answered": answered}

    def mark(self, _now_ns: int) -> None:
        """These modules have no sync input."""

    def reboot(self, now_ns: int) -> None:
        """All modules lose power."""
        self._waiting, self._heard, self._free_ns = [], b"", now_ns
        for slave in self.slaves:
            slave.restart(now_ns)
        self._agree()

    def _agree(self) -> None:
        if self.slaves:
            self._baud = self.slaves[0].settings.baud

    def _finish(self, now_ns: int) -> None:
        """A frame has ended if the line was silent for long enough."""
        end_ns = self._heard_ns + frame_gap_ns(self.baud)
        if self._heard and now_ns >= end_ns:
            frame, self._heard = self._heard, b""
            self._take(frame, end_ns)

    def _take(self, frame: bytes, now_ns: int) -> None:
        replies: list[tuple[int, bytes]] = []
        is_good = False
        for slave in self.slaves:
            request = heard(frame, self.baud, slave.settings.baud)
            if not is_whole(request) or len(request) < 2 + CRC_BYTES:
                continue
            is_good = True
            if request[0] not in (BROADCAST, slave.settings.slave) or slave.dead:
                continue
            if slave.mute:
                slave.mute -= 1
                continue
            begin_ns = now_ns + slave.processing_ns
            address, baud = slave.settings.slave, slave.settings.baud
            reply = framed(address, slave.obey(request[1:-CRC_BYTES], begin_ns, self.epoch_ns, self._random))
            if request[0] != BROADCAST:
                replies.append((begin_ns, heard(self._spoilt(slave, reply), baud, self.baud)))
        self.requests += is_good
        self.damaged += not is_good
        if replies:
            begin_ns = max(begin_ns for begin_ns, _ in replies)
            self._send(_together(reply for _, reply in replies), begin_ns, begin_ns)
        self._agree()

    def _spoilt(self, slave: Slave, reply: bytes) -> bytes:
        slave.answered += 1
        if slave.bad_crc:
            slave.bad_crc -= 1
            return reply[:-1] + bytes([reply[-1] ^ 0x10])
        return reply

    def _send(self, data: bytes, ready_ns: int, sample_ns: int | None) -> None:
        byte_ns, begin_ns = uart_byte_ns(self.baud), max(ready_ns, self._free_ns)
        self._free_ns = begin_ns + len(data) * byte_ns
        step = self.chunk_bytes or len(data) or 1
        for at in range(0, len(data), step):
            end = min(at + step, len(data))
            last = end == len(data)
            self._waiting.append(Burst(begin_ns + end * byte_ns, data[at:end], sample_ns if last else None, 0))


def _together(replies: Iterable[bytes]) -> bytes:
    """What is heard when several send at once."""
    whole = b""
    for reply in replies:
        whole = bytes(a & b for a, b in zip_longest(whole or reply, reply, fillvalue=0xFF))
    return whole


def slaves_at(addresses: Iterable[int], options: SimulatorOptions) -> list[Slave]:
    """Modules with these addresses and consecutive serial numbers."""
    return [
        Slave(
            (0x047D_955F_8D2A_1700 + number).to_bytes(8, "big"),
            SlaveSettings(address, options.baud or FACTORY_BAUD),
            firmware=options.firmware or NEW_FIRMWARE,
            motion=MOTIONS[options.motion](options.gravity_m_s2),
            noise=Noise(options.seed + number) if options.noise == "real" else None,
            skew_ppm=options.skew_ppm,
        )
        for number, address in enumerate(addresses, 1)
    ]


def make(options: SimulatorOptions, now_ns: int) -> ModbusLine:
    """A line from the common options: `message` has the addresses of its modules, with commas. Raises ValueError."""
    if options.motion not in MOTIONS:
        raise ValueError(f"motion {options.motion!r}: expected {' or '.join(MOTIONS)}")
    if options.baud and options.baud not in BAUD_RATES:
        raise ValueError(f"baud {options.baud}: expected one of {', '.join(map(str, BAUD_RATES))}")
    words = options.message.split(",") if options.message else [str(FACTORY_ID)]
    if not all(word.isdecimal() and int(word) in SLAVES for word in words):
        raise ValueError(f"message {options.message!r}: expected addresses of modules, for example 1,2,3")
    return ModbusLine(now_ns, slaves_at(map(int, words), options), seed=options.seed)


SIMULATOR = Simulator("hipnuc-modbus", "HiPNUC HI14R2N on an RS-485 line (--message 1,2,3: their addresses)", make)
