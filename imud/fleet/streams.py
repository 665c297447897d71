"""Streams of a device: messages with sequence numbers without gaps, made of batches and events.

    samples ─┬─▶ complete samples of `batch_s`                ─▶ stream `samples`
             └─▶ intervals of `rate_hz`, `batch_s` of them    ─▶ stream `statistics`
    events  ───▶ one message per event                        ─▶ stream `events`

Samples that had no room in the queue cause a gap in `seq`. A message of the kind `dropped` covers the gap.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

from imud.contracts.publisher import PublisherClock
from imud.fleet.accounts import StreamPosition
from imud.fleet.messages import (
    SAMPLES_MAX,
    SLOTS_MAX,
    VERSION,
    DropCause,
    FleetMessage,
    GatewayClock,
    Interval,
    MessageKind,
    Stream,
    decode_message,
    encode_message,
    encode_slots_message,
    topic_of,
)
from imud.fleet.settings import DeviceSending, Whole
from imud.fleet.spool import SpoolRow, row_of
from imud.fleet.statistics import IntervalMaker, by_interval
from imud.formats.slot import encode_slots
from imud.model.event import Event
from imud.model.sample import Sample
from imud.model.units import NS_PER_S

INTERVALS_MAX: Final = 100  # maximum number of intervals in one message, about 100 kB with all quantities and measures
# Time after the end of an interval before imud sends it, ns, if no later sample arrives. Samples arrive up to 50 ms
# late.
LATE_NS: Final = NS_PER_S


def gateway_clock(clock: PublisherClock) -> GatewayClock:
    """Return the wall clock of this gateway and its state. Any thread may call this function."""
    reference = clock.utc_reference()
    if reference is None:
        return GatewayClock(clock.now_ns(), clock.utc_offset_ns(), synchronised=False)
    return GatewayClock(clock.now_ns(), reference.offset_ns, synchronised=True, error_ns=reference.error_ns)


class Gateway(NamedTuple):
    """Names of this gateway and the identifier of this start of the daemon."""

    site: str
    gateway: str
    boot: str


class _Numbered:
    """One stream: makes messages and counts their numbers."""

    def __init__(self, gateway: Gateway, device: str, stream: Stream, clock: PublisherClock | None) -> None:
        self._gateway, self._device, self._stream, self._clock = gateway, device, stream, clock
        self._topic = topic_of(gateway.site, gateway.gateway, device, stream)
        self._begin = 0
        self.next = 0  # next number; 0 before the first

    def message(
        self, kind: MessageKind, first: int, last: int, count: int, utc_ns: int, *, cause: DropCause | None = None,
        samples: list[Sample] | None = None, intervals: list[Interval] | None = None,
        events: list[Event] | None = None,
    ) -> FleetMessage:  # fmt: skip
        """Return a message of the next numbers."""
        self._begin = self._begin or first
        self.next = last + 1
        return FleetMessage(
            v=VERSION, gateway=self._gateway.gateway, boot=self._gateway.boot, device=self._device, kind=kind,
            begin=self._begin, first=first, last=last, count=count, utc_ns=utc_ns,
            clock=None if self._clock is None else gateway_clock(self._clock), cause=cause,
            samples=samples or [], intervals=intervals or [], events=events or [],
        )  # fmt: skip

    def row(self, message: FleetMessage, stored_utc_ns: int, payload: bytes | None = None) -> SpoolRow:
        return row_of(self._topic, self._stream, message, payload or encode_message(message), stored_utc_ns)

    def resume(self, position: StreamPosition) -> None:
        """Continue at a position of the spool."""
        self._begin, self.next = position.begin, position.last + 1

    def missing(self, first: int, utc_ns: int, cause: DropCause) -> list[SpoolRow]:
        """Return the message about the numbers before `first` that no message covers; empty if there are none."""
        if not self.next or first <= self.next:
            return []
        gap = self.message(MessageKind.DROPPED, self.next, first - 1, first - self.next, utc_ns, cause=cause)
        return [self.row(gap, utc_ns)]


class DeviceStreams:
    """Streams of one device, or of the gateway (empty name). Synchronization: one thread."""

    def __init__(
        self,
        gateway: Gateway,
        device: str,
        device_id: int,
        sending: DeviceSending,
        clock: PublisherClock | None = None,
    ) -> None:
        """The messages contain no clock if `clock` is None."""
        self._device_id, self._sending = device_id, sending
        self._whole = _Numbered(gateway, device, Stream.SAMPLES, clock) if device else None
        self._statistics = _Numbered(gateway, device, Stream.STATISTICS, clock) if device else None
        self._events = _Numbered(gateway, device, Stream.EVENTS, clock)
        self._period_ns = round(NS_PER_S / sending.rate_hz) if sending.rate_hz else 0
        self._maker = IntervalMaker(sending.values)
        self._interval = 0
        self._samples: list[Sample] = []
        self._intervals: list[Interval] = []
        self._samples_max = SLOTS_MAX if sending.whole is Whole.SLOTS else SAMPLES_MAX
        self.gaps = 0  # number of samples that had no room in the queue
        self.next_seq = 0  # next expected `seq`; 0 before the first sample
        # QUEUE, or OFF for the first gap after a restart of the output
        self._gap_cause = DropCause.QUEUE

    def resume(self, stream: str, position: StreamPosition) -> None:
        """Continue a stream of an earlier run of the output in the same boot."""
        numbered = {Stream.SAMPLES: self._whole, Stream.STATISTICS: self._statistics, Stream.EVENTS: self._events}
        found = numbered.get(Stream(stream))
        if found is None:
            return
        found.resume(position)
        if found is not self._events:
            self.next_seq, self._gap_cause = max(self.next_seq, found.next), DropCause.OFF

    def add(self, samples: Sequence[Sample]) -> list[SpoolRow]:
        """Add samples in the order of their `seq`. Return the complete messages."""
        made: list[SpoolRow] = []
        begin = 0
        for at, sample in enumerate(samples):
            if self.next_seq and sample.seq > self.next_seq:
                made += self._add_run(samples[begin:at])
                made += self.flush()
                made += self._note_gap(sample)
                begin = at
            self.next_seq, self._gap_cause = sample.seq + 1, DropCause.QUEUE
        return made + self._add_run(samples[begin:])

    def event(self, event: Event, utc_ns: int) -> list[SpoolRow]:
        """Return the message of an event."""
        if not self._sending.events:
            return []
        number = self._events.next or 1
        message = self._events.message(MessageKind.EVENTS, number, number, 1, utc_ns, events=[event])
        return [self._events.row(message, utc_ns)]

    def missed_events(self, count: int, utc_ns: int) -> list[SpoolRow]:
        """Return the message about `count` events that had no room in the queue."""
        if not self._sending.events:
            return []
        first = self._events.next or 1
        message = self._events.message(
            MessageKind.DROPPED, first, first + count - 1, count, utc_ns, cause=DropCause.QUEUE
        )
        return [self._events.row(message, utc_ns)]

    def take_due(self, now_ns: int) -> list[SpoolRow]:
        """Return the messages that are due although no later sample arrived."""
        made: list[SpoolRow] = []
        late_ns = now_ns - LATE_NS
        if self._samples and self._is_over(self._samples[0].t_ns, late_ns):
            made += self._send_samples()
        if not self._maker.is_empty and late_ns >= (self._interval + 1) * self._period_ns:
            self._end_interval()
        if self._intervals and self._is_over(self._intervals[0].begin_t_ns, late_ns):
            made += self._send_intervals()
        return made

    def flush(self) -> list[SpoolRow]:
        """Return messages of all held samples and intervals, including the present interval."""
        self._end_interval()
        return self._send_samples() + self._send_intervals()

    # --- samples -----------------------------------------------------------------------------------------------------

    def _add_run(self, samples: Sequence[Sample]) -> list[SpoolRow]:
        """Add samples without a gap."""
        made: list[SpoolRow] = []
        if not samples:
            return made
        if self._sending.whole is not Whole.NONE:
            for sample in samples:
                held = self._samples
                if held and (len(held) >= self._samples_max or self._is_over(held[0].t_ns, sample.t_ns)):
                    made += self._send_samples()
                self._samples.append(sample)
        if self._period_ns:
            for number, part in by_interval(samples, self._period_ns):
                if number != self._interval:
                    self._end_interval()
                    self._interval = number
                    made += self._send_intervals_if_due(part[0].t_ns)
                self._maker.add(part)
        return made

    def _is_over(self, begin_ns: int, now_ns: int) -> bool:
        """Return whether now is in a later batch than `begin_ns`; batches start at multiples of `batch_s`."""
        batch_ns = self._sending.batch_ns
        return begin_ns // batch_ns < now_ns // batch_ns

    def _end_interval(self) -> None:
        interval = self._maker.take()
        if interval is not None:
            self._intervals.append(interval)

    def _send_intervals_if_due(self, t_ns: int) -> list[SpoolRow]:
        held = self._intervals
        if held and (len(held) >= INTERVALS_MAX or self._is_over(held[0].begin_t_ns, t_ns)):
            return self._send_intervals()
        return []

    def _send_samples(self) -> list[SpoolRow]:
        samples, self._samples = self._samples, []
        stream = self._whole
        if not samples or stream is None:
            return []
        first, last, utc_ns = samples[0].seq, samples[-1].seq, samples[-1].utc_ns
        if self._sending.whole is Whole.JSON:
            message = stream.message(MessageKind.SAMPLES, first, last, len(samples), utc_ns, samples=samples)
            return [stream.row(message, utc_ns)]
        message = stream.message(MessageKind.SLOTS, first, last, len(samples), utc_ns)
        payload = encode_slots_message(message, encode_slots(samples, self._device_id))
        return [stream.row(message, utc_ns, payload)]

    def _send_intervals(self) -> list[SpoolRow]:
        intervals, self._intervals = self._intervals, []
        stream = self._statistics
        if not intervals or stream is None:
            return []
        newest = intervals[-1]
        count = sum([one.count for one in intervals])
        message = stream.message(
            MessageKind.INTERVALS, intervals[0].first, newest.last, count, newest.end_utc_ns, intervals=intervals
        )
        return [stream.row(message, newest.end_utc_ns)]

    def _note_gap(self, sample: Sample) -> list[SpoolRow]:
        """Return the messages about the gap before a sample."""
        if self._gap_cause is DropCause.QUEUE:
            self.gaps += sample.seq - self.next_seq
        made = []
        if self._whole is not None and self._sending.whole is not Whole.NONE:
            made += self._whole.missing(sample.seq, sample.utc_ns, self._gap_cause)
        if self._statistics is not None and self._period_ns:
            made += self._statistics.missing(sample.seq, sample.utc_ns, self._gap_cause)
        return made


def notes_of(rows: Sequence[SpoolRow], cause: DropCause, gateway: str) -> list[SpoolRow]:
    """Return one `dropped` message per stream in place of `rows`, whose numbers are consecutive."""
    first: dict[tuple[str, str], SpoolRow] = {}
    last: dict[tuple[str, str], SpoolRow] = {}
    count: dict[tuple[str, str], int] = {}
    for row in rows:
        first.setdefault(row.key, row)
        last[row.key] = row
        count[row.key] = count.get(row.key, 0) + row.items
    made = []
    for key, begin in first.items():
        end = last[key]
        note = FleetMessage(
            v=VERSION, gateway=gateway, boot=begin.boot, device=begin.device, kind=MessageKind.DROPPED,
            begin=decode_message(begin.payload).begin,
            first=begin.first, last=end.last, count=count[key], utc_ns=end.stored_utc_ns, cause=cause,
        )  # fmt: skip
        made.append(row_of(begin.topic, Stream(begin.stream), note, encode_message(note), end.stored_utc_ns))
    return made
