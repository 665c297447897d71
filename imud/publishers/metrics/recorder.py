"""Table of the recorder's metrics; there are none where nothing is to be recorded."""

from collections.abc import Callable
from typing import Final

from imud.contracts.status import RecorderStatus
from imud.publishers.metrics.family import BYTES, NO_UNIT, Family, Lines, MetricType, Reader, Snapshot


def _recorder(read: Callable[[RecorderStatus], float]) -> Reader:
    """A value of the recorder."""

    def lines(snapshot: Snapshot) -> Lines:
        return [((), read(status)) for status in snapshot.recorders]

    return Reader((), lines)


RECORDER_FAMILIES: Final = (
    Family(
        "imud_recorder_active", MetricType.GAUGE, NO_UNIT, "1 while imud records, 0 while the disk does not let it.",
        _recorder(lambda status: not status.problem),
    ),
    Family(
        "imud_recorder_written_bytes_total", MetricType.COUNTER, BYTES, "Bytes written to recordings.",
        _recorder(lambda status: status.written_bytes),
    ),
    Family(
        "imud_recorder_records_total", MetricType.COUNTER, NO_UNIT, "Records written to recordings.",
        _recorder(lambda status: status.records),
    ),
    Family(
        "imud_recorder_records_dropped_total", MetricType.COUNTER, NO_UNIT,
        "Records that are missing in recordings because the disk was too slow.",
        _recorder(lambda status: status.records_dropped),
    ),
    Family(
        "imud_recorder_waiting_bytes", MetricType.GAUGE, BYTES, "Records that wait to be written.",
        _recorder(lambda status: status.waiting_bytes),
    ),
    Family(
        "imud_recorder_files_removed_total", MetricType.COUNTER, NO_UNIT,
        "Recordings that were removed to keep within the budget.",
        _recorder(lambda status: status.files_removed),
    ),
)  # fmt: skip
