"""Observers of a device's path and of the host's clocks: they encode each input as a record.

The path calls its observer after each input, so that the clock readings and edges of this input are recorded before it.
Synchronization: the event loop's thread only.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any, Final

import msgspec

from imud.attitude.conventions import AttitudeSource
from imud.config.model import DeviceConfig
from imud.contracts.codec import Reading
from imud.contracts.lines import Edge
from imud.contracts.publisher import PutRecord
from imud.formats import records
from imud.formats.can import CanFrame
from imud.formats.records import CallRecord, CheckRecord, ClocksRecord, DeviceRecord, Kind, PathRecord
from imud.formats.state import StateError
from imud.host.clock import HostClock
from imud.model.errors import Trouble
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.recording.calls import HostState
from imud.sampling.path import PolledPath, SamplePath
from imud.sampling.state import save_path, save_steady

log = logging.getLogger(__name__)

TROUBLES: Final = tuple(Trouble)


class PathObserver:
    """Recorder of the input of one device. The transport calls `path_made` for each new path."""

    def __init__(self, config: DeviceConfig, device_id: int, ledger: Ledger, host: HostClock) -> None:
        self._config = config
        self._id = device_id
        self._ledger = ledger
        self._host = host
        self.listeners: list[PutRecord] = []
        self._path: SamplePath | None = None
        self._driver = ""
        self._options: Options | None = None
        # newest recorded count; the kernel counts from the opening of the link
        self._overruns = 0

    # --- the transport's side ----------------------------------------------------------------------------------------

    def path_made(self, path: SamplePath, driver: str, options: Options | None) -> None:
        """Observe `path` instead of the previous path. Record the driver, its options and the state of the new path."""
        if self._path is not None:
            self._path.observe(None)
        self._path, self._driver, self._options = path, driver, options
        if self.listeners:
            self._put(self._path_record(path))
            path.observe(self)

    def codec_changed(self) -> None:
        """Record the path again: the codec changed its options because the device reported its identity."""
        if self.listeners and self._path is not None:
            self._put(self._path_record(self._path))

    def described(self, where: str, identity: Mapping[str, str], settings: Mapping[str, str]) -> None:
        """Record the identity and the settings that the device reported."""
        self._put(self._device_record(where, identity, settings))

    # --- the recorder's side -----------------------------------------------------------------------------------------

    def begin(self, put: PutRecord, where: str, identity: Mapping[str, str], settings: Mapping[str, str]) -> None:
        """Send the description and the state of the device to `put`, then each input.

        A second call sends the description and the state again.
        """
        put(self._device_record(where, identity, settings))
        if put not in self.listeners:
            self.listeners.append(put)
        if self._path is not None:
            put(self._path_record(self._path))
            self._path.observe(self)

    def end(self, put: PutRecord) -> None:
        """Send no more records to `put`. Do nothing if `put` receives no records."""
        if put in self.listeners:
            self.listeners.remove(put)
        if not self.listeners and self._path is not None:
            self._path.observe(None)

    def check(self, put: PutRecord) -> None:
        """Send the newest sample and the ledger to `put`. A replay compares its own values with them."""
        newest = self._path.newest if self._path is not None else None
        checked = CheckRecord(
            self._host.now_ns(),
            newest.seq if newest is not None else 0,
            newest.t_ns if newest is not None else 0,
            newest.t_err_ns if newest is not None else 0,
            self._ledger.snapshot(),
        )
        put(records.encode_object(Kind.CHECK, self._id, checked))

    # --- records -----------------------------------------------------------------------------------------------------

    def _put(self, record: bytes) -> None:
        for put in self.listeners:
            put(record)

    def _device_record(self, where: str, identity: Mapping[str, str], settings: Mapping[str, str]) -> bytes:
        config = self._config
        described = DeviceRecord(
            config.name, config.driver, config.link, where, _configuration(config), dict(identity), dict(settings)
        )
        return records.encode_object(Kind.DEVICE, self._id, described)

    def _path_record(self, path: SamplePath) -> bytes:
        options = msgspec.to_builtins(self._options) if self._options is not None else {}
        period_ns = path.period_ns if isinstance(path, PolledPath) else 0
        made = PathRecord(self._driver, options, period_ns, self._ledger.snapshot(), self._state(path))
        return records.encode_object(Kind.PATH, self._id, made)

    def _state(self, path: SamplePath) -> bytes:
        try:
            return save_path(path)
        except StateError as error:
            log.warning("%s: recorded without its state: %s", self._config.name, error)
            return b""  # a replay then starts with a new clock

    # --- input, called by the path (contract `InputObserver`)
    # ----------------------------------------------------------

    def data(self, data: bytes, t_rx_ns: int, waited_ns: int) -> None:
        self._put(records.encode_data(self._id, data, t_rx_ns, waited_ns))

    def frames(self, frames: Sequence[CanFrame]) -> None:
        self._put(records.encode_frames(self._id, frames))

    def readings(self, readings: Sequence[Reading]) -> None:
        self._put(records.encode_readings(self._id, [_reading(one) for one in readings]))

    def edges(self, line: str, edges: Sequence[Edge]) -> None:
        self._put(records.encode_edges(self._id, line, edges))

    def overruns(self, count: int) -> None:
        """Record the number of overruns if it changed."""
        # The path calls this method before it reports the data of the loss.
        if count != self._overruns:
            self._overruns = count
            self.call("path", "overruns", count)

    def call(self, target: str, method: str, *arguments: object, **keywords: object) -> None:
        """Record the call of a method of path or clock."""
        # named tuples become lists
        call = CallRecord(target, method, [msgspec.to_builtins(one) for one in arguments], keywords)
        self._put(records.encode_object(Kind.CALL, self._id, call))


class ClockObserver:
    """Recorder of the host's clocks."""

    def __init__(self, host: HostClock) -> None:
        self._host = host
        self.listeners: list[PutRecord] = []

    def begin(self, put: PutRecord) -> None:
        """Send the present state of the clocks to `put`, then each reading."""
        host = self._host
        host.utc_offset_ns()  # reads the clocks, so that the state is up to date
        call = CallRecord(*HostState.CALL, [save_steady(host.steady), *host.kept()])
        put(records.encode_object(Kind.CALL, records.NO_DEVICE, call))
        if put not in self.listeners:
            self.listeners.append(put)
        host.on_measured = self._measured

    def end(self, put: PutRecord) -> None:
        """Send no more readings to `put`. Do nothing if `put` receives no readings."""
        if put in self.listeners:
            self.listeners.remove(put)
        if not self.listeners:
            self._host.on_measured = None

    def _measured(self, monotonic_ns: int, raw_ns: int, held_raw_ns: int) -> None:
        host = self._host
        utc_offset_ns, suspends = host.kept()
        clocks = ClocksRecord(monotonic_ns, raw_ns, held_raw_ns, host.error_ns, utc_offset_ns, suspends)
        record = records.encode_clocks(clocks)
        for put in self.listeners:
            put(record)


def _reading(reading: Reading) -> records.ReadingRecord:
    error = reading.error
    trouble = 0 if error is None else 1 + TROUBLES.index(error.trouble)
    data = reading.data if error is None else str(error).encode()
    return records.ReadingRecord(reading.poll, reading.start_ns, reading.end_ns, trouble, data)


def _configuration(config: DeviceConfig) -> dict[str, Any]:
    """Return the keys of the device's configuration that a replay needs, and the options of its link, for display."""
    made = {
        "driver": config.driver,
        config.link: config.link_settings,
        "options": config.options,
        "lines": config.lines,
        "frame": config.frame,
        "convention": config.convention,
        "declination_deg": config.declination_deg,
        "attitude": None if config.attitude is AttitudeSource.DEVICE else config.attitude,
        "noise": config.noise,
    }
    tree: dict[str, Any] = msgspec.to_builtins({key: one for key, one in made.items() if one is not None})
    return tree
