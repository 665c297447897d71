"""What takes an export: the contract, and the table of samples, events or losses as CSV."""

from collections.abc import Collection
from typing import Final, Protocol

from imud.bridges import table
from imud.bridges.channel import ByteWriter, LossCounts, StampedEvent
from imud.contracts.publisher import Batch
from imud.sample import SAMPLE_FIELDS

CSV_BYTES: Final = 1 << 16
"""Text that is gathered before it is written."""
TABLES: Final = ("samples", "events", "losses")


class Sink(Protocol):
    """What takes all that a file has, in its order."""

    def samples(self, batch: Batch) -> None:
        """Take samples, in the axes that are wanted."""
        ...

    def losses(self, losses: LossCounts) -> None:
        """Take the losses of a device, which have grown."""
        ...

    def event(self, event: StampedEvent) -> None:
        """Take an event."""
        ...

    def finish(self) -> None:
        """Write what waits."""
        ...

    def close(self) -> None:
        """Release everything; may be called twice."""
        ...


class CsvSink:
    """One table as CSV."""

    def __init__(self, out: ByteWriter, what: str, fields: Collection[str] | None, *, without_times: bool) -> None:
        """`what` is one of TABLES; `fields` are those of samples, None for all."""
        self._out = out
        self._what = what
        names = SAMPLE_FIELDS if fields is None else tuple(fields)
        self._rows = table.SampleText(names, without_times)
        heads = {"samples": table.sample_columns(names), "events": table.EVENT_COLUMNS, "losses": table.LOSS_COLUMNS}
        self._text = bytearray(table.csv_text([heads[what]]))

    def samples(self, batch: Batch) -> None:
        """Write a row each."""
        if self._what == "samples":
            self._text += self._rows.of(batch.samples)
            if len(self._text) >= CSV_BYTES:
                self.finish()

    def losses(self, losses: LossCounts) -> None:
        """Write a row."""
        if self._what == "losses":
            self._text += table.csv_text([table.loss_row(losses)])

    def event(self, event: StampedEvent) -> None:
        """Write a row."""
        if self._what == "events":
            self._text += table.csv_text([table.event_row(event)])

    def finish(self) -> None:
        """Write what waits."""
        self._out.write(bytes(self._text))
        self._text.clear()

    def close(self) -> None:
        """No-op: nothing is held."""
