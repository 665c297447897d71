"""Recording for a client: complete for a client that reads, with marked losses for a slow client, without waiting."""

import select
import socket
from io import BytesIO
from unittest.mock import Mock, call

import pytest

from imud.formats import records
from imud.formats.recording import RecordingReader
from imud.formats.records import Kind, Record
from imud.model.event import Event, EventKind
from imud.publishers.recorder import client_stream as module
from imud.publishers.recorder.client_stream import ClientRecording, stream_pair
from imud.publishers.recorder.writer import RecordQueue
from tests.publishers.recorder.recording_bench import RecordingBench

FULL_NS = 20_000_000
LINGER_NS = 10_000_000_000


class StreamBench(RecordingBench):
    """Recording with a thread that the test runs, and the client's end of the socket."""

    def __init__(self, *devices: str) -> None:
        super().__init__()
        ours, self.client = stream_pair()
        self.client.setblocking(False)
        self.got = b""
        self.recording = ClientRecording(self.context, devices or None, ours, self.workers.start)

    def tick(self, seconds: float = 1.1) -> None:
        self.recording.tick(self.advance(seconds))
        self.workers[0].work()

    def read(self) -> bool:
        """Read the present data. Return whether the recording ended."""
        while True:
            try:
                data = self.client.recv(1 << 20)
            except BlockingIOError:
                return False
            if not data:
                return True
            self.got += data

    def records(self) -> list[Record]:
        reader = RecordingReader(BytesIO(self.got), "read")
        found = list(reader)
        assert reader.problems == []
        return found

    def close(self) -> None:
        self.recording.close()
        self.client.close()


def test_a_recording_starts_with_all_states_and_ends_with_an_end_record() -> None:
    bench = StreamBench()
    bench.tick()
    bench.source.deliver()
    bench.tick()
    assert not bench.read()
    bench.recording.event(Event(1, "", EventKind.CONFIGURATION, "read again"))
    bench.recording.stop("it was stopped")
    bench.recording.stop("again")
    bench.recording.event(Event(1, "", EventKind.CONFIGURATION, "too late"))
    bench.tick()
    assert bench.read()
    assert bench.recording.ended
    assert [one.kind for one in bench.records()] == [
        Kind.SESSION, Kind.CALL, Kind.DEVICE, Kind.DEVICE, Kind.CHECK, Kind.CHECK, Kind.DATA, Kind.CHECK, Kind.CHECK,
        Kind.EVENT, Kind.CHECK, Kind.CHECK, Kind.END,
    ]  # fmt: skip
    assert bench.source.listening == []
    bench.close()


def test_the_recording_contains_the_number_of_records_lost_by_a_slow_client(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RecordQueue", {module.LastRecords: lambda: RecordQueue[module.LastRecords](1 << 20)})
    bench = StreamBench()
    delivered = 0
    while not bench.recording.records_dropped:
        bench.source.deliver(50_000)
        delivered += 1
        bench.tick()
        assert delivered < 1000
    for _ in range(10):
        bench.source.deliver(50_000)
        delivered += 1
        bench.tick()
    assert not bench.read()
    bench.tick()
    while bench.workers[0].work() == FULL_NS:
        bench.read()
    bench.tick()  # the queue has room again
    bench.source.deliver(77)
    bench.recording.stop("")
    while not bench.read():
        bench.workers[0].work()
    found = bench.records()
    lost = sum(records.decode_lost(one.body).records for one in found if one.kind == Kind.LOST)
    kept = sum(one.kind == Kind.DATA for one in found)
    assert lost == bench.recording.records_dropped
    assert kept + lost >= delivered + 1  # some of the lost records can be checks
    after = [one.kind for one in found][[one.kind for one in found].index(Kind.LOST) + 1 :]
    assert after[:3] == [Kind.CALL, Kind.DEVICE, Kind.DEVICE]
    bench.close()


def test_only_selected_devices_are_recorded_until_the_client_disconnects() -> None:
    bench = StreamBench("mast")
    bench.tick()
    bench.recording.stop("")
    bench.tick()
    bench.read()
    assert {one.device for one in bench.records() if one.kind in (Kind.DEVICE, Kind.CHECK)} == {1}
    bench.close()
    bench = StreamBench()
    bench.client.close()
    bench.tick()
    assert bench.recording.ended
    bench.close()
    assert bench.source.listening == []
    assert bench.workers[0].ended
    ours, theirs = stream_pair()
    with ours, theirs:
        assert ours.recv(1) == b""
        sizes = [end.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) for end in (theirs, ours)]
        assert sizes[0] < sizes[1], "the default is too small for two blocks"
        with pytest.raises(BrokenPipeError):
            theirs.send(b"?", socket.MSG_NOSIGNAL)


def test_a_client_without_progress_and_an_internal_error_end_the_recording() -> None:
    bench = StreamBench()
    for _ in range(100):
        bench.source.deliver(100_000)
    bench.recording.stop("")
    assert bench.workers[0].work() == FULL_NS
    bench.clock.advance(LINGER_NS - 1)
    bench.workers[0].work()
    assert not bench.recording.ended
    bench.clock.advance(1)
    bench.workers[0].work()
    assert bench.recording.ended
    bench.close()
    bench = StreamBench()
    bench.workers[0].failed(ZeroDivisionError("a mistake"))
    with pytest.raises(ZeroDivisionError):
        bench.recording.tick(0)
    bench.close()


def test_waiting_records_are_sent_when_imud_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = StreamBench()
    bench.source.deliver()
    bench.recording.stop("imud stopped")
    bench.recording.close(flush=True)
    assert bench.read()
    assert bench.records()[-1].kind == Kind.END
    poll = Mock()
    monkeypatch.setattr(select, "poll", lambda: poll)
    stuck = StreamBench()
    for _ in range(100):
        stuck.source.deliver(100_000)
    stuck.recording.stop("imud stopped")
    stuck.recording.close(flush=True)
    assert stuck.recording.ended
    assert poll.poll.mock_calls == [call(50)] * 10, "half a second"
    quick = StreamBench()
    quick.recording.close()
    assert (quick.read(), quick.got) == (True, b"")
    bench.close()
    quick.close()
    stuck.close()
