"""State of a clock's aiding sources (`imud.sampling.state`)."""

from typing import Any, Final

from imud.contracts.lines import Mark, UtcReference
from imud.formats.state import Field, Flag, Integer, Items, Maybe, New, Real, Row, SameAs, StateError, StateTable
from imud.sampling import device_utc, edge_pairing
from imud.sampling.fit_state import (
    CONSTRUCTOR,
    COUNT,
    DAEMON,
    NS,
    NUMBER,
    SIGNED,
    SLOPE,
    SLOPE_ERROR,
    SYNC,
    TIME,
    TIME_MAX_NS,
)

_STAMP: Final = Row(TIME, SIGNED)  # time and number of a rising edge

TRACKER: Final = StateTable(
    (
        Field(1, "_count", Integer(1, edge_pairing.TRACKED)),
        Field(2, "_device_ns", TIME),
        Field(3, "_edge_ns", TIME),
        Field(4, "_offset", NS),
        Field(5, "slope", Real(-1e6, 1e6)),
        Field(6, "spread_ns", NS),
    )
)

PAIRING: Final = StateTable(
    (
        Field(1, "_first", Items(Row(TIME, TIME), edge_pairing.FIRST - 1)),
        Field(2, "_pairs", COUNT),
        Field(3, "_queue", Items(_STAMP, edge_pairing.QUEUE_MOST)),
        Field(4, "_tracker", Maybe(New(TRACKER, lambda _pairing: edge_pairing.EdgeTracker(0, 0, 1.0)))),
        Field(5, "_wrong", COUNT),
        Field(6, "delay_error_ns", NS),
        Field(7, "delay_ns", NS),
        Field(8, "due_ns", TIME),
        Field(9, "events", COUNT),
        Field(10, "events_unpaired", COUNT),
        Field(11, "learned", Flag()),
        Field(12, "misses", COUNT),
        Field(13, "number", SIGNED),
        Field(14, "samples_unpaired", COUNT),
        Field(15, "spread_ns", NS),
        Field(16, "stamp_ns", TIME),
    ),
    {"_lead_ns": CONSTRUCTOR},
)

EDGE_SOURCE: Final = StateTable(
    (
        Field(1, "pairing", PAIRING),
        Field(2, "stamp_error_ns", Integer(0, TIME_MAX_NS)),
        Field(3, "bit_seen", Flag()),
    ),
    {"offset_ns": CONSTRUCTOR, "sigma_ns": CONSTRUCTOR, "mask": CONSTRUCTOR},
)

MARKS: Final = StateTable(
    (
        Field(1, "_waiting", Items(_STAMP, edge_pairing.MARKS_KEPT)),
        Field(2, "_found", Items(Row(TIME, SIGNED, Maybe(COUNT), make=Mark), edge_pairing.MARKS_KEPT)),
    )
)

_INTERVAL: Final = StateTable(
    (
        Field(1, "begin_ns", TIME),
        Field(2, "high", TIME),
        Field(3, "high_device_ns", TIME),
        Field(4, "low", TIME),
        Field(5, "low_device_ns", TIME),
    )
)

INTERVALS: Final = StateTable(
    (
        Field(1, "_bins", Items(New(_INTERVAL, lambda _fit: device_utc._Bin(0, 0, 0)), device_utc.BINS)),
        Field(2, "_fan", NUMBER),
        Field(3, "_middle", NS),
        Field(4, "_ref_device_ns", TIME),
        Field(5, "_ref_ns", TIME),
        Field(6, "_slope", Real(-1e6, 1e6)),
        Field(7, "_width_ns", NS),
        Field(8, "known", Flag()),
        Field(9, "newest_ns", TIME),
    ),
    {"_narrowest_ns": CONSTRUCTOR},
)

_REFERENCE: Final = Maybe(Row(Integer(-(1 << 62), 1 << 62), Integer(0, TIME_MAX_NS), make=UtcReference))

DEVICE_UTC: Final = StateTable(
    (
        Field(1, "_agreed", COUNT),
        Field(2, "_checked_ns", TIME),
        Field(3, "_differed", COUNT),
        Field(4, "active", Flag()),
        Field(5, "intervals", INTERVALS),
        Field(6, "reference", _REFERENCE),
    ),
    {"_tick_ns": CONSTRUCTOR, "_turn_ns": CONSTRUCTOR},
)

PPS_AGE: Final = StateTable(
    (
        Field(1, "_pulses_ns", Items(TIME, device_utc.PULSES_KEPT)),
        Field(2, "_trusted", Flag()),
        Field(3, "intervals", INTERVALS),
    )
)

SLEW: Final = StateTable((Field(1, "left_ns", NS),))

HOLDOVER: Final = StateTable(
    (
        Field(1, "_device_ns", TIME),
        Field(2, "_error_ns", NS),
        Field(3, "_t_ns", TIME),
        Field(4, "least_ns", Integer(0, TIME_MAX_NS)),
        Field(5, "slope", SLOPE),
        Field(6, "slope_error", SLOPE_ERROR),
    )
)

PULSES: Final = StateTable((Field(1, "_risen", SIGNED),), {"_width_ns": CONSTRUCTOR})


def _make_sout(aiding: Any) -> Any:
    aiding.on_sout_edges(())
    return aiding.sout


def _make_sin(aiding: Any) -> Any:
    aiding.on_trigger_stamps(())
    return aiding.sin


def _finish_aiding(aiding: Any) -> None:
    sources = [source for source in (aiding.sout, aiding.sin) if source is not None]
    if len(aiding._sources) != len(sources) or any(source not in aiding._sources for source in sources):
        raise StateError("expected each aiding source once in the order of the sources")
    for source in sources:
        tracker = source.pairing._tracker
        # a line follows an event only if the device time rises
        if tracker is not None and (aiding._device_ns is None or tracker._device_ns > aiding._device_ns):
            raise StateError("expected a line through the events up to the newest sample")


AIDING: Final = StateTable(
    (
        Field(1, "sout", Maybe(New(EDGE_SOURCE, _make_sout))),
        Field(2, "sin", Maybe(New(EDGE_SOURCE, _make_sin))),
        Field(3, "_sources", Items(SameAs("sout", "sin"), 2)),
        Field(4, "_source", Maybe(SameAs("sout", "sin"))),
        Field(5, "_device_ns", Maybe(TIME)),
        Field(6, "_fix_ns", NS),
        Field(7, "_pps", Maybe(New(PPS_AGE, lambda _aiding: device_utc.PpsAge()))),
        Field(8, "_pulses", PULSES),
        Field(9, "edge_seq", Maybe(SIGNED)),
        Field(10, "error_ns", NS),
        Field(11, "marks", Maybe(New(MARKS, lambda _aiding: edge_pairing.MarkPairing()))),
        Field(12, "slew", SLEW),
        Field(13, "sync", SYNC),
        Field(14, "utc", DEVICE_UTC),
        Field(15, "utc_reference", _REFERENCE),
    ),
    {
        "_bits": CONSTRUCTOR, "_host": DAEMON, "_sin_timing": CONSTRUCTOR, "_sout_timing": CONSTRUCTOR,
        "sout_offset_ns": "set by the first edges of SOUT",
    },
    _finish_aiding,
)  # fmt: skip
