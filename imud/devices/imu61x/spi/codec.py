"""Forsense IMU61x on SPI. Manual "IMU61X Interface Protocol and Instructions", chapter 2.

Words of 16 bits, high byte first: bit 15 set writes the byte in bits 7-0 to the address in bits 14-8, bit 15 clear
reads the word at that address. The answer to a word comes with the second word after it:

    MOSI   0x8000   0x0000   0x0000   0x0000   …                burst: chip select is held low through all of it
    MISO    any      any     word 1   word 2   …   word n

    standard, 14 words   gyro 3, accel 3, all i32, low word first | sum of these twelve words, low word first
    extended, 24 words   gyro 3 °/s | accel 3 g | temperature °C | roll pitch yaw ° | status u32 | CRC-32, all f32 else

The manual prints 13 words for the standard burst, with a checksum of 16 bits; devices send 14, with one of 32 bits
(`checksum_bits: 16` looks at the low word only). The extended burst, which the manual mentions and does not define, is
as the vendor's own program reads it; the order of its angles is assumed. WIN_CTRL is 0 outside of this file's
messages: a message that opens window 1 closes it again, and one that fails is followed by one that closes it.
Between the words of a message for registers chip select is released for GAP_US (assumed; the manual draws one word per
selection and says nothing of the pause).
"""

import struct
from collections.abc import Mapping, Sequence
from math import isfinite
from random import Random
from typing import Final, Literal

from imud.attitude import quat_from_euler_zyx
from imud.contracts.codec import BadReason
from imud.contracts.driver import Identity
from imud.contracts.polling import Poll, PolledDriver, PolledEvent, Transfer, TransferScript, Vanished
from imud.devices.imu61x.common.family import (
    EULER_CONVENTION,
    M_S2_PER_G,
    NAVIGATION_FRAME,
    RAD_S_PER_DEG_S,
    crc32,
)
from imud.devices.imu61x.common.register_actions import filter_actions
from imud.devices.imu61x.common.registers import (
    BURST,
    BURST_CTRL,
    FILTER_CTRL,
    M_S2_PER_COUNT,
    M_S2_PER_COUNT_REGISTER,
    PROD_ID,
    RAD_S_PER_COUNT,
    TEMP_HIGH,
    WIN_CTRL,
    ZACCEL_LOW,
    RegisterSettings,
    check_filter,
    filter_words,
    identity_of,
    temperature_c,
    update_ns,
    wanted_filter,
)
from imud.devices.polled_frames import Measured, PolledFrameDecoder
from imud.errors import DeviceRefused, TransferError
from imud.ledger import Ledger
from imud.sample import Measurement, Vector3
from imud.units import NS_PER_S, RAD_PER_DEG

MODES: Final = (0, 3)
"""The manual's, and the one of the vendor's own program: both sample on the rising edge."""
PIPELINE_WORDS: Final = 2
PIPELINE_BYTES: Final = 2 * PIPELINE_WORDS
GAP_US: Final = 10
CHECK_NS: Final = 10 * NS_PER_S
"""How often identity and settings are read again: a device that restarted by itself has lost what was not saved."""
TEMPERATURE_NS: Final = NS_PER_S
"""How often the temperature is read where the burst has none."""

STANDARD_WORDS: Final = 14
EXTENDED_WORDS: Final = 24
REGISTER_WORDS: Final = (ZACCEL_LOW - TEMP_HIGH) // 2 + 1
EXTENDED: Final = struct.Struct("<10fII")
"""gyro 3 °/s, accel 3 g, temperature °C, roll pitch yaw °, status, CRC-32 of the 44 bytes before."""
CRC_OFFSET: Final = 44


class SpiDeviceSettings(RegisterSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an IMU61x on SPI."""

    burst: Literal["standard", "extended", "registers"] = "standard"
    """What is read: the standard burst; the extended burst, which has temperature and angles; or single registers."""
    checksum_bits: Literal[16, 32] = 32
    """Checksum of the standard burst: all 32 bits, or only the 16 that the manual has."""


# --- words -----------------------------------------------------------------------------------------------------------


def read(address: int) -> int:
    """The word that reads a register."""
    return address << 8


def write(address: int, value: int) -> int:
    """The word that writes one byte."""
    return 0x8000 | address << 8 | value


def message(*words: int) -> Transfer:
    """Words with chip select released between them, and two more for the answers to the last ones."""
    pipeline = (read(WIN_CTRL),) * PIPELINE_WORDS  # answers with the window, which must be 0 again by then
    return Transfer(tuple(word.to_bytes(2, "big") for word in (*words, *pipeline)), gap_us=GAP_US)


def answers(data: bytes) -> tuple[int, ...]:
    """The answer to each word of a message, without the two of the pipeline itself."""
    words = memoryview(data)[PIPELINE_BYTES:]
    return struct.unpack(f">{len(words) // 2}H", words[: len(words) // 2 * 2])


def _burst(words: int) -> Transfer:
    """0x8000 and as many zeros as bring `words` words through the pipeline, in one selection."""
    return Transfer((write(BURST, 0).to_bytes(2, "big") + bytes(2 * (PIPELINE_WORDS + words - 1)),))


OPEN: Final = write(WIN_CTRL, 1)
CLOSE: Final = write(WIN_CTRL, 0)
CLOSE_ONLY: Final = message(CLOSE)
READ_STANDARD: Final = _burst(STANDARD_WORDS)
READ_EXTENDED: Final = _burst(EXTENDED_WORDS)
READ_REGISTERS: Final = message(*(read(address) for address in range(TEMP_HIGH, ZACCEL_LOW + 1, 2)))
READ_TEMPERATURE: Final = message(read(TEMP_HIGH), read(TEMP_HIGH + 2))
READ_STATE: Final = message(
    OPEN, *(read(PROD_ID + 2 * n) for n in range(4)), read(FILTER_CTRL), read(BURST_CTRL), CLOSE, read(WIN_CTRL)
)  # fmt: skip
"""Identity and settings in one message, and the window after it was closed."""
_POLLS: Final = {
    "standard": (Poll(READ_STANDARD), Poll(READ_STATE, CHECK_NS), Poll(READ_TEMPERATURE, TEMPERATURE_NS)),
    "extended": (Poll(READ_EXTENDED), Poll(READ_STATE, CHECK_NS)),
    "registers": (Poll(READ_REGISTERS), Poll(READ_STATE, CHECK_NS)),
}
_BURST, _STATE, _TEMPERATURE = range(3)
_EXTENDED_ON: Final = {"standard": 0, "extended": 1}


class State:
    """What READ_STATE read. Shorter data counts as zeros."""

    def __init__(self, data: bytes) -> None:
        _, *words, _, self.window = (*answers(data), *(0,) * 9)[:9]
        self.product_id = b"".join(word.to_bytes(2, "big") for word in words[:4])
        self.filter = words[4] & 0xFF
        self.extended = words[5] >> 8

    def differences(self, settings: SpiDeviceSettings) -> str:
        """What is not as the settings say; an empty string if all is."""
        wanted = wanted_filter(settings, self.filter)
        if self.filter != wanted:
            return f"FILTER_CTRL is {self.filter:#04x}, expected {wanted:#04x}"
        burst = _EXTENDED_ON.get(settings.burst, self.extended)
        if self.extended != burst:
            return f"BURST_CTRL is {self.extended}, expected {burst}"
        return f"WIN_CTRL is {self.window}, expected 0" if self.window else ""


# --- dialogues -------------------------------------------------------------------------------------------------------


def probe(_settings: SpiDeviceSettings) -> TransferScript[Identity]:
    """PROD_ID1 … 4. Raises DeviceRefused for anything but an IMU61x. Whatever happens, the window is closed."""
    data = yield from _in_window_1(READ_STATE)
    return identity_of(State(data).product_id)


def set_up(settings: SpiDeviceSettings) -> TransferScript[Mapping[str, str]]:
    """Write FILTER_CTRL and BURST_CTRL where they differ, read them back. Raises DeviceRefused if they did not take."""
    state = State((yield from _in_window_1(READ_STATE)))
    wanted = wanted_filter(settings, state.filter)
    if state.differences(settings):
        extended = _EXTENDED_ON.get(settings.burst, state.extended)
        yield from _in_window_1(message(OPEN, write(FILTER_CTRL, wanted), write(BURST_CTRL + 1, extended), CLOSE))
        state = State((yield from _in_window_1(READ_STATE)))
        check_filter(wanted, state.filter)
        if why := state.differences(settings):
            raise DeviceRefused(f"{why} after it was written; is the bus too fast?")
    return {**filter_words(state.filter), "burst": "extended" if state.extended else "standard"}


def _in_window_1(transfer: Transfer) -> TransferScript[bytes]:
    """A message that opens and closes window 1; one that failed on its way may have left it open."""
    try:
        return (yield transfer)
    except TransferError:
        yield CLOSE_ONLY
        raise


# --- codec -----------------------------------------------------------------------------------------------------------


class Imu61xSpiCodec:
    """Measurements out of bursts or registers. Synchronization: one thread.

    Where a burst has no temperature, samples carry the last one read, at most two seconds old. Registers have no check
    value: only what no device can send is refused there, and a value may be of two updates (by one step of its high
    word at most).
    """

    def __init__(self, ledger: Ledger, settings: SpiDeviceSettings) -> None:
        self.ledger = ledger
        self.polls: Sequence[Poll] = _POLLS[settings.burst]
        self._settings = settings
        self._bad, self._measure, words = {
            "standard": (self._bad_sum, self._standard, STANDARD_WORDS),
            "extended": (_bad_crc, _extended, EXTENDED_WORDS),
            "registers": (_never_bad, _registers, REGISTER_WORDS),
        }[settings.burst]
        self._book = PolledFrameDecoder(ledger, 2 * words)
        self._temperature_c: float | None = None

    @property
    def stale(self) -> int:
        """Frames that repeated the one before."""
        return self._book.stale

    def take(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Take the bytes of one transfer; those of the pipeline are no part of a frame. Never raises."""
        if poll == _BURST:
            return self._book.take(data[PIPELINE_BYTES:], self._bad, self._measure)
        return self._take_state(data) if poll == _STATE else self._take_temperature(data)

    def reset(self) -> None:
        """The next frame is not compared with an earlier one."""
        self._book.reset()
        self._temperature_c = None

    def _take_state(self, data: bytes) -> Sequence[PolledEvent]:
        state = State(data)
        why = state.differences(self._settings)
        try:
            identity_of(state.product_id)
        except DeviceRefused as error:
            why = str(error)
        self._book.book_reply(data[PIPELINE_BYTES:], good=not why)
        return (Vanished(why),) if why else ()

    def _take_temperature(self, data: bytes) -> Sequence[PolledEvent]:
        words = answers(data)
        good = len(words) >= 2 and any(words[:2]) and words[:2] != (0xFFFF, 0xFFFF)
        self._temperature_c = temperature_c(_signed(words[0] << 16 | words[1])) if good else None
        self._book.book_reply(data[PIPELINE_BYTES:], good=good)
        return ()

    def _bad_sum(self, frame: bytes) -> BadReason | None:
        *words, low, high = _STANDARD.unpack(frame)
        total = sum(words)
        good = low == total & 0xFFFF and (self._settings.checksum_bits == 16 or high == total >> 16)
        return None if good else BadReason.CRC

    def _standard(self, frame: bytes) -> Measured:
        gyro, accel = _scaled(_joined(frame, 0), RAD_S_PER_COUNT), _scaled(_joined(frame, 12), M_S2_PER_COUNT)
        return Measurement(len(frame), 0, None, accel, gyro, temperature_c=self._temperature_c), True


_STANDARD: Final = struct.Struct(">14H")
_SIX: Final = struct.Struct(">6H")
_THREE: Final = struct.Struct(">3i")


def _joined(frame: bytes, at: int) -> tuple[int, int, int]:
    """Three i32 of low word, high word."""
    words = _SIX.unpack_from(frame, at)
    x, y, z = ((high << 16 | low) for low, high in zip(words[::2], words[1::2], strict=True))
    return _signed(x), _signed(y), _signed(z)


def _signed(value: int) -> int:
    return value - 0x1_0000_0000 if value & 0x8000_0000 else value


def _scaled(values: Sequence[float], factor: float) -> Vector3:
    x, y, z = values
    return (x * factor, y * factor, z * factor)


def _registers(frame: bytes) -> Measured:
    (temperature,) = struct.unpack_from(">i", frame)
    gyro = _scaled(_THREE.unpack_from(frame, 4), RAD_S_PER_COUNT)
    accel = _scaled(_THREE.unpack_from(frame, 16), M_S2_PER_COUNT_REGISTER)
    return Measurement(len(frame), 0, None, accel, gyro, temperature_c=temperature_c(temperature)), True


def _never_bad(_frame: bytes) -> BadReason | None:
    return None


def _little(frame: bytes) -> bytes:
    """The words as they lie in the memory of a little-endian host."""
    return struct.pack("<24H", *struct.unpack(">24H", frame))


def _bad_crc(frame: bytes) -> BadReason | None:
    memory = _little(frame)
    return None if crc32(memory[:CRC_OFFSET]) == EXTENDED.unpack(memory)[11] else BadReason.CRC


def _extended(frame: bytes) -> Measured:
    values = EXTENDED.unpack(_little(frame))
    gyro, accel, euler = (
        _scaled(part, factor) if isfinite(sum(part)) else None
        for part, factor in (
            (values[0:3], RAD_S_PER_DEG_S), (values[3:6], M_S2_PER_G), (values[7:10], RAD_PER_DEG),
        )
    )  # fmt: skip
    temperature = values[6] if isfinite(values[6]) else None
    measurement = Measurement(
        len(frame), 0, None, accel, gyro,
        quat_wxyz=None if euler is None else quat_from_euler_zyx(euler),
        euler_rad=euler, temperature_c=temperature, status=values[10],
    )  # fmt: skip
    return measurement, None not in (accel, gyro, euler, temperature)


# --- the device's side ------------------------------------------------------------------------------------------------


def encode_standard(*, accel_m_s2: Vector3, gyro_rad_s: Vector3) -> bytes:
    """The 14 words of a standard burst from SI values; values beyond 32 bits are cut off."""
    counts = [*(round(w / RAD_S_PER_COUNT) for w in gyro_rad_s), *(round(a / M_S2_PER_COUNT) for a in accel_m_s2)]
    words = [word for count in counts for word in (count & 0xFFFF, count >> 16 & 0xFFFF)]
    total = sum(words)
    return _STANDARD.pack(*words, total & 0xFFFF, total >> 16)


def encode_extended(
    *, accel_m_s2: Vector3, gyro_rad_s: Vector3, temperature_c: float, euler_rad: Vector3, status: int = 0
) -> bytes:
    """The 24 words of an extended burst from SI values. Raises OverflowError beyond f32."""
    memory = struct.pack(
        "<10fI",
        *(w / RAD_S_PER_DEG_S for w in gyro_rad_s),
        *(a / M_S2_PER_G for a in accel_m_s2),
        temperature_c,
        *(angle / RAD_PER_DEG for angle in euler_rad),
        status,
    )
    memory += struct.pack("<I", crc32(memory))
    return struct.pack(">24H", *struct.unpack("<24H", memory))


def _example_reading(random: Random) -> bytes:
    """A standard burst with random values, the words of the pipeline before it."""

    def three(spread: float) -> Vector3:
        return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))

    return random.randbytes(PIPELINE_BYTES) + encode_standard(accel_m_s2=three(9.8), gyro_rad_s=three(2))


DRIVER: Final = PolledDriver(
    name="imu61x-spi",
    title="Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B (SPI)",
    settings=SpiDeviceSettings,
    euler_convention=EULER_CONVENTION,
    navigation_frame=NAVIGATION_FRAME,
    lines=frozenset({"reset", "data_ready"}),
    link="spi",
    targets=MODES,
    probe=probe,
    set_up=set_up,
    make_codec=Imu61xSpiCodec,
    update_ns=update_ns,
    example_reading=_example_reading,
    actions=filter_actions(set_up),
)
