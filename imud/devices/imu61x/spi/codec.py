"""Forsense IMU61x on SPI: decoding of bursts and single registers. Manual "IMU61X Interface Protocol and Instructions",
chapter 2. Layouts and check values are in `bursts.py`, words in `words.py`, identity and settings in `session.py`.
"""

import struct
from collections.abc import Sequence
from math import isfinite
from typing import Final

from imud.attitude import quat_from_euler_zyx
from imud.contracts.codec import BadReason
from imud.contracts.polling import Poll, PolledEvent, Vanished
from imud.devices.imu61x.common.family import M_S2_PER_G, RAD_S_PER_DEG_S, scaled
from imud.devices.imu61x.common.register_driver import CHECK_NS, identity_of
from imud.devices.imu61x.common.registers import (
    M_S2_PER_COUNT,
    M_S2_PER_COUNT_REGISTER,
    RAD_S_PER_COUNT,
    temperature_c,
)
from imud.devices.imu61x.spi.bursts import (
    EXTENDED,
    EXTENDED_WORDS,
    READ_EXTENDED,
    READ_REGISTERS,
    READ_STANDARD,
    READ_TEMPERATURE,
    REGISTER_WORDS,
    STANDARD_WORDS,
    crc_matches,
    little_endian,
    sum_matches,
)
from imud.devices.imu61x.spi.session import SpiDeviceSettings, State
from imud.devices.imu61x.spi.words import PIPELINE_BYTES, READ_STATE, answers
from imud.devices.polled_frames import Measured, PolledFrameDecoder
from imud.errors import DeviceRefused
from imud.ledger import Ledger
from imud.sample import Measurement, Vector3
from imud.units import NS_PER_S, RAD_PER_DEG

TEMPERATURE_NS: Final = NS_PER_S
"""Interval of reading the temperature where the burst has none."""

POLLS: Final = {
    "standard": (Poll(READ_STANDARD), Poll(READ_STATE, CHECK_NS), Poll(READ_TEMPERATURE, TEMPERATURE_NS)),
    "extended": (Poll(READ_EXTENDED), Poll(READ_STATE, CHECK_NS)),
    "registers": (Poll(READ_REGISTERS), Poll(READ_STATE, CHECK_NS)),
}
"""Polls by the setting `burst`, in the order of the codec's polls."""
_BURST, _STATE, _TEMPERATURE = range(3)
DEVICE_STATUS: Final = 0x7FFF_FFFF
"""The bits of the extended burst's status that are passed on: bit 31 of a sample's status is imud's own. The manual
gives none of them a meaning."""


class Imu61xSpiCodec:
    """Decoder of bursts or registers. Synchronization: one thread.

    Where a burst has no temperature, samples carry the last one read, at most two seconds old. Registers have no check
    value: only what no device can send is refused there, and a value may be of two updates (by one step of its high
    word at most).
    """

    def __init__(self, ledger: Ledger, settings: SpiDeviceSettings) -> None:
        self.ledger = ledger
        self.polls: Sequence[Poll] = POLLS[settings.burst]
        self._settings = settings
        self._bad, self._measure, words = {
            "standard": (self._bad_sum, self._standard, STANDARD_WORDS),
            "extended": (_bad_crc, _extended, EXTENDED_WORDS),
            "registers": (_never_bad, _registers, REGISTER_WORDS),
        }[settings.burst]
        self._frames = PolledFrameDecoder(ledger, 2 * words)
        self._temperature_c: float | None = None

    @property
    def stale(self) -> int:
        """Frames that repeated the one before."""
        return self._frames.stale

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Decode the bytes of one transfer; those of the pipeline are no part of a frame. Never raises."""
        if poll == _BURST:
            return self._frames.decode(data[PIPELINE_BYTES:], self._bad, self._measure)
        return self._on_state(data) if poll == _STATE else self._on_temperature(data)

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        """No-op: nothing follows from one failed transfer."""
        return ()

    def reset(self) -> None:
        """Forget the last frame: the next one is not compared with it."""
        self._frames.reset()
        self._temperature_c = None

    def _on_state(self, data: bytes) -> Sequence[PolledEvent]:
        state = State(data)
        why = state.differences(self._settings)
        try:
            identity_of(state.product_id)
        except DeviceRefused as error:
            why = str(error)
        self._frames.add_reply(data[PIPELINE_BYTES:], good=not why)
        return (Vanished(why),) if why else ()

    def _on_temperature(self, data: bytes) -> Sequence[PolledEvent]:
        words = answers(data)
        good = len(words) >= 2 and any(words[:2]) and words[:2] != (0xFFFF, 0xFFFF)
        self._temperature_c = temperature_c(_signed(words[0] << 16 | words[1])) if good else None
        self._frames.add_reply(data[PIPELINE_BYTES:], good=good)
        return ()

    def _bad_sum(self, frame: bytes) -> BadReason | None:
        return None if sum_matches(frame, self._settings.checksum_bits) else BadReason.CRC

    def _standard(self, frame: bytes) -> Measured:
        gyro, accel = _in_si(_joined(frame, 0), RAD_S_PER_COUNT), _in_si(_joined(frame, 12), M_S2_PER_COUNT)
        return Measurement(len(frame), 0, None, accel, gyro, temperature_c=self._temperature_c), True


_SIX: Final = struct.Struct(">6H")
_THREE: Final = struct.Struct(">3i")


def _joined(frame: bytes, at: int) -> tuple[int, int, int]:
    """Three i32 of low word, high word."""
    words = _SIX.unpack_from(frame, at)
    x, y, z = ((high << 16 | low) for low, high in zip(words[::2], words[1::2], strict=True))
    return _signed(x), _signed(y), _signed(z)


def _signed(value: int) -> int:
    return value - 0x1_0000_0000 if value & 0x8000_0000 else value


def _in_si(counts: Sequence[int], factor: float) -> Vector3:
    x, y, z = counts
    return (x * factor, y * factor, z * factor)


def _registers(frame: bytes) -> Measured:
    (temperature,) = struct.unpack_from(">i", frame)
    gyro = _in_si(_THREE.unpack_from(frame, 4), RAD_S_PER_COUNT)
    accel = _in_si(_THREE.unpack_from(frame, 16), M_S2_PER_COUNT_REGISTER)
    return Measurement(len(frame), 0, None, accel, gyro, temperature_c=temperature_c(temperature)), True


def _never_bad(_frame: bytes) -> BadReason | None:
    return None


def _bad_crc(frame: bytes) -> BadReason | None:
    return None if crc_matches(little_endian(frame)) else BadReason.CRC


def _extended(frame: bytes) -> Measured:
    values = EXTENDED.unpack(little_endian(frame))
    gyro, accel, euler = (
        scaled(part, factor)
        for part, factor in (
            (values[0:3], RAD_S_PER_DEG_S), (values[3:6], M_S2_PER_G), (values[7:10], RAD_PER_DEG),
        )
    )  # fmt: skip
    temperature = values[6] if isfinite(values[6]) else None
    measurement = Measurement(
        len(frame), 0, None, accel, gyro,
        quat_wxyz=None if euler is None else quat_from_euler_zyx(euler),
        euler_rad=euler, temperature_c=temperature, status=values[10] & DEVICE_STATUS,
    )  # fmt: skip
    return measurement, None not in (accel, gyro, euler, temperature)
