"""What one client asked to be sent: which devices, in which form, how often."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from enum import StrEnum

from imud.units import NS_PER_S


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

    def takes(self, t_ns: int) -> bool:
        """Whether the sample measured at `t_ns` is one to send."""
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
    """A `watch` as it was asked for and checked."""

    devices: Collection[str] | None
    """None for all, those that appear later included."""
    fields: tuple[str, ...] | None
    """Members of a JSON sample besides those that are always there; None for all."""
    rate_hz: float
    """At most so many samples per second and device; 0 for all."""
    form: Form
    _paces: dict[str, Pace] = field(default_factory=dict)

    def matches(self, device: str) -> bool:
        """Whether samples of `device` are wanted."""
        return self.devices is None or device in self.devices

    def pace_of(self, device: str) -> Pace | None:
        """What thins the samples of `device`; None where all are wanted."""
        if not self.rate_hz:
            return None
        return self._paces.setdefault(device, Pace(self.rate_hz))
