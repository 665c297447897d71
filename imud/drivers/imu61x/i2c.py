"""Forsense IMU61x on I2C: a burst of 32 bytes with CRC. Manual "IMU61X Interface Protocol and Instructions", chapter 3.

    S addr W 0x12 | Sr addr R  accel x y z g | gyro x y z °/s | temperature °C, all f32 | CRC-32 u32 | P

Little-endian. The factory address is 0x18; parameter 30 of the UART sets 0x18 to 0x1B. A burst has no counter and no
time: a burst with the bytes of the previous burst counts as the same measurement. imud also reads identity and filters
periodically.
"""

import struct
from collections.abc import Collection, Sequence
from random import Random
from typing import Any, ClassVar, Final

from imud.contracts.codec import BadReason, Poll, PolledEvent, Vanished
from imud.contracts.command import Target
from imud.contracts.driver import Identity, random_vector
from imud.contracts.script import Transfer, TransferScript
from imud.contracts.setting import Reports, SettingsTable
from imud.drivers.imu61x.common import (
    I2C_ADDRESSES,
    M_S2_PER_G,
    PRODUCT_ID_HEAD,
    RAD_S_PER_DEG_S,
    crc32,
    product_of,
)
from imud.drivers.imu61x.registers import (
    CHECK_NS,
    FILTER_CTRL,
    I2C_BURST,
    PROD_ID,
    FilterControl,
    RegisterOptions,
    check_filter,
    check_settings,
    filter_settings,
    identity_of,
    register_driver,
    report_of,
    wanted_filter,
)
from imud.drivers.polled_frames import Measured, PolledFrameDecoder
from imud.drivers.state import DAEMON, OPTIONS
from imud.drivers.value_limits import ACCEL_LIMIT_G, GYRO_LIMIT_DEG_S, possible_temperature_c, scaled
from imud.formats.state import Field, StateTable
from imud.model.ledger import Ledger
from imud.model.sample import Measurement, Vector3
from imud.model.units import NS_PER_S

READ_FILTER: Final = Transfer((bytes([FILTER_CTRL]),), 1)
READ_ID: Final = Transfer((bytes([PROD_ID]),), len(PRODUCT_ID_HEAD) + 1)


def write_filter(control: int) -> Transfer:
    """Return the transfer that writes FILTER_CTRL (figure 8)."""
    return Transfer((bytes([FILTER_CTRL, control]),))


def probe(_settings: RegisterOptions) -> TransferScript[Identity]:
    """Read PROD_ID. Raises DeviceRefused for another device."""
    return identity_of((yield READ_ID))


def set_up(settings: RegisterOptions) -> TransferScript[Reports]:
    """Write FILTER_CTRL if it differs and read it back. Raises DeviceRefused if it still differs."""
    present = yield from read_control()
    wanted = wanted_filter(settings, present)
    if present != wanted:
        yield from write_control(wanted)
    return report_of(wanted)


def read_control() -> TransferScript[int]:
    return _only((yield READ_FILTER))


def write_control(control: int) -> TransferScript[None]:
    """Write FILTER_CTRL and read it back. Raises DeviceRefused if it differs."""
    yield write_filter(control)
    check_filter(control, (yield from read_control()))


def id_problem(data: bytes) -> str:
    """Return the error of a PROD_ID; empty if there is none."""
    return "" if product_of(data) is not None else f"wrong product id {data.hex(' ')}"


def filter_problem(data: bytes, settings: RegisterOptions) -> str:
    """Return the difference of a FILTER_CTRL from the options; empty if there is none."""
    wanted = wanted_filter(settings, _only(data))
    if data == bytes([wanted]):
        return ""
    return f"the device restarted: expected FILTER_CTRL {wanted:#04x}, got {data.hex()}"


def _only(data: bytes) -> int:
    return data[0] if data else 0


FRAME: Final = struct.Struct("<7fI")  # accel 3 g, gyro 3 °/s, temperature °C, CRC-32 of the 28 bytes before (table 27)
CRC_OFFSET: Final = 28

READ_BURST: Final = Transfer((bytes([I2C_BURST]),), FRAME.size)
_BURST, _ID, _FILTER = range(3)


class Imu61xI2cCodec:
    """Decoder of bursts. Synchronization: one thread."""

    polls: Sequence[Poll] = (Poll(READ_BURST), Poll(READ_ID, CHECK_NS), Poll(READ_FILTER, CHECK_NS))
    STATE: ClassVar = StateTable(
        (Field(1, "_frames", PolledFrameDecoder.STATE),), {"ledger": DAEMON, "_settings": OPTIONS}
    )

    def __init__(self, ledger: Ledger, settings: RegisterOptions) -> None:
        self.ledger = ledger
        self._settings = settings
        self._frames = PolledFrameDecoder(ledger, FRAME.size)

    @property
    def stale(self) -> int:
        """Number of bursts with the same bytes as the previous burst."""
        return self._frames.stale

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Decode the bytes of one transfer. Never raises an exception."""
        if poll == _BURST:
            return self._frames.decode(data, _check, _measure)
        why = id_problem(data) if poll == _ID else filter_problem(data, self._settings)
        self._frames.add_reply(data, good=not why)
        return (Vanished(why),) if why else ()

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        """Do nothing: a failed transfer has no further effect."""
        return ()

    def reset(self) -> None:
        """Forget the previous burst."""
        self._frames.reset()


def _check(data: bytes) -> BadReason | None:
    return None if crc32(data[:CRC_OFFSET]) == FRAME.unpack(data)[7] else BadReason.CRC


def _measure(data: bytes) -> Measured:
    *values, temperature_c, _ = FRAME.unpack(data)
    accel = scaled(values[:3], M_S2_PER_G, ACCEL_LIMIT_G)
    gyro = scaled(values[3:], RAD_S_PER_DEG_S, GYRO_LIMIT_DEG_S)
    temperature = possible_temperature_c(temperature_c)
    measurement = Measurement(FRAME.size, 0, None, accel, gyro, temperature_c=temperature)
    return measurement, None not in (accel, gyro, temperature)


# --- encoder for simulated devices ------------------------------------------------------------------------------


def encode_burst(*, accel_m_s2: Vector3, gyro_rad_s: Vector3, temperature_c: float) -> bytes:
    """Return the 32 bytes of a burst from SI values. Raises OverflowError beyond f32."""
    g, rad = M_S2_PER_G, RAD_S_PER_DEG_S
    values = struct.pack("<7f", *(a / g for a in accel_m_s2), *(w / rad for w in gyro_rad_s), temperature_c)
    return values + struct.pack("<I", crc32(values))


def _read(_target: Target, _names: Collection[str] | None) -> TransferScript[Reports]:
    return report_of((yield from read_control()))


# Settings that a restart of the device resets to parameter 31 of its UART
SETTINGS: Final = SettingsTable(
    table=filter_settings(FilterControl(read_control, write_control)), read=_read, check=check_settings
)


def _example_reading(random: Random) -> bytes:
    accel_m_s2, gyro_rad_s = random_vector(random, 9.8), random_vector(random, 2)
    return encode_burst(accel_m_s2=accel_m_s2, gyro_rad_s=gyro_rad_s, temperature_c=random.uniform(-40, 85))


BUS_HZ: Final = 400_000  # Maximum clock of table 25, Hz. The operating system sets the actual clock.
BITS_PER_BYTE: Final = 9  # eight bits and the acknowledgement
OVERHEAD_BITS: Final = 2 * BITS_PER_BYTE + 3  # two addresses, start, repeated start and stop


def _read_ns(_options: RegisterOptions, _link: Any) -> int:
    # 318 bits, 795 µs at 400 kHz
    (register,) = READ_BURST.sends
    bits = OVERHEAD_BITS + (len(register) + READ_BURST.read_bytes) * BITS_PER_BYTE
    return bits * NS_PER_S // BUS_HZ


DRIVER: Final = register_driver(
    "i2c", RegisterOptions, I2C_ADDRESSES, probe, set_up, Imu61xI2cCodec, _example_reading, _read_ns, SETTINGS
)
