"""Recorded calls of a path, its clock, its edges and the host clocks: a fixed table with the types of the arguments."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Final, NamedTuple

import msgspec
from msgspec import Meta

from imud import __version__
from imud.contracts.lines import TriggerStamp, UtcReference
from imud.formats.records import TIME_MAX_NS, UTC_OFFSET_MAX_NS, CallRecord, Count, Time
from imud.host.log import printable
from imud.model.errors import ImudError, reason_of
from imud.model.ledger import LEDGER_FIELDS, Ledger
from imud.model.units import NS_PER_S
from imud.sampling.path import SamplePath

Duration = Annotated[int, Meta(ge=0, le=TIME_MAX_NS)]
Delay = Annotated[int, Meta(ge=0, le=NS_PER_S)]  # time of a byte or a frame, or period of a latency timer, ns
Status = Annotated[int, Meta(ge=0, le=0xFFFF_FFFF)]
Offset = Annotated[int, Meta(ge=-UTC_OFFSET_MAX_NS, le=UTC_OFFSET_MAX_NS)]
# A device answers each trigger with one frame, so that a call has a few triggers
Triggers = Annotated[list[tuple[Time, Duration, Count]], Meta(max_length=4096)]


class HostState(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Arguments of the call that restores the host clocks."""

    steady: bytes  # state of the steady time (`imud.sampling.state`)
    utc_offset_ns: Offset
    suspends: Count

    CALL: ClassVar = ("host", "restore")  # target and method

    @classmethod
    def of(cls, call: CallRecord) -> "HostState":
        """Return the arguments of a call. Raises ImudError if they are invalid."""
        state: HostState = _converted(call, call.arguments, cls)
        return state


class _Link(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keywords of `SampleClock.link_changed`."""

    byte_ns: Delay
    hold_ns: Delay


class _Nothing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keywords of a call without keywords."""


class _Call(NamedTuple):
    """Row of the table of calls."""

    arguments: Any  # type of the arguments
    # Repeats the call. Arguments: path, ledger, arguments of the call. Returns the number of overruns of the live run
    # if the call reports it.
    repeat: Callable[..., int | None]
    keywords: Any = _Nothing


def set_ledger(ledger: Ledger, values: Mapping[str, int]) -> None:
    """Set all counters."""
    for name in LEDGER_FIELDS:
        setattr(ledger, name, values.get(name, 0))  # 0: an older imud did not have the counter


def _skip(_path: Any, ledger: Ledger, count: int) -> None:
    ledger.bytes_in += count
    ledger.bytes_skipped += count


def _set_utc_reference(path: Any, _ledger: Ledger, reference: tuple[int, int] | None) -> None:
    path.clock.set_utc_reference(None if reference is None else UtcReference(*reference))


def _add_triggers(path: Any, _ledger: Ledger, stamps: list[tuple[int, int, int]]) -> None:
    path.clock.add_triggers([TriggerStamp(*stamp) for stamp in stamps])


_CALLS: Final[Mapping[tuple[str, str], _Call]] = {
    ("path", "begin"): _Call(tuple[Time], lambda path, _ledger, now_ns: path.begin(now_ns)),
    ("path", "flush"): _Call(tuple[Time], lambda path, _ledger, now_ns: path.flush(now_ns)),
    ("path", "reset"): _Call(tuple[()], lambda path, _ledger: path.reset()),
    ("path", "publish_gathered"): _Call(tuple[()], lambda path, _ledger: path.publish_gathered() and None),
    ("path", "set_frame_time"): _Call(tuple[Delay], lambda path, _ledger, frame_ns: path.set_frame_time(frame_ns)),
    ("path", "skip"): _Call(tuple[Count], _skip),
    ("path", "overruns"): _Call(tuple[Count], lambda _path, _ledger, overruns: overruns),
    ("ledger", "set"): _Call(tuple[dict[str, Count]], lambda _path, ledger, values: set_ledger(ledger, values)),
    ("loss", "link_opened"): _Call(tuple[()], lambda path, _ledger: path.link_opened()),
    ("edges", "restart"): _Call(tuple[()], lambda path, _ledger: path.edges.restart()),
    ("clock", "restart"): _Call(tuple[()], lambda path, _ledger: path.clock.restart()),
    ("clock", "expect_rate"): _Call(tuple[()], lambda path, _ledger: path.clock.expect_rate()),
    ("clock", "link_changed"): _Call(
        tuple[()], lambda path, _ledger, byte_ns, hold_ns: path.clock.link_changed(byte_ns=byte_ns, hold_ns=hold_ns),
        _Link,
    ),
    ("clock", "set_own_status"): _Call(
        tuple[Status | None], lambda path, _ledger, bits: path.clock.set_own_status(bits)
    ),
    ("clock", "set_utc_reference"): _Call(tuple[tuple[Offset, Duration] | None], _set_utc_reference),
    ("aiding", "on_trigger_stamps"): _Call(tuple[Triggers], _add_triggers),
}  # fmt: skip


def repeat_call(path: SamplePath, ledger: Ledger, call: CallRecord) -> int | None:
    """Repeat a recorded call. Return the number of overruns of the live run if the call reports it, otherwise None.
    Raises ImudError for an unknown call, and for invalid arguments."""
    row = _CALLS.get((call.target, call.method))
    if row is None:
        name = printable(f"{call.target}.{call.method}")
        raise ImudError(f"cannot replay the call {name}: imud {__version__} does not know it; try a newer imud")
    arguments = _converted(call, call.arguments, row.arguments)
    keywords = msgspec.structs.asdict(_converted(call, call.keywords, row.keywords))
    return row.repeat(path, ledger, *arguments, **keywords)


def _converted(call: CallRecord, values: Any, kind: Any) -> Any:
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        name = printable(f"{call.target}.{call.method}")
        raise ImudError(f"cannot replay a record with the call {name}: {reason_of(error)}") from None
