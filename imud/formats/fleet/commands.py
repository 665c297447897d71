"""Requests to a gateway and its answers, as JSON. With MQTT 5 response topic and correlation data say where they go.

imud/SITE/GATEWAY/DEVICE/command   {"v": 1, "id": "…", "action": "…", "arguments": {…}, "issued_utc_ns": …}
imud/SITE/GATEWAY/DEVICE/answer    {"v": 1, "id": "…", "gateway": …, "device": …, "action": …, "outcome": "done",
                                    "result": …}
"""

from enum import StrEnum
from typing import Annotated, Any, Final

import msgspec

from imud.errors import reason_of
from imud.formats.fleet.messages import VERSION
from imud.formats.fleet.topics import ANSWER, NAME_PATTERN, is_name, topic_of

REQUEST_BYTES: Final = 4096
"""Of a request: the longest arguments of any action have some hundred."""
Id = Annotated[str, msgspec.Meta(pattern=f"^{NAME_PATTERN}$")]


class Outcome(StrEnum):
    """Ends of a request."""

    DONE = "done"
    """The action ran; `result` has what it returned."""
    FAILED = "failed"
    """The action was refused by the device or by its checks, or did not end; `error` says why."""
    DENIED = "denied"
    """The gateway's configuration does not have the action in its list."""
    STALE = "stale"
    """The request is too old, of the future, or of before the gateway's start; or the gateway's clock is not set."""
    DUPLICATE = "duplicate"
    """A request with this id came before, and has or will have its answer."""
    BUSY = "busy"
    """Too many requests wait, or came within a minute."""


class CommandRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A request for one action of one device."""

    v: int
    """VERSION."""
    id: Id
    """Chosen by who asks, another one for each request."""
    action: Id
    """As `imud command` takes it."""
    arguments: dict[str, Any] = {}  # msgspec copies a mutable default
    issued_utc_ns: int
    """CLOCK_REALTIME of who asks: an old request is not carried out."""


class CommandAnswer(msgspec.Struct, frozen=True, omit_defaults=True, kw_only=True):
    """The answer to a request."""

    v: int
    id: str
    gateway: str
    device: str
    action: str
    outcome: Outcome
    result: Any = None
    error: str = ""
    """Why it is not done, one sentence."""


_REQUEST_DECODER: Final = msgspec.json.Decoder(CommandRequest)


def decode_request(payload: bytes) -> CommandRequest:
    """The request in a payload. Raises ValueError for anything else."""
    if len(payload) > REQUEST_BYTES:
        raise ValueError(f"expected at most {REQUEST_BYTES} bytes, got {len(payload)}")
    try:
        request = _REQUEST_DECODER.decode(payload)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"expected a request as JSON: {reason_of(error)}") from error
    if request.v != VERSION:
        raise ValueError(f"expected a request of version {VERSION}, got {request.v}")
    return request


def answer_topic(site: str, gateway: str, device: str, wanted: str = "") -> str | None:
    """The topic of an answer: the device's own, or below it the one that is wanted; None where that is elsewhere.

    A gateway answers nowhere else: who may ask it could otherwise make it write where only it may write.
    """
    own = topic_of(site, gateway, device, ANSWER)
    if not wanted or wanted == own:
        return own
    head, _, name = wanted.rpartition("/")
    return wanted if head == own and is_name(name) else None
