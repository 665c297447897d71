"""Forsense IMU61x on SPI: bursts and single registers. Manual "IMU61X Interface Protocol and Instructions", chapter
2.
"""

import struct
from collections.abc import Collection, Sequence
from random import Random
from typing import Annotated, Any, ClassVar, Final, Literal

from msgspec import Meta

from imud.attitude.rotation import quat_from_euler_zyx
from imud.contracts.codec import BadReason, Poll, PolledEvent, Vanished
from imud.contracts.command import Target
from imud.contracts.driver import Identity, random_vector
from imud.contracts.script import Transfer, TransferScript
from imud.contracts.setting import Reports, Setting, SettingsTable
from imud.drivers.imu61x.common import M_S2_PER_G, RAD_S_PER_DEG_S, crc32
from imud.drivers.imu61x.registers import (
    BURST,
    BURST_CTRL,
    CHECK_NS,
    FILTER_CTRL,
    M_S2_PER_COUNT,
    M_S2_PER_COUNT_REGISTER,
    PROD_ID,
    RAD_S_PER_COUNT,
    TEMP_HIGH,
    WIN_CTRL,
    ZACCEL_LOW,
    FilterControl,
    RegisterOptions,
    check_filter,
    check_settings,
    filter_settings,
    identity_of,
    register_driver,
    report_of,
    temperature_c,
    wanted_filter,
)
from imud.drivers.polled_frames import Measured, PolledFrameDecoder, absence
from imud.drivers.state import DAEMON, NUMBER, OPTIONS
from imud.drivers.value_limits import ACCEL_LIMIT_G, GYRO_LIMIT_DEG_S, TURN_DEG, possible_temperature_c, scaled
from imud.formats.state import Field, Maybe, StateTable
from imud.model.errors import DeviceRefused, TransferError
from imud.model.ledger import Ledger
from imud.model.sample import Measurement, Vector3
from imud.model.units import NS_PER_S, NS_PER_US, RAD_PER_DEG

PIPELINE_WORDS: Final = 2
PIPELINE_BYTES: Final = 2 * PIPELINE_WORDS
GAP_US: Final = 10


def read(address: int) -> int:
    """Return the word that reads a register."""
    return address << 8


def write(address: int, value: int) -> int:
    """Return the word that writes one byte."""
    return 0x8000 | address << 8 | value


def message(*words: int) -> Transfer:
    """Return a transfer that releases chip select between words, with two words for the replies to the last words."""
    pipeline = (read(WIN_CTRL),) * PIPELINE_WORDS  # the window, which must be 0 again
    return Transfer(tuple(word.to_bytes(2, "big") for word in (*words, *pipeline)), gap_us=GAP_US)


def answers(data: bytes) -> tuple[int, ...]:
    """Return the reply to each word of a transfer, without the two words of the pipeline."""
    words = memoryview(data)[PIPELINE_BYTES:]
    return struct.unpack(f">{len(words) // 2}H", words[: len(words) // 2 * 2])


OPEN: Final = write(WIN_CTRL, 1)
CLOSE: Final = write(WIN_CTRL, 0)
CLOSE_ONLY: Final = message(CLOSE)
# Identity and settings in one transfer: both halves of BURST_CTRL, and the window after it was closed
READ_STATE: Final = message(
    OPEN,
    *(read(PROD_ID + 2 * n) for n in range(4)),
    read(FILTER_CTRL),
    read(BURST_CTRL),
    read(BURST_CTRL + 1),
    CLOSE,
    read(WIN_CTRL),
)

BurstKind = Literal["standard", "extended"]  # reply of the device to 0x8000
STANDARD_WORDS: Final = 14
EXTENDED_WORDS: Final = 24
REGISTER_WORDS: Final = (ZACCEL_LOW - TEMP_HIGH) // 2 + 1
STANDARD: Final = struct.Struct(">14H")
# gyro 3 °/s, accel 3 g, temperature °C, roll pitch yaw °, status, CRC-32 of the 44 bytes before
EXTENDED: Final = struct.Struct("<10fII")
CRC_OFFSET: Final = 44


def _burst(words: int) -> Transfer:
    """Return the transfer of a burst: 0x8000, then zeros that move `words` words through the pipeline."""
    return Transfer((write(BURST, 0).to_bytes(2, "big") + bytes(2 * (PIPELINE_WORDS + words - 1)),))


READ_STANDARD: Final = _burst(STANDARD_WORDS)
READ_EXTENDED: Final = _burst(EXTENDED_WORDS)
READ_REGISTERS: Final = message(*(read(address) for address in range(TEMP_HIGH, ZACCEL_LOW + 1, 2)))
READ_TEMPERATURE: Final = message(read(TEMP_HIGH), read(TEMP_HIGH + 2))
# transfer for each kind of burst
BURSTS: Final[dict[BurstKind, Transfer]] = {"standard": READ_STANDARD, "extended": READ_EXTENDED}


def sum_matches(frame: bytes, checksum_bits: int) -> bool:
    """Return whether the checksum of a standard burst is correct."""
    *words, low, high = STANDARD.unpack(frame)
    total = sum(words)
    return low == total & 0xFFFF and (checksum_bits == 16 or high == total >> 16)


def little_endian(frame: bytes) -> bytes:
    """Return the words of an extended burst as bytes in little-endian order."""
    return struct.pack("<24H", *struct.unpack(">24H", frame))


def crc_matches(memory: bytes) -> bool:
    """Return whether the CRC of an extended burst in little-endian order is correct."""
    return bool(crc32(memory[:CRC_OFFSET]) == EXTENDED.unpack(memory)[11])


def burst_problem(kind: BurstKind, data: bytes, checksum_bits: int) -> str:
    """Return the error of received bytes, pipeline included; empty for a valid burst of this kind."""
    frame = data[PIPELINE_BYTES:]
    words = STANDARD_WORDS if kind == "standard" else EXTENDED_WORDS
    if len(frame) != 2 * words:
        return f"expected {2 * words} bytes, got {len(frame)}"
    if why := absence(frame):
        return why
    good = sum_matches(frame, checksum_bits) if kind == "standard" else crc_matches(little_endian(frame))
    return "" if good else f"wrong check value: {frame[:8].hex(' ')} …"


# --- encoder for simulated devices ------------------------------------------------------------------------------


def encode_standard(*, accel_m_s2: Vector3, gyro_rad_s: Vector3) -> bytes:
    """Return the 14 words of a standard burst from SI values, cut to 32 bits."""
    counts = [*(round(w / RAD_S_PER_COUNT) for w in gyro_rad_s), *(round(a / M_S2_PER_COUNT) for a in accel_m_s2)]
    words = [word for count in counts for word in (count & 0xFFFF, count >> 16 & 0xFFFF)]
    total = sum(words)
    return STANDARD.pack(*words, total & 0xFFFF, total >> 16)


def encode_extended(
    *, accel_m_s2: Vector3, gyro_rad_s: Vector3, temperature_c: float, euler_rad: Vector3, status: int = 0
) -> bytes:
    """Return the 24 words of an extended burst from SI values. Raises OverflowError beyond f32."""
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


MODES: Final = (0, 3)  # SPI modes of the manual and of the vendor's program; both sample on the rising edge
WINDOW_ID: Final = 0x01  # bit of WIN_CTRL that differs between the two codes of table 24; no other bit is defined
BURST_TRIES: Final = 3  # maximum number of bursts: one damaged burst or one lost write is not an error


class SpiDeviceOptions(RegisterOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an IMU61x on SPI."""

    burst: Literal["standard", "extended", "registers"] = "standard"
    """Kind of read: standard burst; extended burst with temperature and angles; or single registers."""
    checksum_bits: Literal[16, 32] = 32
    """Checksum of the standard burst: all 32 bits, or only the 16 bits of the manual."""


# --- state -----------------------------------------------------------------------------------------------------------


class State:
    """State in the reply to READ_STATE. Missing bytes count as zeros."""

    def __init__(self, data: bytes) -> None:
        _, *words, _, window = (*answers(data), *(0,) * 10)[:10]
        self.product_id = b"".join(word.to_bytes(2, "big") for word in words[:4])
        self.filter = words[4] & 0xFF
        self.burst_ctrl = (words[5], words[6])  # words at 0x0C and 0x0D
        self.window = window & WINDOW_ID

    def differences(self, settings: SpiDeviceOptions) -> str:
        """Return the difference of filter and window from the options; empty if there is none."""
        wanted = wanted_filter(settings, self.filter)
        if self.filter != wanted:
            return f"expected FILTER_CTRL {wanted:#04x}, got {self.filter:#04x}"
        return f"expected WIN_CTRL 0, got {self.window}" if self.window else ""

    @property
    def kind(self) -> BurstKind:
        """Kind of burst in BURST_CTRL: extended if one of its four bytes is 1."""
        halves = {byte for word in self.burst_ctrl for byte in word.to_bytes(2, "big")}
        return "extended" if 1 in halves else "standard"


# --- scripts ---------------------------------------------------------------------------------------------------------


def probe(_settings: SpiDeviceOptions) -> TransferScript[Identity]:
    """Read PROD_ID1 … 4 and close the window. Raises DeviceRefused for another device."""
    return identity_of((yield from read_state()).product_id)


def set_up(settings: SpiDeviceOptions) -> TransferScript[Reports]:
    """Write FILTER_CTRL and BURST_CTRL if they differ and read them back. Raises DeviceRefused if they still differ."""
    state = yield from read_state()
    wanted = wanted_filter(settings, state.filter)
    if state.filter != wanted:
        yield from write_control(wanted)
    if state.window:
        yield CLOSE_ONLY
    # the place of BURST_CTRL in a read is not certain: a burst decides the selected kind
    if settings.burst != "registers":
        yield from _select(settings.burst, state, settings.checksum_bits)
    return report_of(wanted, burst=state.kind if settings.burst == "registers" else settings.burst)


def read_state() -> TransferScript[State]:
    """Read identity and settings."""
    return State((yield from _in_window_1(READ_STATE)))


def read_control() -> TransferScript[int]:
    return (yield from read_state()).filter


def write_control(control: int) -> TransferScript[None]:
    """Write FILTER_CTRL and read it back. Raises DeviceRefused if it differs."""
    yield from _in_window_1(message(OPEN, write(FILTER_CTRL, control), CLOSE))
    check_filter(control, (yield from read_control()))


def _select(kind: BurstKind, state: State, checksum_bits: int) -> TransferScript[None]:
    """Select a kind of burst until a burst has this kind. Raises DeviceRefused."""
    why = ""
    for attempt in range(BURST_TRIES):
        if attempt or state.kind != kind:
            on = 1 if kind == "extended" else 0
            yield from _in_window_1(message(OPEN, write(BURST_CTRL + 1, on), CLOSE))
        why = burst_problem(kind, (yield BURSTS[kind]), checksum_bits)
        if not why:
            return
    low, high = (yield from read_state()).burst_ctrl
    raise DeviceRefused(
        f"expected a burst of the selected kind {kind}: {why}; BURST_CTRL is {low:#06x} at 0x0C and "
        f"{high:#06x} at 0x0D; try a slower bus"
    )


def _in_window_1(transfer: Transfer) -> TransferScript[bytes]:
    """Make a transfer that opens and closes window 1. Close the window after a failure."""
    try:
        return (yield transfer)
    except TransferError:
        yield CLOSE_ONLY
        raise


TEMPERATURE_NS: Final = NS_PER_S  # time between two reads of the temperature, if the burst does not contain it, ns

# Polls by the option `burst`, in the order of `polls` of the codec
POLLS: Final = {
    "standard": (Poll(READ_STANDARD), Poll(READ_STATE, CHECK_NS), Poll(READ_TEMPERATURE, TEMPERATURE_NS)),
    "extended": (Poll(READ_EXTENDED), Poll(READ_STATE, CHECK_NS)),
    "registers": (Poll(READ_REGISTERS), Poll(READ_STATE, CHECK_NS)),
}
_BURST, _STATE, _TEMPERATURE = range(3)
# Bits of the extended burst's status that imud passes on. Bit 31 of a sample's status belongs to imud. The manual does
# not define the bits.
DEVICE_STATUS: Final = 0x7FFF_FFFF


class Imu61xSpiCodec:
    """Decoder of bursts or registers. Synchronization: one thread.

    Without a temperature in the burst, samples contain the newest read value, at most two seconds old. Registers have
    no check value: the codec rejects only impossible bytes, and a value may consist of two updates (an error of at most
    one step of its high word).
    """

    STATE: ClassVar = StateTable(
        (
            Field(1, "_frames", PolledFrameDecoder.STATE),
            Field(2, "_temperature_c", Maybe(NUMBER)),
        ),
        {"ledger": DAEMON, "polls": OPTIONS, "_settings": OPTIONS, "_bad": OPTIONS, "_measure": OPTIONS},
    )

    def __init__(self, ledger: Ledger, settings: SpiDeviceOptions) -> None:
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
        """Number of frames with the same bytes as the previous frame."""
        return self._frames.stale

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Decode the bytes of one transfer without the bytes of the pipeline. Never raises an exception."""
        if poll == _BURST:
            return self._frames.decode(data[PIPELINE_BYTES:], self._bad, self._measure)
        return self._on_state(data) if poll == _STATE else self._on_temperature(data)

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        """Do nothing: a failed transfer has no further effect."""
        return ()

    def reset(self) -> None:
        """Forget the previous frame."""
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
        self._temperature_c = (
            possible_temperature_c(temperature_c(_signed(words[0] << 16 | words[1]))) if good else None
        )
        self._frames.add_reply(data[PIPELINE_BYTES:], good=good)
        return ()

    def _bad_sum(self, frame: bytes) -> BadReason | None:
        return None if sum_matches(frame, self._settings.checksum_bits) else BadReason.CRC

    def _standard(self, frame: bytes) -> Measured:
        gyro, accel = _in_si(_joined(frame, 0), _joined(frame, 12), M_S2_PER_COUNT)
        measurement = Measurement(len(frame), 0, None, accel, gyro, temperature_c=self._temperature_c)
        return measurement, None not in (accel, gyro)


_SIX: Final = struct.Struct(">6H")
_THREE: Final = struct.Struct(">3i")


def _joined(frame: bytes, at: int) -> tuple[int, int, int]:
    """Return three i32, each of a low word and a high word."""
    words = _SIX.unpack_from(frame, at)
    x, y, z = ((high << 16 | low) for low, high in zip(words[::2], words[1::2], strict=True))
    return _signed(x), _signed(y), _signed(z)


def _signed(value: int) -> int:
    return value - 0x1_0000_0000 if value & 0x8000_0000 else value


def _in_si(gyro: Sequence[int], accel: Sequence[int], m_s2_per_count: float) -> tuple[Vector3 | None, Vector3 | None]:
    """Return angular rate and acceleration, None if not possible."""
    return (
        scaled(gyro, RAD_S_PER_COUNT, GYRO_LIMIT_DEG_S * RAD_S_PER_DEG_S / RAD_S_PER_COUNT),
        scaled(accel, m_s2_per_count, ACCEL_LIMIT_G * M_S2_PER_G / m_s2_per_count),
    )


def _registers(frame: bytes) -> Measured:
    temperature = possible_temperature_c(temperature_c(*struct.unpack_from(">i", frame)))
    gyro, accel = _in_si(_THREE.unpack_from(frame, 4), _THREE.unpack_from(frame, 16), M_S2_PER_COUNT_REGISTER)
    measurement = Measurement(len(frame), 0, None, accel, gyro, temperature_c=temperature)
    return measurement, None not in (accel, gyro, temperature)


def _never_bad(_frame: bytes) -> BadReason | None:
    return None


def _bad_crc(frame: bytes) -> BadReason | None:
    return None if crc_matches(little_endian(frame)) else BadReason.CRC


def _extended(frame: bytes) -> Measured:
    values = EXTENDED.unpack(little_endian(frame))
    gyro, accel, euler = (
        scaled(part, factor, limit)
        for part, factor, limit in (
            (values[0:3], RAD_S_PER_DEG_S, GYRO_LIMIT_DEG_S), (values[3:6], M_S2_PER_G, ACCEL_LIMIT_G),
            (values[7:10], RAD_PER_DEG, TURN_DEG),
        )
    )  # fmt: skip
    temperature = possible_temperature_c(values[6])
    measurement = Measurement(
        len(frame), 0, None, accel, gyro,
        quat_wxyz=None if euler is None else quat_from_euler_zyx(euler),
        euler_rad=euler, temperature_c=temperature, status=values[10] & DEVICE_STATUS,
    )  # fmt: skip
    return measurement, None not in (accel, gyro, euler, temperature)


Burst = Annotated[
    BurstKind,
    Meta(description="kind of burst by BURST_CTRL; `options.burst` sets it", extra={"section": "2.4.1, table 16"}),
]


def _read(_target: Target, _names: Collection[str] | None) -> TransferScript[Reports]:
    state = yield from read_state()
    return report_of(state.filter, burst=state.kind)


# Settings that a restart of the device resets. The filters after a restart are parameter 31 of its UART.
SETTINGS: Final = SettingsTable(
    table={**filter_settings(FilterControl(read_control, write_control)), "burst": Setting(type=Burst)},
    read=_read,
    check=check_settings,
)


def _example_reading(random: Random) -> bytes:
    """Return a standard burst with random values, after the words of the pipeline."""
    pipeline = random.randbytes(PIPELINE_BYTES)
    return pipeline + encode_standard(accel_m_s2=random_vector(random, 9.8), gyro_rad_s=random_vector(random, 2))


def _read_ns(options: SpiDeviceOptions, link: Any) -> int:
    # bits at the clock of the bus, and pauses between words: 256 µs for a standard burst at 1 MHz
    transfer = POLLS[options.burst][0].transfer
    bits = 8 * sum(map(len, transfer.sends))
    speed_hz: int = link.speed_hz
    return bits * NS_PER_S // speed_hz + len(transfer.sends) * transfer.gap_us * NS_PER_US


DRIVER: Final = register_driver(
    "spi", SpiDeviceOptions, MODES, probe, set_up, Imu61xSpiCodec, _example_reading, _read_ns, SETTINGS
)
