"""Observers: the path has an observer only while a recording runs, and the records contain every input in order."""

from imud.config.model import DeviceConfig
from imud.contracts.lines import Edge
from imud.drivers.hipnuc.uart.driver import DRIVER
from imud.formats.records import CheckRecord, Kind, PathRecord, decode_object, records_of
from imud.model.ledger import Ledger
from imud.model.options import NoOptions
from imud.recording.observer import ClockObserver, PathObserver
from imud.sampling.driver_clock import make_clock
from imud.sampling.path import PathContext, StreamPath
from tests.support.event_loops import VirtualClock
from tests.support.files import hi91


class ObservedPath:
    def __init__(self) -> None:
        self.clock = VirtualClock()
        self.host = self.clock.host
        self.ledger = Ledger()
        config = DeviceConfig("bow", "hipnuc-uart", None, False, "uart", NoOptions())
        context = PathContext(
            "bow", 3, self.ledger, lambda _batch: None, lambda _message, _t: None, lambda _frame: None, lambda: 0,
            self.host,
        )  # fmt: skip
        options, gap = DRIVER.settings(), self.ledger.add_unknown_gap
        self.path = StreamPath(
            DRIVER.make_codec(self.ledger, options),
            make_clock(config.name, config.lines, DRIVER, None, host=self.host.steady, on_unknown_gap=gap),
            context,
        )
        self.observer = PathObserver(config, 3, self.ledger, self.host)
        self.observer.path_made(self.path, DRIVER.name, options)
        self.records: list[bytes] = []

    def begin(self) -> None:
        self.observer.begin(self.records.append, "/dev/ttyUSB0", {}, {})

    def kinds(self) -> list[int]:
        return [record.kind for one in self.records for record in records_of(one)]

    @property
    def observers(self) -> set[object]:
        return {self.path.observer, self.path.clock.observer}


def test_a_recording_contains_the_inputs_in_order() -> None:
    one = ObservedPath()
    assert one.observers == {None}
    one.begin()
    assert one.observers == {one.observer}
    (path,) = [decode_object(record, PathRecord) for record in records_of(one.records[-1])]
    assert (path.driver, path.options) == ("hipnuc-uart", {"hi91_word": "auto"})
    one.observer.codec_changed()
    one.observer.end(one.records.append)
    assert one.observers == {None}
    one.path.on_data(hi91(0), 1)
    assert one.kinds() == [Kind.DEVICE, Kind.PATH, Kind.PATH]
    one = ObservedPath()
    one.begin()
    one.path.clock.link_changed(byte_ns=86_806, hold_ns=0)
    one.path.on_data(hi91(0), 5)
    one.path.flush(6)
    assert one.kinds() == [Kind.DEVICE, Kind.PATH, Kind.CALL, Kind.DATA, Kind.CALL]


def test_two_recorders_get_the_same_records_and_the_state_of_a_new_path() -> None:
    one, other = ObservedPath(), list[bytes]()
    one.begin()
    one.observer.begin(other.append, "", {}, {})
    one.path.on_data(hi91(0), 5)
    one.observer.end(one.records.append)
    one.path.on_data(hi91(10), 6)
    assert (one.records[-1], len(other)) == (other[-2], 4)
    one = ObservedPath()
    one.begin()
    before = one.path
    two = ObservedPath()
    one.observer.path_made(two.path, DRIVER.name, None)
    before.on_data(hi91(0), 5)
    assert one.kinds() == [Kind.DEVICE, Kind.PATH, Kind.PATH]
    two.path.on_data(hi91(0), 6)
    assert one.kinds()[-1] == Kind.DATA
    for path in (two.path, ObservedPath().path):  # the edges reach the clock of the present path, and the recording
        one.observer.path_made(path, DRIVER.name, None)
        path.clock.add_edges("sout", [Edge(7, True, 1)])
        assert (path.clock.status().edges, one.kinds()[-1]) == (1, Kind.EDGES)


def test_readings_of_the_clocks_are_recorded() -> None:
    clock = VirtualClock()
    host, records = clock.host, list[bytes]()
    observer = ClockObserver(host)
    observer.begin(records.append)
    assert [record.kind for one in records for record in records_of(one)] == [Kind.CALL]
    clock.advance(2_000_000_000)
    host.utc_offset_ns()
    assert [record.kind for record in records_of(records[-1])] == [Kind.CLOCKS]
    observer.end(records.append)
    clock.advance(2_000_000_000)
    host.utc_offset_ns()
    assert len(records) == 2


def test_a_check_contains_the_newest_sample_and_the_ledger() -> None:
    one, put = ObservedPath(), list[bytes]()
    one.observer.check(put.append)
    one.path.on_data(hi91(0), 5)
    one.observer.check(put.append)
    newest = one.path.newest
    assert newest is not None
    found = [decode_object(record, CheckRecord) for data in put for record in records_of(data)]
    written = [(check.seq, check.sample_t_ns, check.sample_t_err_ns) for check in found]
    assert written == [(0, 0, 0), (newest.seq, newest.t_ns, newest.t_err_ns)]
    assert found[1].ledger == one.ledger.snapshot()
