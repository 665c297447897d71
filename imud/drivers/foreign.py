"""Boundary to the drivers of other packages: their code raises only errors of imud, and returns only valid values.

    row of a package ──guarded_driver──▶ the same row, each function and each script guarded
    make_codec ──▶ GuardedStreamCodec, GuardedCanCodec or GuardedPolledCodec around the codec of the package

Any exception becomes `DriverFailed`, also SystemExit, KeyboardInterrupt, GeneratorExit and CancelledError. After its
first failure imud does not call a codec again. The drivers of imud do not pass this boundary: their samples keep the
fast path.
"""

import logging
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import partial, update_wrapper
from types import GeneratorType
from typing import Any, Final, TypeVar

from imud.contracts.codec import BadFrame, BadReason, CodecEvent, Poll, PolledEvent, Vanished
from imud.contracts.driver import CanDriver, Driver, PolledDriver, StreamDriver
from imud.contracts.script import ReplyFrame, Request, TextLine, Transfer
from imud.drivers.measured_values import WrongMeasurement, checked_measurement
from imud.host.scope import words_of
from imud.model.errors import DriverFailed, ImudError
from imud.model.ledger import LEDGER_FIELDS, Ledger
from imud.model.sample import Measurement

log = logging.getLogger(__name__)

D = TypeVar("D", bound=Driver)

EVENTS_MAX: Final = 100_000
"""Maximum number of events of one call. A read has at most 64 KiB, and the shortest frame has some bytes."""
COUNTER_MAX: Final = (1 << 63) - 1  # maximum value of a counter of the ledger in all outputs


def guarded_driver(driver: D) -> D:
    """Return the row of another package with guarded functions, scripts and codecs."""
    guard = DriverGuard(driver.name)
    row: Any = guard.value(driver)
    codec: Any = {StreamDriver: GuardedStreamCodec, CanDriver: GuardedCanCodec, PolledDriver: GuardedPolledCodec}
    kind = next((kind for kind in codec if isinstance(driver, kind)), None)
    if kind is None:
        return row  # type: ignore[no-any-return]
    row = replace(row, make_codec=partial(_make_codec, codec[kind], guard, driver))
    if isinstance(driver, StreamDriver | CanDriver):
        apply = row.apply_identity
        row = replace(row, apply_identity=lambda codec, identity: apply(codec.codec, identity))
    return row  # type: ignore[no-any-return]


def _make_codec(
    codec_type: Callable[..., Any], guard: "DriverGuard", driver: Driver, ledger: Ledger, options: Any
) -> Any:
    codec = guard.call(driver.make_codec, ledger, options)  # type: ignore[attr-defined]
    return codec_type(guard, codec, ledger, driver.tick_modulus)


class DriverGuard:
    """Guard of the code of one driver."""

    def __init__(self, driver: str) -> None:
        self.driver = driver
        self._guarded: dict[int, tuple[Any, Any]] = {}  # by identity: the original, which must stay, and its guard

    def failure(self, error: BaseException) -> DriverFailed:
        """Return the error for the rest of imud."""
        failure = DriverFailed(self.driver, words_of(error))
        failure.__cause__ = error
        return failure

    def wrong(self, message: str) -> DriverFailed:
        """Return the error for a wrong value."""
        return DriverFailed(self.driver, f"{message}; install another version of the package")

    def call(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        """Call a function of the driver. Raises ImudError."""
        try:
            result = function(*arguments, **named)
        except ImudError:
            raise
        except BaseException as error:
            raise self.failure(error) from error
        return self.script(result) if isinstance(result, GeneratorType) else result

    def value(self, value: Any) -> Any:
        """Return a part of a row with guarded functions."""
        known = self._guarded.get(id(value))
        if known is not None:
            return known[1]
        guarded = self._value(value)
        self._guarded[id(value)] = value, guarded
        return guarded

    def _value(self, value: Any) -> Any:
        if is_dataclass(value) and not isinstance(value, type):
            changed = {field.name: self.value(getattr(value, field.name)) for field in fields(value) if field.init}
            return replace(value, **changed)
        if isinstance(value, Mapping):
            return {key: self.value(part) for key, part in value.items()}
        if callable(value) and not isinstance(value, type):
            return update_wrapper(partial(self.call, value), value)
        return value

    def script(self, script: Generator[Any, Any, Any]) -> Generator[Any, Any, Any]:
        """Run a script of the driver. Raises ImudError."""
        reply: Any = None
        thrown: BaseException | None = None
        try:
            while True:
                try:
                    request = script.send(reply) if thrown is None else script.throw(thrown)
                except StopIteration as end:
                    return end.value
                except ImudError:
                    raise
                except BaseException as error:
                    raise self.failure(error) from error
                self._check_request(request)
                thrown = None
                try:
                    reply = yield self._guarded_request(request)
                except ImudError as error:
                    thrown = error
        finally:
            self._close(script)

    def _close(self, script: Generator[Any, Any, Any]) -> None:
        try:
            script.close()
        except BaseException as error:  # noqa: BLE001 - foreign code can raise any exception
            log.error("%s: a script failed at its end: %s", self.driver, words_of(error))

    def _guarded_request(self, request: Request | Transfer) -> Request | Transfer:
        """Return a request with guarded functions. They run when a message arrives."""
        if isinstance(request, Transfer):
            return request
        functions: dict[str, Any] = {
            field.name: update_wrapper(partial(self.call, function), function)
            for field in fields(request)
            if callable(function := getattr(request, field.name))
        }
        return replace(request, **functions)

    def _check_request(self, request: object) -> None:
        if isinstance(request, Request):
            is_valid = isinstance(request.payload, bytes) and type(request.timeout_ns) is int
        elif isinstance(request, Transfer):
            parts = [*request.sends] if isinstance(request.sends, tuple | list) else [None]
            is_valid = all(isinstance(part, bytes) for part in parts) and type(request.read_bytes) is int
        else:
            is_valid = False
        if not is_valid:
            raise self.wrong(f"expected a Request or Transfer from its script, got {shown(request)}")


def shown(value: object) -> str:
    """Return a foreign value for a message."""
    try:
        return repr(value)[:120]
    except BaseException:  # noqa: BLE001 - foreign code can raise any exception
        return f"a {type(value).__name__} that cannot be printed"


class _GuardedCodec:
    """Guard of a codec. After a failure it counts all bytes as skipped and returns no events."""

    def __init__(self, guard: DriverGuard, codec: Any, ledger: Ledger, tick_modulus: int) -> None:
        self.codec = codec
        self.ledger = ledger
        self.has_failed = False
        self._guard = guard
        self._tick_modulus = tick_modulus

    def flush(self) -> Sequence[CodecEvent]:
        return self._events(0, self.codec.flush)

    def reset(self) -> None:
        if not self.has_failed:
            self._call(self.codec.reset)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return self._guard.call(function, *arguments)
        except BaseException:
            self._end()
            raise

    def _attribute(self, name: str, default: Any) -> Any:
        """Return an attribute of the codec, which can be a property that fails."""
        if self.has_failed:
            return default
        return self._call(getattr, self.codec, name)

    def _events(self, size: int, function: Callable[..., Any], *arguments: Any) -> Sequence[Any]:
        """Return the checked events of a call that passes `size` bytes."""
        if self.has_failed:
            self.ledger.bytes_in += size
            self.ledger.bytes_skipped += size
            return ()
        events = self._call(function, *arguments)
        try:
            return self._checked(events)
        except WrongMeasurement as error:
            self._end()
            raise self._guard.wrong(str(error)) from error

    def _checked(self, events: Any) -> Sequence[Any]:
        if not isinstance(events, list | tuple) or len(events) > EVENTS_MAX:
            raise WrongMeasurement(
                f"expected a list of at most {EVENTS_MAX} events from its codec, got {shown(events)}"
            )
        for value in self.ledger.values():
            if type(value) is not int or not 0 <= value <= COUNTER_MAX:
                raise WrongMeasurement(f"expected counters from 0 to {COUNTER_MAX} in the ledger, got {shown(value)}")
        return [self._checked_event(event) for event in events]

    def _checked_event(self, event: Any) -> PolledEvent:
        kind = type(event)
        if kind is Measurement:
            measurement, dropped = checked_measurement(event, self._tick_modulus)
            if dropped:
                self.ledger.frames_not_finite += 1
            return measurement
        is_valid = (
            (kind is TextLine and isinstance(event.text, str))
            or (kind is ReplyFrame and type(event.frame_id) is int and isinstance(event.payload, bytes))
            or (kind is BadFrame and isinstance(event.reason, BadReason) and isinstance(event.raw, bytes))
            or (kind is Vanished and isinstance(event.why, str))
        )
        if not is_valid:
            raise WrongMeasurement(f"expected a Measurement, TextLine, ReplyFrame or BadFrame, got {shown(event)}")
        return event  # type: ignore[no-any-return]

    def _end(self) -> None:
        """Do not call the codec again, and repair the ledger: all outputs read it."""
        self.has_failed = True
        ledger = self.ledger
        for name in LEDGER_FIELDS:
            value = getattr(ledger, name, None)
            if type(value) is not int or not 0 <= value <= COUNTER_MAX:
                setattr(ledger, name, 0)
        ledger.bytes_pending = 0
        ledger.frames_pending = 0
        ledger.bytes_skipped += max(ledger.bytes_open(), 0)
        ledger.frames_ignored += max(ledger.frames_open(), 0)


class GuardedStreamCodec(_GuardedCodec):
    """Guard of a `StreamCodec`."""

    @property
    def unknown(self) -> dict[int, int]:
        counts: dict[int, int] = self._attribute("unknown", {})
        return counts

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        return self._events(len(data), self.codec.feed, data)


class GuardedCanCodec(_GuardedCodec):
    """Guard of a `CanCodec`."""

    @property
    def unknown(self) -> dict[int, int]:
        counts: dict[int, int] = self._attribute("unknown", {})
        return counts

    @property
    def counts_losses(self) -> bool:
        return bool(self._attribute("counts_losses", False))

    @property
    def problem(self) -> str:
        return str(self._attribute("problem", ""))

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        return self._events(len(data), self.codec.feed_frame, can_id, extended, data, t_rx_ns)


class GuardedPolledCodec(_GuardedCodec):
    """Guard of a `PolledCodec`."""

    @property
    def polls(self) -> Sequence[Poll]:
        polls = self._attribute("polls", ())
        is_valid = isinstance(polls, list | tuple) and polls and all(isinstance(poll, Poll) for poll in polls)
        if not self.has_failed and not is_valid:
            self._end()
            raise self._guard.wrong(f"expected polls from its codec, got {shown(polls)}")
        return tuple(polls)

    @property
    def stale(self) -> int:
        stale = self._attribute("stale", 0)
        return stale if type(stale) is int else 0

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        return self._events(len(data), self.codec.decode, poll, data)

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        return self._events(0, self.codec.on_silence, poll)
