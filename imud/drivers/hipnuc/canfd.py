"""HiPNUC devices with newer firmware on CAN FD: a sample in one frame. Sources: the vendor's public SDK and documents.

    0CFF5B08   PGN FF5B | source 08, the address of the device
    0        4            6            7          8
    +--------+------------+------------+----------+-----------------------------------+---------+
    | bitmap | status u16 | INS status | sequence | HI83 fields of the bits 0-6 and 8 | padding |
    +--------+------------+------------+----------+-----------------------------------+---------+

    0CFF5A08   PGN FF5A of older firmware, 64 bytes
    0        2      4         8       14     20     26                  38           46            48
    +--------+------+---------+-------+------+------+-------------------+------------+-------------+---+
    | status | 0    | time ms | accel | gyro | mag  | roll pitch yaw i32| quaternion | temperature | 0 |
    +--------+------+---------+-------+------+------+-------------------+------------+-------------+---+

Otherwise 16 bits, little-endian, with the scales of J1939. The padding fills the frame up to the next length of CAN FD,
or to 64 bytes; imud ignores its values. A bitmap with other bits, or another length, makes the frame bad. The
address, the registers and the requests of `j1939` also apply to these devices (assumption: the intervals of FF5A and
FF5B have registers at the same offset as the intervals of the other messages).

The sequence number and the period of the frames prove losses (`assembly.KindLosses`).
"""

import struct
from collections.abc import Sequence
from dataclasses import replace
from random import Random
from typing import Any, ClassVar, Final

import msgspec

from imud.attitude.rotation import euler312_from_quat
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, wrong_length
from imud.contracts.driver import random_vector
from imud.drivers.hipnuc.assembly import KindLosses
from imud.drivers.hipnuc.assembly_state import KIND_LOSSES, SAME_ADDRESS
from imud.drivers.hipnuc.common import (
    ACCEL_M_S2_PER_LSB,
    EULER_RAD_PER_LSB,
    GYRO_RAD_S_PER_LSB,
    MAG_T_PER_LSB,
    MAIN_STATUS,
    QUAT_PER_LSB,
    TEMPERATURE_C_PER_LSB,
    counts_of,
    field_of,
    random_quaternion,
    vector_of,
)
from imud.drivers.hipnuc.frame_copies import REPETITION_NS
from imud.drivers.hipnuc.j1939 import commands
from imud.drivers.hipnuc.j1939.codec import (
    CONFIGURE,
    FAST,
    FAST_OLD,
    HOST_ADDRESS,
    NODE_OTHER,
    NodeCodec,
    NodeOptions,
    encode,
)
from imud.drivers.hipnuc.j1939.driver import DRIVER as J1939
from imud.drivers.hipnuc.same_address import SameAddress
from imud.drivers.hipnuc.uart import ins
from imud.drivers.state import TIME, UNKNOWN
from imud.drivers.value_limits import possible_angles, possible_quaternion, possible_temperature_c
from imud.formats.can import FD_DATA_BYTES_MAX, FD_LENGTHS, CanFilter, CanFrame
from imud.formats.j1939 import ADDRESS_MAX, filter_of, split
from imud.formats.state import Data, Field, Map, New, OneOf, Row, StateError, StateTable
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.model.units import NS_PER_MS

HEAD: Final = struct.Struct("<IHBB")  # bitmap, main status, INS status, sequence number
# status, time, acceleration, angular rate, field, roll pitch yaw, quaternion, temperature
OLD: Final = struct.Struct("<H2xI9h3i5h16x")
FIELD_BITS: Final = (0, 1, 2, 3, 4, 5, 6, 8)
KNOWN_BITS: Final = sum(1 << bit for bit in FIELD_BITS)
PGNS: Final = (FAST_OLD, FAST)


class HipnucCanfdOptions(NodeOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a device on CAN FD."""


def padded(size: int) -> int:
    """Return the length of the shortest CAN FD frame for a number of bytes; 0 above the maximum."""
    return next((length for length in FD_LENGTHS if length >= size), 0)


_PGN: Final = OneOf(*PGNS)


def _check_losses(codec: Any) -> None:
    if codec._losses.keys() != set(PGNS):
        raise StateError("expected the losses of each PGN")


class HipnucCanfdCodec(NodeCodec):
    """Decoder of the frames of one device."""

    STATE: ClassVar = StateTable(
        (
            Field(1, "unknown", UNKNOWN),
            Field(2, "_same_address", SAME_ADDRESS),
            Field(3, "_newest", Map(_PGN, Row(Data(FD_DATA_BYTES_MAX), TIME), len(PGNS))),
            Field(4, "_losses", Map(_PGN, New(KIND_LOSSES, lambda _codec: KindLosses()), len(PGNS))),
        ),
        NODE_OTHER,
        _check_losses,
    )

    def __init__(self, ledger: Ledger, settings: HipnucCanfdOptions) -> None:
        super().__init__(ledger, settings, PGNS)
        self._same_address = SameAddress()
        self._newest: dict[int, tuple[bytes, int]] = {}  # newest frame of each PGN, and its arrival
        self._losses = {pgn: KindLosses() for pgn in PGNS}

    @property
    def problem(self) -> str:
        """Return the address conflict that the frames show; empty without a conflict."""
        return self._same_address.problem

    def _decode(self, pgn: int, can_id: int, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        ledger, size = self.ledger, len(data)
        sequence = None
        if pgn == FAST:
            bitmap = int.from_bytes(data[:4], "little")
            if size >= HEAD.size and bitmap & ~KNOWN_BITS:
                ledger.bytes_in_bad_frames += size
                ledger.frames_bad_content += 1
                return (BadFrame(BadReason.CONTENT, data, can_id),)
            # The documents allow "padding up to a valid CAN FD length". The vendor's parsers check a minimum length.
            shortest = padded(ins.hi83_size(bitmap))
            is_length = shortest >= HEAD.size and size in (shortest, FD_DATA_BYTES_MAX)
            sequence = data[HEAD.size - 1] if is_length else None
        else:
            is_length = size == OLD.size
        if not is_length:
            return wrong_length(ledger, can_id, data)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        newest, newest_ns = self._newest.get(pgn, (b"", 0))
        if data == newest and t_rx_ns - newest_ns < REPETITION_NS:  # a repetition by the bus
            ledger.frames_ignored += 1
            return ()
        self._newest[pgn] = data, t_rx_ns
        ledger.frames_in_samples += 1
        self._same_address.add_frame(pgn, t_rx_ns, sequence)
        ledger.lost_gap_device += self._losses[pgn].add(t_rx_ns, sequence)
        made, is_possible = _fast(data, t_rx_ns) if pgn == FAST else _old(data, t_rx_ns)
        self._same_address.add_values(made)
        if is_possible:
            return (made,)
        ledger.frames_not_finite += 1
        return BadFrame(BadReason.NOT_FINITE, data, can_id), made

    def flush(self) -> Sequence[CodecEvent]:
        """Return nothing: each frame makes a sample."""
        return ()

    def reset(self) -> None:
        """Forget the newest frames."""
        self._newest.clear()


def _fast(data: bytes, t_rx_ns: int) -> tuple[Measurement, bool]:
    """Return the measurement of FF5B, and whether all values are possible."""
    bitmap, status, ins_status, _ = HEAD.unpack_from(data)
    packet = ins.HI83_HEAD.pack(ins.TAG_HI83, status, ins_status, bitmap) + data[HEAD.size :]
    made, is_possible = ins.decode_hi83(packet, 0, True, len(data), 0)
    return msgspec.structs.replace(made, t_first_ns=t_rx_ns), is_possible


def _old(data: bytes, t_rx_ns: int) -> tuple[Measurement, bool]:
    """Return the measurement of FF5A, and whether all values are possible."""
    status, time_ms, ax, ay, az, gx, gy, gz, mx, my, mz, roll, pitch, yaw, qw, qx, qy, qz, celsius = OLD.unpack(data)
    angle, q = EULER_RAD_PER_LSB, QUAT_PER_LSB
    euler = possible_angles((roll * angle, pitch * angle, yaw * angle))
    return Measurement(
        len(data), 0, time_ms, vector_of(ax, ay, az, ACCEL_M_S2_PER_LSB), vector_of(gx, gy, gz, GYRO_RAD_S_PER_LSB),
        field_of(mx, my, mz), possible_quaternion(qw * q, qx * q, qy * q, qz * q), euler,
        possible_temperature_c(celsius * TEMPERATURE_C_PER_LSB), None, None,
        None if status & ins.RESERVED_STATUS else status, t_first_ns=t_rx_ns,
    ), euler is not None  # fmt: skip


# --- encoder for simulated devices ------------------------------------------------------------------------------


def pack_fast(
    values: Measurement, bitmap: int, sequence: int, *, status: int = 0, ins_status: int = 0, time_us: int = 0
) -> bytes:
    """Return FF5B with the fields of `bitmap`. Raises ValueError for NaN, and for more bytes than a frame has."""
    packet = ins.pack_hi83(values, bitmap, system_time_us=time_us)
    if len(packet) > FD_DATA_BYTES_MAX:
        raise ValueError(f"bitmap {bitmap:#x}: expected at most {FD_DATA_BYTES_MAX} bytes, got {len(packet)}")
    head = HEAD.pack(bitmap, status, ins_status, sequence % 256)
    return (head + packet[ins.HI83_HEAD.size :]).ljust(padded(len(packet)), b"\0")


def pack_old(values: Measurement, time_ms: int, status: int = 0) -> bytes:
    """Return FF5A. Absent values are zeros; values are clipped to the range of their field."""
    zero = (0.0, 0.0, 0.0)
    fields = (
        (values.accel_m_s2 or zero, ACCEL_M_S2_PER_LSB, 16), (values.gyro_rad_s or zero, GYRO_RAD_S_PER_LSB, 16),
        (values.mag_t or zero, MAG_T_PER_LSB, 16), (values.euler_rad or zero, EULER_RAD_PER_LSB, 32),
        (values.quat_wxyz or (0.0, 0.0, 0.0, 0.0), QUAT_PER_LSB, 16),
        ((values.temperature_c or 0.0,), TEMPERATURE_C_PER_LSB, 16),
    )  # fmt: skip
    counts = [counts_of(value / scale, bits) for vector, scale, bits in fields for value in vector]
    return OLD.pack(status, time_ms % 2**32, *counts)


def _example_frames(random: Random) -> list[CanFrame]:
    """Return FF5B with acceleration, angular rate, quaternion and angles."""
    quat, bitmap = random_quaternion(random), 1 << ins.ACCEL | 1 << ins.GYRO | 1 << ins.QUAT | 1 << ins.EULER
    values = Measurement(
        0, 0, None, random_vector(random, 9.8), random_vector(random, 2), quat_wxyz=quat,
        euler_rad=euler312_from_quat(quat),
    )  # fmt: skip
    can_id, data = encode(FAST, pack_fast(values, bitmap, random.randrange(256)))
    return [CanFrame(can_id, True, data, 0)]


def _filters(settings: HipnucCanfdOptions) -> list[CanFilter]:
    """Return the filters for the samples and replies of one device."""
    hosts = sorted({settings.host_address, HOST_ADDRESS})
    return [filter_of(pgn, settings.address) for pgn in PGNS] + [
        filter_of(CONFIGURE, settings.address, host) for host in hosts
    ]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    parts = split(can_id)
    is_one = extended and parts.pgn in PGNS and len(data) >= HEAD.size
    return parts.source if is_one and parts.source <= ADDRESS_MAX else None


DRIVER: Final = replace(
    J1939,
    name="hipnuc-canfd",
    title="HiPNUC devices with newer firmware (CAN FD)",
    settings=HipnucCanfdOptions,
    make_codec=HipnucCanfdCodec,
    filters=_filters,
    tick_ns=NS_PER_MS,
    tick_modulus=ins.TICK_MODULUS,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above",
    status_bits=MAIN_STATUS,
    renamed={},
    node_of=_node_of,
    node_settings=lambda address: HipnucCanfdOptions(address=address),
    identify=lambda settings: commands.identify(settings.peer),
    sample_frames=1,
    example_frames=_example_frames,
    decoded="imud decodes FF5A and FF5B on CAN FD: enable one of these PGNs in the device",
)
