"""Forsense IMU61x on I2C: a burst of 32 bytes with CRC. Manual "IMU61X Interface Protocol and Instructions", chapter 3.

    S addr W 0x12 | Sr addr R  accel x y z g | gyro x y z °/s | temperature °C, all f32 | CRC-32 u32 | P
    S addr W 0x06 | Sr addr R  FILTER_CTRL          S addr W 0x06 value P
    S addr W 0x6A | Sr addr R  PROD_ID, 8 bytes

Little-endian. The address is 0x18 as delivered, 0x18 to 0x1B by parameter 30 of the UART. There is no counter and no
time in a burst: one that repeats the bytes of the one before is taken for the same measurement.
"""

import struct
from collections.abc import Mapping, Sequence
from math import isfinite
from random import Random
from typing import Final

from imud.contracts.codec import BadReason
from imud.contracts.driver import Identity
from imud.contracts.polling import Poll, PolledDriver, PolledEvent, Transfer, TransferScript, Vanished
from imud.devices.imu61x.common.family import (
    EULER_CONVENTION,
    I2C_ADDRESSES,
    M_S2_PER_G,
    NAVIGATION_FRAME,
    PRODUCT_ID_HEAD,
    RAD_S_PER_DEG_S,
    crc32,
    product_of,
)
from imud.devices.imu61x.common.register_actions import filter_actions
from imud.devices.imu61x.common.registers import (
    FILTER_CTRL,
    I2C_BURST,
    PROD_ID,
    RegisterSettings,
    check_filter,
    filter_words,
    identity_of,
    update_ns,
    wanted_filter,
)
from imud.devices.polled_frames import Measured, PolledFrameDecoder
from imud.ledger import Ledger
from imud.sample import Measurement, Vector3
from imud.units import NS_PER_S

FRAME: Final = struct.Struct("<7fI")
"""accel 3 g, gyro 3 °/s, temperature °C, CRC-32 of the 28 bytes before (table 27)."""
CRC_OFFSET: Final = 28
CHECK_NS: Final = 10 * NS_PER_S
"""How often product id and filter are read again: a device that restarted by itself has lost what was not saved."""

READ_BURST: Final = Transfer((bytes([I2C_BURST]),), FRAME.size)
READ_FILTER: Final = Transfer((bytes([FILTER_CTRL]),), 1)
READ_ID: Final = Transfer((bytes([PROD_ID]),), len(PRODUCT_ID_HEAD) + 1)
_BURST, _ID, _FILTER = range(3)


def write_filter(control: int) -> Transfer:
    """Write FILTER_CTRL (figure 8)."""
    return Transfer((bytes([FILTER_CTRL, control]),))


def probe(_settings: RegisterSettings) -> TransferScript[Identity]:
    """PROD_ID. Raises DeviceRefused for anything but an IMU61x."""
    return identity_of((yield READ_ID))


def set_up(settings: RegisterSettings) -> TransferScript[Mapping[str, str]]:
    """Write FILTER_CTRL where it differs, read it back. Raises DeviceRefused if it did not take."""
    present = _only((yield READ_FILTER))
    wanted = wanted_filter(settings, present)
    if present != wanted:
        yield write_filter(wanted)
        check_filter(wanted, _only((yield READ_FILTER)))
    return filter_words(wanted)


def _only(data: bytes) -> int:
    return data[0] if data else 0


class Imu61xI2cCodec:
    """Measurements out of bursts. Synchronization: one thread."""

    polls: Sequence[Poll] = (Poll(READ_BURST), Poll(READ_ID, CHECK_NS), Poll(READ_FILTER, CHECK_NS))

    def __init__(self, ledger: Ledger, settings: RegisterSettings) -> None:
        self.ledger = ledger
        self._settings = settings
        self._book = PolledFrameDecoder(ledger, FRAME.size)

    @property
    def stale(self) -> int:
        """Bursts that repeated the one before."""
        return self._book.stale

    def take(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Take the bytes of one transfer. Never raises."""
        if poll == _BURST:
            return self._book.take(data, _check, _measure)
        wanted = wanted_filter(self._settings, _only(data))
        if poll == _ID:
            good = product_of(data) is not None
            why = f"wrong product id {data.hex(' ')}"
        else:
            good = poll == _FILTER and len(data) == 1 and data[0] == wanted
            why = f"FILTER_CTRL is {data.hex()}, was set to {wanted:#04x}: the device restarted"
        self._book.book_reply(data, good=good)
        return () if good else (Vanished(why),)

    def reset(self) -> None:
        """The next burst is not compared with an earlier one."""
        self._book.reset()


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


def _example_reading(random: Random) -> bytes:
    """A burst with random values."""

    def three(spread: float) -> Vector3:
        return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))

    return encode_burst(accel_m_s2=three(9.8), gyro_rad_s=three(2), temperature_c=random.uniform(-40, 85))


DRIVER: Final = PolledDriver(
    name="imu61x-i2c",
    title="Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B (I2C)",
    settings=RegisterSettings,
    euler_convention=EULER_CONVENTION,
    navigation_frame=NAVIGATION_FRAME,
    lines=frozenset({"reset", "data_ready"}),
    link="i2c",
    targets=I2C_ADDRESSES,
    probe=probe,
    set_up=set_up,
    make_codec=Imu61xI2cCodec,
    update_ns=update_ns,
    example_reading=_example_reading,
    actions=filter_actions(set_up),
)
