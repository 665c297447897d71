"""The boundary to a driver of another package: any exception and any wrong value is one error with its name."""

import asyncio
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from typing import Any

import pytest

from imud.contracts.codec import BadFrame, BadReason, Poll, Vanished
from imud.contracts.command import Proof, Verb
from imud.contracts.driver import Identity
from imud.contracts.script import Outcome, ReplyFrame, Request, Silence, TextLine, Transfer, pause, says_nothing
from imud.drivers import DRIVERS
from imud.drivers.foreign import GuardedStreamCodec, guarded_driver
from imud.model.errors import DriverFailed, NoReply, Rejected
from imud.model.ledger import Ledger
from imud.model.options import NoOptions
from imud.model.sample import Measurement
from tests.support.fake_drivers import FAKE_DRIVER, fake_can_driver

ERRORS: list[BaseException] = [
    RuntimeError("boom"), SystemExit(0), KeyboardInterrupt(), GeneratorExit(), asyncio.CancelledError(),
    BaseExceptionGroup("several", [KeyboardInterrupt()]), StopIteration(), RecursionError(), MemoryError(),
]  # fmt: skip
GOOD = Measurement(10, 0, None, accel_m_s2=(0.0, 0.0, 9.8))


class Codec:
    """Codec of all three kinds, with functions that a test replaces."""

    counts_losses = False
    problem = ""
    stale = 0
    polls: Any = (Poll(Transfer((b"x",))),)

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self.unknown: dict[int, int] = {}
        self.result: Any = ()
        self.error: BaseException | None = None

    def feed(self, data: bytes) -> Any:
        self.ledger.bytes_in += len(data)
        if self.error is not None:
            raise self.error
        self.ledger.bytes_skipped += len(data)
        return self.result

    def feed_frame(self, _can_id: int, _extended: bool, data: bytes, _t_rx_ns: int) -> Any:
        return self.feed(data)

    def decode(self, _poll: int, data: bytes) -> Any:
        return self.feed(data)

    def flush(self) -> Any:
        return self.feed(b"")

    def on_silence(self, _poll: int) -> Any:
        return self.feed(b"")

    def reset(self) -> None:
        self.feed(b"")


I2C_DRIVER: Any = DRIVERS["imu61x-i2c"]
POLLED = replace(I2C_DRIVER, make_codec=lambda ledger, _options: Codec(ledger))
DRIVER_ROWS: dict[str, Any] = {
    "stream": replace(FAKE_DRIVER, make_codec=lambda ledger, _options: Codec(ledger), interface=1),
    "can": replace(fake_can_driver(), make_codec=lambda ledger, _options: Codec(ledger), interface=1),
    "polled": POLLED,
}
CALLS: list[tuple[str, Callable[[Any], object]]] = [
    ("stream", lambda codec: codec.feed(b"abc")), ("stream", lambda codec: codec.flush()),
    ("stream", lambda codec: codec.reset()), ("can", lambda codec: codec.feed_frame(1, False, b"abc", 0)),
    ("can", lambda codec: codec.flush()), ("can", lambda codec: codec.reset()),
    ("polled", lambda codec: codec.decode(0, b"abc")), ("polled", lambda codec: codec.on_silence(0)),
    ("polled", lambda codec: codec.reset()),
]  # fmt: skip


def guarded(kind: str) -> Any:
    return guarded_driver(DRIVER_ROWS[kind]).make_codec(Ledger(), NoOptions())


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("number", range(len(CALLS)))
def test_codec_failure_has_the_name_of_the_driver(number: int, error: BaseException) -> None:
    kind, call = CALLS[number]
    codec = guarded(kind)
    codec.codec.error = error
    with pytest.raises(
        DriverFailed, match=f"of another package failed: internal error {type(error).__name__}"
    ) as failure:
        call(codec)
    assert failure.value.driver == DRIVER_ROWS[kind].name
    assert codec.ledger.closes()


@pytest.mark.parametrize("number", range(len(CALLS)))
def test_failed_codec_is_called_no_more(number: int) -> None:
    """The device calls `reset` after the failure of `feed`, and a second failure ended all devices."""
    kind, call = CALLS[number]
    codec = guarded(kind)
    codec.codec.error = RuntimeError("boom")
    with pytest.raises(DriverFailed):
        call(codec)
    before = codec.ledger.bytes_skipped
    assert not call(codec)
    assert codec.ledger.bytes_skipped in (before, before + 3)
    codec.reset()
    assert codec.ledger.closes()


EVENTS: list[Any] = [
    [GOOD], (GOOD,), [TextLine("OK")], [ReplyFrame(1, b"x")], [BadFrame(BadReason.CRC, b"x")], [Vanished("no reply")],
    [],
]  # fmt: skip
WRONG_EVENTS: list[Any] = [
    None, "text", 5, {GOOD: 1}, iter([GOOD]), [None], [object()], [TextLine(5)], [ReplyFrame("1", b"x")],  # type: ignore[arg-type]
    [ReplyFrame(1, "x")], [BadFrame("crc", b"x")], [BadFrame(BadReason.CRC, "x")], [Vanished(None)],  # type: ignore[arg-type]
    [Measurement(10, 0, None, accel_m_s2=("x", None))],  # type: ignore[arg-type]
]  # fmt: skip


@pytest.mark.parametrize("events", EVENTS, ids=map(str, range(len(EVENTS))))
def test_valid_events_pass(events: Any) -> None:
    codec = guarded("stream")
    codec.codec.result = events
    assert codec.feed(b"abc") == list(events)


@pytest.mark.parametrize("events", WRONG_EVENTS, ids=map(str, range(len(WRONG_EVENTS))))
def test_wrong_events_fail(events: Any) -> None:
    codec = guarded("stream")
    codec.codec.result = events
    with pytest.raises(DriverFailed, match=r"expected .*, got .*; install another version of the package"):
        codec.feed(b"abc")
    assert codec.feed(b"abc") == ()


@pytest.mark.parametrize("value", ["x", None, 1.5, -1, 1 << 63, True], ids=str)
def test_wrong_counter_is_repaired(value: Any) -> None:
    codec = guarded("stream")
    codec.ledger.frames_good = value
    with pytest.raises(DriverFailed, match="expected counters from 0"):
        codec.feed(b"abc")
    assert codec.ledger.frames_good == 0
    assert codec.ledger.closes()


@pytest.mark.parametrize(("name", "kind", "default"), [
    ("unknown", "stream", {}), ("problem", "can", ""), ("counts_losses", "can", False), ("polls", "polled", ()),
    ("stale", "polled", 0),
])  # fmt: skip
def test_attribute_that_fails(name: str, kind: str, default: object, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_codec: object) -> None:
        raise SystemExit(0)

    codec = guarded(kind)
    monkeypatch.setattr(Codec, name, property(fail, lambda _codec, _value: None), raising=False)
    with pytest.raises(DriverFailed):
        getattr(codec, name)
    assert getattr(codec, name) == default


@pytest.mark.parametrize("polls", [None, (), [5]], ids=str)
def test_wrong_polls_fail(polls: Any) -> None:
    codec = guarded("polled")
    codec.codec.polls = polls
    with pytest.raises(DriverFailed, match="expected polls"):
        _ = codec.polls


def failing_script(error: BaseException, requests: int) -> Generator[Request, Outcome, None]:
    for _ in range(requests):
        yield pause(1)
    raise error


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("requests", [0, 1])
def test_script_failure(error: BaseException, requests: int) -> None:
    """A script that raises GeneratorExit looked like a closed script."""
    row = guarded_driver(replace(DRIVER_ROWS["stream"], identify=lambda: failing_script(error, requests)))
    script = row.identify()
    for _ in range(requests):
        next(script)
    with pytest.raises(DriverFailed):
        next(script)


@pytest.mark.parametrize("error", [NoReply("nothing"), Rejected("no")], ids=str)
def test_errors_of_the_contract_pass(error: Exception) -> None:
    row = guarded_driver(replace(DRIVER_ROWS["stream"], identify=lambda: failing_script(error, 0)))
    with pytest.raises(type(error)):
        next(row.identify())


def test_script_returns_its_value_and_handles_errors() -> None:
    def script() -> Generator[Any, Any, str]:
        assert isinstance((yield pause(1)), Silence)
        try:
            yield pause(2)
        except NoReply:
            return "handled"
        return "not handled"

    running = guarded_driver(replace(DRIVER_ROWS["stream"], identify=script)).identify()
    assert next(running).timeout_ns == 1
    assert running.send(Silence(())).timeout_ns == 2
    with pytest.raises(StopIteration, match="handled"):
        running.throw(NoReply("nothing"))


@pytest.mark.parametrize("request_", [
    5, None, Request("x", "n", bool, bool, bool), Request(b"", "n", bool, bool, bool, timeout_ns="1"),  # type: ignore[arg-type]
    Transfer(("x",)), Transfer(None), Transfer((b"x",), "1"),  # type: ignore[arg-type]
], ids=lambda value: type(value).__name__)  # fmt: skip
def test_wrong_request_fails(request_: Any) -> None:
    row = guarded_driver(replace(DRIVER_ROWS["stream"], identify=lambda: (item for item in [request_])))
    with pytest.raises(DriverFailed, match="expected a Request or Transfer"):
        next(row.identify())


def test_functions_of_a_request_are_guarded() -> None:
    def fail(_message: object) -> bool:
        raise SystemExit(0)

    row = guarded_driver(
        replace(DRIVER_ROWS["stream"], identify=lambda: (item for item in [Request(b"", "n", fail, fail, fail)]))
    )
    with pytest.raises(DriverFailed):
        next(row.identify()).is_end("OK")


def test_script_that_fails_at_its_end(caplog: pytest.LogCaptureFixture) -> None:
    def script() -> Generator[Any, Any, None]:
        try:
            yield pause(1)
        finally:
            raise KeyboardInterrupt

    running = guarded_driver(replace(DRIVER_ROWS["stream"], identify=script)).identify()
    next(running)
    running.close()
    assert "fake-uart: a script failed at its end: internal error KeyboardInterrupt" in caplog.text


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_functions_of_the_row_are_guarded(error: BaseException) -> None:
    def fail(*_: object) -> Any:
        raise error

    def begin(_target: object, *, angle_deg: float = 1.0) -> Any:
        raise error

    verbs = {"turn": Verb("turn", begin, proof=Proof.VALUE, expected=fail)}
    row = guarded_driver(
        replace(
            DRIVER_ROWS["stream"], make_codec=fail, heading=fail, check=fail, unknown_name=fail, verbs=verbs, wake=fail
        )
    )
    arguments = row.verbs["turn"].arguments({"angle_deg": 2.0})
    calls: Sequence[Callable[[], object]] = [
        lambda: row.make_codec(Ledger(), NoOptions()), lambda: row.heading(None, {}), lambda: row.problems(None, None),
        lambda: row.unknown_words({1: 2}), row.wake, lambda: row.verbs["turn"].script(None, arguments),
        lambda: row.verbs["turn"].expected(arguments),
    ]  # fmt: skip
    for call in calls:
        with pytest.raises(DriverFailed, match="the driver fake-uart of another package failed"):
            call()


def test_row_keeps_its_type_and_parameters() -> None:
    row = guarded_driver(DRIVER_ROWS["stream"])
    assert isinstance(row, type(FAKE_DRIVER))
    assert isinstance(row.make_codec(Ledger(), NoOptions()), GuardedStreamCodec)
    assert row.settings is FAKE_DRIVER.settings
    applied: list[object] = []
    row = guarded_driver(replace(DRIVER_ROWS["stream"], apply_identity=lambda codec, _identity: applied.append(codec)))
    codec = row.make_codec(Ledger(), NoOptions())
    row.apply_identity(codec, Identity("X"))
    assert applied == [codec.codec]
    assert list(says_nothing(1)) == []
