"""`imud fleet collect --to -`: one JSON object a line for each sample, interval, event, and range that was dropped.

Every line has `site`, `gateway`, `boot`, `device`, `stream` and `kind`: `sample`, `interval`, `event` or `dropped`.
A line comes at least once: what was printed and not acknowledged when the collector was killed comes again.
"""

from collections.abc import Iterator, Sequence
from typing import Final, TextIO

import msgspec

from imud.fleet.reader import FleetBatch
from imud.formats.fleet.ledger import Accounts, FleetLedger
from imud.formats.fleet.messages import MessageKind

_ENCODER: Final = msgspec.json.Encoder()


class JsonLines:
    """A store that prints. Synchronization: as `FleetStore`."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def restore(self, ledger: FleetLedger) -> None:
        """Nothing: a stream of lines keeps no accounts."""

    def write(self, batches: Sequence[FleetBatch], _accounts: Accounts) -> None:
        """Print everything in the batches. Raises OSError."""
        for batch in batches:
            for line in lines_of(batch):
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
        cause = message.cause.value if message.cause is not None else None
        yield _line(head | {"kind": "dropped", "first": message.first, "last": message.last, "cause": cause})
    for kind, records in (("sample", message.samples), ("interval", message.intervals), ("event", message.events)):
        for record in records:
            members = _members(record)
            if "kind" in members:  # that of an event
                members["event"] = members.pop("kind")
            yield _line(head | {"kind": kind} | members)


def _members(record: msgspec.Struct) -> dict[str, object]:
    """Members of a record that it has, by name."""
    values = ((name, getattr(record, name)) for name in record.__struct_fields__)
    return {name: value for name, value in values if value is not None}


def _line(members: dict[str, object]) -> str:
    return _ENCODER.encode(members).decode()
