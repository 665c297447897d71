"""Forsense IMU61x on I2C: a burst of 32 bytes with CRC. Manual "IMU61X Interface Protocol and Instructions", chapter 3.

    S addr W 0x12 | Sr addr R  accel x y z g | gyro x y z °/s | temperature °C, all f32 | CRC-32 u32 | P

Little-endian. The address is 0x18 as delivered, 0x18 to 0x1B by parameter 30 of the UART. There is no counter and no
time in a burst: one that repeats the bytes of the one before counts as the same measurement. Identity and filters,
which are also read at intervals, are in `session.py`.
"""

import struct
from collections.abc import Sequence
from math import isfinite
from typing import Final

from imud.contracts.codec import BadReason
from imud.contracts.polling import Poll, PolledEvent, Transfer, Vanished
from imud.devices.imu61x.common.family import M_S2_PER_G, RAD_S_PER_DEG_S, crc32
from imud.devices.imu61x.common.register_driver import CHECK_NS, RegisterSettings
from imud.devices.imu61x.common.registers import I2C_BURST
from imud.devices.imu61x.i2c.session import READ_FILTER, READ_ID, filter_problem, id_problem
from imud.devices.polled_frames import Measured, PolledFrameDecoder
from imud.ledger import Ledger
from imud.sample import Measurement, Vector3

FRAME: Final = struct.Struct("<7fI")
"""accel 3 g, gyro 3 °/s, temperature °C, CRC-32 of the 28 bytes before (table 27)."""
CRC_OFFSET: Final = 28

READ_BURST: Final = Transfer((bytes([I2C_BURST]),), FRAME.size)
_BURST, _ID, _FILTER = range(3)


class Imu61xI2cCodec:
    """Decoder of bursts. Synchronization: one thread."""

    polls: Sequence[Poll] = (Poll(READ_BURST), Poll(READ_ID, CHECK_NS), Poll(READ_FILTER, CHECK_NS))

    def __init__(self, ledger: Ledger, settings: RegisterSettings) -> None:
        self.ledger = ledger
        self._settings = settings
        self._frames = PolledFrameDecoder(ledger, FRAME.size)

    @property
    def stale(self) -> int:
        """Bursts that repeated the one before."""
        return self._frames.stale

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Decode the bytes of one transfer. Never raises."""
        if poll == _BURST:
            return self._frames.decode(data, _check, _measure)
        why = id_problem(data) if poll == _ID else filter_problem(data, self._settings)
        self._frames.add_reply(data, good=not why)
        return (Vanished(why),) if why else ()

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        """No-op: nothing follows from one failed transfer."""
        return ()

    def reset(self) -> None:
        """Forget the last burst: the next one is not compared with it."""
        self._frames.reset()


def _check(data: bytes) -> BadReason | None:
    return None if crc32(data[:CRC_OFFSET]) == FRAME.unpack(data)[7] else BadReason.CRC


def _measure(data: bytes) -> Measured:
    ax, ay, az, gx, gy, gz, temperature, _ = FRAME.unpack(data)
    g, rad = M_S2_PER_G, RAD_S_PER_DEG_S
    accel, gyro = isfinite(ax + ay + az), isfinite(gx + gy + gz)  # sums of floats of 32 bits do not overflow in 64
    measurement = Measurement(
        FRAME.size, 0, None,
        (ax * g, ay * g, az * g) if accel else None,
        (gx * rad, gy * rad, gz * rad) if gyro else None,
        temperature_c=temperature if isfinite(temperature) else None,
    )  # fmt: skip
    return measurement, accel and gyro and isfinite(temperature)


# --- the device's side ------------------------------------------------------------------------------------------------


def encode_burst(*, accel_m_s2: Vector3, gyro_rad_s: Vector3, temperature_c: float) -> bytes:
    """The 32 bytes of a burst from SI values. Raises OverflowError beyond f32."""
    g, rad = M_S2_PER_G, RAD_S_PER_DEG_S
    values = struct.pack("<7f", *(a / g for a in accel_m_s2), *(w / rad for w in gyro_rad_s), temperature_c)
    return values + struct.pack("<I", crc32(values))
