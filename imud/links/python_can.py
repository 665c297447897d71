"""A CAN bus through python-can, for adapters without a network interface: serial adapters, drivers of vendors,
`virtual`.

A thread receives frames and passes them to the event loop in batches. The time stamp of a frame is the time at which
python-can returns it, because the time stamps of adapters have no common time base.
"""

import asyncio
import threading
import time
from collections.abc import Sequence
from typing import Any, Final

import can
from can.typechecking import CanFilters

from imud.contracts.link import OnBusNews, OnEnd, OnFrames
from imud.contracts.status import KernelCounters
from imud.formats.can import EXTENDED_FLAG, EXTENDED_ID_MAX, RAW_FRAME, CanFilter, CanFrame, CyclicFrame
from imud.links.cyclic_sender import LoopSender
from imud.model.errors import LinkError, reason_of

LOOK_S: Final = 0.05  # Timeout of a read, s. After it, the thread checks whether to end.
BATCH_FRAMES: Final = 64


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
        self._filters = filters
        if self._bus is not None:
            self._bus.set_filters(_as_python_can(filters))

    def absence(self) -> str:
        """Return an empty text: the state is unknown before the bus is open."""
        return ""

    async def wait_present(self) -> None:
        """Open the bus in a thread, because the constructor of slcan sleeps for 2 s. Raises LinkError."""
        opening = asyncio.get_running_loop().run_in_executor(None, self._opened)
        try:
            self._bus = await asyncio.shield(opening)
        except asyncio.CancelledError:
            opening.add_done_callback(_shut_down)
            raise

    def open(self) -> None:
        """Open the bus if `wait_present` has not opened it. Raises LinkError with the message of python-can."""
        self._bus = self._bus or self._opened()

    def _opened(self) -> can.BusABC:
        filters = _as_python_can(self._filters)
        rate: dict[str, Any] = {"bitrate": self.bitrate} if self.bitrate else {}
        if self._data_bitrate:
            rate |= {"fd": True, "data_bitrate": self._data_bitrate}
        try:
            return can.Bus(self._channel, self._backend, can_filters=filters, ignore_config=True, **rate)
        except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as error:
            raise LinkError(f"cannot open {self.title}: {reason_of(error)}") from error

    def start(self, on_frames: OnFrames, on_news: OnBusNews, on_end: OnEnd) -> None:
        """Start the delivery of frames. python-can does not report changes of the bus state."""
        assert self._bus is not None
        self._on_end = on_end
        self._stop = threading.Event()
        arguments = (self._bus, self._stop, asyncio.get_running_loop(), on_frames, on_end)
        self._thread = threading.Thread(target=self._receive, args=arguments, name=f"can {self._channel}")
        self._thread.start()

    def write(self, data: bytes) -> None:
        """Send frames (`struct can_frame`). Raises LinkError."""
        if self._bus is None:
            raise LinkError(f"{self.title} is not open and cannot send")
        try:
            for can_id, size, payload in RAW_FRAME.iter_unpack(data):
                extended = can_id >= EXTENDED_FLAG
                message = can.Message(
                    arbitration_id=can_id & EXTENDED_ID_MAX, is_extended_id=extended, data=payload[:size]
                )
                self._bus.send(message, timeout=0)
        except can.CanError as error:
            raise LinkError(f"{self.title} cannot send: {reason_of(error)}") from error

    def send_cyclic(self, frames: Sequence[CyclicFrame]) -> None:
        """Send the frames from the event loop. The link ends if it cannot send a frame. Raises LinkError.

        `send_periodic` of python-can needs a thread for each frame and does not report failures.
        """
        if self._sender is not None:
            self._sender.close()
        self._sender = LoopSender(self, frames)

    def kernel_counters(self) -> KernelCounters:
        """Return zeros: python-can does not count errors."""
        return KernelCounters()

    def close(self) -> None:
        """Release the bus and wait for the thread, at most LOOK_S. A second call does nothing."""
        self._stop.set()
        sender, self._sender = self._sender, None
        if sender is not None:
            sender.close()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def sender_failed(self, error: LinkError) -> None:
        if self._on_end is not None:
            self._on_end(error)

    def _receive(
        self,
        bus: can.BusABC,
        stop: threading.Event,
        loop: asyncio.AbstractEventLoop,
        on_frames: OnFrames,
        on_end: OnEnd,
    ) -> None:
        def deliver(frames: list[CanFrame]) -> None:
            if not stop.is_set():
                on_frames(frames)

        def end(error: LinkError) -> None:
            if not stop.is_set():
                on_end(error)

        try:
            while not stop.is_set():
                frames = _batch(bus)
                if frames:
                    loop.call_soon_threadsafe(deliver, frames)
        except Exception as error:  # noqa: BLE001 - a backend raises any error, for example slcan for a damaged line
            loop.call_soon_threadsafe(end, LinkError(f"{self.title} ended: {reason_of(error)}"))


def _shut_down(opening: asyncio.Future[can.BusABC]) -> None:
    if opening.exception() is None:
        opening.result().shutdown()


def _as_python_can(filters: Sequence[CanFilter]) -> CanFilters:
    return [{"can_id": f.can_id, "can_mask": f.mask, "extended": f.extended} for f in filters]


def _batch(bus: can.BusABC) -> list[CanFrame]:
    """Wait for the first data frame. Return all data frames that python-can has now."""
    frames: list[CanFrame] = []
    message = bus.recv(LOOK_S)
    while message is not None:
        if not (message.is_error_frame or message.is_remote_frame):
            now_ns = time.monotonic_ns()
            frames.append(CanFrame(message.arbitration_id, message.is_extended_id, bytes(message.data), now_ns))
        message = bus.recv(0) if len(frames) < BATCH_FRAMES else None
    return frames
