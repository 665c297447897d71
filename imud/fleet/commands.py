"""The command channel: requests from the broker, checked, carried out one at a time, and answered.

    broker ──▶ sender's thread: take (size, form, age, id, list, rate) ──▶ queue ──▶ event loop: run ──▶ device
    broker ◀── sender ◀───────────────────── answer ◀─────────────────────────────────────┘

Who may ask is the broker's to decide, by its rights on the topic; what may be asked is in the list of the gateway's
configuration. The arguments are checked by the device's own description of the action, as those of the socket are.
The event loop does of it what it does for a client of the socket: it starts the action, and sends its result away.

A request is carried out once: its id is remembered for as long as its age would let it be taken again, and what was
issued before the output started is too old. An answer can be lost with its connection, and who asked then asks again:
the same request with the same id is answered with the answer that it has.
"""

import asyncio
import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec

from imud.contracts.publisher import DeviceControl
from imud.fleet.broker import Received
from imud.fleet.messages import (
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
from imud.fleet.settings import CommandOptions
from imud.fleet.streams import Gateway
from imud.host.log import SAME_AS, shown
from imud.model.errors import ImudError
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

WAITING_MAX: Final = 8
"""Requests that wait for the one before: actions take a second each at most, calibrations longer."""
CLOCK_SET_NS: Final = 1_577_836_800 * NS_PER_S
"""2020: a wall clock before it is not set, and says nothing of ages."""
MINUTE_NS: Final = 60 * NS_PER_S
ANSWERS_KEPT: Final = 32
"""Answers that are kept for requests that come again, the newest."""
ANSWER_BYTES: Final = 65_536
"""Of an answer that is kept: 2 MB of all. What actions return has some kB."""


class CommandReply(NamedTuple):
    """An answer on its way to the broker."""

    topic: str
    payload: bytes
    correlation: bytes | None


class _Asked(NamedTuple):
    """A request that may be carried out."""

    device: str
    request: CommandRequest
    topic: str
    correlation: bytes | None

    def is_same(self, other: "_Asked") -> bool:
        """Whether both ask for the same."""
        mine, theirs = self.request, other.request
        return (self.device, mine.action, mine.arguments) == (other.device, theirs.action, theirs.arguments)


class CommandChannel:
    """The channel. Synchronization: `take` by the sender's thread, `run_next` and `close` by the event loop's; the
    counters are read by any. What both change is changed under a lock, which is held for no I/O."""

    def __init__(
        self, settings: CommandOptions, gateway: Gateway, control: Callable[[str], DeviceControl],
        now_ns: Callable[[], int], utc_offset_ns: Callable[[], int],
    ) -> None:  # fmt: skip
        self.run = 0
        """Requests that were carried out, or tried."""
        self.refused = 0
        """Requests that were not."""
        self.answer: Callable[[CommandReply], None] = lambda _reply: None
        """Takes answers, from both threads; set by who sends them."""
        self._settings, self._gateway, self._control = settings, gateway, control
        self._now_ns, self._utc_offset_ns = now_ns, utc_offset_ns
        self._start_ns = now_ns()
        self._asked: deque[_Asked] = deque()
        self._times_ns: deque[int] = deque()
        self._known: dict[str, int] = {}
        """When each id came, CLOCK_MONOTONIC; as many as the rate allows."""
        self._lock = threading.Lock()
        self._answers: dict[str, tuple[_Asked, bytes]] = {}
        """Requests that ended and their answers, by id, the newest last."""
        self._task: asyncio.Task[None] | None = None

    @property
    def subscription(self) -> str:
        """The topics of requests."""
        return f"{ROOT}/{self._gateway.site}/{self._gateway.gateway}/+/{COMMAND}"

    # --- the sender's thread -----------------------------------------------------------------------------------------

    def take(self, received: Received) -> None:
        """Check a message of the subscription, and queue or refuse it."""
        parts = parse_topic(received.topic)
        if parts is None or parts.leaf != COMMAND or parts[:2] != self._gateway[:2]:
            self._ignore(f"expected a topic of {self.subscription}, got {shown(received.topic)}")
            return
        if received.retain:
            self._ignore("the broker kept it (retained), it would be carried out at each connection")
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
        asked = _Asked(parts.device, request, topic, received.correlation)
        outcome, problem = self._judged(asked)
        if outcome is Outcome.DUPLICATE and self._repeat(asked):
            return
        if outcome is not None:
            self._refuse(asked, outcome, problem)
            return
        self._known[request.id] = self._now_ns()
        self._asked.append(asked)

    def _judged(self, asked: _Asked) -> tuple[Outcome | None, str]:
        """Why a request is not carried out, if it is not."""
        now_ns, request = self._now_ns(), asked.request
        while self._times_ns and now_ns - self._times_ns[0] >= MINUTE_NS:
            self._times_ns.popleft()
        if len(self._times_ns) >= self._settings.per_minute:
            return Outcome.BUSY, f"expected at most {self._settings.per_minute} requests a minute"
        self._times_ns.append(now_ns)
        if problem := self._age_problem(request.issued_utc_ns):
            return Outcome.STALE, problem
        kept_ns = 2 * self._settings.max_age_ns
        while self._known and now_ns - next(iter(self._known.values())) > kept_ns:
            del self._known[next(iter(self._known))]
        if request.id in self._known:
            return Outcome.DUPLICATE, "a request with this id came before"
        if not self._settings.allows(asked.device, request.action):
            return Outcome.DENIED, "the gateway's configuration (mqtt.commands.actions) does not have it"
        if len(self._asked) >= WAITING_MAX:
            return Outcome.BUSY, f"{WAITING_MAX} requests wait"
        return None, ""

    def _age_problem(self, issued_utc_ns: int) -> str:
        """Why a request of that time is not carried out now; empty where it is."""
        utc_ns = self._now_ns() + self._utc_offset_ns()
        most_ns = self._settings.max_age_ns
        if utc_ns < CLOCK_SET_NS:
            return "the gateway's clock is not set, and the age of the request is not known"
        if abs(utc_ns - issued_utc_ns) > most_ns:
            age_s = (utc_ns - issued_utc_ns) / NS_PER_S
            return f"expected an age of at most {self._settings.max_age_s:g} s, got {age_s:.1f} s"
        if issued_utc_ns < self._start_ns + self._utc_offset_ns():
            return "it was issued before the gateway's start, and may have been carried out then"
        return ""

    def _repeat(self, asked: _Asked) -> bool:
        """Give the answer that the request had when it came before; return whether there is one."""
        with self._lock:
            kept = self._answers.get(asked.request.id)
        if kept is None or not asked.is_same(kept[0]):
            return False
        log.info("mqtt: %s: request %s came again, and is answered again", asked.device, asked.request.id)
        self.answer(CommandReply(asked.topic, kept[1], asked.correlation))
        return True

    def _ignore(self, problem: str) -> None:
        with self._lock:
            self.refused += 1
        log.warning("mqtt: a request is ignored: %s", problem)

    def _refuse(self, asked: _Asked, outcome: Outcome, problem: str) -> None:
        with self._lock:
            self.refused += 1
        log.warning(
            "mqtt: %s: request %s for %s is refused (%s): %s",
            asked.device, asked.request.id, shown(asked.request.action), outcome, problem,
            extra=None if outcome is Outcome.BUSY else _by_itself(asked),
        )  # fmt: skip
        self._give_answer(asked, outcome, error=problem)

    # --- the event loop's thread -------------------------------------------------------------------------------------

    def run_next(self) -> None:
        """Begin the next request where none runs; called ten times a second. Needs a running loop if any waits."""
        if not self._asked or (self._task is not None and not self._task.done()):
            return
        asked = self._asked.popleft()
        problem = self._age_problem(asked.request.issued_utc_ns)
        if problem:
            self._refuse(asked, Outcome.STALE, problem)
            return
        self._task = asyncio.get_running_loop().create_task(self._run(asked))

    async def _run(self, asked: _Asked) -> None:
        """Carry a request out and answer it."""
        request = asked.request
        self.run += 1
        log.warning(
            "mqtt: %s: request %s: %s %s", asked.device, request.id, shown(request.action), shown(request.arguments),
            extra=_by_itself(asked),
        )  # fmt: skip
        try:
            result = await self._control(asked.device).act(request.action, request.arguments)
        except ImudError as error:
            log.warning("mqtt: %s: request %s failed: %s", asked.device, request.id, error, extra=_by_itself(asked))
            self._end(asked, Outcome.FAILED, error=str(error))
        except Exception:
            log.exception("mqtt: %s: request %s ended by an internal error", asked.device, request.id)
            self._end(asked, Outcome.FAILED, error="an internal error; the log of imud has a traceback")
        else:
            log.info("mqtt: %s: request %s is done: %s", asked.device, request.id, shown(result))
            self._end(asked, Outcome.DONE, result=result)

    def close(self) -> None:
        """End what runs, without an answer; may be called twice."""
        self._asked.clear()
        if self._task is not None:
            self._task.cancel()

    def _end(self, asked: _Asked, outcome: Outcome, *, result: object = None, error: str = "") -> None:
        """Answer what was carried out, and keep the answer."""
        payload = self._give_answer(asked, outcome, result=result, error=error)
        if len(payload) > ANSWER_BYTES:
            return
        with self._lock:
            self._answers[asked.request.id] = asked, payload
            while len(self._answers) > ANSWERS_KEPT:
                del self._answers[next(iter(self._answers))]

    def _give_answer(self, asked: _Asked, outcome: Outcome, *, result: object = None, error: str = "") -> bytes:
        """Have an answer sent; return its payload."""
        answer = CommandAnswer(
            v=VERSION, id=asked.request.id, gateway=self._gateway.gateway, device=asked.device,
            action=asked.request.action, outcome=outcome, result=result, error=error,
        )  # fmt: skip
        payload = msgspec.json.encode(answer)
        self.answer(CommandReply(asked.topic, payload, asked.correlation))
        return payload


def _by_itself(asked: _Asked) -> dict[str, str]:
    """The `extra` of a message that the log does not sum up with those of other requests; the rate bounds them."""
    return {SAME_AS: asked.request.id}
