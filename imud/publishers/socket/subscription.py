"""What clients watch (devices, form, rate), and the plan by which a batch goes to all that watch its device."""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import chain
from typing import Final

from imud.contracts.publisher import Batch
from imud.frames.conventions import Convention
from imud.publishers.socket.encoding import BinaryEncoding, ConvertedEncoding, Encoding, JsonEncoding
from imud.publishers.socket.outbox import Delivery, Outbox
from imud.publishers.socket.serving import TokenBucket
from imud.publishers.thinning import Pace

PUBLISH_NS: Final = 1_000_000
"""Sending a batch takes so long at most; the clients that are left are served by the scheduler, in several turns."""
NEVER_NS: Final = 1 << 63
CLIENTS_PER_LOOK: Final = 32
FORMS_AT_ONCE: Final = 16
"""So many forms are encoded while a batch is sent. Others are encoded when their clients are served, in their time."""
_BINARY: Final = BinaryEncoding()


class Form(StrEnum):
    """Encodings of samples by their names in the protocol."""

    JSON = "json"
    """One notification per sample."""
    BINARY = "binary"
    """One slot of shared memory per sample."""


FormKey = tuple[Form, tuple[str, ...] | None, bool, Convention | None, bool]
"""What clients that get the same messages have in common: encoding, fields, frames or lines, axes and angles, big
numbers as text."""


@dataclass(slots=True)
class Subscription:
    """The parameters of a `watch`, checked."""

    devices: Collection[str] | None
    """None for all, those that appear later included."""
    fields: tuple[str, ...] | None
    """Members of a JSON sample in addition to ALWAYS_FIELDS; None for all."""
    rate_hz: float
    """At most so many samples per second and device; 0 for all."""
    form: Form
    framed: bool = False
    """Whether messages go out as frames."""
    convention: Convention | None = None
    """Axes and angles of samples; None for those of the device's configuration."""
    text_numbers: bool = False
    """Whether integers of JSON samples that may exceed 2⁵³ are text."""
    latency_ns: int = 0
    """How late samples may be; 0: each at once."""
    key: FormKey = field(init=False)
    """What clients have in common that get the same messages."""
    _paces: dict[str, Pace] = field(default_factory=dict)

    def __post_init__(self) -> None:
        json = self.form is Form.JSON
        self.key = (
            self.form, self.fields if json else None, self.framed, self.convention, json and self.text_numbers,
        )  # fmt: skip

    def encoding(self) -> Encoding:
        """Make the encoding of these messages."""
        binary = self.form is Form.BINARY
        encoding: Encoding = _BINARY if binary else JsonEncoding(self.fields, self.framed, self.text_numbers)
        return encoding if self.convention is None else ConvertedEncoding(encoding, self.convention)

    def matches(self, device: str) -> bool:
        """Whether samples of `device` are wanted."""
        return self.devices is None or device in self.devices

    def pace_of(self, device: str) -> Pace | None:
        """The pace that thins samples of `device`; None where all are wanted."""
        if not self.rate_hz:
            return None
        return self._paces.setdefault(device, Pace(self.rate_hz))


class DeliveryGroup:
    """Clients that get samples of one device in the same form: each message is encoded once for all of them.

    The lists are replaced, never changed: a client may leave while a batch is being sent to them. They are made for the
    next batch, not for each client that comes or goes: 256 clients that watch something else all the time cost the
    group no more than its batches do.
    """

    def __init__(self, encoding: Encoding, order: Callable[[], int]) -> None:
        self.encoding = encoding
        self._order = order
        self._paces: dict[Outbox, Pace | None] = {}
        """The clients; None for one that gets every sample."""
        self._changed = False
        """Whether the lists are not those of the clients any more."""
        self._direct: list[list[Outbox]] = []
        """Of clients that get every sample, in lists of CLIENTS_PER_LOOK at most."""
        self._paced: list[tuple[Pace, Outbox]] = []

    @property
    def is_small(self) -> bool:
        """Whether sending to all takes so little time that no look at the clock is needed."""
        return len(self._paces) <= CLIENTS_PER_LOOK

    def add(self, outbox: Outbox, pace: Pace | None) -> None:
        """Add a client."""
        self._paces[outbox] = pace
        self._changed = True

    def discard(self, outbox: Outbox) -> bool:
        """Remove a client if it is there; return whether none is left."""
        self._paces.pop(outbox, None)
        self._changed = True
        return not self._paces

    def send(self, batch: Batch, now_ns: Callable[[], int], end_ns: int) -> None:
        """Send the batch to every client of the group until `end_ns`, then queue it for the others."""
        if self._changed:
            self._make_lists()
        encoding = self.encoding
        messages: Sequence[bytes] = ()
        if self._direct:
            messages = encoding.encode(batch)
            Outbox.put_samples(self._direct[0], messages, batch, encoding)
            if len(self._direct) > 1:
                self._send_parts(self._direct[1:], messages, batch, None, now_ns, end_ns)
        if self._paced:
            for chosen, outboxes in self._due(batch).items():
                if messages:
                    some: Sequence[bytes] = [messages[index] for index in chosen]
                else:
                    some = [encoding.encode_one(batch, index) for index in chosen]
                self._send_parts(_in_parts(outboxes), some, batch, chosen, now_ns, end_ns)

    def defer(self, batch: Batch) -> None:
        """Queue the batch for every client of the group; it is encoded when the first of them is served."""
        if self._changed:
            self._make_lists()
        for chosen, outboxes in self._due(batch).items():
            _defer(outboxes, Delivery(self._order(), batch, self.encoding, None, chosen))
        if self._direct:
            _defer(chain(*self._direct), Delivery(self._order(), batch, self.encoding, None))

    def _make_lists(self) -> None:
        self._changed = False
        self._direct = _in_parts([outbox for outbox, pace in self._paces.items() if pace is None])
        self._paced = [(pace, outbox) for outbox, pace in self._paces.items() if pace is not None]

    def _due(self, batch: Batch) -> dict[tuple[int, ...], list[Outbox]]:
        """Which samples of the batch are due for clients that get only some, by their indices."""
        found: dict[tuple[int, ...], list[Outbox]] = {}
        times_ns = [sample.t_ns for sample in batch.samples]
        newest_ns = times_ns[-1]
        for pace, outbox in self._paced:
            if newest_ns < pace.due_ns:
                continue  # the usual case, so no call for it
            chosen = tuple([index for index, t_ns in enumerate(times_ns) if pace.is_due(t_ns)])
            if chosen:
                found.setdefault(chosen, []).append(outbox)
        return found

    def _send_parts(
        self, parts: Iterable[list[Outbox]], messages: Sequence[bytes], batch: Batch, chosen: Sequence[int] | None,
        now_ns: Callable[[], int], end_ns: int,
    ) -> None:  # fmt: skip
        """Send to clients in parts of CLIENTS_PER_LOOK, with a look at the clock before each; queue after `end_ns`."""
        delivery: Delivery | None = None
        for outboxes in parts:
            if delivery is None and now_ns() < end_ns:
                Outbox.put_samples(outboxes, messages, batch, self.encoding, chosen)
                continue
            delivery = delivery or Delivery(self._order(), batch, self.encoding, messages, chosen)
            _defer(outboxes, delivery)


def _defer(outboxes: Iterable[Outbox], delivery: Delivery) -> None:
    for outbox in outboxes:
        outbox.defer(delivery)


def _in_parts(outboxes: list[Outbox]) -> list[list[Outbox]]:
    return [outboxes[first : first + CLIENTS_PER_LOOK] for first in range(0, len(outboxes), CLIENTS_PER_LOOK)]


class DeliveryPlan:
    """Where batches of one device go: a group of clients for each form that is wanted.

    `order` gives the number of the next message that is queued.
    """

    def __init__(self, order: Callable[[], int]) -> None:
        self._next_order = order
        self._groups: dict[FormKey, DeliveryGroup] = {}
        self._order: tuple[DeliveryGroup, ...] = ()

    def __len__(self) -> int:
        return len(self._groups)

    def add(self, device: str, wanted: Subscription, outbox: Outbox) -> None:
        """Send to a client that watches this device."""
        key = wanted.key
        group = self._groups.get(key)
        if group is None:
            group = self._groups[key] = DeliveryGroup(wanted.encoding(), self._next_order)
            self._order = tuple(self._groups.values())
        group.add(outbox, wanted.pace_of(device))

    def discard(self, wanted: Subscription, outbox: Outbox) -> None:
        """Send to a client no more; no-op if absent."""
        key = wanted.key
        group = self._groups.get(key)
        if group is not None and group.discard(outbox):
            del self._groups[key]
            self._order = tuple(self._groups.values())

    def send(self, batch: Batch, now_ns: Callable[[], int], time: TokenBucket) -> None:
        """Send a batch to all clients of the plan: to few at once, to many for PUBLISH_NS, then through their queues.

        `time` is what is left of the time for serving; without any, most of many clients get it through their queues.
        """
        groups = self._order
        if not groups:
            return
        if len(groups) == 1 and groups[0].is_small:
            groups[0].send(batch, now_ns, NEVER_NS)
            return
        begun_ns = now_ns()
        time.fill(begun_ns)
        end_ns = begun_ns + PUBLISH_NS if time.level > 0 else begun_ns
        for number, group in enumerate(groups):
            if number and (number >= FORMS_AT_ONCE or now_ns() > end_ns):
                group.defer(batch)
            else:
                group.send(batch, now_ns, end_ns)
        time.use(now_ns() - begun_ns)
