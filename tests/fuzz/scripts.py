"""Scripts of stream and CAN drivers, with any bytes as replies: they end, and raise only the documented exceptions.

The first byte of an input selects the script: `identify`, `read_settings`, `wake`, or an action without arguments. The
rest is the data of the device, as in `streams` and `can`.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from imud.contracts.codec import CodecEvent, message_of
from imud.contracts.command import Target as ActionTarget
from imud.contracts.driver import CanDriver, Driver, StreamDriver
from imud.contracts.script import Message, Outcome, Reply, Request, RequestScript
from imud.device.scripts import ScriptRunner
from imud.model.errors import BadArgument, CommandError, DeviceRefused
from imud.model.ledger import Ledger
from tests.fuzz import can, streams
from tests.fuzz.drivers import mender, names_of, row
from tests.fuzz.target import FRAMES_BYTES_MAX, Target
from tests.support.script_runners import offline_runner

REQUESTS_MAX = 500
"""Maximum number of requests of a script, for any replies."""
BAUD = 115200

Script = Callable[[], RequestScript[Any]]


def names() -> Sequence[str]:
    drivers = [*names_of(StreamDriver), *names_of(CanDriver)]
    return [name for name in drivers if any(map(_asks, _scripts(row(name, Driver))))]


def _asks(begin: Script) -> bool:
    return next(begin(), None) is not None


def make(name: str) -> Target:
    driver = row(name, Driver)
    messages = _stream_messages(driver) if isinstance(driver, StreamDriver) else can_messages(row(name, CanDriver))
    scripts = _scripts(driver)
    mend = mender(name)

    def run(data: bytes) -> None:
        if data:
            answer(scripts[data[0] % len(scripts)], messages(data[1:]))

    def seeds() -> list[bytes]:
        if isinstance(driver, StreamDriver):
            replies = streams.seeds(driver)
        else:
            replies = can.seeds(row(name, CanDriver), can.own_identifiers(row(name, CanDriver)))
        return [bytes([number % len(scripts)]) + replies[number % len(replies)] for number in range(24)]

    return Target(run, seeds, lambda data, random: data[:1] + mend(data[1:], random), bytes_max=FRAMES_BYTES_MAX)


def _scripts(driver: Driver) -> list[Script]:
    settings = driver.settings()
    found: list[Script] = []
    if isinstance(driver, StreamDriver):
        found = [driver.identify, *([driver.wake] if driver.wake else [])]
    elif isinstance(driver, CanDriver):
        found = [lambda: driver.identify(settings)]
    target = ActionTarget(settings, BAUD)
    if driver.device_settings is not None:
        found.append(partial(driver.device_settings.read, target, None))
    for action in driver.verbs.values():
        try:
            arguments = action.arguments({})
        except BadArgument:
            continue
        found.append(partial(action.script, target, arguments))
    return found


def _stream_messages(driver: StreamDriver) -> Callable[[bytes], Iterator[Message]]:
    def messages(data: bytes) -> Iterator[Message]:
        codec = driver.make_codec(Ledger(), driver.settings())
        yield from messages_of([*codec.feed(data), *codec.flush()])

    return messages


def can_messages(driver: CanDriver) -> Callable[[bytes], Iterator[Message]]:
    own = can.own_identifiers(driver)

    def messages(data: bytes) -> Iterator[Message]:
        codec = driver.make_codec(Ledger(), driver.settings())
        for frame in can.decoded(data, own):
            yield from messages_of(codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns))

    return messages


def messages_of(events: Sequence[CodecEvent]) -> Iterator[Message]:
    return (message for message in map(message_of, events) if message is not None)


def answer(begin: Script, messages: Iterator[Message]) -> None:
    session = offline_runner(Ledger())
    now_ns = 0
    try:
        script = begin()
        request = next(script)
        for _ in range(REQUESTS_MAX):
            outcome, now_ns = _outcome(session, request, messages, now_ns)
            request = script.send(outcome)
    except StopIteration:
        return
    except (CommandError, DeviceRefused):
        return
    raise AssertionError(f"expected the end of the script after at most {REQUESTS_MAX} requests")


def _outcome(session: ScriptRunner, request: Request, messages: Iterator[Message], now_ns: int) -> tuple[Outcome, int]:
    session.start(request, now_ns)
    if request.silent:
        return Reply(()), now_ns
    for message in messages:
        now_ns += 1_000_000
        outcome = session.on_message(message, now_ns) or session.on_time(now_ns)
        if outcome is not None:
            return outcome, now_ns
    now_ns = session.deadline_ns or now_ns
    silence = session.on_time(now_ns)
    assert silence is not None
    return silence, now_ns
