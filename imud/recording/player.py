"""Player of recordings: it passes the records to the codecs and clocks of the daemon, in the recorded order.

The replay makes the samples, time stamps, errors and ledger counters of the live run again. Check records contain these
values of the live run. The player compares them with its own values and counts the differences.

A recording is a foreign file: it supplies values only. The name of its driver selects a row of imud's registry. Codec,
clock and path come from their constructors. `imud.sampling.state` checks each value of a recorded state, and
`imud.recording.calls` each recorded call.
"""

import logging
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

import msgspec
from msgspec.structs import replace

from imud import __version__
from imud.attitude.conventions import AttitudeSource, Convention
from imud.attitude.published import FrameOptions, PublishedAxes, published_frame
from imud.config.model import DeviceConfig
from imud.contracts.codec import BadFrame, Reading
from imud.contracts.driver import CanDriver, Driver, PolledDriver, StreamDriver
from imud.contracts.lines import DeviceLines, Edge
from imud.contracts.publisher import Batch
from imud.contracts.script import Message
from imud.drivers import DRIVERS
from imud.formats import records
from imud.formats.records import CallRecord, CheckRecord, DeviceRecord, Kind, PathRecord, Record, SessionRecord
from imud.formats.state import StateError
from imud.host.clock import HostClock
from imud.host.log import printable
from imud.model.errors import ImudError, TransferError, reason_of
from imud.model.event import Event, kind_of
from imud.model.ledger import Ledger
from imud.model.options import NoOptions
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS
from imud.recording.calls import HostState, repeat_call, set_ledger
from imud.recording.observer import TROUBLES
from imud.sampling.driver_clock import make_clock
from imud.sampling.path import (
    CanPath,
    PathContext,
    PolledPath,
    PollTiming,
    ReadyEdges,
    SamplePath,
    StreamPath,
)
from imud.sampling.state import load_path, load_steady

log = logging.getLogger(__name__)

# Ledger counters that do not depend on codec and clock. The player copies them from each check record.
FROM_OUTSIDE: Final = ("lost_queue", "replies_late", "replies_unsolicited")
# Maximum number of devices in all runs of a recording, because each device needs memory: 64 devices in 16 runs
DEVICES_MAX: Final = 1024
# Maximum number of runs and suspends in a recording: a year with 170 a day
OFFSETS_MAX: Final = 1 << 16
NOTES_MAX: Final = 16  # maximum number of stored differences and reasons of a device; further ones only count
_DATA: Final = int(Kind.DATA)  # integer of `Kind.DATA`: reading a member of an enumeration takes 0.1 µs on Python 3.11


@dataclass(slots=True)
class PlayedDevice:
    """State of one device during the replay."""

    device_id: int
    described: DeviceRecord
    ledger: Ledger = field(default_factory=Ledger)
    path: SamplePath | None = None
    driver: Driver | None = None
    config: DeviceConfig | None = None
    wrong_length: BadFrame | None = None  # newest CAN frame of a wrong length
    # overruns that the kernel counted in the live run
    overruns: int = 0
    before: dict[str, int] | None = None  # counters of the live run at the start of the recording; None if unknown
    checks: int = 0  # number of check records
    different_checks: int = 0  # number of check records whose values differ from the replay
    # Differences between replay and live run, one sentence for each of the first check records that differ.
    differences: list[str] = field(default_factory=list)
    # Reasons for the first new clocks that replaced the clock of the live run.
    fresh_starts: list[str] = field(default_factory=list)
    newest: Sample | None = None  # newest sample, after `end`
    rate_hz: float = 0.0  # sample rate by the device counter, after `end`; 0 if unknown
    unknown: Mapping[int, int] = field(default_factory=dict)  # frames of unknown types, after `end`

    def end(self) -> None:
        """Keep the results of the path. Release the path, which needs the most memory."""
        path = self.path
        if path is not None:
            self.newest = path.newest
            self.rate_hz = path.clock.expected_rate_hz
            self.unknown = dict(path.unknown)
            self.path = None

    def note_fresh_start(self, reason: str) -> None:
        """Note a new clock in place of the clock of the live run."""
        if len(self.fresh_starts) < NOTES_MAX:
            self.fresh_starts.append(reason)

    def note_difference(self, difference: str) -> None:
        """Note a check record that differs."""
        self.different_checks += 1
        if len(self.differences) < NOTES_MAX:
            self.differences.append(difference)

    def note_frame(self, frame: BadFrame) -> None:
        """Note a CAN frame of a wrong length. The codec counts damaged frames in the ledger."""
        if frame.can_id is not None:
            self.wrong_length = frame


class RecordedEvent(msgspec.Struct, frozen=True):
    """An event of a recording. `kind` may be unknown to this version of imud."""

    t_ns: records.Time
    device: records.DeviceNameOrEmpty
    kind: str
    message: str
    detail: dict[str, str | int | float | bool | None] = {}  # msgspec copies a mutable default


class PlayedClock(HostClock):
    """Host clocks with the recorded readings."""

    __slots__ = ("offset_ns",)

    def __init__(self) -> None:
        super().__init__(int, int, int)
        self.offset_ns = 0

    def utc_offset_ns(self) -> int:
        """Return CLOCK_REALTIME minus CLOCK_MONOTONIC of the newest record, ns."""
        return self.offset_ns


# Minimum difference of two offsets for a step of the wall clock, ns. A more exact reading differs by some microseconds.
STEP_NS: Final = 1 * NS_PER_MS


class _Offsets:
    """Offsets of CLOCK_REALTIME to CLOCK_MONOTONIC in one run of imud."""

    def __init__(self) -> None:
        self.suspends = 0  # number of suspends at the newest reading
        self.starts_ns: list[int] = []  # CLOCK_MONOTONIC at the start of each offset
        self.offsets_ns: list[int] = []


class RecordedClock:
    """CLOCK_REALTIME of a recording: CLOCK_MONOTONIC plus the last recorded offset. Times before a step of the wall
    clock then match the corrected clock. CLOCK_MONOTONIC stops during a suspend, so each suspend starts a new offset.
    Each run of imud has its own offsets: joined files can be from different boots.
    """

    def __init__(self) -> None:
        self._runs: dict[int, _Offsets] = {}
        self._offsets = 0  # number of runs and offsets
        self.begin(0)

    def read(self, record: Record) -> None:
        """Add the clocks in a record, in the order of the file."""
        if record.kind == Kind.CLOCKS:
            read = records.decode_clocks(record.body)
            self.add(read.monotonic_ns, read.utc_offset_ns, read.suspends)
        elif record.kind == Kind.SESSION:
            self.begin(records.decode_object(record, SessionRecord).epoch)
        elif record.kind == Kind.CALL and record.device == records.NO_DEVICE:
            call = records.decode_object(record, CallRecord)
            if (call.target, call.method) == HostState.CALL:
                state = HostState.of(call)
                self.add(0, state.utc_offset_ns, state.suspends)

    def begin(self, epoch: int) -> None:
        """Continue with the records of a run of imud. Raises ImudError above OFFSETS_MAX runs and suspends."""
        if epoch not in self._runs:
            self._count()
        self._run = self._runs.setdefault(epoch, _Offsets())

    def _count(self) -> None:
        self._offsets += 1
        if self._offsets > OFFSETS_MAX:
            raise ImudError(f"cannot read the recording: expected at most {OFFSETS_MAX} runs and suspends, got more")

    def add(self, monotonic_ns: int, offset_ns: int, suspends: int) -> None:
        """Add a reading of the clocks, in the order of the file."""
        run = self._run
        if run.offsets_ns and suspends == run.suspends:
            run.offsets_ns[-1] = offset_ns
            return
        self._count()
        run.suspends = suspends
        run.starts_ns.append(monotonic_ns)
        run.offsets_ns.append(offset_ns)

    def utc_ns(self, t_ns: int, recorded_ns: int) -> int:
        """Return CLOCK_REALTIME at a CLOCK_MONOTONIC time; `recorded_ns` if the wall clock did not step after it."""
        run = self._run
        if not run.offsets_ns:
            return recorded_ns
        utc_ns = t_ns + run.offsets_ns[max(bisect_right(run.starts_ns, t_ns) - 1, 0)]
        return utc_ns if abs(utc_ns - recorded_ns) > STEP_NS else recorded_ns

    def placed(self, batch: Batch) -> Batch:
        """Return samples with `utc_ns` of this clock."""
        times_ns = [self.utc_ns(sample.t_ns, sample.utc_ns) for sample in batch.samples]
        if times_ns == [sample.utc_ns for sample in batch.samples]:
            return batch
        placed = [replace(sample, utc_ns=utc_ns) for sample, utc_ns in zip(batch.samples, times_ns, strict=True)]
        return Batch(batch.device, batch.device_id, placed, batch.frame)


class Player:
    """Player of the records of one recording. Synchronization: one thread."""

    def __init__(
        self,
        publish: Callable[[Batch], None],
        *,
        fresh: bool = False,
        on_event: Callable[[Event, int], None] = lambda _event, _utc_ns: None,
        on_session: Callable[[int], None] = lambda _epoch: None,
    ) -> None:
        """Publish the batches of all devices to `publish`. Pass each event with its CLOCK_REALTIME to `on_event`, and
        the epoch of each file to `on_session`.

        With `fresh`, or if another version of imud wrote the recording, codecs and clocks start without their recorded
        state.
        """
        self.devices: dict[int, PlayedDevice] = {}  # devices by their number in the recorded daemon
        # devices of the earlier runs of imud in joined files, without their paths
        self.earlier: list[PlayedDevice] = []
        self.lost = 0  # number of records that the recorder dropped
        self._publish = publish
        self._on_event = on_event
        self._on_session = on_session
        self._host = PlayedClock()
        self._epoch: int | None = None  # run of the newest file; None before the first
        # Whether the replay can equal the live run: not with new clocks on request
        self.is_comparable = not fresh
        # reason to ignore recorded states; empty if the player uses them
        self._no_state = "a new clock was requested" if fresh else ""
        self._no_host_state = ""  # reason to ignore the states of devices: the state of the host clocks is not usable

    def play(self, found: Iterable[Record]) -> None:
        """Process records. Raises ImudError for an invalid record, and OSError if `publish` raises it."""
        for record in found:
            try:
                self._play(record)
            except (ImudError, OSError):  # codecs and clocks do no I/O: `publish` raised the OSError
                raise
            except Exception as error:  # forged values can cause any exception in a codec or clock
                words = f"{type(error).__name__}: {printable(str(error))}"
                raise ImudError(
                    f"cannot replay a record of kind {record.kind}: {words}; is the file damaged?"
                ) from error

    def _play(self, record: Record) -> None:
        kind, device = record.kind, self.devices.get(record.device)
        if kind == _DATA and device is not None:  # most records
            self._play_device(device, record)
        elif kind == Kind.CLOCKS:
            self._read_clocks(records.decode_clocks(record.body))
        elif kind == Kind.CALL:
            self._call(device, records.decode_object(record, CallRecord))
        elif kind == Kind.DEVICE:
            self._describe(record.device, records.decode_object(record, DeviceRecord))
        elif kind == Kind.SESSION:
            self._begin(records.decode_object(record, SessionRecord))
        elif kind == Kind.LOST:
            self.lost += records.decode_lost(record.body).records
        elif kind == Kind.EVENT:
            self._event(records.decode_object(record, RecordedEvent))
        elif device is not None:
            self._play_device(device, record)

    def _play_device(self, device: PlayedDevice, record: Record) -> None:
        kind, path = record.kind, device.path
        if kind == _DATA and isinstance(path, StreamPath):
            t_rx_ns, waited_ns, data = records.decode_data(record.body)
            if waited_ns < 0:
                path.on_data(data, t_rx_ns)
            else:
                path.gather(data, t_rx_ns, waited_ns)
        elif kind == Kind.FRAMES and isinstance(path, CanPath):
            path.on_frames(records.decode_frames(record.body))
        elif kind == Kind.READINGS and isinstance(path, PolledPath):
            path.on_readings([_reading(one) for one in records.decode_readings(record.body)])
        elif kind == Kind.EDGES:
            _give_edges(device, *records.decode_edges(record.body))
        elif kind == Kind.PATH:
            self._make_path(device, records.decode_object(record, PathRecord))
        elif kind == Kind.CHECK:
            _check(device, records.decode_object(record, CheckRecord))

    def _begin(self, session: SessionRecord) -> None:
        self._on_session(session.epoch)
        if session.epoch != self._epoch:  # another run numbers its devices and samples from the start
            for device in self.devices.values():
                device.end()
            self.earlier += self.devices.values()
            self.devices.clear()
            self._epoch = session.epoch
        if session.imud != __version__:
            recorder = printable(session.imud)
            self._no_state = self._no_state or f"imud {recorder} wrote the recording, this is imud {__version__}"

    def _event(self, recorded: RecordedEvent) -> None:
        event = Event(recorded.t_ns, recorded.device, kind_of(recorded.kind), recorded.message, recorded.detail)
        self._on_event(event, event.t_ns + self._host.offset_ns)

    # --- the host ----------------------------------------------------------------------------------------------------

    def _read_clocks(self, clocks: records.ClocksRecord) -> None:
        host = self._host
        host.steady.add_pair(clocks.monotonic_ns, clocks.raw_ns, clocks.held_raw_ns, clocks.error_ns)
        host.offset_ns = clocks.utc_offset_ns
        if clocks.suspends > host.suspends:
            host.suspends = clocks.suspends
            for device in self.devices.values():
                # CLOCK_MONOTONIC stops during a suspend, so the number of lost samples is unknown
                if device.path is not None and device.path.fresh:
                    device.ledger.add_unknown_gap()

    def _restore_host(self, state: HostState) -> None:
        """Continue from the clocks of a host. If their state is not usable, all clocks of devices start again."""
        host = self._host
        host.offset_ns, host.suspends = state.utc_offset_ns, state.suspends
        host.steady.restart()
        self._no_host_state = ""
        if self._no_state:
            return
        try:
            load_steady(host.steady, state.steady)
        except StateError as error:
            host.steady.restart()
            self._no_host_state = f"cannot restore the clocks of the host: {error}"

    # --- devices -----------------------------------------------------------------------------------------------------

    @property
    def all_devices(self) -> list[PlayedDevice]:
        """Devices of all runs."""
        return [*self.earlier, *self.devices.values()]

    def _describe(self, device_id: int, described: DeviceRecord) -> None:
        known = self.devices.get(device_id)
        if known is None:
            if len(self.devices) + len(self.earlier) >= DEVICES_MAX:
                raise ImudError(f"cannot replay the recording: expected at most {DEVICES_MAX} devices in all runs")
            self.devices[device_id] = PlayedDevice(device_id, described)
        else:
            known.described = described
            if known.path is not None and known.config is not None and known.driver is not None:
                # the settings can select other axes
                known.path.set_frame(_frame_of(known.config, known.driver, described))

    def _make_path(self, device: PlayedDevice, made: PathRecord) -> None:
        try:
            driver = DRIVERS[made.driver]
        except KeyError as error:
            raise ImudError(f"{device.described.name}: {error.args[0]}") from None
        config = device.config = _config_of(device.described, driver, made)
        before = device.path
        device.path = self._path(device, driver, config, made, before=None)
        set_ledger(device.ledger, made.ledger)
        if device.before is None:
            device.before = device.ledger.snapshot()
        try:
            self._restore(device, made.state)
        except StateError as error:
            device.note_fresh_start(str(error))
            # the new clock continues the sequence numbers of the previous path
            device.path = self._path(device, driver, config, made, before=before)
            ledger = device.ledger
            # the new codec does not contain the pending bytes and frames
            ledger.bytes_skipped, ledger.bytes_pending = ledger.bytes_skipped + ledger.bytes_pending, 0
            ledger.frames_ignored, ledger.frames_pending = ledger.frames_ignored + ledger.frames_pending, 0

    def _restore(self, device: PlayedDevice, state: bytes) -> None:
        if reason := self._no_state or self._no_host_state:
            raise StateError(reason)
        if not state:
            raise StateError("the recording does not contain the state of the clock")
        assert device.path is not None
        try:
            load_path(device.path, state)
        except StateError as error:
            raise StateError(f"cannot restore the state: {error}") from None

    def _path(
        self, device: PlayedDevice, driver: Driver, config: DeviceConfig, made: PathRecord, before: SamplePath | None
    ) -> SamplePath:
        ledger, options = device.ledger, config.options
        device.driver = driver
        clock = make_clock(
            config.name, config.lines, driver, before.clock if before is not None else None, host=self._host.steady,
            on_unknown_gap=ledger.add_unknown_gap,
        )  # fmt: skip
        context = PathContext(
            config.name, device.device_id, ledger, self._publish, ignore_message, device.note_frame,
            lambda: device.overruns, self._host,
            _frame_of(config, driver, device.described), config.attitude,
        )  # fmt: skip
        if isinstance(driver, StreamDriver):
            return StreamPath(driver.make_codec(ledger, options), clock, context)
        if isinstance(driver, CanDriver):
            return CanPath(driver.make_codec(ledger, options), clock, context)
        assert isinstance(driver, PolledDriver)
        ready = config.lines.data_ready if config.lines is not None else None
        edges = ReadyEdges(ready, made.period_ns) if ready is not None else None
        timing = PollTiming(made.period_ns, driver.update_ns(options), edges)
        return PolledPath(driver.make_codec(ledger, options), timing, clock, context)

    # --- calls -------------------------------------------------------------------------------------------------------

    def _call(self, device: PlayedDevice | None, call: CallRecord) -> None:
        if (call.target, call.method) == HostState.CALL:
            self._restore_host(HostState.of(call))
        elif device is not None and device.path is not None:
            overruns = repeat_call(device.path, device.ledger, call)
            device.overruns = device.overruns if overruns is None else overruns


def _frame_of(config: DeviceConfig, driver: Driver, described: DeviceRecord) -> PublishedAxes:
    axes = driver.sent_axes(described.settings).axes
    return published_frame(config.frame, config.convention, config.declination_deg, axes)


def _config_of(described: DeviceRecord, driver: Driver, made: PathRecord) -> DeviceConfig:
    """Return the recorded configuration of a device. Raises ImudError if it is invalid."""
    tree = described.configuration
    # another version of imud can have recorded an option that this version does not have
    options = {name: value for name, value in made.options.items() if name in driver.settings.__struct_fields__}
    if unknown := sorted(made.options.keys() - options.keys()):
        log.warning("%s: this imud ignores recorded options: %s", described.name, printable(", ".join(unknown)))
    try:
        return DeviceConfig(
            described.name, made.driver, msgspec.convert(options, driver.settings), False, described.link,
            NoOptions(), lines=msgspec.convert(tree.get("lines"), DeviceLines | None),
            frame=msgspec.convert(tree.get("frame"), FrameOptions | None),
            convention=msgspec.convert(tree.get("convention"), Convention | None),
            declination_deg=msgspec.convert(tree.get("declination_deg"), float | None),
            attitude=msgspec.convert(tree.get("attitude", AttitudeSource.DEVICE), AttitudeSource),
        )  # fmt: skip
    except msgspec.ValidationError as error:
        raise ImudError(f"{described.name}: cannot read the recorded configuration: {reason_of(error)}") from None


def _give_edges(device: PlayedDevice, line: str, found: list[records.EdgeRecord]) -> None:
    edges, path = [Edge(*one) for one in found], device.path
    if line != "data_ready":
        if path is not None:
            path.clock.add_edges(line, edges)
    elif isinstance(path, PolledPath) and path.edges is not None:
        path.edges.on_edges(edges)


def _reading(one: records.ReadingRecord) -> Reading:
    if not one.trouble:
        return Reading(one.poll, one.data, None, one.start_ns, one.end_ns)
    trouble = TROUBLES[min(one.trouble, len(TROUBLES)) - 1]  # a newer imud can record further kinds
    error = TransferError(trouble, one.data.decode(errors="replace"))
    return Reading(one.poll, b"", error, one.start_ns, one.end_ns)


def _check(device: PlayedDevice, live: CheckRecord) -> None:
    """Compare newest sample and ledger with the live run. Copy the counters that codec and clock do not decide."""
    ledger, newest = device.ledger, device.path.newest if device.path is not None else None
    for name in FROM_OUTSIDE:
        setattr(ledger, name, live.ledger[name])
    # a search skipped bytes that the recording does not contain
    searched = live.ledger["bytes_in"] - ledger.bytes_in
    if searched and searched == live.ledger["bytes_skipped"] - ledger.bytes_skipped:
        ledger.bytes_in += searched
        ledger.bytes_skipped += searched
    device.checks += 1
    if not live.seq and newest is None:
        found = {}
    else:
        own = (newest.seq, newest.t_ns, newest.t_err_ns) if newest is not None else (0, 0, 0)
        names = ("seq", "t_ns", "t_err_ns")
        theirs = (live.seq, live.sample_t_ns, live.sample_t_err_ns)
        found = {name: (a, b) for name, a, b in zip(names, theirs, own, strict=True) if a != b}
    found |= {
        name: (live.ledger[name], here)
        for name, here in ledger.snapshot().items()
        if live.ledger.get(name, here) != here  # an older imud did not have the counter
    }
    if found:
        words = ", ".join(f"{name} recorded {a}, replayed {b}" for name, (a, b) in found.items())
        device.note_difference(f"at {live.t_ns} ns: {words}")


def ignore_message(_message: Message, _t_rx_ns: int) -> None:
    """Ignore a text line or reply: a replay sends no requests."""
