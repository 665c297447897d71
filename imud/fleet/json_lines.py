"""`imud fleet collect --to -`: one JSON object a line for each sample, interval, event, and range that was dropped.

Every line has `site`, `gateway`, `boot`, `device`, `stream` and `kind`: `sample`, `interval`, `event` or `dropped`.
A line comes at least once: what was printed and not acknowledged when the collector was killed comes again.

Lines of a gateway whose wall clock is not set have `"utc": "not set"`: their `utc_ns` says nothing. When it becomes
known, a line of the kind `clock` has gateway, boot and `utc_offset_ns`: added to `t_ns` of any line of this boot it
gives UTC.
"""

from collections.abc import Iterator, Sequence
from typing import Final, TextIO

import msgspec

from imud.fleet.collect import Offsets
from imud.fleet.reader import FleetBatch
from imud.formats.fleet.boots import PlacedTime
from imud.formats.fleet.ledger import Accounts, FleetLedger
from imud.formats.fleet.messages import Interval, MessageKind

NOT_SET: Final = {"utc": "not set"}
_ENCODER: Final = msgspec.json.Encoder()


class JsonLines:
    """A store that prints. Synchronization: as `FleetStore`."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def restore(self, ledger: FleetLedger) -> None:
        """Nothing: a stream of lines keeps no accounts."""

    def write(self, batches: Sequence[FleetBatch], _accounts: Accounts, offsets: Offsets) -> None:
        """Print everything in the batches, then clocks that are known now. Raises OSError."""
        for batch in batches:
            for line in lines_of(batch):
                self._out.write(line + "\n")
        for line in clock_lines(offsets):
            self._out.write(line + "\n")
        self._out.flush()

    def close(self) -> None:
        """Nothing: who gave the output closes it."""


def lines_of(batch: FleetBatch) -> Iterator[str]:
    """The lines of a message. Values that JSON does not have (not a number, infinity) are null."""
    message = batch.message
    head: dict[str, object] = {
        "site": batch.site, "gateway": message.gateway, "boot": message.boot, "device": message.device,
        "stream": batch.stream.value,
    }  # fmt: skip
    if message.kind is MessageKind.DROPPED:
        dropped = {"kind": "dropped", "first": message.first, "last": message.last, "cause": message.cause}
        yield _line(head | dropped | _times(batch.time_of_newest()))
    for sample in message.samples:
        yield _line(head | {"kind": "sample"} | _members(sample) | _times(batch.time_of(sample.utc_ns, sample.t_ns)))
    for interval in message.intervals:
        yield _line(head | {"kind": "interval"} | _members(interval) | _interval_times(batch, interval))
    for event in message.events:
        members = _members(event)
        members["event"] = members.pop("kind")
        yield _line(head | {"kind": "event"} | members | _times(batch.time_of(message.utc_ns, event.t_ns)))


def clock_lines(offsets: Offsets) -> Iterator[str]:
    """A line for each boot whose wall clock is known from now on."""
    for key, offset in sorted(offsets.items()):
        members: dict[str, object] = {"kind": "clock"}
        yield _line(members | key._asdict() | offset._asdict())


def _times(at: PlacedTime) -> dict[str, object]:
    members: dict[str, object] = {"utc_ns": at.utc_ns}
    return members | _clock(at)


def _interval_times(batch: FleetBatch, one: Interval) -> dict[str, object]:
    begin = batch.time_of(one.begin_utc_ns, one.begin_t_ns)
    end = batch.time_of(one.end_utc_ns, one.end_t_ns)
    return {"begin_utc_ns": begin.utc_ns, "end_utc_ns": end.utc_ns} | _clock(begin)


def _clock(at: PlacedTime) -> dict[str, object]:
    if not at.is_set:
        return dict(NOT_SET)
    return {} if at.error_ns is None else {"utc_err_ns": at.error_ns}


def _members(record: msgspec.Struct) -> dict[str, object]:
    """Members of a record that it has, by name."""
    values = ((name, getattr(record, name)) for name in record.__struct_fields__)
    return {name: value for name, value in values if value is not None}


def _line(members: dict[str, object]) -> str:
    return _ENCODER.encode(members).decode()
