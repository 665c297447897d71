"""State of `assembly` and `same_address`, for recordings. The limits keep the cost of one frame constant."""

from collections.abc import Mapping
from typing import Any, Final

from imud.drivers.hipnuc import assembly, frame_copies, same_address
from imud.drivers.hipnuc.assembly import Cadence, Part
from imud.drivers.state import COUNT, DAEMON, FLAG, NUMBER, OPTIONS, SID, TIME
from imud.formats.state import Data, Each, Field, Integer, Items, Map, Maybe, New, Row, StateError, StateTable, Values

KINDS_MAX: Final = 64  # maximum number of kinds of frames: more than the PGNs and TPDOs of a device
FRAME_BYTES_MAX: Final = 64  # maximum data of a CAN FD frame, bytes
KIND: Final = Integer(0, 0x3FFFF)  # number of a TPDO, or PGN of 18 bits

CADENCE: Final = StateTable(
    (
        Field(1, "_due_ns", TIME),
        Field(2, "_is_silent", FLAG),
        Field(3, "_late_ns", Items(TIME, assembly.UNSTEADY_BURSTS)),
        Field(4, "_least_ns", TIME),
        Field(5, "_newest_ns", TIME),
        Field(6, "_odd_ns", Items(TIME, assembly.ODD_BURSTS - 1)),
        Field(7, "_room", COUNT),
        Field(8, "_usual_ns", Items(TIME, assembly.UNSTEADY_BURSTS)),
        Field(9, "period_ns", Integer(assembly.PERIOD_LEAST_NS, 1 << 61)),
    )
)


def _finish_sids(sids: Any) -> None:
    if sids.is_known and sids._step <= 0:
        raise StateError("expected a known step of the SIDs above 0")


SIDS: Final = StateTable(
    (
        Field(1, "_newest", SID),
        Field(2, "_modulus", Integer(0, assembly.SID_MODULUS_MOST)),
        Field(3, "_step", Integer(-0xFF, 0xFF)),
        Field(4, "_run", COUNT),
    ),
    finish=_finish_sids,
)


KIND_LOSSES: Final = StateTable(
    (
        Field(1, "_learning", Items(Row(Integer(0, 0), TIME), assembly.LEARNING_STEPS)),
        Field(2, "_cadence", Maybe(New(CADENCE, lambda _losses: Cadence(0, 0)))),
        Field(3, "_sids", SIDS),
    )
)

_KIND_STATE: Final = StateTable(
    (
        Field(1, "agree", Integer(-(1 << 31), assembly.SIDS_AGREE_MAX)),
        Field(2, "anchors", COUNT),
        Field(3, "behind_ns", TIME),
        Field(4, "every", COUNT),
        Field(5, "leads", FLAG),
        Field(6, "losses", KIND_LOSSES),
        Field(7, "missed", COUNT),
        Field(8, "near", Integer(0, assembly.NEAR_FRAMES_MAX)),
        Field(9, "run", COUNT),
        Field(10, "seen_ns", Maybe(TIME)),
        Field(11, "step", TIME),
        Field(12, "step_ns", TIME),
    )
)


def _check_place(order: Any) -> None:
    if order._place >= len(order._mean):
        raise StateError(f"expected a place below {len(order._mean)}, got {order._place}")


_ORDER: Final = StateTable(
    (
        Field(1, "count", Integer(0, 2 * same_address.VALUES)),
        Field(2, "_mean", Each(NUMBER)),
        Field(3, "_place", COUNT),
    ),
    finish=_check_place,
)


_VALUES: Final = StateTable(
    (
        Field(1, "_newest", Each(Items(NUMBER, same_address.SERIES_MOST))),
        Field(2, "_orders", Each(Each(_ORDER))),
        Field(3, "_counts", Each(FLAG)),
        Field(4, "_yaw", NUMBER),
    ),
    {"_least": "a constant"},
)

_PERIODS: Final = Items(Integer(0, 1 << 61), same_address.SERIES_MOST + 1)


def _check_extras(watch: Any) -> None:
    if sorted(watch._extras_ns) != list(watch._extras_ns):
        raise StateError("expected the extra frames in the order of their times")


_WATCH: Final = StateTable(
    (
        Field(1, "_extras_ns", Items(TIME, 2 * same_address.EXTRAS)),
        Field(2, "_frames", Items(Row(TIME, SID), same_address.WINDOW - 1)),
        Field(3, "_windows", COUNT),
        Field(4, "periods_ns", _PERIODS),
        Field(5, "slow_ns", _PERIODS),
    ),
    finish=_check_extras,
)

SAME_ADDRESS: Final = StateTable(
    (
        Field(1, "_watches", Map(KIND, New(_WATCH, lambda _owner: same_address._Watch()), KINDS_MAX)),
        Field(2, "_values", _VALUES),
    )
)


_NEWEST: Final = Row(Data(FRAME_BYTES_MAX), TIME, Integer(-1, 1 << 61), FLAG, make=frame_copies.NewestFrame)
COPIES: Final = StateTable(
    (
        Field(1, "_arrival_ns", Map(KIND, TIME, KINDS_MAX)),
        Field(2, "_is_proven", FLAG),
        Field(3, "_kind", Maybe(KIND)),
        Field(4, "_newest", Map(KIND, _NEWEST, KINDS_MAX)),
    )
)


def _finish_assembly(value: Any) -> None:
    kinds, parts, anchor = value._kinds, value._parts, value._anchor
    known = {kind for kind, _ in value._learning} if anchor is None else kinds.keys()
    if not parts.keys() <= known or not value._due <= kinds.keys() or (anchor is not None and anchor not in kinds):
        raise StateError("expected the state of each kind of frame in the present sample")


ASSEMBLY: Final = StateTable(
    (
        Field(1, "_parts", Map(KIND, Row(Data(FRAME_BYTES_MAX), TIME, SID, make=Part), KINDS_MAX)),
        Field(2, "_newest", Maybe(Row(KIND, Data(FRAME_BYTES_MAX), TIME))),
        Field(3, "_learning", Items(Row(KIND, TIME), KINDS_MAX * (assembly.LEARNING_STEPS + 1))),
        Field(4, "_kinds", Map(KIND, New(_KIND_STATE, lambda _assembly: assembly._Kind()), KINDS_MAX)),
        Field(5, "_anchor", Maybe(KIND)),
        Field(6, "_anchor_ns", TIME),
        Field(7, "_anchor_sid", SID),
        Field(8, "_due", Values(KIND, KINDS_MAX)),
        Field(9, "_cadence", CADENCE),
        Field(10, "_sids", SIDS),
        Field(11, "_strays", Integer(0, assembly.STRAYS_MAX + assembly.STRAY_WEIGHT)),
        Field(12, "_same_address", SAME_ADDRESS),
        Field(13, "_incomplete", COUNT),
        Field(14, "_copies", COPIES),
    ),
    {"_ledger": DAEMON, "_allowed": OPTIONS},
    _finish_assembly,
)


def check_parts(value: Any, sizes: Mapping[int, int]) -> None:
    """Raise StateError if the present sample of an assembly has a frame of another kind or length than in `sizes`."""
    for kind, part in value._parts.items():
        if len(part.data) != sizes.get(kind):
            raise StateError(f"expected a frame of kind {kind} with {sizes.get(kind, 0)} bytes, got {len(part.data)}")
