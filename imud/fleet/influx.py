"""Store of `imud fleet collect --to http://…`: line protocol for InfluxDB, VictoriaMetrics, QuestDB or Telegraf.

    records ──▶ lines ──POST──▶ reply 2xx ──▶ (the collector) acknowledge

The collector acknowledges messages to the broker only after the server has confirmed their lines: each record arrives
at least once. A repeated line is the same row, because a row is identified by measurement, tags and time. The store
does not keep the ledger.
"""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final

from imud.fleet.accounts import PlacedTime
from imud.fleet.collector import Offsets
from imud.fleet.messages import Interval, MessageKind
from imud.fleet.reader import FleetBatch
from imud.formats.influx import DistinctTimes, Tags, Value, cut, event_fields, head, line, measure_fields, sample_fields
from imud.host.http_post import HttpPost, RequestRejected, RequestTooLarge, halves_of
from imud.model.errors import ServerError, reason_of

log = logging.getLogger(__name__)

REQUEST_BYTES: Final = 1_000_000  # maximum size of a request, bytes
# Number of attempts after a failure, and the pause before each, s. The restart of a server takes some seconds.
ATTEMPTS: Final = 20
ATTEMPT_PAUSE_S: Final = 0.5


class InfluxStore:
    """Store in a database that accepts line protocol. Synchronization: one thread at a time."""

    def __init__(self, post: HttpPost, sleep: Callable[[float], None] = time.sleep) -> None:
        self._post, self._sleep = post, sleep
        self._is_stopping = False
        self._has_accepted = False  # whether the server has accepted a request
        self.refused = 0  # number of messages with a line that the server could not store

    def write(self, batches: Sequence[FleetBatch], offsets: Offsets) -> None:
        """Send all records, then new clock offsets. Raises ServerError if the server does not confirm them. If it
        rejects values, send each message in its own request and ignore the messages that it rejects."""
        clocks = "".join(clock_lines(offsets))
        messages = [("".join(lines_of(batch)), batch.message.gateway) for batch in batches]
        try:
            self._send("".join(text for text, _ in messages) + clocks)
        except RequestRejected as error:
            log.warning("influx: %s; sending each message in its own request", error)
            for text, gateway in [*messages, (clocks, "*")]:
                try:
                    self._send(text)
                except RequestRejected as refused:
                    self.refused += 1
                    log.warning("influx: cannot store a message of %s: %s; ignoring it", gateway, refused)

    def stop(self) -> None:
        """End the present write: a server without a reply must not delay the end. From any thread."""
        self._is_stopping = True
        self._post.stop()

    def close(self) -> None:
        """Close the connection. A second call does nothing."""
        self._post.close()

    def _send(self, lines: str) -> None:
        """Send lines. Raises RequestRejected for values that the server rejects, otherwise ServerError."""
        for body in cut(lines.encode(), REQUEST_BYTES):
            self._send_body(body)

    def _send_body(self, body: bytes) -> None:
        """Send complete lines, in smaller requests if the server refuses the size. Send all other lines before the
        error for a line that is too long alone."""
        parts = [body]  # the rest, newest part first
        refusal: RequestTooLarge | None = None
        while parts:
            part = parts.pop()
            try:
                self._send_part(part)
                self._has_accepted = True
            except RequestTooLarge as error:
                first, second = halves_of(part)
                if second:
                    parts += [second, first]
                elif not self._has_accepted:  # the server refuses each size, which a person can repair
                    raise ServerError(f"--to: expected the reply 204 to {len(part)} bytes, but {error}") from error
                else:
                    refusal = error
        if refusal is not None:
            raise refusal

    def _send_part(self, body: bytes) -> None:
        for attempt in range(ATTEMPTS + 1):
            try:
                self._post.post(body)
            except OSError as error:
                if attempt == ATTEMPTS or self._is_stopping:
                    raise ServerError(
                        f"--to: cannot send: {reason_of(error)}; the broker keeps the messages for the next collector"
                    ) from error
                if not attempt:
                    log.warning("influx: %s; trying again", reason_of(error))
                self._sleep(ATTEMPT_PAUSE_S)
            else:
                return


def lines_of(batch: FleetBatch) -> Iterator[str]:
    """Yield the lines of a message. A record of a gateway without a set clock has the field `utc_set=false`."""
    message, times = batch.message, DistinctTimes()
    tags = {"site": batch.site, "gateway": message.gateway, "device": message.device}
    if message.kind is MessageKind.DROPPED:
        fields = (("first", message.first), ("last", message.last), ("cause", message.cause))
        yield _placed(_in_stream("imud_dropped", tags, batch), fields, batch, batch.time_of_newest())
    series = head("imud_sample", tags)
    for sample in message.samples:
        yield _placed(series, sample_fields(sample), batch, batch.time_of(sample.utc_ns, sample.t_ns))
    for interval in message.intervals:
        at = batch.time_of(interval.begin_utc_ns, interval.begin_t_ns)
        yield _placed(_in_stream("imud_interval", tags, batch), _interval_fields(interval), batch, at)
    for event in message.events:
        series = head("imud_event", {**tags, "kind": event.kind.value})
        at = batch.time_of(message.utc_ns, event.t_ns)
        yield _placed(series, event_fields(event), batch, at._replace(utc_ns=times.at(series, at.utc_ns)))


def clock_lines(offsets: Offsets) -> Iterator[str]:
    """Yield a line for each boot whose wall clock is known now: UTC = `t_ns` of a record + `utc_offset_ns`."""
    for key, offset in sorted(offsets.items()):
        fields = {"boot": key.boot, **offset._asdict()}
        yield line(head("imud_clock", {"gateway": key.gateway}), fields.items(), offset.t_ns + offset.utc_offset_ns)


def _in_stream(measurement: str, tags: Tags, batch: FleetBatch) -> str:
    # a statistic of the stream `samples` can begin at the same time as a statistic of the stream `statistics`
    return head(measurement, {**tags, "stream": batch.stream.value})


def _placed(series: str, fields: Iterable[tuple[str, Value]], batch: FleetBatch, at: PlacedTime) -> str:
    """Return a line with its boot and the state of its time."""
    place = (("boot", batch.message.boot), ("utc_set", at.is_set), ("utc_err_ns", at.error_ns))
    return line(series, (*place, *fields), at.utc_ns)


def _interval_fields(one: Interval) -> Iterator[tuple[str, Value]]:
    yield from (("first", one.first), ("last", one.last), ("count", one.count), ("t_ns", one.begin_t_ns))
    yield from (("end_t_ns", one.end_t_ns), ("t_err_ns", one.t_err_ns), ("sync", one.sync.value))
    yield "status", one.status
    for name, measures in one.values.items():
        for measure in measures.__struct_fields__:
            values = getattr(measures, measure)
            if values is not None:
                yield from measure_fields(name, measure, values)
