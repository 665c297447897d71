"""The device of the measurements: an HI91 device at 1 kHz.

The first minute is cheap: most frames are lost, so the fit gets old with few frames. Frames, arrival times and their
small delays are the same in every run.
"""

import struct
from typing import Final, NamedTuple

from imud.drivers.hipnuc.uart.codec import encode_frame, encode_hi91
from imud.model.units import NS_PER_MS, uart_byte_ns
from tests.bench.instructions.virtual_time import BEGIN_NS

BAUD: Final = 921600
PAIRS: Final = 350
"""Number of pairs of frames in the first minute. Two adjacent frames let the clock keep the period of 1 ms."""
PAIR_STEP_MS: Final = 200
"""Time between two pairs, ms. After 64 s, the bins of the fit are 1 s wide, and the clock rarely computes a new fit."""
SETTLE_READS: Final = 300
"""Number of reads after a gap, more than the 256 samples that the clock checks closely after a gap."""
PPM: Final = 40  # rate error of the device's crystal
DELAY_NS: Final = (20_000, 90_000, 35_000, 150_000, 60_000, 25_000, 110_000)  # delays of arrivals, repeated
HEADER_BYTES: Final = 6
TIME_AT: Final = 8  # offset of the device time in an HI91 payload (u32, ms)
HI91: Final = encode_hi91(
    system_time_ms=0, accel_m_s2=(0.1226, -0.4903, 9.787), gyro_rad_s=(0.00175, -0.0035, 0.0052),
    mag_t=(2.13e-5, -3.4e-6, -4.27e-5), euler_rad=(0.0123, -0.0235, 0.7854),
    quat_wxyz=(0.9239, 0.0012, -0.0034, 0.3827), temperature_c=31, pressure_pa=101_325.25,
)  # fmt: skip


class Read(NamedTuple):
    data: bytes
    t_rx_ns: int


def hi91(time_ms: int) -> bytes:
    payload = bytearray(HI91[HEADER_BYTES:])
    struct.pack_into("<I", payload, TIME_AT, time_ms)
    return encode_frame(bytes(payload))


def arrival_ns(time_ms: int, number: int) -> int:
    true_ns = time_ms * NS_PER_MS + time_ms * PPM
    return BEGIN_NS + true_ns + len(HI91) * uart_byte_ns(BAUD) + DELAY_NS[number % len(DELAY_NS)]


class Module:
    def __init__(self) -> None:
        self._time_ms = 1000

    def first_minute(self) -> list[Read]:
        """Return reads until the fit is old and the clock has finished its checks after the gaps."""
        found = self.reads(SETTLE_READS)
        for _ in range(PAIRS):
            self.skip(PAIR_STEP_MS)
            found += self.reads(2)
        return found + self.reads(SETTLE_READS)

    def skip(self, duration_ms: int) -> None:
        self._time_ms += duration_ms

    def reads(self, count: int, frames: int = 1) -> list[Read]:
        found = []
        for number in range(count):
            times = range(self._time_ms + 1, self._time_ms + frames + 1)
            self._time_ms += frames
            found.append(Read(b"".join(map(hi91, times)), arrival_ns(self._time_ms, number)))
        return found
