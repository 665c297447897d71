"""Player of captures, raw, stamped, or of a CAN bus: through the codecs and clocks of the daemon, without a daemon.

A capture has less than a recording: what it cannot know is said by `KnownTimes`, and stamps that would be made up are
made so that nobody takes them for more than they are.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final

import msgspec

from imud.attitude.published import published_frame
from imud.config.model import DeviceConfig
from imud.contracts.codec import BadFrame
from imud.contracts.driver import CanDriver, Driver, StreamDriver
from imud.contracts.publisher import Batch
from imud.contracts.script import Message
from imud.formats.can import CandumpReader
from imud.formats.capture import CaptureReader
from imud.formats.records import DeviceRecord
from imud.model.errors import BadArgument
from imud.model.options import NoOptions, Options
from imud.model.sample import T_ERR_MOST, Sample, Sync
from imud.model.units import uart_byte_ns
from imud.recording.player import PlayedClock, PlayedDevice
from imud.sampling.clock import SampleClock
from imud.sampling.path import CanPath, PathContext, SamplePath, StreamPath, make_clock

NAME: Final = "replay"
"""Of the device, as in `imud replay` of a capture."""
DEVICE_ID: Final = 0
GATHERED: Final = 256
"""Frames of a CAN bus that are processed together, as of one read."""
START_UTC: Final = "start_utc_ns"
"""Detail of a stamped capture: CLOCK_REALTIME at its first record."""


class KnownTimes(Enum):
    """What the times of exported samples are; the value says it for people."""

    HOST = "times of the host, by its CLOCK_MONOTONIC and CLOCK_REALTIME then"
    MONOTONIC = (
        "the capture has CLOCK_MONOTONIC of its reads and does not say what time of day that was: "
        "utc_ns counts from the first read"
    )
    WALL_CLOCK = (
        "the log has the wall clock only, as candump wrote it: t_ns and utc_ns are both made of it, and a step of that "
        "clock is in them"
    )
    NONE = (
        "the capture has bytes and no time of any read: host times, their error and their source are not known. Times "
        "are those of the device's own clock, where it sends them, else of the bytes on the wire"
    )

    @property
    def has_host_times(self) -> bool:
        """Whether stamps are of a clock of the host."""
        return self is not KnownTimes.NONE


class CapturePlayer:
    """Player of one capture of one device. Synchronization: one thread."""

    def __init__(self, publish: Callable[[Batch], None], driver: Driver, options: Options, where: str) -> None:
        """`where` names the file for people. Raises BadArgument for a driver whose devices cannot be captured."""
        if not isinstance(driver, StreamDriver | CanDriver):
            raise BadArgument(f"--driver {driver.name}: expected a driver of bytes or of CAN frames; it is polled")
        described = DeviceRecord(NAME, driver.name, "replay", where, {}, {}, {})
        self.device: Final = PlayedDevice(DEVICE_ID, described)
        self.device.driver = driver
        self.times = KnownTimes.NONE
        """What the times are; known from the first sample on."""
        self._publish = publish
        self._driver = driver
        self._options = options
        self._host = PlayedClock()

    def play_bytes(self, reader: CaptureReader, baud: int) -> None:
        """Play a capture of bytes; `baud` is the rate of the wire in bit/s where the capture does not name it."""
        driver = self._driver
        assert isinstance(driver, StreamDriver)
        rate = reader.baud or baud
        byte_ns, sent, t_ns, path = uart_byte_ns(rate), 0, 0, None
        for chunk in reader:
            sent += len(chunk.data)
            t_ns = sent * byte_ns if chunk.t_ns is None else chunk.t_ns
            if path is None:
                self._set_times(reader, t_ns)
                path = self._stream_path(driver, byte_ns, reader.hold_ns, t_ns)
            path.on_data(chunk.data, t_ns)
        self._end(path, t_ns)

    def play_frames(self, reader: CandumpReader) -> None:
        """Play a log of a CAN bus."""
        driver = self._driver
        assert isinstance(driver, CanDriver)
        self.times = KnownTimes.WALL_CLOCK
        filters = driver.filters(self._options)
        codec = driver.make_codec(self.device.ledger, self._options)
        path = CanPath(codec, self._clock(0, 0), self._context(self._publish))
        self.device.path = path
        waiting, t_ns = [], 0
        for frame in reader:
            if not t_ns:
                path.begin(frame.t_rx_ns)
            t_ns = frame.t_rx_ns
            if any(wanted.matches(frame.can_id, frame.extended) for wanted in filters):
                waiting.append(frame)
            if len(waiting) >= GATHERED:
                path.on_frames(waiting)
                waiting = []
        if waiting:
            path.on_frames(waiting)
        self._end(path, t_ns)

    def _set_times(self, reader: CaptureReader, first_ns: int) -> None:
        utc = reader.details.get(START_UTC, "")
        if not reader.stamped:
            self.times = KnownTimes.NONE
        elif utc.isascii() and utc.isdigit():
            self.times, self._host.offset_ns = KnownTimes.HOST, int(utc) - first_ns
        else:
            self.times, self._host.offset_ns = KnownTimes.MONOTONIC, -first_ns

    def _stream_path(self, driver: StreamDriver, byte_ns: int, hold_ns: int, t_ns: int) -> StreamPath:
        codec = driver.make_codec(self.device.ledger, self._options)
        publish = self._publish if self.times.has_host_times else self._publish_without_times
        path = StreamPath(codec, self._clock(byte_ns, hold_ns), self._context(publish))
        path.begin(t_ns)
        self.device.path = path
        return path

    def _clock(self, byte_ns: int, hold_ns: int) -> SampleClock:
        config = DeviceConfig(NAME, self._driver.name, self._options, False, "replay", NoOptions())
        return make_clock(
            config.name, config.lines, self._driver, None, host=self._host.steady, byte_ns=byte_ns, hold_ns=hold_ns,
            on_unknown_gap=self.device.ledger.add_unknown_gap,
        )  # fmt: skip

    def _context(self, publish: Callable[[Batch], None]) -> PathContext:
        frame = published_frame(None, None, None, self._driver.axes)
        return PathContext(
            NAME, DEVICE_ID, self.device.ledger, publish, _ignore_message, _ignore_frame, lambda: 0, self._host, frame
        )

    def _publish_without_times(self, batch: Batch) -> None:
        """Publish samples with the time of the device in place of times that nobody measured."""
        samples = [_by_device(sample) for sample in batch.samples]
        self._publish(Batch(batch.device, batch.device_id, samples, batch.frame))

    def _end(self, path: SamplePath | None, t_ns: int) -> None:
        if path is not None:
            path.flush(t_ns)
            path.reset()


def _by_device(sample: Sample) -> Sample:
    t_ns = sample.t_ns if sample.t_dev_ns is None else sample.t_dev_ns
    return msgspec.structs.replace(sample, t_ns=t_ns, t_err_ns=T_ERR_MOST, sync=Sync.ARRIVAL, t_rx_ns=t_ns, utc_ns=t_ns)


def _ignore_message(_message: Message, _t_rx_ns: int) -> None:
    """Ignore what the device answered."""


def _ignore_frame(_frame: BadFrame) -> None:
    """Ignore the frame: the ledger has it."""
