"""Command channel: checks requests from the broker, runs them one at a time, and sends replies.

    broker ──▶ sender's thread: take (size, form, age, ID, list, rate) ──▶ queue ──▶ event loop: run ──▶ device
    broker ◀── sender ◀───────────────────── reply ◀──────────────────────────────────────┘

The access rights of the broker decide who may send requests. The configuration of the gateway decides which commands
are allowed. The device checks the arguments, as for the socket. The command `set` changes device settings.

imud runs each request once. It stores the ID of a request until the request is too old, and rejects requests from
before its start. A reply can be lost with its connection. If the sender repeats the same request with the same ID, imud
sends the stored reply again.
"""

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec

from imud.contracts.command import REQUESTED_BY
from imud.contracts.publisher import DeviceControl
from imud.fleet.broker import Received
from imud.fleet.messages import (
    CLOCK_SET_NS,
    COMMAND,
    ROOT,
    VERSION,
    CommandAnswer,
    CommandRequest,
    Outcome,
    answer_topic,
    decode_request,
    parse_topic,
)
from imud.fleet.settings import SET, CommandOptions
from imud.fleet.streams import Gateway
from imud.host.log import SAME_AS, shown
from imud.model.errors import BadArgument, ImudError
from imud.model.options import got
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

SAVE: Final = "save"  # argument of the command `set`: whether to write the settings to flash
WAITING_MAX: Final = 8  # Maximum number of waiting requests. A command takes at most one second, a calibration longer.
MINUTE_NS: Final = 60 * NS_PER_S
ANSWERS_KEPT: Final = 32  # number of stored replies for repeated requests
ANSWER_BYTES: Final = 65_536  # Maximum length of a stored reply, bytes: 2 MB for all. Commands return some kB.


class CommandReply(NamedTuple):
    """Reply on its way to the broker."""

    topic: str
    payload: bytes
    correlation: bytes | None


class _Request(NamedTuple):
    """Request that passed its checks."""

    device: str
    request: CommandRequest
    topic: str
    correlation: bytes | None

    def is_same(self, other: "_Request") -> bool:
        """Return whether both requests are equal."""
        mine, theirs = self.request, other.request
        return (self.device, mine.action, mine.arguments) == (other.device, theirs.action, theirs.arguments)


class CommandChannel:
    """Queue of requests with their checks and replies.

    Synchronization: the sender's thread calls `take`, the event loop calls `run_next` and `close`, any thread reads the
    counters. A lock protects shared members and is never held during I/O.
    """

    def __init__(
        self, settings: CommandOptions, gateway: Gateway, control: Callable[[str], DeviceControl],
        now_ns: Callable[[], int], utc_offset_ns: Callable[[], int],
    ) -> None:  # fmt: skip
        self.run = 0  # number of requests that imud ran
        self.refused = 0  # number of rejected requests
        # Sends replies, called from both threads. The output sets it.
        self.answer: Callable[[CommandReply], None] = lambda _reply: None
        # Returns whether a rejected or repeated request may get a reply. The output sets it.
        self.may_reply: Callable[[], bool] = lambda: True
        self._settings, self._gateway, self._control = settings, gateway, control
        self._now_ns, self._utc_offset_ns = now_ns, utc_offset_ns
        self._start_ns = now_ns()
        self._asked: deque[_Request] = deque()
        self._times_ns: deque[int] = deque()
        self._known: dict[str, int] = {}  # arrival of each ID, CLOCK_MONOTONIC; `per_minute` limits their number
        self._lock = threading.Lock()
        self._answers: dict[str, tuple[_Request, bytes]] = {}  # finished requests and their replies by ID, newest last
        self._task: asyncio.Task[None] | None = None

    @property
    def subscription(self) -> str:
        """Return the topic filter of requests."""
        return f"{ROOT}/{self._gateway.site}/{self._gateway.gateway}/+/{COMMAND}"

    # --- sender's thread ----------------------------------------------------------------------------------------------

    def take(self, received: Received) -> None:
        """Check a message of the subscription, then queue or reject it."""
        parts = parse_topic(received.topic)
        if parts is None or parts.leaf != COMMAND or parts[:2] != self._gateway[:2]:
            self._ignore(f"expected a topic of {self.subscription}, got {shown(received.topic)}")
            return
        if received.retain:
            self._ignore("the message is retained, so imud would run the request at each connection")
            return
        try:
            request = decode_request(received.payload)
        except ValueError as error:
            self._ignore(str(error))
            return
        topic = answer_topic(*parts[:3], received.response_topic)
        if topic is None:
            self._ignore(f"expected a response topic below {answer_topic(*parts[:3])}")
            return
        asked = _Request(parts.device, request, topic, received.correlation)
        outcome, problem = self._check(asked)
        if outcome is None:
            self._known[request.id] = self._now_ns()
            self._asked.append(asked)
        elif not self.may_reply():
            self.refuse_excess()
        elif outcome is not Outcome.DUPLICATE or not self._repeat(asked):
            self._refuse(asked, outcome, problem)

    def refuse_excess(self) -> None:
        """Count a request above the budget of the broker. imud neither runs nor answers it."""
        with self._lock:
            self.refused += 1

    def _check(self, asked: _Request) -> tuple[Outcome | None, str]:
        """Return the outcome and the cause if imud rejects a request, otherwise None."""
        now_ns, request = self._now_ns(), asked.request
        while self._times_ns and now_ns - self._times_ns[0] >= MINUTE_NS:
            self._times_ns.popleft()
        if len(self._times_ns) >= self._settings.per_minute:
            return (
                Outcome.BUSY,
                f"the limit of {self._settings.per_minute} requests per minute is reached; try again later",
            )
        self._times_ns.append(now_ns)
        if problem := self._age_problem(request.issued_utc_ns):
            return Outcome.STALE, problem
        # twice the maximum age: a request may be in the future by max_age_s
        kept_ns = 2 * self._settings.max_age_ns
        while self._known and now_ns - next(iter(self._known.values())) > kept_ns:
            del self._known[next(iter(self._known))]
        if request.id in self._known:
            return Outcome.DUPLICATE, "the gateway already received a request with this id"
        settings = [name for name in request.arguments if name != SAVE]
        if not self._settings.allows(asked.device, request.action, settings):
            return (
                Outcome.DENIED,
                "mqtt.commands.actions in the configuration of the gateway does not allow the command",
            )
        if len(self._asked) >= WAITING_MAX:
            return Outcome.BUSY, f"the limit of {WAITING_MAX} waiting requests is reached; try again later"
        return None, ""

    def _age_problem(self, issued_utc_ns: int) -> str:
        """Return why the age of a request is not acceptable; empty if it is."""
        utc_ns = self._now_ns() + self._utc_offset_ns()
        most_ns = self._settings.max_age_ns
        if utc_ns < CLOCK_SET_NS:
            return "the clock of the gateway is not set, so the age of the request is unknown"
        if abs(utc_ns - issued_utc_ns) > most_ns:
            age_s = (utc_ns - issued_utc_ns) / NS_PER_S
            return f"expected an age of at most {self._settings.max_age_s:g} s, got {age_s:.1f} s"
        if issued_utc_ns < self._start_ns + self._utc_offset_ns():
            return "the request is older than the start of imud, and may already have run"
        return ""

    def _repeat(self, asked: _Request) -> bool:
        """Send the stored reply of an equal request. Return whether there is one."""
        with self._lock:
            kept = self._answers.get(asked.request.id)
        if kept is None or not asked.is_same(kept[0]):
            return False
        log.info("mqtt: %s: request %s was repeated; sending the stored reply", asked.device, asked.request.id)
        self.answer(CommandReply(asked.topic, kept[1], asked.correlation))
        return True

    def _ignore(self, problem: str) -> None:
        with self._lock:
            self.refused += 1
        log.warning("mqtt: ignoring a request: %s", problem)

    def _refuse(self, asked: _Request, outcome: Outcome, problem: str) -> None:
        with self._lock:
            self.refused += 1
        log.warning(
            "mqtt: %s: rejecting request %s for %s (%s): %s",
            asked.device, asked.request.id, shown(asked.request.action), outcome, problem,
            extra=None if outcome is Outcome.BUSY else _own_log_line(asked),
        )  # fmt: skip
        self._send_reply(asked, outcome, error=problem)

    # --- event loop
    # -----------------------------------------------------------------------------------------------------

    def run_next(self) -> None:
        """Start the next request if none is running. The output calls this method ten times a second."""
        if not self._asked or (self._task is not None and not self._task.done()):
            return
        asked = self._asked.popleft()
        # the request waited in the queue
        problem = self._age_problem(asked.request.issued_utc_ns)
        if problem:
            self._refuse(asked, Outcome.STALE, problem)
            return
        self._task = asyncio.get_running_loop().create_task(self._run(asked))

    async def _run(self, asked: _Request) -> None:
        """Run a request and send its reply."""
        request = asked.request
        self.run += 1
        log.warning(
            "mqtt: %s: request %s: %s %s", asked.device, request.id, shown(request.action), shown(request.arguments),
            extra=_own_log_line(asked),
        )  # fmt: skip
        try:
            control = self._control(asked.device)
            if request.action == SET:
                await self._set(asked, control)
                return
            REQUESTED_BY.set("mqtt")
            result = await control.act(request.action, request.arguments)
            log.info("mqtt: %s: request %s is done: %s", asked.device, request.id, shown(result))
            self._end(asked, Outcome.DONE, result=result)
        except ImudError as error:
            log.warning("mqtt: %s: request %s failed: %s", asked.device, request.id, error, extra=_own_log_line(asked))
            self._end(asked, Outcome.FAILED, error=str(error))
        except Exception:
            log.exception("mqtt: %s: request %s failed because of an internal error", asked.device, request.id)
            self._end(asked, Outcome.FAILED, error="internal error; see the traceback in the log of imud")

    async def _set(self, asked: _Request, control: DeviceControl) -> None:
        """Set settings and send the reply. Raises ImudError if imud did not begin."""
        settings = dict(asked.request.arguments)
        save = settings.pop(SAVE, False)
        if not isinstance(save, bool):
            raise BadArgument(f"{SAVE}: expected true or false, got {got(save)}")
        if not settings and not save:
            raise BadArgument(f"{SET}: expected at least one setting by name, or `{SAVE}`, got neither")
        applied = await control.settings.apply(settings, save=save)
        failure, result = applied.failure, msgspec.to_builtins(applied)
        log.info("mqtt: %s: request %s set %s", asked.device, asked.request.id, failure or shown(settings))
        self._end(asked, Outcome.FAILED if failure else Outcome.DONE, result=result, error=failure)

    def close(self) -> None:
        """Stop the running request without a reply. A second call does nothing."""
        self._asked.clear()
        if self._task is not None:
            self._task.cancel()

    def _end(self, asked: _Request, outcome: Outcome, *, result: object = None, error: str = "") -> None:
        """Send the reply of a finished request and store it."""
        payload = self._send_reply(asked, outcome, result=result, error=error)
        if len(payload) > ANSWER_BYTES:
            return
        with self._lock:
            self._answers[asked.request.id] = asked, payload
            while len(self._answers) > ANSWERS_KEPT:
                del self._answers[next(iter(self._answers))]

    def _send_reply(self, asked: _Request, outcome: Outcome, *, result: object = None, error: str = "") -> bytes:
        """Send a reply. Return its payload."""
        answer = CommandAnswer(
            v=VERSION, id=asked.request.id, gateway=self._gateway.gateway, device=asked.device,
            action=asked.request.action, outcome=outcome, result=result, error=error,
        )  # fmt: skip
        payload = msgspec.json.encode(answer)
        self.answer(CommandReply(asked.topic, payload, asked.correlation))
        return payload


def _own_log_line(asked: _Request) -> dict[str, str]:
    """Return the `extra` of log messages that the log must not merge with messages of other requests."""
    return {SAME_AS: asked.request.id}
