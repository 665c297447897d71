"""Player of captures: raw, with time stamps, or of a CAN bus. It uses the codecs and clocks of the daemon.

A capture contains less than a recording. `KnownTimes` describes the meaning of its times. If the capture does not
contain host times, the samples have the device time and the maximum error.
"""

from collections.abc import Callable
from enum import Enum
from typing import Final

import msgspec

from imud.attitude.published import published_frame
from imud.contracts.driver import CanDriver, Driver, StreamDriver
from imud.contracts.publisher import Batch
from imud.formats.can import CandumpReader
from imud.formats.capture import CaptureReader
from imud.formats.records import DeviceRecord
from imud.model.errors import BadArgument
from imud.model.options import Options
from imud.model.sample import T_ERR_MOST, Sample, Sync
from imud.model.units import uart_byte_ns
from imud.recording.player import PlayedClock, PlayedDevice, ignore_message
from imud.sampling.clock import SampleClock
from imud.sampling.driver_clock import make_clock
from imud.sampling.path import CanPath, PathContext, SamplePath, StreamPath

NAME: Final = "replay"  # name of the device, as in `imud replay`
DEVICE_ID: Final = 0
GATHERED: Final = 256  # number of CAN frames in one call of the path
START_UTC: Final = "start_utc_ns"  # detail of a capture with time stamps: CLOCK_REALTIME at its first record


class KnownTimes(Enum):
    """Meaning of the times of exported samples. The value is the text for the user."""

    HOST = "times of the host: CLOCK_MONOTONIC and CLOCK_REALTIME of the capture"
    MONOTONIC = (
        "the capture contains CLOCK_MONOTONIC of its reads and no time of day: utc_ns counts from the first read"
    )
    WALL_CLOCK = (
        "the log of candump contains only the wall clock: t_ns and utc_ns are this clock until its first step; after a "
        "step, they continue with a new offset"
    )
    NONE = (
        "the capture contains bytes without the times of the reads: host times, their error and their source are "
        "unknown. The times are the device time, or the time on the wire if the device does not send its time"
    )

    @property
    def has_host_times(self) -> bool:
        """Return whether a clock of the host made the time stamps."""
        return self is not KnownTimes.NONE


class CapturePlayer:
    """Player of one capture of one device. Synchronization: one thread."""

    def __init__(self, publish: Callable[[Batch], None], driver: Driver, options: Options, where: str) -> None:
        """`where` names the file for the user. Raises BadArgument if no capture of this driver's devices exists."""
        if not isinstance(driver, StreamDriver | CanDriver):
            raise BadArgument(
                f"--driver {driver.name}: expected a driver of bytes or CAN frames, got a driver that polls its devices"
            )
        described = DeviceRecord(NAME, driver.name, "replay", where, {}, {}, {})
        self.device: Final = PlayedDevice(DEVICE_ID, described)
        self.device.driver = driver
        self.times = KnownTimes.NONE  # meaning of the times; valid after the first sample
        self.problem = ""  # problem that the frames show, valid at the end; empty if there is none
        self._publish = publish
        self._driver = driver
        self._options = options
        self._host = PlayedClock()

    def play_bytes(self, reader: CaptureReader, baud: int) -> None:
        """Play a capture of bytes. `baud` is the bit rate if the capture does not contain it."""
        driver = self._driver
        assert isinstance(driver, StreamDriver)
        rate = reader.baud or baud
        byte_ns, sent, t_ns, path = uart_byte_ns(rate), 0, 0, None
        for chunk in reader:
            sent += len(chunk.data)
            t_ns = sent * byte_ns if chunk.t_ns is None else chunk.t_ns  # no time stamps: time on the wire
            if path is None:
                self._set_times(reader, t_ns)
                path = self._stream_path(driver, byte_ns, reader.hold_ns, t_ns)
            path.on_data(chunk.data, t_ns)
        self._end(path, t_ns)

    def play_frames(self, reader: CandumpReader) -> None:
        """Play a log of a CAN bus. Ignore the frames of other devices."""
        driver = self._driver
        assert isinstance(driver, CanDriver)
        self.times = KnownTimes.WALL_CLOCK
        filters, after_loss = driver.filters(self._options), False
        codec = driver.make_codec(self.device.ledger, self._options)
        path = CanPath(codec, self._clock(0, 0), self._context(self._publish))
        self.device.path = path
        waiting, t_ns = [], 0
        for frame in reader:
            if not t_ns:
                path.begin(frame.t_rx_ns)
            t_ns, after_loss = frame.t_rx_ns, after_loss or frame.after_loss
            if any(wanted.matches(frame.can_id, frame.extended) for wanted in filters):
                waiting.append(frame._replace(after_loss=after_loss))
                after_loss = False
            if len(waiting) >= GATHERED:
                path.on_frames(waiting)
                waiting = []
        if waiting:
            path.on_frames(waiting)
        self._end(path, t_ns)
        self.problem = codec.problem

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
        return make_clock(
            NAME, None, self._driver, None, host=self._host.steady, byte_ns=byte_ns, hold_ns=hold_ns,
            on_unknown_gap=self.device.ledger.add_unknown_gap,
        )  # fmt: skip

    def _context(self, publish: Callable[[Batch], None]) -> PathContext:
        frame = published_frame(None, None, None, self._driver.axes)
        device, host = self.device, self._host
        return PathContext(
            NAME, DEVICE_ID, device.ledger, publish, ignore_message, device.note_frame, lambda: 0, host, frame
        )

    def _publish_without_times(self, batch: Batch) -> None:
        """Publish samples with the device time in place of the unknown host time."""
        samples = [_by_device(sample) for sample in batch.samples]
        self._publish(Batch(batch.device, batch.device_id, samples, batch.frame))

    def _end(self, path: SamplePath | None, t_ns: int) -> None:
        if path is not None:
            path.flush(t_ns)
            path.reset()


def _by_device(sample: Sample) -> Sample:
    t_ns = sample.t_ns if sample.t_dev_ns is None else sample.t_dev_ns
    return msgspec.structs.replace(sample, t_ns=t_ns, t_err_ns=T_ERR_MOST, sync=Sync.ARRIVAL, t_rx_ns=t_ns, utc_ns=t_ns)
