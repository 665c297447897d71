"""What clients watch (devices, form, rate), and the plan by which a batch goes to all that watch its device."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import chain
from typing import Final

from imud.attitude.conventions import Convention
from imud.contracts.publisher import Batch
from imud.publishers.socket.outbox import BinaryEncoding, Delivery, Encoding, JsonEncoding, Outbox
from imud.publishers.socket.scheduler import TokenBucket
from imud.publishers.thinning import NOTHING, RateThinner

PUBLISH_NS: Final = 1_000_000
"""Sending a batch takes so long at most; the clients that are left are served by the scheduler, in several turns."""
NEVER_NS: Final = 1 << 63
CLIENTS_PER_LOOK: Final = 32
FORMS_AT_ONCE: Final = 16
"""So many forms are encoded while a batch is sent. Others are encoded when their clients are served, in their time."""
ChosenSamples = Mapping[float, tuple[int, ...]]
"""Indices of the samples of a batch that go to clients with a rate, by that rate."""


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

    def __post_init__(self) -> None:
        json = self.form is Form.JSON
        self.key = (
            self.form, self.fields if json else None, self.framed, self.convention, json and self.text_numbers,
        )  # fmt: skip

    def encoding(self) -> Encoding:
        """Make the encoding of these messages."""
        if self.form is Form.BINARY:
            return BinaryEncoding(self.convention)
        return JsonEncoding(self.fields, self.framed, self.text_numbers, self.convention)

    def matches(self, device: str) -> bool:
        """Whether samples of `device` are wanted."""
        return self.devices is None or device in self.devices


class DeliveryGroup:
    """Clients that get samples of one device in the same form: each message is encoded once for all of them.

    The lists are replaced, never changed: a client may leave while a batch is being sent to them. They are made for the
    next batch, not for each client that comes or goes: 256 clients that watch something else all the time cost the
    group no more than its batches do.
    """

    def __init__(self, encoding: Encoding, order: Callable[[], int]) -> None:
        self.encoding = encoding
        self._order = order
        self._rates_hz: dict[Outbox, float] = {}
        """The clients; 0 for one that gets every sample."""
        self._changed = False
        """Whether the lists are not those of the clients any more."""
        self._direct: list[list[Outbox]] = []
        """Of clients that get every sample, in lists of CLIENTS_PER_LOOK at most."""
        self._thinned: dict[float, list[Outbox]] = {}
        """Of clients that get samples at a rate, by it."""

    def __contains__(self, outbox: Outbox) -> bool:
        return outbox in self._rates_hz

    @property
    def is_small(self) -> bool:
        """Whether sending to all takes so little time that no look at the clock is needed."""
        return len(self._rates_hz) <= CLIENTS_PER_LOOK

    def add(self, outbox: Outbox, rate_hz: float) -> None:
        """Add a client; with the rate 0 it gets every sample."""
        self._rates_hz[outbox] = rate_hz
        self._changed = True

    def discard(self, outbox: Outbox) -> bool:
        """Remove a client if it is there; return whether none is left."""
        self._rates_hz.pop(outbox, None)
        self._changed = True
        return not self._rates_hz

    def send(self, batch: Batch, chosen: ChosenSamples, now_ns: Callable[[], int], end_ns: int) -> None:
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
        if chosen:
            for indices, outboxes in self._due(chosen):
                if messages:
                    some: Sequence[bytes] = [messages[index] for index in indices]
                else:
                    some = [encoding.encode_one(batch, index) for index in indices]
                self._send_parts(_in_parts(outboxes), some, batch, indices, now_ns, end_ns)

    def defer(self, batch: Batch, chosen: ChosenSamples) -> None:
        """Queue the batch for every client of the group; it is encoded when the first of them is served."""
        if self._changed:
            self._make_lists()
        for indices, outboxes in self._due(chosen):
            _defer(outboxes, Delivery(self._order(), batch, self.encoding, None, indices))
        if self._direct:
            _defer(chain(*self._direct), Delivery(self._order(), batch, self.encoding, None))

    def _make_lists(self) -> None:
        self._changed = False
        self._direct = _in_parts([outbox for outbox, rate_hz in self._rates_hz.items() if not rate_hz])
        self._thinned = {}
        for outbox, rate_hz in self._rates_hz.items():
            if rate_hz:
                self._thinned.setdefault(rate_hz, []).append(outbox)

    def _due(self, chosen: ChosenSamples) -> list[tuple[tuple[int, ...], list[Outbox]]]:
        """Which samples of a batch go to which clients of those that get only some."""
        thinned = self._thinned
        return [(indices, thinned[rate_hz]) for rate_hz, indices in chosen.items() if rate_hz in thinned]

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
        self._thinner = RateThinner()
        self._groups: dict[FormKey, DeliveryGroup] = {}
        self._order: tuple[DeliveryGroup, ...] = ()
        self._only: DeliveryGroup | None = None
        """The group of a plan that has one, of few clients."""
        self._thins = False
        """Whether any client has a rate."""

    def __len__(self) -> int:
        return len(self._groups)

    def add(self, wanted: Subscription, outbox: Outbox) -> None:
        """Send to a client that watches the device, and is not in the plan."""
        key = wanted.key
        group = self._groups.get(key)
        if group is None:
            group = self._groups[key] = DeliveryGroup(wanted.encoding(), self._next_order)
            self._order = tuple(self._groups.values())
        group.add(outbox, wanted.rate_hz)
        if wanted.rate_hz:
            self._thinner.add(wanted.rate_hz)
        self._note_groups()

    def discard(self, wanted: Subscription, outbox: Outbox) -> None:
        """Send to a client no more; no-op if absent."""
        key = wanted.key
        group = self._groups.get(key)
        if group is None or outbox not in group:
            return
        if wanted.rate_hz:
            self._thinner.discard(wanted.rate_hz)
        if group.discard(outbox):
            del self._groups[key]
            self._order = tuple(self._groups.values())
        self._note_groups()

    def _note_groups(self) -> None:
        order = self._order
        self._thins = bool(self._thinner)
        self._only = order[0] if len(order) == 1 and order[0].is_small else None

    def send(self, batch: Batch, now_ns: Callable[[], int], time: TokenBucket) -> None:
        """Send a batch to all clients of the plan: to few at once, to many for PUBLISH_NS, then through their queues.

        `time` is what is left of the time for serving; without any, most of many clients get it through their queues.
        """
        groups = self._order
        if not groups:
            return
        chosen = self._thinner.choose(batch.samples) if self._thins else NOTHING
        if self._only is not None:
            self._only.send(batch, chosen, now_ns, NEVER_NS)
            return
        begun_ns = now_ns()
        time.fill(begun_ns)
        end_ns = begun_ns + PUBLISH_NS if time.level > 0 else begun_ns
        for number, group in enumerate(groups):
            if number and (number >= FORMS_AT_ONCE or now_ns() > end_ns):
                group.defer(batch, chosen)
            else:
                group.send(batch, chosen, now_ns, end_ns)
        time.use(now_ns() - begun_ns)
