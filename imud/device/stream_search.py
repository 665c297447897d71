"""Detection of device and baud rate on a serial port, without I/O and without reads of the clock.

The search visits one baud rate after the other. A new codec of each driver decodes the bytes of the visit and counts
frames with a correct check value. QUICK visits find a device at 100 Hz, MIDDLE visits at 5 Hz, SLOW visits at 1 Hz.
MIDDLE and SLOW visits need received bytes. One good frame extends the visit for a second frame. The baud rate of the
last successful search is first. If no byte has arrived in one pass and within QUIET_NS, and if the configuration
allows it, the search sends the query of each driver at each rate. After the first received byte it sends no query.

False results. LOCK_FRAMES = 2 good frames are enough if there are fewer bad frames. With a 16-bit check value, the
probability at a wrong rate is 3 × 2⁻³² = 7 × 10⁻¹⁰ per visit, if each frame looks like a sync word with a valid length.
Random bytes contain a sync word and a length of HiPNUC with 2⁻²³ per byte: (1000 × 2⁻³⁹)² / 2 = 2 × 10⁻¹⁸ in a visit
of 1,000 bytes. With more bad frames, SURE_FRAMES = 4 good frames are enough: C(60, 4) × 2⁻⁶⁴ = 3 × 10⁻¹⁴.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from imud.config.model import DeviceConfig
from imud.contracts.codec import CodecEvent, StreamCodec, message_of
from imud.contracts.driver import StreamDriver, of_kind
from imud.contracts.link import StreamLink
from imud.contracts.script import Request
from imud.device.search import GaveUp, Listen, RememberedDevice, SearchRound
from imud.drivers import DRIVERS
from imud.host.clock import HostClock
from imud.model.errors import DriverFailed, LinkError
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, uart_byte_ns

LOCK_FRAMES: Final = 2  # number of good frames that is enough if there are fewer bad frames
SURE_FRAMES: Final = 4  # number of good frames that is enough with any number of bad frames

SETTLE_NS: Final = 10 * NS_PER_MS  # time to set a baud rate, ns: control transfers of a USB adapter take some ms
QUICK_NS: Final = 45 * NS_PER_MS  # QUICK visit, ns. A device at 50 or 100 Hz sends one complete frame.
MIDDLE_NS: Final = 250 * NS_PER_MS  # MIDDLE visit, ns. A device at 5 Hz sends one complete frame.
SLOW_NS: Final = 1150 * NS_PER_MS
"""SLOW visit, ns: 1 Hz, the lowest rate in the manuals, and 15 % for the crystal and the frame."""
WHOLE_FRAME_BYTES: Final = 300
"""Minimum length of a visit, bytes: two frames of 150 bytes, so that one frame is complete. HI91 and HI92 in one frame
have 130 bytes. This limit is only relevant at 9600 baud."""
QUIET_NS: Final = 1200 * NS_PER_MS  # silence before the first query, ns. A device at 1 Hz sends within this time.
ASK_NS: Final = 120 * NS_PER_MS  # wait for the reply to a query, ns
QUERY_BYTES: Final = 32  # maximum length of a query, bytes
REPLY_GAP_NS: Final = 200 * NS_PER_MS  # maximum pause within a reply, ns
VISIT_BYTES_MAX: Final = 256 * 1024  # maximum number of bytes in a visit. A visit with more bytes ends.
ASK_TRIES: Final = 2
"""Number of queries per rate. Bytes of wrong rates in the buffer of the device can damage the first query."""


@dataclass(frozen=True, slots=True)
class StreamFound:
    """Result of a search: the device, and its bytes for its own codec, so that its ledger counts them."""

    driver: StreamDriver
    baud: int
    chunks: tuple[tuple[bytes, int], ...] = ()  # bytes of the last visit, with the time of each read
    wasted_bytes: int = 0  # number of bytes of the previous visits: the ledger counts them as `bytes_skipped`


Step = Listen | StreamFound | GaveUp


class Search:
    """Search on one port. Synchronization: one thread. All times are CLOCK_MONOTONIC in ns."""

    def __init__(
        self,
        drivers: Sequence[StreamDriver],
        *,
        bauds: Sequence[int] = (),
        remembered: tuple[str, int] | None = None,
        may_ask: bool = False,
        hold_ns: int = 0,
        options: Any = None,
    ) -> None:
        """`bauds` contains the allowed baud rates; empty: all rates of the drivers, most likely first.

        `remembered` is (driver name, rate) of the last successful search. `options` are the options of the driver, if
        there is only one driver. Raises ValueError without a driver or a rate.
        """
        self._options = options
        self._hold_ns = hold_ns
        self._may_ask = may_ask
        self._first = _usable(remembered, drivers, bauds)
        self._drivers = sorted(
            drivers, key=lambda d: self._first is None or remembered is None or d.name != remembered[0]
        )
        self._bauds = tuple(bauds) or _rates(drivers)
        if not self._drivers or not self._bauds:
            raise ValueError("a search needs at least one driver and one baud rate")
        self._tallies = {baud: _Tally() for baud in self._bauds}
        self._heard_bytes = 0
        self._asked = False
        self._failures: dict[str, str] = {}  # problem of each driver of another package that failed
        self._started_ns = self._now_ns = 0
        self._plan = self._visits()
        self._visit = _Visit(self._bauds[0], 0)

    def start(self, now_ns: int) -> Step:
        self._started_ns = now_ns
        return self._next(now_ns)

    def on_data(self, data: bytes, t_rx_ns: int) -> Step | None:
        """Process bytes of the present visit. Return None to continue."""
        visit = self._visit
        self._heard_bytes += len(data)
        before = visit.good_frames()
        visit.add(data, t_rx_ns)
        self._try_each(lambda trial: visit.look_for_reply(trial, trial.codec.feed(data)))
        if found := self._found():
            return found
        if visit.size > VISIT_BYTES_MAX:
            return self._next(t_rx_ns)
        until_ns = visit.until_ns
        if visit.good_frames() > before:
            until_ns = t_rx_ns + self._dwell_ns(SLOW_NS)
        elif visit.question is not None:
            until_ns = max(until_ns, min(t_rx_ns + REPLY_GAP_NS + self._hold_ns, visit.started_ns + SLOW_NS))
        elif visit.only_until_heard and len(visit.chunks) == 1:
            until_ns = min(until_ns, t_rx_ns + self._dwell_ns(MIDDLE_NS))
        return self._listen_until(until_ns)

    def on_time(self, now_ns: int) -> Step | None:
        visit = self._visit
        if now_ns < visit.until_ns:
            return None
        before = visit.good_frames()
        self._try_each(lambda trial: visit.look_for_reply(trial, trial.codec.flush()))
        if found := self._found():
            return found
        if visit.good_frames() > before:
            return self._listen_until(now_ns + self._dwell_ns(SLOW_NS))
        return self._next(now_ns)

    def refused(self, why: str, now_ns: int) -> Step:
        """Continue without the rate of the last Listen, because the port does not support it."""
        self._tallies[self._visit.baud].refusal = why
        return self._next(now_ns)

    # --- the order of visits -----------------------------------------------------------------------------------------

    def _visits(self) -> Iterator["_Visit"]:
        if self._first is not None:
            yield _Visit(self._first, SLOW_NS, only_until_heard=True)
        others = [baud for baud in self._bauds if baud != self._first]
        order = others + [baud for baud in self._bauds if baud == self._first]
        alone = len(order) == 1
        yield from self._pass(order, SLOW_NS if alone else QUICK_NS)
        yield from self._rest_of_quiet(order)
        if self._may_ask:
            yield from self._questions(order)
        if self._heard_bytes and not alone:
            yield from self._pass(order, MIDDLE_NS)
            yield from self._pass(order, SLOW_NS)

    def _rest_of_quiet(self, bauds: Sequence[int]) -> Iterator["_Visit"]:
        while usable := [baud for baud in bauds if not self._tallies[baud].refusal]:
            for baud in usable:
                if self._heard_bytes or self._now_ns - self._started_ns >= QUIET_NS:
                    return
                yield _Visit(baud, QUICK_NS)

    def _pass(self, bauds: Sequence[int], dwell_ns: int) -> Iterator["_Visit"]:
        for baud in bauds:
            if not self._tallies[baud].refusal:
                yield _Visit(baud, dwell_ns)

    def _questions(self, bauds: Sequence[int]) -> Iterator["_Visit"]:
        for baud in bauds:
            for driver in self._drivers * ASK_TRIES:
                if self._heard_bytes or self._tallies[baud].refusal:
                    break
                self._asked = True
                try:
                    question = next(driver.identify())
                except DriverFailed as error:
                    self._remove_driver(error)
                    continue
                dwell_ns = ASK_NS + QUERY_BYTES * uart_byte_ns(baud)
                yield _Visit(baud, dwell_ns, question=question, asked=driver)

    def _next(self, now_ns: int) -> Step:
        self._now_ns = now_ns
        self._tallies[self._visit.baud].add(self._visit)
        self._visit = _Visit(self._visit.baud, 0)
        visit = next(self._plan, None)
        if visit is None:
            return GaveUp(self._summary(), self._heard_bytes)
        self._visit = visit
        visit.begin(self._trials(visit.baud), now_ns, now_ns + self._dwell_ns(visit.dwell_ns))
        return Listen(visit.until_ns, visit.baud, visit.question.payload if visit.question else b"")

    def _trials(self, baud: int) -> list["_Trial"]:
        fitting = [driver for driver in self._drivers if baud in driver.baud_rates]
        trials = []
        for driver in fitting or self._drivers:
            try:
                trials.append(_Trial(driver, self._options))
            except DriverFailed as error:
                self._remove_driver(error)
        return trials

    def _try_each(self, step: "Callable[[_Trial], None]") -> None:
        """Call a function with each trial of the present visit. Continue without a driver that failed."""
        for trial in list(self._visit.trials):
            try:
                step(trial)
            except DriverFailed as error:
                self._remove_driver(error)

    def _remove_driver(self, error: DriverFailed) -> None:
        """Continue without a driver of another package. Raises the error if no other driver remains."""
        self._failures[error.driver] = str(error)
        self._drivers = [driver for driver in self._drivers if driver.name != error.driver]
        self._visit.trials = [trial for trial in self._visit.trials if trial.driver.name != error.driver]
        if not self._drivers:
            raise error

    def _dwell_ns(self, flow_ns: int) -> int:
        """Return the duration of a visit that waits `flow_ns` for bytes."""
        return self._hold_ns + SETTLE_NS + max(flow_ns, WHOLE_FRAME_BYTES * uart_byte_ns(self._visit.baud))

    def _listen_until(self, until_ns: int) -> Listen | None:
        if until_ns == self._visit.until_ns:
            return None
        self._visit.until_ns = until_ns
        return Listen(until_ns, self._visit.baud)

    # --- results -----------------------------------------------------------------------------------------------------

    def _found(self) -> StreamFound | None:
        visit = self._visit
        for trial in visit.trials:
            if trial.locked() or (trial.driver is visit.asked and visit.answered):
                return StreamFound(trial.driver, visit.baud, tuple(visit.chunks), self._heard_bytes - visit.size)
        return None

    def _summary(self) -> str:
        return "; ".join([self._result(), *self._failures.values()])

    def _result(self) -> str:
        names = " or ".join(driver.name for driver in self._drivers)
        rates = ", ".join(str(baud) for baud, tally in self._tallies.items() if not tally.refusal)
        if rates and not self._heard_bytes:
            asked = " and no reply to a query" if self._asked else ""
            return (
                f"expected {names}, got no byte at {rates} baud{asked}; "
                "check the power supply of the device, and the wires from its TX to RX and between the grounds"
            )
        found = "; ".join(f"{baud}: {tally.text()}" for baud, tally in self._tallies.items())
        return f"expected {names}, got too few valid frames at all baud rates ({found}); check the device type"


@dataclass(slots=True)
class _Tally:
    """Result of all visits at one rate."""

    size: int = 0
    good: int = 0
    bad: int = 0
    refusal: str = ""

    def add(self, visit: "_Visit") -> None:
        self.size += visit.size
        self.good += visit.good_frames()
        self.bad += max((trial.ledger.frames_bad() for trial in visit.trials), default=0)

    def text(self) -> str:
        if self.refusal:
            return self.refusal
        return f"{self.size} bytes, {self.good} valid frames, {self.bad} damaged" if self.size else "silence"


class _Trial:
    """A codec of one driver during one visit."""

    def __init__(self, driver: StreamDriver, options: Any) -> None:
        self.driver = driver
        self.ledger = Ledger()
        self.codec: StreamCodec = driver.make_codec(self.ledger, driver.settings() if options is None else options)

    def good_frames(self) -> int:
        """Return the number of binary frames with a correct check value. Text lines have no check value."""
        return self.ledger.frames_good - self.ledger.frames_in_replies

    def locked(self) -> bool:
        good = self.good_frames()
        return good >= SURE_FRAMES or (good >= LOCK_FRAMES and good > self.ledger.frames_bad())


@dataclass(slots=True)
class _Visit:
    """A period of listening at one rate."""

    baud: int
    dwell_ns: int
    only_until_heard: bool = False  # whether the first byte shortens the visit
    question: Request | None = None
    asked: StreamDriver | None = None
    answered: bool = False
    started_ns: int = 0
    until_ns: int = 0
    size: int = 0
    reply_parts: int = 0
    trials: list[_Trial] = field(default_factory=list)
    chunks: list[tuple[bytes, int]] = field(default_factory=list)

    def begin(self, trials: list[_Trial], now_ns: int, until_ns: int) -> None:
        self.trials, self.started_ns, self.until_ns = trials, now_ns, until_ns

    def add(self, data: bytes, t_rx_ns: int) -> None:
        self.chunks.append((data, t_rx_ns))
        self.size += len(data)

    def good_frames(self) -> int:
        return max((trial.good_frames() for trial in self.trials), default=0)

    def look_for_reply(self, trial: _Trial, events: Sequence[CodecEvent]) -> None:
        """Detect a complete reply. The end alone (`OK`) is not enough, because many devices send it."""
        question = self.question
        if question is None or trial.driver is not self.asked:
            return
        for event in events:
            message = message_of(event)
            if message is None:
                continue
            if question.is_end(message):
                self.answered |= self.reply_parts + 1 >= question.messages_min
            elif question.is_part(message):
                self.reply_parts += 1


def _usable(remembered: tuple[str, int] | None, drivers: Sequence[StreamDriver], bauds: Sequence[int]) -> int | None:
    """Return the remembered rate; None if the configuration has changed."""
    if remembered is None:
        return None
    name, baud = remembered
    known = any(driver.name == name and (baud in bauds if bauds else baud in driver.baud_rates) for driver in drivers)
    return baud if known else None


def _rates(drivers: Sequence[StreamDriver]) -> tuple[int, ...]:
    """Return all rates of all drivers, most likely first."""
    ranked = [(rank, baud) for driver in drivers for rank, baud in enumerate(driver.baud_rates)]
    return tuple(dict.fromkeys(baud for _, baud in sorted(ranked, key=lambda pair: pair[0])))


class StreamRound(SearchRound[StreamFound]):
    """Search round on a serial port."""

    def __init__(
        self, config: DeviceConfig, link: StreamLink, ledger: Ledger, last: RememberedDevice | None, host: HostClock
    ) -> None:
        """`last` is the result of the last successful search. The ledger counts the received bytes as skipped, but
        not the bytes of the device: its own codec counts them."""
        named = config.driver != "auto"
        self._search = Search(
            of_kind([DRIVERS[config.driver]] if named else DRIVERS.values(), StreamDriver),
            bauds=() if link.auto_baud else (link.baud,),
            remembered=(last.driver, last.baud) if last else None,
            may_ask=config.identify and link.writable,
            hold_ns=link.hold_ns,
            options=config.options if named else None,
        )
        super().__init__(ledger, host)
        self._link = link

    def on_data(self, data: bytes, t_rx_ns: int) -> None:
        """Process bytes of the link. The ledger counts them as skipped."""
        self._count(len(data))
        if not self._done.done():
            self._follow(self._search.on_data(data, t_rx_ns))

    def _first(self, now_ns: int) -> Step:
        return self._search.start(now_ns)

    def _due(self, now_ns: int) -> Step | None:
        return self._search.on_time(now_ns)

    def _found(self, found: StreamFound) -> None:
        self._count(-sum(len(data) for data, _ in found.chunks))
        super()._found(found)

    def _listen(self, step: Listen) -> Listen | StreamFound | GaveUp | None:
        if step.baud != self._link.baud:
            try:
                self._link.set_baud(step.baud)
            except LinkError as error:
                return self._search.refused(str(error), self._host.now_ns())
        if step.send:
            try:
                self._link.write(step.send)
            except LinkError as error:
                self._done.set_exception(error)
        return None
