"""What clients watch (devices, form, rate), and the plan by which a batch goes to all that watch its device."""

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from imud.contracts.publisher import Batch
from imud.publishers.socket.encoding import BinaryEncoding, Encoding, JsonEncoding
from imud.publishers.socket.outbox import Outbox
from imud.units import NS_PER_S

_BINARY: Final = BinaryEncoding()


class Form(StrEnum):
    """Encodings of samples by their names in the protocol."""

    JSON = "json"
    """One notification per sample."""
    BINARY = "binary"
    """One slot of shared memory per sample."""


class Pace:
    """Thins the samples of one device to `rate_hz`: the first one at or after each due instant, never resampled.

    Due instants are start + k / rate_hz in the time of the samples, k counted, so that rounding never adds up.
    """

    __slots__ = ("_period_ns", "_start_ns", "due_ns")

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = NS_PER_S / rate_hz
        self._start_ns: int | None = None
        self.due_ns = 0
        """A sample measured before this instant is not one to send."""

    def is_due(self, t_ns: int) -> bool:
        """Whether the sample measured at `t_ns` is one to send; if so, the next due instant is a later one."""
        start_ns = self._start_ns
        if start_ns is None:
            start_ns = self._start_ns = t_ns
        elif t_ns < self.due_ns:
            return False
        period_ns = self._period_ns
        passed = math.floor((t_ns - start_ns) / period_ns)
        due_ns = start_ns + math.ceil((passed + 1) * period_ns)
        self.due_ns = due_ns if due_ns > t_ns else t_ns + 1  # a period below one ns, or a sum that rounds down
        return True


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
    _paces: dict[str, Pace] = field(default_factory=dict)

    def matches(self, device: str) -> bool:
        """Whether samples of `device` are wanted."""
        return self.devices is None or device in self.devices

    def pace_of(self, device: str) -> Pace | None:
        """The pace that thins samples of `device`; None where all are wanted."""
        if not self.rate_hz:
            return None
        return self._paces.setdefault(device, Pace(self.rate_hz))


class DeliveryGroup:
    """Clients that get samples of one device in the same form: each message is encoded once for all of them."""

    def __init__(self, encoding: Encoding) -> None:
        self.encoding = encoding
        self.direct: list[Outbox] = []
        """Of clients that get every sample."""
        self.paced: list[tuple[Pace, Outbox]] = []

    def send(self, batch: Batch) -> None:
        """Send the batch to every client of the group."""
        encoding, device = self.encoding, batch.device
        made: dict[int, bytes] = {}
        if self.direct:
            messages = encoding.encode(batch)
            Outbox.put_samples(self.direct, messages, device, encoding)
            made = dict(enumerate(messages)) if self.paced else made
        newest_ns = batch.samples[-1].t_ns
        for pace, outbox in self.paced:
            if newest_ns < pace.due_ns:
                continue  # the usual case, so no call for it
            chosen = [index for index, sample in enumerate(batch.samples) if pace.is_due(sample.t_ns)]
            if chosen:
                for index in chosen:
                    if index not in made:
                        made[index] = encoding.encode_one(batch, index)
                messages = [made[index] for index in chosen]
                Outbox.put_samples((outbox,), messages, device, encoding)


@dataclass(frozen=True, slots=True)
class DeliveryPlan:
    """Where a batch of one device goes. Never changed, but replaced when clients or their subscriptions change."""

    groups: Sequence[DeliveryGroup]
    wakes: bool
    """Whether these batches wake any client."""


@dataclass(frozen=True, slots=True)
class Watcher:
    """A client that watches."""

    subscription: Subscription
    outbox: Outbox
    framed: bool
    """Whether it gets frames."""


def make_plan(device: str, watchers: Iterable[Watcher], wakes: bool) -> DeliveryPlan:
    """The plan for batches of `device`: one group per form that is wanted."""
    groups: dict[tuple[Form, tuple[str, ...] | None, bool], DeliveryGroup] = {}
    for watcher in watchers:
        wanted, framed = watcher.subscription, watcher.framed
        if not wanted.matches(device):
            continue
        key = (wanted.form, wanted.fields if wanted.form is Form.JSON else None, framed)
        group = groups.get(key)
        if group is None:
            group = groups[key] = DeliveryGroup(_encoding(wanted, framed))
        pace = wanted.pace_of(device)
        if pace is None:
            group.direct.append(watcher.outbox)
        else:
            group.paced.append((pace, watcher.outbox))
    return DeliveryPlan(tuple(groups.values()), wakes)


def _encoding(wanted: Subscription, framed: bool) -> Encoding:
    return _BINARY if wanted.form is Form.BINARY else JsonEncoding(wanted.fields, framed)
