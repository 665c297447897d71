"""HiPNUC devices and other heading or attitude sensors on NMEA 2000.

    09F112ss  127250 Vessel Heading     09F113ss  127251 Rate of Turn     0DF119ss  127257 Attitude

ss is the address of the sender, which NMEA 2000 can change each time the bus is assembled. `source: auto` selects the
first sender of these messages and keeps it. The sender claims each new address with its NAME (60928), and imud follows
the NAME. If the NAME is unknown, imud follows a claim after which only the new address sends. After SILENT_NS without a
message, imud selects the next sender, and counts a gap of unknown size. imud claims no address and sends no requests.

Messages of one instant should have the same SID. Real senders also number each PGN independently, or send a constant
SID. `assembly.py` makes samples by the period of each PGN, and uses SIDs only while they agree.

A sender may send its heading twice, from true and from magnetic north. `heading` selects one; `auto` selects the first
received reference and keeps it. imud ignores the other heading. It does not apply deviation and variation.
"""

from collections.abc import Mapping, Sequence
from math import isfinite, nan, pi, tau
from random import Random
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple

from msgspec import Meta

from imud.attitude.conventions import Heading
from imud.attitude.rotation import euler312_from_quat, quat_from_euler312
from imud.contracts.codec import CodecEvent, count_unknown, wrong_length
from imud.contracts.driver import SAMPLE_COUNTER, CanDriver, Identity
from imud.contracts.script import says_nothing
from imud.drivers.hipnuc.assembly import Assembled, Assembly
from imud.drivers.hipnuc.assembly_state import ASSEMBLY, check_parts
from imud.drivers.hipnuc.common import FLOATS, random_quaternion
from imud.drivers.state import DAEMON, FLAG, OPTIONS, TIME, UNKNOWN
from imud.formats import nmea2000
from imud.formats.can import CanFilter, CanFrame
from imud.formats.j1939 import (
    ADDRESS_MAX,
    CLAIMED,
    GLOBAL,
    WITHOUT_PRIORITY,
    J1939Id,
    all_of,
    filter_of,
    join,
    pgn_name,
    sender_of,
    split,
)
from imud.formats.nmea2000 import (
    ATTITUDE,
    ATTITUDE_LAYOUT,
    HEADING,
    HEADING_LAYOUT,
    HEADING_MOST,
    I16_MOST,
    I32_MOST,
    MESSAGE_BYTES,
    NAME_BYTES,
    PRIORITIES,
    RAD_PER_LSB,
    RATE_LAYOUT,
    RATE_OF_TURN,
    RATE_RAD_S_PER_LSB,
    SID_MOST,
    Reference,
)
from imud.formats.state import Data, Field, Integer, Map, Maybe, Row, StateTable, member_of
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.sample import Measurement, Vector3
from imud.model.units import NS_PER_S

PGNS: Final = (HEADING, RATE_OF_TURN, ATTITUDE)
_NOTHING: Final = (b"\xff" * 7, b"\x7f" * 7)  # filler bytes after the SID of a message without values


class Head(NamedTuple):
    """Header of a message."""

    sid: int | None  # number of the instant, equal in all messages of one instant; None without a number
    reference: Reference | None  # reference of a heading


def head_of(pgn: int, data: bytes) -> Head:
    """Return the header of a message of eight bytes."""
    reference = Reference(data[7] & 3) if pgn == HEADING else None
    return Head(data[0] if data[0] <= SID_MOST else None, reference)


def measurement_of(
    messages: Sequence[tuple[int, bytes]], t_first_ns: int | None = None, *, heading_elsewhere: bool = False
) -> Measurement:
    """Return the measurement of messages (PGN, data) of one instant, each PGN at most once.

    Yaw is from the heading, otherwise from the attitude. `heading_elsewhere`: the device sends its heading in other
    samples.
    """
    roll = pitch = yaw = rate = nan
    has_heading = heading_elsewhere
    for pgn, data in messages:
        if data.endswith(_NOTHING):
            has_heading = has_heading or pgn == HEADING
        elif pgn == HEADING:
            _, heading, _, _, reference = HEADING_LAYOUT.unpack(data)
            has_heading = True
            is_good = heading <= HEADING_MOST and reference & 3 != Reference.ERROR
            yaw = _counter_clockwise(heading) if is_good else nan
        elif pgn == RATE_OF_TURN:
            _, counts = RATE_LAYOUT.unpack(data)
            rate = -counts * RATE_RAD_S_PER_LSB if counts <= I32_MOST else nan
        else:
            _, clockwise, pitch_counts, roll_counts, _ = ATTITUDE_LAYOUT.unpack(data)
            roll, pitch = _angle(roll_counts), _angle(pitch_counts)
            if not has_heading and clockwise <= I16_MOST:
                yaw = _counter_clockwise(clockwise)
    euler = (roll, pitch, yaw)
    is_whole = isfinite(roll + pitch + yaw)
    return Measurement(
        MESSAGE_BYTES * len(messages), 0, None,
        gyro_rad_s=(nan, nan, rate) if isfinite(rate) else None,
        quat_wxyz=quat_from_euler312(euler) if is_whole else None,
        euler_rad=euler if is_whole or any(map(isfinite, euler)) else None,
        t_first_ns=t_first_ns,
    )  # fmt: skip


def _angle(counts: int) -> float:
    return counts * RAD_PER_LSB if counts <= I16_MOST else nan


def _counter_clockwise(clockwise: int) -> float:
    """Return the yaw in ±π of a clockwise angle in counts."""
    angle = -clockwise * RAD_PER_LSB
    return angle if -pi <= angle <= pi else (angle + pi) % tau - pi


# --- encoder for simulated devices ------------------------------------------------------------------------------


def pack_heading(sid: int, yaw_rad: float | None, reference: Reference) -> bytes:
    """Return 127250 of a counter-clockwise yaw, without deviation and variation; None means "not available"."""
    return nmea2000.pack_heading(sid, None if yaw_rad is None else -yaw_rad, reference)


def pack_rate_of_turn(sid: int, gyro_z_rad_s: float | None) -> bytes:
    """Return 127251 of a counter-clockwise rate."""
    return nmea2000.pack_rate_of_turn(sid, None if gyro_z_rad_s is None else -gyro_z_rad_s)


def pack_attitude(sid: int, euler_rad: Vector3, *, has_yaw: bool = True) -> bytes:
    """Return the data of a frame with PGN 127257. The yaw of `euler_rad` is counter-clockwise."""
    roll, pitch, yaw = euler_rad
    return nmea2000.pack_attitude(sid, roll, pitch, -yaw if has_yaw else None)


# Time without a message after which imud selects another sender, ns. The slowest message has a period of 1 s.
SILENT_NS: Final = 3 * NS_PER_S
MOVED_PERIODS: Final = 2  # minimum silence of the previous address in periods, if the NAME of the sender is unknown
SENDERS_SHOWN: Final = 8  # maximum number of other senders in a text

_PGNS: Final = {join(J1939Id(0, pgn, 0)): pgn for pgn in PGNS}  # PGN by identifier without priority and source
_CLAIM: Final = join(J1939Id(0, CLAIMED, 0))  # identifier of a claim without priority and source
_REFERENCES: Final = {"true": Reference.TRUE, "magnetic": Reference.MAGNETIC, "auto": None}


class HipnucNmea2000Options(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a heading or attitude sensor."""

    source: Literal["auto"] | Annotated[int, Meta(ge=0, le=ADDRESS_MAX)] = "auto"
    """Address of the sender. `auto` selects the first sender that imud receives, and another sender if that sender
    stops."""
    heading: Literal["auto", "true", "magnetic"] = "auto"
    """Heading to use if the sender sends two; `auto` = the first received reference."""


_ADDRESS: Final = Integer(0, ADDRESS_MAX)
_NAME: Final = Data(NAME_BYTES, NAME_BYTES)
_SIZES: Final = dict.fromkeys(PGNS, MESSAGE_BYTES)  # length of the messages of a sample, bytes


class HipnucNmea2000Codec:
    """Decoder of the frames of one sender. Synchronization: one thread."""

    counts_losses = True
    STATE: ClassVar = StateTable(
        (
            Field(1, "_source", Maybe(_ADDRESS)),
            Field(2, "_assembly", ASSEMBLY),
            Field(3, "_reference", Maybe(member_of(Reference))),
            Field(4, "_has_heading", FLAG),
            Field(5, "_heard_ns", TIME),
            Field(6, "_frames", Map(_ADDRESS, Integer(0, 2), ADDRESS_MAX + 1)),
            Field(7, "unknown", UNKNOWN),
            Field(8, "_frame_ns", Map(_ADDRESS, TIME, ADDRESS_MAX + 1)),
            Field(9, "_names", Map(_ADDRESS, _NAME, ADDRESS_MAX + 1)),
            Field(10, "_claim", Maybe(Row(_ADDRESS, TIME))),
            Field(11, "_name", Maybe(_NAME)),
            Field(12, "_is_displaced", FLAG),
        ),
        {"ledger": DAEMON, "_fixed": OPTIONS, "_wanted_reference": OPTIONS},
        lambda codec: check_parts(codec._assembly, _SIZES),
    )

    def __init__(self, ledger: Ledger, settings: HipnucNmea2000Options) -> None:
        self.ledger = ledger
        self._fixed = None if settings.source == "auto" else settings.source
        self._wanted_reference = _REFERENCES[settings.heading]
        self._source: int | None = None  # address of the sender; None if it is unknown
        self._heard_ns = 0
        self._frames: dict[int, int] = {}  # number of frames by source, at most 2; empty if options.source is set
        self._frame_ns: dict[int, int] = {}  # arrival of the newest frame by source
        self._names: dict[int, bytes] = {}  # NAME of the owner of each address, from claims
        self._claim: tuple[int, int] | None = None  # address and time of the newest claim of another address
        self._name: bytes | None = None  # NAME of the sender; None if it is unknown
        self._is_displaced = False  # whether another node has the address of the sender
        self._set_sender(self._fixed)
        self.unknown: dict[int, int] = {}  # number of frames by unknown PGN

    @property
    def problem(self) -> str:
        """Return the address conflict, or the other senders that the frames show; empty without them."""
        others = [f"source {source}" for source in self._frames if self._is_other(source)]
        if not others:
            return self._assembly.problem
        more = f" and {len(others) - SENDERS_SHOWN} more" * (len(others) > SENDERS_SHOWN)
        named = (
            f"several devices send these PGNs: imud uses source {self._source} and ignores "
            f"{', '.join(others[:SENDERS_SHOWN])}{more}; select a device with options.source"
        )
        return "; ".join(filter(None, (self._assembly.problem, named)))

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """Add one frame. Return the completed events. Never raises an exception."""
        ledger, size = self.ledger, len(data)
        ledger.bytes_in += size
        group_id = can_id & WITHOUT_PRIORITY & ~0xFF
        pgn = _PGNS.get(group_id) if extended else None
        if pgn is None and extended and group_id == _CLAIM and self._fixed is None:
            ledger.bytes_skipped += size
            self._add_claim(can_id & 0xFF, data, t_rx_ns)
            return ()
        if pgn is None or not self._is_sender(can_id & 0xFF, t_rx_ns):
            ledger.bytes_skipped += size
            if pgn is None and extended and self._source in (None, can_id & 0xFF):
                count_unknown(self.unknown, split(can_id).pgn)
            return ()
        if size != MESSAGE_BYTES:
            return wrong_length(ledger, can_id, data)
        ledger.bytes_in_good_frames += size
        ledger.frames_good += 1
        sid, reference = head_of(pgn, data)
        if reference is not None and not self._is_reference(reference):
            ledger.frames_ignored += 1
            return ()
        self._has_heading |= pgn == HEADING
        return self._measurements(self._assembly.add_frame(pgn, data, t_rx_ns, sid))

    def flush(self) -> Sequence[CodecEvent]:
        """Return the incomplete sample."""
        return self._measurements(self._assembly.flush())

    def reset(self) -> None:
        """Drop the incomplete sample after lost frames."""
        self._assembly.reset()

    # --- selection of sender and reference --------------------------------------------------------------------------

    def _is_other(self, source: int) -> bool:
        """Return whether a second sender uses this address now."""
        is_sending = self._heard_ns - self._frame_ns.get(source, 0) <= SILENT_NS
        return source != self._source and self._frames[source] > 1 and is_sending

    def _is_sender(self, source: int, t_rx_ns: int) -> bool:
        if self._fixed is None and source <= ADDRESS_MAX:
            self._frames[source] = min(self._frames.get(source, 0) + 1, 2)
            self._frame_ns[source] = t_rx_ns
        if source != self._source or self._is_displaced:
            silent_ns = t_rx_ns - self._heard_ns
            if self._fixed is not None or source > ADDRESS_MAX:
                return False
            if self._has_moved_to(source, silent_ns):
                self._source = source
                self._name = self._names.get(source)
            elif self._source is None or silent_ns > SILENT_NS:
                if self._source is not None:
                    self.ledger.add_unknown_gap()
                self._assembly.reset()
                self._set_sender(source)
            else:
                return False
        self._heard_ns = t_rx_ns
        return True

    def _add_claim(self, source: int, name: bytes, t_rx_ns: int) -> None:
        """Store the NAME of an address. Follow the sender if it claims another address."""
        if len(name) != NAME_BYTES or source > ADDRESS_MAX:
            return
        # a node has one address: it left its previous address
        self._names = {address: owner for address, owner in self._names.items() if owner != name}
        self._names[source] = name
        if name == self._name:
            if self._source is not None and source != self._source:
                self._frames.pop(self._source, None)
            self._source = source
            self._is_displaced = False
        elif source != self._source:
            self._claim = (source, t_rx_ns)
        elif self._name is None:
            self._name = name
        elif int.from_bytes(name, "little") < int.from_bytes(self._name, "little"):
            self._is_displaced = True  # a node with a higher priority takes the address of the sender

    def _has_moved_to(self, source: int, silent_ns: int) -> bool:
        """Return whether the sender, whose NAME is unknown, claimed this address and left its previous address."""
        if self._claim is None or self._name is not None or self._claim[0] != source:
            return False
        period_ns = self._assembly.period_ns
        return self._heard_ns <= self._claim[1] and 0 < MOVED_PERIODS * period_ns <= silent_ns

    def _set_sender(self, source: int | None) -> None:
        """Start again with this sender."""
        self._source = source
        self._name = self._names.get(source) if source is not None else None
        self._is_displaced = False
        self._assembly: Assembly = Assembly(self.ledger)
        self._reference = self._wanted_reference
        self._has_heading = False

    def _measurements(self, samples: Sequence[Assembled]) -> Sequence[CodecEvent]:
        made = [measurement_of(*one, heading_elsewhere=self._has_heading) for one in samples]
        return self._assembly.watched(made)

    def _is_reference(self, reference: Reference) -> bool:
        """Return whether imud uses this heading. It uses the code "error" with both references."""
        if self._reference is None and reference is not Reference.ERROR:
            self._reference = reference
        return reference in (self._reference, Reference.ERROR)


# --- encoder for simulated devices ------------------------------------------------------------------------------


def encode(pgn: int, data: bytes, source: int) -> tuple[int, bytes]:
    """Return a message as (identifier, data)."""
    return join(J1939Id(PRIORITIES[pgn], pgn, source)), data


EXAMPLE_SOURCE: Final = 35


def _example_frames(random: Random) -> list[CanFrame]:
    quat = random_quaternion(random)
    euler = euler312_from_quat(quat)
    sid = random.randrange(SID_MOST + 1)
    made = (
        encode(HEADING, pack_heading(sid, euler[2], Reference.MAGNETIC), EXAMPLE_SOURCE),
        encode(RATE_OF_TURN, pack_rate_of_turn(sid, random.gauss(0, 0.5)), EXAMPLE_SOURCE),
        encode(ATTITUDE, pack_attitude(sid, euler, has_yaw=False), EXAMPLE_SOURCE),
    )
    return [CanFrame(can_id, True, data, 0) for can_id, data in made]


def _filters(settings: HipnucNmea2000Options) -> list[CanFilter]:
    source = None if settings.source == "auto" else settings.source
    filters = [filter_of(pgn, source) for pgn in PGNS]
    # without a configured address, imud follows the claims of the sender
    return filters if source is not None else [*filters, filter_of(CLAIMED, None, GLOBAL)]


def _sent_by(settings: HipnucNmea2000Options) -> list[CanFilter]:
    return [all_of(None if settings.source == "auto" else settings.source)]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    return sender_of(can_id, extended, data, PGNS)


def _heading(settings: object, _read_back: Mapping[str, Any]) -> Heading:
    """Return the reference of the selected heading; with `auto` it is not known in advance."""
    chosen = settings.heading if isinstance(settings, HipnucNmea2000Options) else "auto"
    return Heading.UNKNOWN if chosen == "auto" else Heading(chosen)


DRIVER: Final = CanDriver(
    name="hipnuc-nmea2000",
    never_sends=frozenset({"accel_m_s2", "temperature_c", "incli_rad"}),
    title="HiPNUC CH0x0, CH10x, HI14, other heading and attitude sensors (CAN, NMEA 2000)",
    settings=HipnucNmea2000Options,
    make_codec=HipnucNmea2000Codec,
    filters=_filters,
    sent_by=_sent_by,
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=2,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above, "
    "0 with the bow to the north of the heading reference; NaN for an angle that the device does not send",
    navigation_frame="ENU",
    data_sheet=FLOATS,
    heading=_heading,
    node_of=_node_of,
    node_settings=lambda source: HipnucNmea2000Options(source=source),
    node_title=lambda source: f"source {source}",
    identify=lambda _settings: says_nothing(Identity()),
    sample_frames=len(PGNS),
    example_frames=_example_frames,
    unknown_name=pgn_name,
    decoded=f"imud decodes {', '.join(map(pgn_name, PGNS))}: configure options.source, or enable one of them in the "
    "device",
)
