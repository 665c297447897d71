"""Taps: where a recording hears what goes into the path and the clock of a device, and the host's clocks.

A tap without listeners costs nothing: the methods of path and clock are as their classes have them. While anything
listens, those of the device's own objects are replaced by ones that call them and then make a record: after, so that
clocks that were read and edges that were fetched on the way stand before it.
Synchronization: the event loop's thread only.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, cast

import msgspec

from imud.config.model import DeviceConfig
from imud.contracts.codec import Reading
from imud.contracts.lines import Edge
from imud.contracts.publisher import PutRecord
from imud.formats import records
from imud.formats.can import CanFrame
from imud.formats.records import CallRecord, CheckRecord, ClocksRecord, DeviceRecord, Kind, PathRecord
from imud.host.clock import HostClock
from imud.model.errors import Trouble
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.recording.state import StateError, StateWriter
from imud.sampling.path import DeviceClock, ReadyEdges, SamplePath
from imud.sampling.steering import AidingSources

log = logging.getLogger(__name__)

PATH_OWN: Final = frozenset({
    "_device", "_device_id", "_drain_edges", "_ledger", "_listener", "_now_ns", "_on_bad_frame", "_on_message",
    "_overruns", "_publish", "_rotation", "_status_mask", "_status_seen", "_utc_offset_ns", "frame", "latency",
})  # fmt: skip
"""Attributes of a path that are no part of its state: what it was made with, and what is only shown."""
TROUBLES: Final = tuple(Trouble)
PATH_CALLS: Final = ("begin", "flush", "reset", "publish_gathered", "set_frame_time")
CLOCK_CALLS: Final = ("restart", "link_changed", "set_utc_reference", "set_own_status")
LINE_CALLS: Final = {"sout": "on_sout_edges", "sout_div": "on_divided_edges", "pps": "on_pps_edges"}
"""Method of the clock's aiding sources that takes the edges of a line."""

Note = Callable[..., None]


@dataclass(frozen=True, slots=True)
class PathParts:
    """A path as its transport made it."""

    path: SamplePath
    driver: str
    options: Options | None
    period_ns: int = 0
    """Polled devices: time between two reads."""
    edges: ReadyEdges | None = None
    """Of a data-ready line."""


class PathObserver:
    """Tap of one device; its transport says when there is another path."""

    def __init__(self, config: DeviceConfig, device_id: int, ledger: Ledger, host: HostClock) -> None:
        self._config = config
        self._id = device_id
        self._ledger = ledger
        self._host = host
        self._listeners: list[PutRecord] = []
        self._parts: PathParts | None = None
        self._observed: list[tuple[object, str]] = []
        self._overruns = 0
        self._inside = False
        """Whether a method of the path runs."""
        self._heard: _HeardAiding | None = None

    # --- the transport's side ----------------------------------------------------------------------------------------

    def path_made(self, parts: PathParts) -> None:
        """Listen to this path from now on."""
        self._release()
        self._parts = parts
        if self._listeners:
            self._put(self._path_record())
            self._observe(parts)

    def codec_changed(self) -> None:
        """Note that the codec was set by what the device said of itself."""
        if self._listeners and self._parts is not None:
            self._put(self._path_record())

    def described(self, where: str, identity: Mapping[str, str], settings: Mapping[str, str]) -> None:
        """Note what the device said of itself."""
        if self._listeners:
            self._put(self._device_record(where, identity, settings))

    # --- the recorder's side -----------------------------------------------------------------------------------------

    def begin(self, put: PutRecord, where: str, identity: Mapping[str, str], settings: Mapping[str, str]) -> None:
        """Describe the device with its path as it is now, and pass on all that follows."""
        put(self._device_record(where, identity, settings))
        if self._parts is not None:
            put(self._path_record())
        if put not in self._listeners:
            self._listeners.append(put)
        if self._parts is not None and not self._observed:
            self._observe(self._parts)

    def end(self, put: PutRecord) -> None:
        """Pass on nothing any more; no-op for one that does not listen."""
        if put in self._listeners:
            self._listeners.remove(put)
        if not self._listeners:
            self._release()

    def check(self, put: PutRecord) -> None:
        """Record the newest sample and the ledger."""
        newest = self._parts.path.newest if self._parts is not None else None
        checked = CheckRecord(
            self._host.now_ns(),
            newest.seq if newest is not None else 0,
            newest.t_ns if newest is not None else 0,
            newest.t_err_ns if newest is not None else 0,
            self._ledger.snapshot(),
        )
        put(records.encode_object(Kind.CHECK, self._id, checked))

    # --- what is recorded --------------------------------------------------------------------------------------------

    def _put(self, record: bytes) -> None:
        for put in self._listeners:
            put(record)

    def _device_record(self, where: str, identity: Mapping[str, str], settings: Mapping[str, str]) -> bytes:
        config = self._config
        described = DeviceRecord(
            config.name, config.driver, config.link, where, _configuration(config), dict(identity), dict(settings)
        )
        return records.encode_object(Kind.DEVICE, self._id, described)

    def _path_record(self) -> bytes:
        parts = self._parts
        assert parts is not None
        options = msgspec.to_builtins(parts.options) if parts.options is not None else {}
        made = PathRecord(parts.driver, options, parts.period_ns, self._ledger.snapshot(), self._state(parts))
        return records.encode_object(Kind.PATH, self._id, made)

    def _state(self, parts: PathParts) -> bytes:
        writer = StateWriter({"ledger": self._ledger, "steady": self._host.steady}, PATH_OWN)
        roots: dict[str, object] = {"path": parts.path}
        if parts.edges is not None:
            roots = {"edges": parts.edges, **roots}
        try:
            return writer.write(roots)
        except StateError as error:
            log.warning("%s: recorded without its state: %s", self._config.name, error)
            return b""

    def _observe(self, parts: PathParts) -> None:
        path, clock = parts.path, parts.path.clock
        for name, note in self._notes().items():
            if hasattr(path, name):
                self._replace(path, name, note)
        for name in PATH_CALLS:
            if hasattr(path, name):
                self._replace(path, name, self._begun if name == "begin" else self._call("path", name))
        self._replace(path.loss, "link_opened", self._call("loss", "link_opened"))
        self._replace(path.loss, "missed", self._missed)
        for name in CLOCK_CALLS:
            self._replace(clock, name, self._call("clock", name))
        if isinstance(clock, DeviceClock):
            clock.heard_aiding = self._hear
            self._observed.append((clock, "heard_aiding"))
        if parts.edges is not None:
            self._replace(parts.edges, "on_edges", self._edges("data_ready"))
            self._replace(parts.edges, "restart", self._call("edges", "restart"))

    def _replace(self, target: object, name: str, note: Note) -> None:
        method = getattr(target, name)

        def observed(*args: Any, **kwargs: Any) -> Any:
            try:
                return method(*args, **kwargs)
            finally:  # what made the daemon fail is what one wants to see
                note(*args, **kwargs)

        def outermost(*args: Any, **kwargs: Any) -> Any:
            if self._inside:  # a replay makes this call by the outer one
                return method(*args, **kwargs)
            self._inside = True
            try:
                return method(*args, **kwargs)
            finally:
                self._inside = False
                note(*args, **kwargs)

        setattr(target, name, outermost if isinstance(target, SamplePath) else observed)
        self._observed.append((target, name))

    def _hear(self, aiding: AidingSources) -> AidingSources:
        """Return what stands for the aiding sources."""
        if self._heard is None or self._heard.of is not aiding:
            notes = {name: self._edges(line) for line, name in LINE_CALLS.items()}
            self._heard = _HeardAiding(
                aiding, {**notes, "on_trigger_stamps": self._call("aiding", "on_trigger_stamps")}
            )
        return cast(AidingSources, self._heard)

    def _release(self) -> None:
        for target, name in self._observed:
            delattr(target, name)
        self._observed = []

    def _notes(self) -> dict[str, Note]:
        """What makes records of the methods of a path that are given data."""
        device, put = self._id, self._put
        encode_data = records.encode_data

        def on_data(data: bytes, t_rx_ns: int) -> None:
            put(encode_data(device, data, t_rx_ns, -1))

        def gather(data: bytes, t_rx_ns: int, waited_ns: int = 0) -> None:
            put(encode_data(device, data, t_rx_ns, waited_ns))

        def on_frames(frames: Sequence[CanFrame]) -> None:
            put(records.encode_frames(device, frames))

        def on_readings(readings: Sequence[Reading]) -> None:
            put(records.encode_readings(device, [_reading(one) for one in readings]))

        def skip(reading: Reading) -> None:
            put(records.encode_object(Kind.CALL, device, CallRecord("path", "skip", [len(reading.data)])))

        return {
            "on_data": on_data, "gather": gather, "on_frames": on_frames, "on_readings": on_readings, "skip": skip
        }  # fmt: skip

    def _call(self, target: str, method: str) -> Note:
        def note(*args: Any, **kwargs: Any) -> None:
            call = CallRecord(target, method, [msgspec.to_builtins(one) for one in args], kwargs)
            self._put(records.encode_object(Kind.CALL, self._id, call))

        return note

    def _begun(self, now_ns: int) -> None:
        """Record the begin of the path, with what a search has counted before."""
        self._call("ledger", "set")(self._ledger.snapshot())
        self._call("path", "begin")(now_ns)

    def _missed(self, _count: int, overruns: int) -> None:
        """Record the kernel's overruns, before the data with which they were looked at."""
        if overruns != self._overruns:
            self._overruns = overruns
            self._call("path", "overruns")(overruns)

    def _edges(self, line: str) -> Note:
        def note(edges: Sequence[Edge]) -> None:
            self._put(records.encode_edges(self._id, line, edges))

        return note


class _HeardAiding:
    """Aiding sources with notes of some of their methods."""

    def __init__(self, of: AidingSources, notes: Mapping[str, Note]) -> None:
        self.of = of
        self._notes = notes

    def __getattr__(self, name: str) -> Any:
        method, note = getattr(self.of, name), self._notes.get(name)
        if note is None:
            return method

        def observed(*args: Any) -> None:
            try:
                method(*args)
            finally:
                note(*args)

        return observed


class ClockObserver:
    """Tap of the host's clocks."""

    def __init__(self, host: HostClock) -> None:
        self._host = host
        self._listeners: list[PutRecord] = []

    def begin(self, put: PutRecord) -> None:
        """Describe how the clocks were steered so far, and pass on each reading that follows."""
        host = self._host
        host.utc_offset_ns()
        steady = StateWriter({}).write({"steady": host.steady})
        call = CallRecord("host", "restore", [steady, *host.kept()])
        put(records.encode_object(Kind.CALL, records.NO_DEVICE, call))
        if put not in self._listeners:
            self._listeners.append(put)
        host.on_measured = self._measured

    def end(self, put: PutRecord) -> None:
        """Pass on nothing any more; no-op for one that does not listen."""
        if put in self._listeners:
            self._listeners.remove(put)
        if not self._listeners:
            self._host.on_measured = None

    def _measured(self, monotonic_ns: int, raw_ns: int, held_raw_ns: int) -> None:
        host = self._host
        utc_offset_ns, suspends = host.kept()
        clocks = ClocksRecord(monotonic_ns, raw_ns, held_raw_ns, host.error_ns, utc_offset_ns, suspends)
        record = records.encode_clocks(clocks)
        for put in self._listeners:
            put(record)


class RecordedDevice(Protocol):
    """A device with its tap."""

    @property
    def tap(self) -> PathObserver:
        """Where it is heard."""
        ...

    def record(self, put: PutRecord) -> None:
        """Describe the device as it is now, and pass on all that it delivers."""
        ...


class RecordableDevices:
    """What can be recorded of a daemon. Synchronization: the event loop's thread only."""

    def __init__(self, devices: Mapping[str, RecordedDevice], host: HostClock) -> None:
        """`devices` are those that there are at the time of each call."""
        self._devices = devices
        self._host = ClockObserver(host)

    def names(self) -> Sequence[str]:
        """Names of the devices there are."""
        return list(self._devices)

    def begin_host(self, put: PutRecord) -> None:
        """Describe the host's clocks, and pass on their readings from now on; again for one that listens already."""
        self._host.begin(put)

    def begin(self, device: str, put: PutRecord) -> None:
        """Describe a device, and pass on all that it delivers; again for one that listens already. No-op if absent."""
        found = self._devices.get(device)
        if found is not None:
            found.record(put)

    def check(self, device: str, put: PutRecord) -> None:
        """Pass on the newest sample and the ledger of a device as a record. No-op if absent."""
        found = self._devices.get(device)
        if found is not None:
            found.tap.check(put)

    def end(self, put: PutRecord) -> None:
        """Pass on nothing of any device any more, nor of the host."""
        for device in self._devices.values():
            device.tap.end(put)
        self._host.end(put)


def _reading(reading: Reading) -> records.ReadingRecord:
    error = reading.error
    trouble = 0 if error is None else 1 + TROUBLES.index(error.trouble)
    data = reading.data if error is None else str(error).encode()
    return records.ReadingRecord(reading.poll, reading.start_ns, reading.end_ns, trouble, data)


def _configuration(config: DeviceConfig) -> dict[str, Any]:
    """What a replay needs of the configuration, and the link for people, as it stands below the device's name."""
    made = {
        "driver": config.driver,
        config.link: config.link_settings,
        "options": config.options,
        "lines": config.lines,
        "frame": config.frame,
        "convention": config.convention,
        "declination_deg": config.declination_deg,
        "noise": config.noise,
    }
    tree: dict[str, Any] = msgspec.to_builtins({key: one for key, one in made.items() if one is not None})
    return tree
