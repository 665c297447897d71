"""Subscriptions of clients, and the plan that sends a batch to all clients that watch its device."""

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
"""Maximum time to send a batch, ns. The scheduler serves the remaining clients, in several turns."""
NEVER_NS: Final = 1 << 63
CLIENTS_PER_CHECK: Final = 32
"""Number of clients between two reads of the clock."""
FORMS_AT_ONCE: Final = 16
"""Maximum number of forms that imud encodes in `publish`. It encodes other forms when it serves their clients."""
ChosenSamples = Mapping[float, tuple[int, ...]]
"""Indices of the samples for clients with a rate, by rate."""


class Form(StrEnum):
    """Encoding of samples in the protocol."""

    JSON = "json"  # one notification per sample
    BINARY = "binary"  # one slot of shared memory per sample


FormKey = tuple[Form, tuple[str, ...] | None, bool, Convention | None, bool]
"""Key of clients that get the same messages: encoding, fields, framed, convention, big numbers as strings."""


@dataclass(slots=True)
class Subscription:
    """The checked parameters of a `watch`."""

    devices: Collection[str] | None  # watched devices; None for all devices, also devices that imud adds later
    fields: tuple[str, ...] | None  # members of a JSON sample in addition to ALWAYS_FIELDS; None for all
    rate_hz: float  # maximum number of samples per second and device; 0 for all
    form: Form
    framed: bool = False  # whether imud sends messages as frames
    convention: Convention | None = None
    """Axes and angles of samples; None for the convention in the configuration of the device."""
    text_numbers: bool = False  # whether integers of JSON samples that may exceed 2⁵³ are strings
    latency_ns: int = 0  # maximum hold of a sample, ns
    key: FormKey = field(init=False)

    def __post_init__(self) -> None:
        json = self.form is Form.JSON
        self.key = (
            self.form, self.fields if json else None, self.framed, self.convention, json and self.text_numbers,
        )  # fmt: skip

    def encoding(self) -> Encoding:
        if self.form is Form.BINARY:
            return BinaryEncoding(self.convention)
        return JsonEncoding(self.fields, self.framed, self.text_numbers, self.convention)

    def matches(self, device: str) -> bool:
        return self.devices is None or device in self.devices


class DeliveryGroup:
    """Clients that receive the same messages of one device. imud encodes each message once for all of them.

    The lists of clients are replaced, never changed, because a client may leave while imud sends a batch to its list.
    imud makes the lists for the next batch, not for each change. Thus 256 clients that change their subscription all
    the time cost little.
    """

    def __init__(self, encoding: Encoding, next_order: Callable[[], int]) -> None:
        self.encoding = encoding
        self._next_order = next_order
        self._rates_hz: dict[Outbox, float] = {}  # rate of each client; 0 for every sample
        self._changed = False  # whether the lists are out of date
        self._direct: list[list[Outbox]] = []  # clients with every sample, in lists of at most CLIENTS_PER_CHECK
        self._thinned: dict[float, list[Outbox]] = {}  # clients with a rate, by rate

    def __contains__(self, outbox: Outbox) -> bool:
        return outbox in self._rates_hz

    @property
    def is_small(self) -> bool:
        """Whether the group has so few clients that imud need not limit the time to send."""
        return len(self._rates_hz) <= CLIENTS_PER_CHECK

    def add(self, outbox: Outbox, rate_hz: float) -> None:
        """Add a client. With the rate 0 it gets every sample."""
        self._rates_hz[outbox] = rate_hz
        self._changed = True

    def discard(self, outbox: Outbox) -> bool:
        """Remove a client. Return whether the group is empty."""
        self._rates_hz.pop(outbox, None)
        self._changed = True
        return not self._rates_hz

    def send(self, batch: Batch, chosen: ChosenSamples, now_ns: Callable[[], int], end_ns: int) -> None:
        """Send the batch to the clients of the group until `end_ns`, then queue it for the others."""
        messages = self.send_first(batch)
        if len(self._direct) > 1:
            self._send_parts(self._direct[1:], messages, batch, None, now_ns, end_ns)
        for indices, outboxes in self._due(chosen):
            if messages:
                some: Sequence[bytes] = [messages[index] for index in indices]
            else:
                some = [self.encoding.encode_one(batch, index) for index in indices]
            self._send_parts(_in_parts(outboxes), some, batch, indices, now_ns, end_ns)

    def send_first(self, batch: Batch) -> Sequence[bytes]:
        """Send the batch to the first clients without a rate. Return the messages; empty without such clients."""
        if self._changed:
            self._make_lists()
        if not self._direct:
            return ()
        messages = self.encoding.encode(batch)
        Outbox.put_samples(self._direct[0], messages, batch, self.encoding)
        return messages

    def defer(self, batch: Batch, chosen: ChosenSamples) -> None:
        """Queue the batch for every client. imud encodes it when it serves the first client."""
        if self._changed:
            self._make_lists()
        for indices, outboxes in self._due(chosen):
            _defer(outboxes, Delivery(self._next_order(), batch, self.encoding, None, indices))
        if self._direct:
            _defer(chain(*self._direct), Delivery(self._next_order(), batch, self.encoding, None))

    def _make_lists(self) -> None:
        self._changed = False
        self._direct = _in_parts([outbox for outbox, rate_hz in self._rates_hz.items() if not rate_hz])
        self._thinned = {}
        for outbox, rate_hz in self._rates_hz.items():
            if rate_hz:
                self._thinned.setdefault(rate_hz, []).append(outbox)

    def _due(self, chosen: ChosenSamples) -> list[tuple[tuple[int, ...], list[Outbox]]]:
        """Return the indices of samples for the clients with a rate, with these clients."""
        thinned = self._thinned
        return [(indices, thinned[rate_hz]) for rate_hz, indices in chosen.items() if rate_hz in thinned]

    def _send_parts(
        self, parts: Iterable[list[Outbox]], messages: Sequence[bytes], batch: Batch, chosen: Sequence[int] | None,
        now_ns: Callable[[], int], end_ns: int,
    ) -> None:  # fmt: skip
        """Send to lists of clients until `end_ns`, then queue. Read the clock before each list."""
        delivery: Delivery | None = None
        for outboxes in parts:
            if delivery is None and now_ns() < end_ns:
                Outbox.put_samples(outboxes, messages, batch, self.encoding, chosen)
                continue
            delivery = delivery or Delivery(self._next_order(), batch, self.encoding, messages, chosen)
            _defer(outboxes, delivery)


def _defer(outboxes: Iterable[Outbox], delivery: Delivery) -> None:
    for outbox in outboxes:
        outbox.defer(delivery)


def _in_parts(outboxes: list[Outbox]) -> list[list[Outbox]]:
    return [outboxes[first : first + CLIENTS_PER_CHECK] for first in range(0, len(outboxes), CLIENTS_PER_CHECK)]


class DeliveryPlan:
    """The clients that watch one device: a group for each form.

    `next_order` returns the order number of the next queued message, and `now_ns` returns CLOCK_MONOTONIC. `time` is
    the allowance for serving.
    """

    def __init__(self, next_order: Callable[[], int], now_ns: Callable[[], int], time: TokenBucket) -> None:
        self._next_order = next_order
        self._now_ns = now_ns
        self._time = time
        self._thinner = RateThinner()
        self._groups: dict[FormKey, DeliveryGroup] = {}
        # a copy of `_groups`: a client may leave while `send` iterates over it
        self._in_order: tuple[DeliveryGroup, ...] = ()
        self._only: DeliveryGroup | None = None  # the only group, if it is small; otherwise None
        self._thins = False  # whether a client has a rate
        # the only group, if it is small and no client has a rate; the caller then uses its `send_first` for each batch
        self.simple: DeliveryGroup | None = None

    def __len__(self) -> int:
        return len(self._groups)

    def add(self, wanted: Subscription, outbox: Outbox) -> None:
        """Add a client that is not in the plan."""
        key = wanted.key
        group = self._groups.get(key)
        if group is None:
            group = self._groups[key] = DeliveryGroup(wanted.encoding(), self._next_order)
            self._in_order = tuple(self._groups.values())
        group.add(outbox, wanted.rate_hz)
        if wanted.rate_hz:
            self._thinner.add(wanted.rate_hz)
        self._note_groups()

    def discard(self, wanted: Subscription, outbox: Outbox) -> None:
        """Remove a client. Do nothing if it is unknown."""
        key = wanted.key
        group = self._groups.get(key)
        if group is None or outbox not in group:
            return
        if wanted.rate_hz:
            self._thinner.discard(wanted.rate_hz)
        if group.discard(outbox):
            del self._groups[key]
            self._in_order = tuple(self._groups.values())
        self._note_groups()

    def _note_groups(self) -> None:
        groups = self._in_order
        self._thins = bool(self._thinner)
        self._only = groups[0] if len(groups) == 1 and groups[0].is_small else None
        self.simple = None if self._thins else self._only

    def send(self, batch: Batch) -> None:
        """Send a batch to all clients: to a small group without a time limit, otherwise for PUBLISH_NS, then queue it.

        If the allowance for serving is used up, imud queues the batch for most of many clients.
        """
        chosen = self._thinner.choose(batch.times_ns) if self._thins else NOTHING
        if self._only is not None:
            self._only.send(batch, chosen, self._now_ns, NEVER_NS)
            return
        groups, now_ns, time = self._in_order, self._now_ns, self._time
        if not groups:
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
