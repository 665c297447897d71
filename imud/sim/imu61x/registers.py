"""A Forsense IMU61x on SPI or I2C: windows, pipeline of SPI, latched values, and faults on request.

Manual "IMU61X Interface Protocol and Instructions", chapters 2 and 3. The simulator contains no I/O: its owner passes
the bytes of one transaction and gets the bytes of the device.

- The device updates its registers every `update_ns`. A transaction reads the values of its start (latched).
- SPI: the reply to a word is the second word after it, also across selections. A burst lasts as long as its selection.
  In an unsupported SPI mode, the device samples each bit one bit late.
- A restart resets window, filter and kind of burst (assumption: only a command of the UART saves them).
"""

import errno
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

from imud.attitude.rotation import euler_zyx_from_quat
from imud.drivers.imu61x import i2c, registers, spi
from imud.drivers.imu61x.common import FILTER_DEFAULT, product_id_of
from imud.drivers.imu61x.spi import PIPELINE_BYTES, PIPELINE_WORDS, write
from imud.model.units import NS_PER_MS, NS_PER_S, STANDARD_GRAVITY_M_S2
from imud.sim.imu61x.uart import RegisterBehaviour
from imud.sim.physics import Motion, Truth, swing

UPDATE_NS: Final = NS_PER_MS  # time between two updates of the registers, ns (assumption)
_WINDOW_0, _WINDOW_1 = 0, 1


@dataclass(slots=True)
class RegisterFaults:
    """Faults of the device or its wires. Tests can change them at any time."""

    # Error number of each transaction: ENXIO for a missing acknowledgement, ETIMEDOUT for a blocked bus; 0: no error.
    error: int = 0
    line: int | None = None  # value of all read bytes: 0xFF or 0x00 for a data line without a driver; None for no fault
    flips: int = 0  # number of next transactions with one wrong bit
    frozen: bool = False  # True: the device does not update its registers
    ignores_writes: bool = False  # True: writes of settings have no effect
    product_id: bytes = b""  # product ID of another device at this place; empty for this device


class Imu61xRegisters:
    """A simulated device. Synchronization: one thread."""

    def __init__(
        self,
        now_ns: Callable[[], int],
        *,
        motion: Motion | None = None,
        product: str = "IMU614",
        modes: frozenset[int] = frozenset({0, 3}),
        update_ns: int = UPDATE_NS,
        behaviour: RegisterBehaviour | None = None,
        seed: int = 1,
    ) -> None:
        """`now_ns` returns CLOCK_MONOTONIC. `modes` are the supported SPI modes."""
        self.faults = RegisterFaults()
        self.behaviour = behaviour or RegisterBehaviour()
        # Zero of the motion, ns: the truth at an instant is `motion.at((instant - epoch_ns) / 1e9)`.
        self.epoch_ns = now_ns()
        self.motion = motion or swing(STANDARD_GRAVITY_M_S2)
        self.transactions = 0
        self.filter = FILTER_DEFAULT
        self.extended = 0
        self.window = _WINDOW_0
        self.latched_ns = self.epoch_ns  # time of the measurement that the newest transaction read, ns
        self._now_ns = now_ns
        self._product_id = product_id_of(product)
        self._modes = modes
        self._update_ns = update_ns
        self._random = Random(seed)
        self._pointer = 0
        self._pipeline = deque((0, 0), maxlen=PIPELINE_WORDS)
        self._truth = self.motion.at(0.0)

    def restart(self) -> None:
        self.filter, self.extended, self.window = FILTER_DEFAULT, 0, _WINDOW_0
        self._pipeline.extend((0, 0))

    def truth_at(self, instant_ns: int) -> Truth:
        """Return the measurement of an ideal sensor at `instant_ns` (CLOCK_MONOTONIC)."""
        return self.motion.at((instant_ns - self.epoch_ns) / NS_PER_S)

    # --- SPI ---------------------------------------------------------------------------------------------------------

    def spi(self, selections: Sequence[bytes], mode: int = 0) -> list[bytes]:
        """Return the MISO bytes for the MOSI bytes of each active chip select. Raises OSError by `faults.error`."""
        self._begin()
        answers = [self._selection(selection) for selection in selections]
        if mode not in self._modes:
            answers = [_one_bit_late(answer) for answer in answers]
        return self._on_the_wire(answers)

    def _selection(self, mosi: bytes) -> bytes:
        burst: deque[int] = deque()
        miso = bytearray()
        for at in range(0, len(mosi) - 1, 2):
            word = int.from_bytes(mosi[at : at + 2], "big")
            miso += self._pipeline[0].to_bytes(2, "big")
            if word == write(registers.BURST, 0) and self.window == _WINDOW_0:
                burst = deque(self._burst_words())
            self._pipeline.append(burst.popleft() if burst and word in (0x8000, 0x0000) else self._answer(word))
        return bytes(miso)

    def _burst_words(self) -> list[int]:
        truth = self._truth
        if self.extended:
            data = spi.encode_extended(
                accel_m_s2=truth.accel_m_s2, gyro_rad_s=truth.gyro_rad_s, temperature_c=truth.temperature_c,
                euler_rad=euler_zyx_from_quat(truth.quat_wxyz),
            )  # fmt: skip
        else:
            data = spi.encode_standard(accel_m_s2=truth.accel_m_s2, gyro_rad_s=truth.gyro_rad_s)
        return [int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2)]

    def _answer(self, word: int) -> int:
        """Process a word. Return the word of its reply."""
        address = word >> 8 & 0x7F
        if word & 0x8000:
            self._write(address, word & 0xFF)
            return 0
        if address == registers.WIN_CTRL:
            return self.window | self.behaviour.window_bits
        return self._configuration(address) if self.window == _WINDOW_1 else self._value(address)

    def _write(self, address: int, value: int) -> None:
        if self.faults.ignores_writes and address != registers.WIN_CTRL:
            return
        if address == registers.WIN_CTRL:
            self.window = value & 1
        elif self.window == _WINDOW_1 and address == registers.FILTER_CTRL:
            self.filter = value
        elif self.window == _WINDOW_1 and address == registers.BURST_CTRL + 1:
            self.extended = value & 1

    def _configuration(self, address: int) -> int:
        if address == registers.FILTER_CTRL:
            return self.filter
        if address in (registers.BURST_CTRL, registers.BURST_CTRL + 1):
            return self.behaviour.burst_ctrl(address, self.extended)
        at = address - registers.PROD_ID
        return int.from_bytes(self.product_id[at : at + 2], "big") if 0 <= at < 8 and not at % 2 else 0

    def _value(self, address: int) -> int:
        """Return one half of a value in window 0, high word first."""
        index, low = divmod((address - registers.TEMP_HIGH) // 2, 2)
        truth = self._truth
        values = (
            registers.temperature_counts(truth.temperature_c),
            *(round(w / registers.RAD_S_PER_COUNT) for w in truth.gyro_rad_s),
            *(round(a / registers.M_S2_PER_COUNT_REGISTER) for a in truth.accel_m_s2),
        )
        if not 0 <= index < len(values) or address % 2:
            return 0
        return values[index] >> (0 if low else 16) & 0xFFFF

    # --- I2C ---------------------------------------------------------------------------------------------------------

    def i2c(self, parts: Sequence[bytes | int]) -> bytes:
        """Make a transaction between start and stop. `parts` are written bytes or numbers of bytes to read. Return all
        read bytes.

        Raises OSError by `faults.error`.
        """
        self._begin()
        return self._on_the_wire([self._read(part) for part in parts if not self._written(part)])[0]

    def _written(self, part: bytes | int) -> bool:
        if isinstance(part, int):
            return False
        if part:
            self._pointer = part[0]
        if part[1:] and self._pointer == registers.FILTER_CTRL and not self.faults.ignores_writes:
            self.filter = part[1]
        return True

    def _read(self, part: bytes | int) -> bytes:
        truth = self._truth
        burst = i2c.encode_burst(
            accel_m_s2=truth.accel_m_s2, gyro_rad_s=truth.gyro_rad_s, temperature_c=truth.temperature_c
        )
        contents = {
            registers.I2C_BURST: burst,
            registers.FILTER_CTRL: bytes([self.filter]),
            registers.PROD_ID: self.product_id,
        }
        size = part if isinstance(part, int) else 0
        return contents.get(self._pointer, b"")[:size].ljust(size, b"\x00")

    # --- both --------------------------------------------------------------------------------------------------------

    @property
    def product_id(self) -> bytes:
        """Return the eight bytes of PROD_ID."""
        return self.faults.product_id or self._product_id

    def _begin(self) -> None:
        """Latch the registers at the start of a transaction."""
        self.transactions += 1
        if self.faults.error:
            raise OSError(self.faults.error, errno.errorcode.get(self.faults.error, "?"))
        if not self.faults.frozen:
            elapsed_ns = self._now_ns() - self.epoch_ns
            self.latched_ns = self.epoch_ns + elapsed_ns // self._update_ns * self._update_ns
            self._truth = self.truth_at(self.latched_ns)

    def _on_the_wire(self, answers: list[bytes]) -> list[bytes]:
        faults = self.faults
        if faults.line is not None:
            return [bytes([faults.line]) * len(answer) for answer in answers] or [b""]
        if faults.flips and any(answers):
            faults.flips -= 1
            longest = max(range(len(answers)), key=lambda n: len(answers[n]))
            answers[longest] = self._flipped(answers[longest])
        return answers or [b""]

    def _flipped(self, data: bytes) -> bytes:
        """Invert one bit, but not in words of the SPI pipeline without a reply."""
        first = PIPELINE_BYTES if len(data) > PIPELINE_BYTES else 0
        at = self._random.randrange(first, len(data))
        return data[:at] + bytes([data[at] ^ 1 << self._random.randrange(8)]) + data[at + 1 :]


def _one_bit_late(data: bytes) -> bytes:
    """Return the bits as sampled at the wrong edge."""
    return (int.from_bytes(data, "big") >> 1).to_bytes(len(data), "big")
