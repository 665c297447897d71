"""Runs the detection on an open link of bytes: sets rates, sends queries, keeps its time."""

from collections.abc import Callable
from dataclasses import dataclass

from imud.config import DeviceConfig
from imud.contracts.driver import StreamDriver, of_kind
from imud.contracts.link import StreamLink
from imud.devices import DRIVERS
from imud.errors import LinkError, NothingHeard
from imud.ledger import Ledger
from imud.runtime.detection import GaveUp, Listen, Search, Step, StreamFound, remembered
from imud.runtime.detection.round import SearchRound


@dataclass(frozen=True, slots=True)
class Finding:
    """What talks on a link, and what was heard of it while searching."""

    driver: StreamDriver
    chunks: tuple[tuple[bytes, int], ...]
    """Bytes with CLOCK_MONOTONIC of their reads, taken out of the ledger again for the device's own codec to count."""


class Finder(SearchRound):
    """One round of detection. `on_found` is called inside the callback that completed it, so that the next bytes
    already go to the device's own codec. Synchronization: the event loop's thread only.
    """

    def __init__(
        self,
        config: DeviceConfig,
        link: StreamLink,
        ledger: Ledger,
        last: remembered.RememberedDevice | None,
        on_found: Callable[[Finding], None],
        *,
        may_ask: bool,
    ) -> None:
        super().__init__()
        self._link = link
        self._ledger = ledger
        self._on_found = on_found
        named = config.driver != "auto"
        self._search = Search(
            of_kind([DRIVERS[config.driver]] if named else DRIVERS.values(), StreamDriver),
            bauds=() if link.auto_baud else (link.baud,),
            remembered=(last.driver, last.baud) if last else None,
            may_ask=may_ask,
            hold_ns=link.hold_ns,
            options=config.options if named else None,
        )

    def start(self) -> None:
        """Begin; from now on bytes go to `take`."""
        self._follow(self._search.start(self._now_ns()))

    def take(self, data: bytes, t_rx_ns: int) -> None:
        """Bytes from the link; they count as skipped until a device is found in them."""
        self._ledger.bytes_in += len(data)
        self._ledger.bytes_skipped += len(data)
        if not self._done.done():
            self._follow(self._search.on_data(data, t_rx_ns))

    def _at_time(self) -> bool:
        step = self._search.on_time(self._now_ns())
        self._follow(step)
        return step is not None

    def _follow(self, step: Step | None) -> None:
        while isinstance(step, Listen):
            step = self._listen(step)
        if isinstance(step, GaveUp):
            self._done.set_exception(NothingHeard(step.summary))
        elif step is not None:
            self._finish(step)

    def _finish(self, found: StreamFound) -> None:
        heard = sum(len(data) for data, _ in found.chunks)
        self._ledger.bytes_in -= heard
        self._ledger.bytes_skipped -= heard
        self._done.set_result(None)
        self._on_found(Finding(found.driver, found.chunks))

    def _listen(self, step: Listen) -> Step | None:
        if step.baud != self._link.baud:
            try:
                self._link.set_baud(step.baud)
            except LinkError as error:
                return self._search.refused(str(error), self._now_ns())
        if step.send:
            try:
                self._link.write(step.send)
            except LinkError as error:
                self._done.set_exception(error)
                return None
        self._wait_until(step.until_ns)
        return None
