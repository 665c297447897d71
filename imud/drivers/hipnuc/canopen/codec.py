"""HiPNUC devices on CAN with CANopen. Manual "IMU配置手冊" V1.5.9, chapter 5; corrections ERRATA B5, B6, B17, B18.

Standard frames, little-endian, one TPDO per quantity; identifier = function + node number (factory value 8):

    ┌───────┬───────┬───────────────────────────────────────┐
    │ TPDO1 │ 0x180 │ accel x, y, z             i16 × 3     │  0.001 G, 1 G = 9.8 m/s²
    │ TPDO2 │ 0x280 │ gyro x, y, z              i16 × 3     │  0.1 °/s
    │ TPDO3 │ 0x380 │ roll, pitch, yaw          i16 × 3     │  0.01°
    │ TPDO4 │ 0x480 │ quaternion w, x, y, z     i16 × 4     │  0.0001
    │ TPDO6 │ 0x680 │ pressure                  i32         │  Pa
    │ TPDO7 │ 0x780 │ inclinometer x, y         i32 × 2     │  0.01°
    └───────┴───────┴───────────────────────────────────────┘

The firmware divides by 1 G = 9.8 m/s², not by standard gravity. The TPDOs have no counter and no time; `assembly` makes
samples of them. The node sends each TPDO by its own timer, or after SYNC (0x080).

Other frames of a node: SDO replies (0x580) are reply frames. A heartbeat (0x700, the first is the boot-up message) is a
reply frame if the state changed or is not operational. Emergencies (0x080 + node) are ignored.
"""

import struct
from collections.abc import Sequence
from typing import Annotated, ClassVar, Final, Literal

from msgspec import Meta

from imud.attitude.rotation import quat_from_euler312
from imud.contracts.codec import CodecEvent, count_unknown, wrong_length
from imud.contracts.script import ReplyFrame
from imud.drivers.hipnuc.assembly import Assembled, Assembly
from imud.drivers.hipnuc.assembly_state import ASSEMBLY, check_parts
from imud.drivers.hipnuc.canopen.cia301 import (
    EMERGENCY,
    HEARTBEAT,
    NMT,
    NODE_DEFAULT,
    NODE_MASK,
    NODE_MAX,
    SDO_BYTES,
    SDO_REPLY,
    SDO_REQUEST,
    TPDO_FUNCTIONS,
    NmtState,
    TpdoNumber,
)
from imud.drivers.hipnuc.common import M_S2_PER_G, QUAT_PER_LSB, pressure_of, vector_of
from imud.drivers.state import DAEMON, OPTIONS, UNKNOWN
from imud.drivers.value_limits import possible_angles, possible_quaternion
from imud.formats.state import Field, Integer, StateTable
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Pair, Quaternion, Vector3
from imud.model.units import RAD_PER_DEG

THREE: Final = struct.Struct("<3h")
FOUR: Final = struct.Struct("<4h")
ONE_LONG: Final = struct.Struct("<i")
TWO_LONG: Final = struct.Struct("<2i")
# Data layout of each TPDO, by its number
LAYOUTS: Final = {1: THREE, 2: THREE, 3: THREE, 4: FOUR, 6: ONE_LONG, 7: TWO_LONG}

ACCEL_M_S2_PER_LSB: Final = 0.001 * M_S2_PER_G
GYRO_RAD_S_PER_LSB: Final = 0.1 * RAD_PER_DEG
EULER_RAD_PER_LSB: Final = 0.01 * RAD_PER_DEG
INCLI_RAD_PER_LSB: Final = 0.01 * RAD_PER_DEG

SYNC_HZ_MIN, SYNC_HZ_MAX = 0.01, 200.0
NOT_OF_NODE: Final = (NMT, SDO_REQUEST)  # functions of frames that a node does not send


class HipnucCanopenOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a node, and of SYNC."""

    node: Annotated[int, Meta(ge=1, le=NODE_MAX)] = NODE_DEFAULT
    """Node number; factory value 8."""
    tpdos: list[TpdoNumber] | Literal["auto"] = "auto"
    """TPDOs that make samples, for example [1, 2, 3]; auto = all received TPDOs."""
    sync_hz: Annotated[float, Meta(ge=0, le=SYNC_HZ_MAX)] = 0.0
    """SYNC frames per second for TPDOs of type 1, sent by one device per bus. 0 = no SYNC, the TPDOs use their
    timers.
    """

    def __post_init__(self) -> None:
        if 0 < self.sync_hz < SYNC_HZ_MIN:
            raise ValueError(f"sync_hz: expected 0, or {SYNC_HZ_MIN} to {SYNC_HZ_MAX:g}, got {self.sync_hz}")


_SIZES: Final = {number: layout.size for number, layout in LAYOUTS.items()}  # length of each TPDO, bytes


class HipnucCanopenCodec:
    """Decoder of the TPDOs of one node. Synchronization: one thread."""

    counts_losses = True
    STATE: ClassVar = StateTable(
        (
            Field(1, "_assembly", ASSEMBLY),
            Field(2, "_state", Integer(0, 0xFF)),
            Field(3, "unknown", UNKNOWN),
        ),
        {
            "ledger": DAEMON, "_tpdos": OPTIONS, "_sdo_id": OPTIONS, "_heartbeat_id": OPTIONS,
            "_emergency_id": OPTIONS, "_node": OPTIONS,
        },
        lambda codec: check_parts(codec._assembly, _SIZES),
    )  # fmt: skip

    def __init__(self, ledger: Ledger, settings: HipnucCanopenOptions) -> None:
        self.ledger = ledger
        node, wanted = settings.node, settings.tpdos
        self._tpdos = {function + node: (number, LAYOUTS[number].size) for number, function in TPDO_FUNCTIONS.items()}
        self._sdo_id, self._heartbeat_id, self._emergency_id = SDO_REPLY + node, HEARTBEAT + node, EMERGENCY + node
        self._assembly = Assembly(ledger, None if wanted == "auto" else frozenset(wanted))
        self._state = NmtState.OPERATIONAL.value
        self._node = node
        self.unknown: dict[int, int] = {}  # number of frames by unknown identifier of this node

    @property
    def problem(self) -> str:
        """Return the address conflict that the frames show; empty without a conflict."""
        return self._assembly.problem

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Add one frame. Return the completed events. Never raises an exception."""
        ledger, size = self.ledger, len(data)
        ledger.bytes_in += size
        tpdo = self._tpdos.get(can_id)
        if tpdo is None or extended:
            return self._other(can_id, extended, data)
        number, expected = tpdo
        if size != expected:
            return wrong_length(ledger, can_id, data)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        made = self._assembly.add_frame(number, data, t_rx_ns)
        return self._assembly.watched([_measurement(one) for one in made]) if made else ()

    def flush(self) -> Sequence[CodecEvent]:
        """Return the incomplete sample."""
        return self._assembly.watched([_measurement(one) for one in self._assembly.flush()])

    def reset(self) -> None:
        """Drop the incomplete sample after lost frames."""
        self._assembly.reset()

    def _other(self, can_id: int, extended: bool, data: bytes) -> Sequence[CodecEvent]:
        """Decode a frame other than a TPDO of this node."""
        ledger, size = self.ledger, len(data)
        if extended or can_id not in (self._sdo_id, self._heartbeat_id, self._emergency_id):
            ledger.bytes_skipped += size
            if not extended and can_id & NODE_MASK == self._node and can_id - self._node not in NOT_OF_NODE:
                count_unknown(self.unknown, can_id)
            return ()
        if size != (1 if can_id == self._heartbeat_id else SDO_BYTES):
            return wrong_length(ledger, can_id, data)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        if can_id == self._sdo_id or (can_id == self._heartbeat_id and self._is_news(data[0])):
            ledger.frames_in_replies += 1
            return (ReplyFrame(can_id, data),)
        ledger.frames_ignored += 1
        return ()

    def _is_news(self, state: int) -> bool:
        """Store the state of a heartbeat. Return whether it changed or the node sends no TPDOs in it."""
        changed = state != self._state
        self._state = state
        if state == NmtState.BOOT_UP.value:
            self._assembly.reset()
        return changed or state != NmtState.OPERATIONAL.value


def _measurement(assembled: Assembled) -> Measurement:
    """Return the measurement of a set of TPDOs. Without a quaternion, the attitude is computed from the angles."""
    frames = dict(assembled.frames)
    euler = _vector(frames.get(3), EULER_RAD_PER_LSB)
    quat: Quaternion | None = None
    if 4 in frames:
        quat = possible_quaternion(*(part * QUAT_PER_LSB for part in FOUR.unpack(frames[4])))
    if quat is None and euler is not None:
        quat = quat_from_euler312(euler)
    incli: Pair | None = None
    if 7 in frames:
        x, y = TWO_LONG.unpack(frames[7])
        incli = possible_angles((x * INCLI_RAD_PER_LSB, y * INCLI_RAD_PER_LSB))
    return Measurement(
        sum(map(len, frames.values())), 0, None,
        accel_m_s2=_vector(frames.get(1), ACCEL_M_S2_PER_LSB),
        gyro_rad_s=_vector(frames.get(2), GYRO_RAD_S_PER_LSB),
        quat_wxyz=quat,
        euler_rad=euler,
        pressure_pa=pressure_of(float(ONE_LONG.unpack(frames[6])[0])) if 6 in frames else None,
        incli_rad=incli,
        t_first_ns=assembled.t_first_ns,
    )  # fmt: skip


def _vector(data: bytes | None, factor: float) -> Vector3 | None:
    if data is None:
        return None
    x, y, z = THREE.unpack(data)
    return vector_of(x, y, z, factor)


# --- encoder for simulated devices ------------------------------------------------------------------------------


def encode_tpdos(
    *,
    accel_m_s2: Vector3 | None = None,
    gyro_rad_s: Vector3 | None = None,
    euler_rad: Vector3 | None = None,
    quat_wxyz: Quaternion | None = None,
    pressure_pa: float | None = None,
    incli_rad: Pair | None = None,
) -> dict[int, bytes]:
    """Return the data of the TPDOs by number, in sending order, for the given SI values.

    Raises struct.error for a value out of range, for example 32.767 G.
    """
    values: dict[int, tuple[Sequence[float] | None, float]] = {
        1: (accel_m_s2, ACCEL_M_S2_PER_LSB),
        2: (gyro_rad_s, GYRO_RAD_S_PER_LSB),
        3: (euler_rad, EULER_RAD_PER_LSB),
        4: (quat_wxyz, QUAT_PER_LSB),
        6: (None if pressure_pa is None else (pressure_pa,), 1.0),
        7: (incli_rad, INCLI_RAD_PER_LSB),
    }
    return {
        number: LAYOUTS[number].pack(*(round(value / factor) for value in vector))
        for number, (vector, factor) in values.items()
        if vector is not None
    }
