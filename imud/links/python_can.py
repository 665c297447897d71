"""A CAN bus through python-can, for adapters without a network interface: serial adapters, drivers of vendors,
`virtual`.

A thread receives frames and passes them to the event loop in batches. The time stamp of a frame is the time at which
python-can returns it, because the time stamps of adapters have no common time base.

A backend raises exceptions of every class, for example NameError without the library of its vendor. No exception leaves
this module: it becomes a LinkError. A line that slcan cannot decode is one damaged frame and does not end the link.
"""

import asyncio
import logging
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, Final

import can
from can.typechecking import CanFilters

from imud.contracts.link import OnBusNews, OnEnd, OnFrames
from imud.contracts.status import KernelCounters
from imud.formats.can import EXTENDED_FLAG, EXTENDED_ID_MAX, RAW_FRAME, CanFilter, CanFrame, CyclicFrame
from imud.host.library_call import LibraryCall
from imud.links.can_backends import backend_problem
from imud.links.cyclic_sender import LoopSender
from imud.model.errors import LinkError

log = logging.getLogger(__name__)

LOOK_S: Final = 0.05  # Timeout of a read, s. After it, the thread checks whether to end.
JOIN_S: Final = 1.0  # maximum wait for the end of the thread, s: the read of a removed adapter can block without end
BATCH_FRAMES: Final = 64
DAMAGED_MAX: Final = 100  # number of consecutive damaged frames after which the link ends: 50 ms of a full bus


class PythonCanLink:
    """A bus of python-can as a `CanLink`. Synchronization: the loop's thread. The link has its own receiving thread."""

    def __init__(self, backend: str, channel: str, bitrate: int = 0, data_bitrate: int = 0) -> None:
        """`data_bitrate`: bit rate of the data phase of CAN FD, bit/s; 0: classical CAN."""
        self._backend = backend
        self._data_bitrate = data_bitrate
        self._channel = channel
        self._bus: can.BusABC | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._filters: Sequence[CanFilter] = ()
        self._sender: LoopSender | None = None
        self._on_end: OnEnd | None = None
        self._reader: _BusReader | None = None  # reader of the newest start
        self.title = self.bus = f"{channel} ({backend})"
        self.bitrate = bitrate
        # Time for which the link holds frames, ns. This link ignores it: the receiving thread decides.
        self.gather_ns = 0
        self.writable = True

    @property
    def filters(self) -> Sequence[CanFilter]:
        return self._filters

    @filters.setter
    def filters(self, filters: Sequence[CanFilter]) -> None:
        """Set the filters. A started link ends if the backend refuses them. Raises LinkError before the start."""
        self._filters = filters
        if self._bus is None:
            return
        try:
            with LibraryCall(f"set the filters of {self.title}"):
                self._bus.set_filters(_as_python_can(filters))
        except LinkError as error:
            if self._on_end is None:
                raise
            asyncio.get_running_loop().call_soon(self._end, self._stop, error)

    def absence(self) -> str:
        """Return an empty text: the state is unknown before the bus is open."""
        return ""

    async def wait_present(self) -> None:
        """Open the bus in a thread, because the constructor of slcan sleeps for 2 s. Raises LinkError."""
        opening = asyncio.get_running_loop().run_in_executor(None, self._opened)
        try:
            self._bus = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_shut_down_opened)
            raise

    def open(self) -> None:
        """Open the bus if `wait_present` has not opened it. Raises LinkError with the message of python-can."""
        self._bus = self._bus or self._opened()
        self._reader = None

    def _opened(self) -> can.BusABC:
        filters = _as_python_can(self._filters)
        rate: dict[str, Any] = {"bitrate": self.bitrate} if self.bitrate else {}
        if self._data_bitrate:
            rate |= {"fd": True, "data_bitrate": self._data_bitrate}
        try:
            with LibraryCall(f"open {self.title}"):
                return can.Bus(self._channel, self._backend, can_filters=filters, ignore_config=True, **rate)
        except LinkError as error:
            if problem := backend_problem(self._backend):
                raise LinkError(f"{error}; {problem[0]}") from error
            raise

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Start the delivery of frames. python-can does not report changes of the bus state."""
        assert self._bus is not None
        self._on_end = on_end
        self._stop = threading.Event()
        self._reader = _BusReader(self._bus)
        arguments = (self._reader, self._stop, asyncio.get_running_loop(), on_frames)
        self._thread = threading.Thread(target=self._receive, args=arguments, name=f"can {self._channel}", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Send frames (`struct can_frame`). Raises LinkError."""
        if self._bus is None:
            raise LinkError(f"{self.title} is not open and cannot send")
        with LibraryCall(f"send on {self.title}"):
            for can_id, size, payload in RAW_FRAME.iter_unpack(data):
                extended = can_id >= EXTENDED_FLAG
                message = can.Message(
                    arbitration_id=can_id & EXTENDED_ID_MAX, is_extended_id=extended, data=payload[:size]
                )
                self._bus.send(message, timeout=0)

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Send the frames from the event loop. The link ends if it cannot send a frame. Raises LinkError.

        `send_periodic` of python-can needs a thread for each frame and does not report failures.
        """
        if self._sender is not None:
            self._sender.close()
        self._sender = LoopSender(self, frames)

    def kernel_counters(self) -> KernelCounters:
        """Return the damaged frames as framing errors. python-can does not count other errors."""
        return KernelCounters(framing=self._reader.damaged if self._reader is not None else 0)

    def close(self) -> None:
        """Release the bus and wait for the thread, usually LOOK_S, at most JOIN_S. A second call does nothing."""
        self._stop.set()
        self._on_end = None
        sender, self._sender = self._sender, None
        if sender is not None:
            sender.close()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(JOIN_S)
        bus, self._bus = self._bus, None
        if bus is not None:
            _shut_down(bus)

    def sender_failed(self, error: LinkError) -> None:
        self._end(self._stop, error)

    def _end(self, stop: threading.Event, error: LinkError) -> None:
        """Report the end of the link once. `stop` belongs to the start of the link that failed."""
        on_end = self._on_end
        if on_end is not None and not stop.is_set():
            stop.set()
            self._on_end = None
            on_end(error)

    def _receive(
        self, reader: "_BusReader", stop: threading.Event, loop: asyncio.AbstractEventLoop, on_frames: OnFrames
    ) -> None:
        """Pass frames to the loop until `stop`. Runs in the receiving thread."""

        def deliver(frames: list[CanFrame]) -> None:
            if not stop.is_set():
                on_frames(frames)

        with suppress(RuntimeError):  # the loop was closed
            try:
                with LibraryCall(f"receive on {self.title}"):
                    while not stop.is_set():
                        if frames := reader.read():
                            loop.call_soon_threadsafe(deliver, frames)
            except LinkError as error:
                loop.call_soon_threadsafe(self._end, stop, error)


def _shut_down_opened(opening: asyncio.Future[can.BusABC]) -> None:
    if opening.exception() is None:
        _shut_down(opening.result())


def _shut_down(bus: can.BusABC) -> None:
    """Shut a bus down. A removed adapter raises an error: its bus is unusable, and its port is closed with the bus."""
    try:
        with LibraryCall("shut the bus down"):
            bus.shutdown()
    except LinkError as error:
        log.info("%s: %s", type(bus).__name__, error)


def _as_python_can(filters: Sequence[CanFilter]) -> CanFilters:
    return [{"can_id": f.can_id, "can_mask": f.mask, "extended": f.extended} for f in filters]


class _BusReader:
    """Reader of the data frames of a bus. Synchronization: the receiving thread only, except `damaged`."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._run = 0  # number of consecutive frames that the backend could not decode
        self.damaged = 0  # number of damaged frames

    def read(self) -> list[CanFrame]:
        """Wait for the first frame. Return all data frames that python-can has now, at most BATCH_FRAMES.

        Raises the exceptions of the backend, also after DAMAGED_MAX consecutive damaged frames."""
        frames: list[CanFrame] = []
        timeout_s = LOOK_S
        for _ in range(BATCH_FRAMES):
            try:
                message = self._bus.recv(timeout_s)
            except Exception as error:
                if not _is_damaged_frame(error) or self._run >= DAMAGED_MAX:
                    raise
                self._run += 1
                self.damaged += 1
                _drop_line(self._bus)
                continue
            if message is None:
                break
            timeout_s = 0
            if message.is_error_frame or message.is_remote_frame:
                continue
            if message.dlc != len(message.data):
                self.damaged += 1
                continue
            self._run = 0
            now_ns = time.monotonic_ns()
            frames.append(CanFrame(message.arbitration_id, message.is_extended_id, bytes(message.data), now_ns))
        return frames


def _is_damaged_frame(error: Exception) -> bool:
    """Return whether the backend received bytes that are not a frame: slcan converts the text of each line."""
    errors = (error, error.__cause__)
    return any(type(part) in (ValueError, IndexError, UnicodeDecodeError) for part in errors)


def _drop_line(bus: can.BusABC) -> None:
    """Remove a line that is not ASCII from the buffer of slcan, which would decode the line again."""
    line = getattr(bus, "_buffer", None)
    if isinstance(line, bytearray):
        line.clear()
