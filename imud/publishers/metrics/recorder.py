"""Tables of the metrics of the recorder and of the flight recorder; there are none where there is no such thing."""

from collections.abc import Callable
from typing import Final

from imud.contracts.status import FlightStatus, RecorderStatus
from imud.publishers.metrics.family import BYTES, NO_UNIT, SECONDS, Family, Lines, MetricType, Reader, Snapshot, each


def _recorder(read: Callable[[RecorderStatus], float]) -> Reader:
    """A value of the recorder."""
    return each(lambda snapshot: snapshot.recorders, read)


def _flight(read: Callable[[FlightStatus], float]) -> Reader:
    """A value of the flight recorder."""
    return each(lambda snapshot: snapshot.flights, read)


def _snapshots(snapshot: Snapshot) -> Lines:
    """Snapshots by what became of them."""
    return [
        ((result,), getattr(status, result))
        for status in snapshot.flights
        for result in ("saved", "failed", "left_out")
    ]


def _disk(snapshot: Snapshot) -> Lines:
    """Both recorders write to one directory; the one that always writes knows its present file, too."""
    always = [status.disk_bytes for status in snapshot.recorders]
    return [((), size) for size in always or [status.disk_bytes for status in snapshot.flights]]


RECORDINGS_FAMILIES: Final = (
    Family(
        "imud_recordings_bytes", MetricType.GAUGE, BYTES,
        "Size of all recordings in the directory of the recorder, snapshots included.", Reader((), _disk),
    ),
)  # fmt: skip

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

FLIGHT_FAMILIES: Final = (
    Family(
        "imud_flight_recorder_active", MetricType.GAUGE, NO_UNIT,
        "1 while the flight recorder keeps what devices deliver, 0 while there is no room for it.",
        _flight(lambda status: not status.problem),
    ),
    Family(
        "imud_flight_recorder_kept_seconds", MetricType.GAUGE, SECONDS, "Length of what the flight recorder has.",
        _flight(lambda status: status.kept_ns),
    ),
    Family(
        "imud_flight_recorder_kept_bytes", MetricType.GAUGE, BYTES, "Size of what the flight recorder has.",
        _flight(lambda status: status.kept_bytes),
    ),
    Family(
        "imud_flight_recorder_records_dropped_total", MetricType.COUNTER, NO_UNIT,
        "Records that the flight recorder does not have because this machine was too slow.",
        _flight(lambda status: status.records_dropped),
    ),
    Family(
        "imud_flight_recorder_snapshots_total", MetricType.COUNTER, NO_UNIT,
        "Alerts whose snapshot was saved, could not be saved, or was one too many within an hour.",
        Reader(("result",), _snapshots),
    ),
    Family(
        "imud_flight_recorder_snapshots_sent_total", MetricType.COUNTER, NO_UNIT, "Snapshots that clients asked for.",
        _flight(lambda status: status.sent),
    ),
)  # fmt: skip
