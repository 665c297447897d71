"""Forsense IMU61x on a UART: AHRS frames and replies. Manual "IMU61X Interface Protocol and Instructions", chapter 1.

    AHRS, id 0x0002, 44 bytes   timer µs u32 | pitch | roll | yaw ° | accel 3 g | gyro 3 °/s | temperature °C, all f32

    of newer models, 56 bytes   … | magnetic field 3, f32

The manual does not contain the longer frame (source: the vendor's public ROS drivers). No source states the unit of the
field; imud assumes µT (option `mag_unit`). The device sends pitch before roll. imud computes the quaternion from the
angles. The manual does not define their convention; imud assumes `common.EULER_CONVENTION`. The timer counts µs and
wraps after 71.6 minutes.

The kernel (`imud/_kernel.c`) decodes usual AHRS frames in less CPU time. `make bench-instructions` measures the cost.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Final, Literal
from zlib import crc32 as inverted_crc32

import msgspec

from imud.attitude.rotation import quat_from_euler_zyx
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, count_unknown
from imud.contracts.script import Message, ReplyFrame
from imud.drivers.imu61x.common import CRC_INVERSION, CRC_START, M_S2_PER_G, RAD_S_PER_DEG_S, crc32
from imud.drivers.state import DAEMON, OPTIONS, UNKNOWN
from imud.drivers.value_limits import (
    ACCEL_LIMIT_G,
    GYRO_LIMIT_DEG_S,
    MAG_LIMIT_UT,
    TURN_DEG,
    possible_temperature_c,
    scaled,
)
from imud.formats.kernel import KernelFormat, KernelFrames
from imud.formats.state import Data, Field, Integer, StateTable
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Vector3
from imud.model.units import RAD_PER_DEG, T_PER_UT

DEVICE_SYNC: Final = b"\xaa\x55"  # start of a frame from the device
HOST_SYNC: Final = b"\x55\xaa"  # start of a frame from the host
HEADER: Final = struct.Struct("<2sHH")  # sync word, id, payload length
HEADER_BYTES: Final = HEADER.size  # the attribute is slower than a name
CRC_BYTES: Final = 4
OVERHEAD_BYTES: Final = HEADER_BYTES + CRC_BYTES
# Maximum length of a payload, bytes. The longest known payload has 66 bytes (S1, depends on the model). A false length
# then hides at most five samples, 23 ms at 115200 baud.
PAYLOAD_BYTES_MAX: Final = 256
FRAME_BYTES_MAX: Final = OVERHEAD_BYTES + PAYLOAD_BYTES_MAX

# timer µs, pitch roll yaw °, accel x y z g, gyro x y z °/s, temperature °C (table 4)
AHRS: Final = struct.Struct("<I10f")
AHRS_BYTES: Final = AHRS.size
AHRS_FRAME: Final = 0x0002
AHRS_FRAME_BYTES: Final = OVERHEAD_BYTES + AHRS_BYTES
RAW_FRAME: Final = 0x0666  # see `imud.drivers.imu61x.uart.raw`
MAG: Final = struct.Struct("<3f")  # after AHRS
MAG_FRAME_BYTES: Final = AHRS_FRAME_BYTES + MAG.size
MagUnit = Literal["ut", "mgauss"]
T_PER_UNIT: Final[Mapping[MagUnit, float]] = {"ut": T_PER_UT, "mgauss": T_PER_UT / 10}


class Frame(msgspec.Struct, frozen=True, gc=False):
    """Frame with a correct CRC."""

    frame_id: int
    raw: bytes
    trailing_bytes: int  # number of bytes of the same read after the frame

    @property
    def payload(self) -> bytes:
        return self.raw[HEADER_BYTES:-CRC_BYTES]


def encode_frame(sync: bytes, frame_id: int, payload: bytes) -> bytes:
    """Return a frame with `payload`. Raises ValueError for an empty payload or more than PAYLOAD_BYTES_MAX bytes."""
    if not 1 <= len(payload) <= PAYLOAD_BYTES_MAX:
        raise ValueError(f"payload of {len(payload)} bytes: expected 1 … {PAYLOAD_BYTES_MAX}")
    body = HEADER.pack(sync, frame_id, len(payload)) + payload
    return body + crc32(body).to_bytes(CRC_BYTES, "little")


class FrameFinder(KernelFrames):
    """Finder of the frames of one direction in a byte stream. Synchronization: one thread.

    It counts every byte and every damaged frame in the ledger. The caller counts the returned frames, because only the
    caller knows whether their content is valid.
    """

    kernel_format = KernelFormat("AHRS", HEADER.pack(DEVICE_SYNC, AHRS_FRAME, AHRS_BYTES), AHRS_FRAME_BYTES)
    STATE: ClassVar = StateTable(
        (
            Field(1, "_tail", Data(FRAME_BYTES_MAX)),
            Field(2, "_bad_ahead", Integer(0, OVERHEAD_BYTES + 0xFFFF)),
        ),
        {"ledger": DAEMON, "_sync": "set by the constructor"},
    )

    def __init__(self, ledger: Ledger, sync: bytes) -> None:
        super().__init__(ledger)
        self._sync = sync
        self._bad_ahead = 0  # rest of a damaged frame by its length field, in bytes from the start of the tail

    def feed(self, data: bytes) -> Sequence[Frame | BadFrame]:
        """Add the next bytes of the stream. Return the completed frames. Never raises an exception."""
        self.ledger.bytes_in += len(data)
        return self._scan(self._tail + data if self._tail else data, 0)

    # --- frames for the kernel ----------------------------------------------------------------------------------------

    def usual_frames(self, data: bytes) -> bytes:
        """See `KernelCodec`."""
        if self._bad_ahead:
            return b""
        return self._tail + data if self._tail else data

    # --- end of the stream --------------------------------------------------------------------------------------------

    def flush(self) -> Sequence[Frame | BadFrame]:
        """Drop an incomplete frame that contains a complete frame. imud calls this method when the link is idle."""
        found: list[Frame | BadFrame] = []
        while drop_before := self._whole_inside():
            found += self._scan(self._tail, drop_before)
        return found

    def reset(self) -> None:
        """Count the pending bytes as skipped."""
        self.ledger.bytes_skipped += len(self._tail)
        self._tail = b""
        self._bad_ahead = 0
        self.ledger.bytes_pending = 0

    def _scan(self, data: bytes, drop_before: int) -> list[Frame | BadFrame]:
        """Return all complete frames in `data`. Incomplete frames that start before `drop_before` are bad."""
        found: list[Frame | BadFrame] = []
        at, total = 0, len(data)
        while at < total:
            after = self._frame_at(data, at, drop_before, found)
            if after == at:
                break
            at = after
        self._tail = data[at:]
        self._bad_ahead = max(self._bad_ahead - at, 0)
        self.ledger.bytes_pending = total - at
        return found

    def _frame_at(self, data: bytes, at: int, drop_before: int, found: list[Frame | BadFrame]) -> int:
        """Find the frame or the other bytes at `at`. Return their end, or `at` if the frame is incomplete."""
        total = len(data)
        if total - at < HEADER_BYTES:
            if not data.startswith(self._sync, at):
                return self._skip(data, at)
            return self._spend_sync(data, at, total, BadReason.CRC, found) if at < drop_before else at
        sync: bytes
        frame_id: int
        length: int
        sync, frame_id, length = HEADER.unpack_from(data, at)
        if sync != self._sync:
            return self._skip(data, at)
        if not 1 <= length <= PAYLOAD_BYTES_MAX:
            return self._spend_sync(data, at, at + HEADER_BYTES, BadReason.LENGTH, found)
        end = at + OVERHEAD_BYTES + length
        raw = data[at:end]
        if end > total or inverted_crc32(raw, CRC_START) != CRC_INVERSION:
            is_incomplete = end > total and at >= drop_before
            return at if is_incomplete else self._spend_sync(data, at, end, BadReason.CRC, found)
        found.append(Frame(frame_id, raw, total - end))
        return end

    def _skip(self, data: bytes, at: int) -> int:
        """Count the bytes before the next sync word. Return their end. Bytes of a damaged frame by its length field are
        bad."""
        begin = data.find(self._sync, at)
        end = begin if begin >= 0 else len(data) - data.endswith(self._sync[:1], at)
        bad = max(min(self._bad_ahead, end) - at, 0)
        self.ledger.bytes_in_bad_frames += bad
        self.ledger.bytes_skipped += end - at - bad
        return end

    def _spend_sync(self, data: bytes, at: int, end: int, reason: BadReason, found: list[Frame | BadFrame]) -> int:
        """Reject the frame from `at` to its `end` by the length field: skip only the sync word."""
        ledger = self.ledger
        if reason is BadReason.CRC:
            ledger.frames_bad_crc += 1
        else:
            ledger.frames_bad_length += 1
        ledger.bytes_in_bad_frames += len(self._sync)
        self._bad_ahead = max(self._bad_ahead, end)
        found.append(BadFrame(reason, data[at:end]))
        return at + len(self._sync)

    def _whole_inside(self) -> int:
        """Return the start of the first frame with a correct CRC in the tail, after its own sync word; otherwise 0."""
        tail, sync = self._tail, self._sync
        at = tail.find(sync, len(sync))
        while at > 0:
            length = int.from_bytes(tail[at + 4 : at + HEADER.size], "little")
            raw = tail[at : at + OVERHEAD_BYTES + length]
            if 1 <= length <= PAYLOAD_BYTES_MAX and len(raw) == OVERHEAD_BYTES + length and _crc_matches(raw):
                return at
            at = tail.find(sync, at + len(sync))
        return 0


def _crc_matches(raw: bytes) -> bool:
    return inverted_crc32(raw, CRC_START) == CRC_INVERSION


STATUS_FRAME: Final = 0x00FF
PARAMETER_FRAME: Final = 0x0006

_STATUS_HEAD: Final = struct.Struct("<IIH3I")  # 22 bytes that every model sends
_STATUS_REST: Final = struct.Struct("<IHHBBBB32s")
# End offset of each member of the rest. An incomplete member is absent.
_STATUS_STEPS: Final = tuple(_STATUS_HEAD.size + n for n in (4, 6, 8, 9, 10, 11, 12, 44))
STATUS_BYTES_MIN: Final = _STATUS_HEAD.size
PARAMETERS: Final = struct.Struct("<ffIIii")  # P1, and R1 of commands: value, 0, index, 0, 0, 0 (tables 8 and 11)
ACKNOWLEDGEMENT: Final = struct.Struct("<HH")

RESULT_DONE: Final = 0  # result in K1 for an executed command; assumed


class Parameter(IntEnum):
    """Readable parameters by their index (table 9)."""

    BAUD = 3  # baud rate of the UART, bit/s
    GYRO_X_OFF = 8  # zero bias from the static calibration, °/s; also Y and Z
    GYRO_Y_OFF = 9
    GYRO_Z_OFF = 10
    INSTALL_X_OFF = 16  # mounting error angle, °; also Y and Z
    INSTALL_Y_OFF = 17
    INSTALL_Z_OFF = 18
    AHRS_RATE = 21  # AHRS frames per second, Hz
    BUS_MODE = 27  # bus in addition to the UART, see `commands.BusMode`
    I2C_ADDRESS = 30
    FILTER = 31  # filter codes as in FILTER_CTRL, see `common.filter_codes`


@dataclass(frozen=True, slots=True)
class Status:
    """S1. Members that the model does not send are None; codes are as sent."""

    software_version: int
    hardware_version: int
    model: int
    serial_number: tuple[int, int, int]
    system_status: int | None = None
    cpu_load: int | None = None
    drop_rate: int | None = None
    i2c_master: int | None = None
    voltage: int | None = None
    user_config_fault: int | None = None  # fault code of the flash sector with the settings
    calibration_fault: int | None = None  # fault code of the flash sector with the calibration: not its progress
    imu_health: bytes | None = None  # 32 bytes


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """P1."""

    index: int
    value: float


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """K1."""

    command: int
    result: int  # the raw value


def is_reply(frame_id: int, size: int) -> bool:
    """Return whether a frame is S1, P1 or K1 by its id and the size of its payload."""
    return (
        size == ACKNOWLEDGEMENT.size
        or (frame_id == STATUS_FRAME and size >= STATUS_BYTES_MIN)
        or (frame_id == PARAMETER_FRAME and size >= PARAMETERS.size)
    )


def parse_status(message: Message) -> Status | None:
    """Return S1 of 22 bytes or more; None for another message."""
    if not isinstance(message, ReplyFrame) or message.frame_id != STATUS_FRAME:
        return None
    payload = message.payload
    if len(payload) < STATUS_BYTES_MIN:
        return None
    software, hardware, model, *serial = _STATUS_HEAD.unpack_from(payload)
    padded = payload[STATUS_BYTES_MIN:].ljust(_STATUS_REST.size, b"\x00")
    rest = [
        value if len(payload) >= end else None
        for value, end in zip(_STATUS_REST.unpack_from(padded), _STATUS_STEPS, strict=True)
    ]
    return Status(software, hardware, model, (serial[0], serial[1], serial[2]), *rest)


def parse_parameter(message: Message) -> ParameterValue | None:
    """Return P1; None for another message. Its value may be NaN or infinite."""
    if not isinstance(message, ReplyFrame) or message.frame_id != PARAMETER_FRAME:
        return None
    if len(message.payload) < PARAMETERS.size:
        return None
    value, _, index, *_ = PARAMETERS.unpack_from(message.payload)
    return ParameterValue(index, value)


def parse_acknowledgement(message: Message) -> Acknowledgement | None:
    """Return K1; None for another message."""
    if not isinstance(message, ReplyFrame) or len(message.payload) != ACKNOWLEDGEMENT.size:
        return None
    return Acknowledgement(*ACKNOWLEDGEMENT.unpack(message.payload))


# --- encoder for simulated devices ------------------------------------------------------------------------------


def pack_status(status: Status) -> bytes:
    """Return the payload of S1, up to the first member that is None."""
    head = _STATUS_HEAD.pack(status.software_version, status.hardware_version, status.model, *status.serial_number)
    rest = (
        status.system_status, status.cpu_load, status.drop_rate, status.i2c_master, status.voltage,
        status.user_config_fault, status.calibration_fault, status.imu_health,
    )  # fmt: skip
    there = next((n for n, value in enumerate(rest) if value is None), len(rest))
    values = [b"" if n == 7 else 0 for n in range(8)]
    values[:there] = [value for value in rest[:there] if value is not None]
    end = _STATUS_STEPS[there - 1] if there else STATUS_BYTES_MIN
    return (head + _STATUS_REST.pack(*values))[:end]


def pack_parameters(value: float, index: int) -> bytes:
    """Return the payload of P1 or of a command (R1). Raises OverflowError for a value beyond f32."""
    return PARAMETERS.pack(value, 0.0, index, 0, 0, 0)


def pack_acknowledgement(command: int, result: int) -> bytes:
    """Return the payload of K1."""
    return ACKNOWLEDGEMENT.pack(command, result)


TIMER_MODULUS: Final = 2**32


class Imu61xCodec:
    """Decoder of a byte stream into measurements and reply frames. Synchronization: one thread.

    It counts frames of an unknown kind (`frames_ignored`) and drops them. Short frames of a known kind are bad. For a
    frame with values that are not possible, it returns a `BadFrame` (not-finite) and the measurement without these
    values; the frame counts as good.
    """

    kernel_format: ClassVar = FrameFinder.kernel_format
    word_is_status: ClassVar = False
    sample_frame: ClassVar = AHRS_FRAME  # identifier of the frames with measurements
    STATE: ClassVar = StateTable(
        (Field(1, "unknown", UNKNOWN), Field(2, "_finder", FrameFinder.STATE)),
        {"ledger": DAEMON, "_mag_factor": OPTIONS, "_payload_bytes_min": OPTIONS},
    )

    def __init__(self, ledger: Ledger, settings: Options | None = None) -> None:
        self.ledger = ledger
        self._mag_factor = T_PER_UNIT[getattr(settings, "mag_unit", "ut")]
        self.unknown: dict[int, int] = {}  # number of frames by unknown identifier
        self._finder = FrameFinder(ledger, DEVICE_SYNC)
        # by identifier of a known frame; a shorter frame is bad
        self._payload_bytes_min = {
            AHRS_FRAME: AHRS_BYTES, STATUS_FRAME: STATUS_BYTES_MIN, PARAMETER_FRAME: PARAMETERS.size,
        }  # fmt: skip

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        """Decode the next bytes of the stream. Return the completed events. Never raises an exception."""
        return self._events(self._finder.feed(data))

    def usual_frames(self, data: bytes) -> bytes:
        return self._finder.usual_frames(data)

    def take(self, frames: bytes, count: int, data: bytes) -> bytes:
        return self._finder.take(frames, count, data)

    def flush(self) -> Sequence[CodecEvent]:
        """Return the complete frames inside an incomplete longer frame. imud calls it when the link is idle."""
        return self._events(self._finder.flush())

    def reset(self) -> None:
        """Count the pending bytes as skipped."""
        self._finder.reset()

    def _events(self, found: Sequence[Frame | BadFrame]) -> list[CodecEvent]:
        events: list[CodecEvent] = []
        for frame in found:
            if isinstance(frame, BadFrame):
                events.append(frame)
            else:
                self._add_frame(frame, events)
        return events

    def _add_frame(self, frame: Frame, events: list[CodecEvent]) -> None:
        """Count a frame with a correct CRC and add its event."""
        ledger, frame_id, size = self.ledger, frame.frame_id, len(frame.raw)
        payload_size = size - OVERHEAD_BYTES
        is_short = payload_size < self._payload_bytes_min.get(frame_id, 0)
        measured = frame_id == self.sample_frame and not is_short
        reply = not measured and is_reply(frame_id, payload_size)
        if is_short and not reply:
            ledger.frames_bad_content += 1
            ledger.bytes_in_bad_frames += size
            events.append(BadFrame(BadReason.CONTENT, frame.raw))
            return
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        if measured:
            ledger.frames_in_samples += 1
            self._measure(frame, events)
        elif reply:
            ledger.frames_in_replies += 1
            events.append(ReplyFrame(frame_id, frame.payload))
        else:
            ledger.frames_ignored += 1
            count_unknown(self.unknown, frame_id)

    def _measure(self, frame: Frame, events: list[CodecEvent]) -> None:
        raw = frame.raw
        us, pitch, roll, yaw, ax, ay, az, gx, gy, gz, temperature = AHRS.unpack_from(raw, HEADER_BYTES)
        accel = scaled((ax, ay, az), M_S2_PER_G, ACCEL_LIMIT_G)
        gyro = scaled((gx, gy, gz), RAD_S_PER_DEG_S, GYRO_LIMIT_DEG_S)
        euler = scaled((roll, pitch, yaw), RAD_PER_DEG, TURN_DEG)
        temperature_c = possible_temperature_c(temperature)
        mag, is_field = self._field(raw) if len(raw) == MAG_FRAME_BYTES else (None, True)
        if accel is None or gyro is None or euler is None or temperature_c is None or not is_field:
            self.ledger.frames_not_finite += 1
            events.append(BadFrame(BadReason.NOT_FINITE, raw))
        quat = None if euler is None else quat_from_euler_zyx(euler)
        events.append(Measurement(len(raw), frame.trailing_bytes, us, accel, gyro, mag, quat, euler, temperature_c))

    def _field(self, raw: bytes) -> tuple[Vector3 | None, bool]:
        """Return the magnetic field, T, and whether it is possible. A device without magnetometer sends zeros."""
        sent = MAG.unpack_from(raw, HEADER_BYTES + AHRS_BYTES)
        if not any(sent):
            return None, True
        factor = self._mag_factor
        mag = scaled(sent, factor, MAG_LIMIT_UT * T_PER_UT / factor)
        return mag, mag is not None


# Name and next step of frames that the codec does not decode: without a layout in the manual, or ignored by an option
UNKNOWN_FRAMES: Final = {
    AHRS_FRAME: ("AHRS", "ignored because options.raw_frame is set"),
    0x0166: ("navigation", ""),
    RAW_FRAME: ("raw data", "set options.raw_frame to the layout in the documents of the device, docs/buses.md"),
}


def frame_name(frame_id: int) -> str:
    """Return the name of an unknown frame, for example `navigation (identifier 0x0166)`."""
    name, step = UNKNOWN_FRAMES.get(frame_id, ("", ""))
    words = f"identifier {frame_id:#06x}" + f", {step}" * bool(step)
    return f"{name} ({words})" if name else words


# --- encoder for simulated devices ------------------------------------------------------------------------------

K1_FRAME: Final = 0x000C  # id of K1 from the simulator; no document states it, and the codec accepts any id


def encode_ahrs(
    *,
    timer_us: int,
    accel_m_s2: Vector3,
    gyro_rad_s: Vector3,
    euler_rad: Vector3,
    temperature_c: float,
    mag_t: Vector3 | None = None,
) -> bytes:
    """Return a complete AHRS frame from SI values, of 56 bytes with `mag_t`. `euler_rad` is roll, pitch, yaw. Raises
    OverflowError beyond f32."""
    roll, pitch, yaw = euler_rad
    payload = AHRS.pack(
        timer_us % TIMER_MODULUS,
        *(angle / RAD_PER_DEG for angle in (pitch, roll, yaw)),
        *(a / M_S2_PER_G for a in accel_m_s2),
        *(w / RAD_S_PER_DEG_S for w in gyro_rad_s),
        temperature_c,
    )
    field = b"" if mag_t is None else MAG.pack(*(tesla / T_PER_UT for tesla in mag_t))
    return encode_frame(DEVICE_SYNC, AHRS_FRAME, payload + field)


def encode_status(status: Status) -> bytes:
    """Return a complete S1 frame."""
    return encode_frame(DEVICE_SYNC, STATUS_FRAME, pack_status(status))


def encode_parameter(index: int, value: float) -> bytes:
    """Return a complete P1 frame."""
    return encode_frame(DEVICE_SYNC, PARAMETER_FRAME, pack_parameters(value, index))


def encode_acknowledgement(command: int, result: int = RESULT_DONE, frame_id: int = K1_FRAME) -> bytes:
    """Return a complete K1 frame."""
    return encode_frame(DEVICE_SYNC, frame_id, pack_acknowledgement(command, result))
