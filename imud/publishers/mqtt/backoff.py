"""Which broker is tried next, and when: the list in turn, with pauses that grow and are drawn at random.

    attempt ──fails──▶ next broker of the list ──pause──▶ attempt
    connection ──lost──▶ the same broker ──pause──▶ attempt

A broker that restarts loses all gateways in the same second. Each draws its pause from 0 to the present length ("full
jitter"), the first one as well, so that they come back spread over it; the length doubles with each failed turn through
the list, up to the longest.

After a loss the same broker is the likeliest to be back; after an attempt that failed, the next one of the list is the
likeliest to be there.
"""

from collections.abc import Callable
from random import random
from typing import Final

from imud.publishers.mqtt.settings import Broker
from imud.units import NS_PER_S

FIRST_S: Final = 4.0
"""Length of the first pause: 500 gateways come back at 125 a second."""
STABLE_NS: Final = 30 * NS_PER_S
"""A connection that held for so long was a good one: pauses begin anew."""


class BrokerTurn:
    """The list of brokers and its pauses. Synchronization: one thread."""

    def __init__(self, brokers: list[Broker], most_s: float, draw: Callable[[], float] = random) -> None:
        """`draw` gives numbers from 0 to below 1."""
        self._brokers = brokers
        self._most_s = most_s
        self._draw = draw
        self._at = 0
        self._failed = 0
        self._up_ns: int | None = None

    @property
    def broker(self) -> Broker:
        """The one whose turn it is."""
        return self._brokers[self._at]

    def connected(self, now_ns: int) -> None:
        """Note that the broker has accepted the connection."""
        self._up_ns = now_ns

    def failed(self, now_ns: int) -> float:
        """Note that it did not, or that the connection was lost; return how long to wait, s.

        After a loss the same broker is tried again first; after an attempt that failed, the next one.
        """
        up_ns, self._up_ns = self._up_ns, None
        if up_ns is not None and now_ns - up_ns >= STABLE_NS:
            self._failed = 0
        if up_ns is None:
            self._at = (self._at + 1) % len(self._brokers)
        length_s: float = min(self._most_s, FIRST_S * 2.0 ** min(self._failed // len(self._brokers), 16))
        self._failed += 1
        return self._draw() * length_s
