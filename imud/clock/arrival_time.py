"""The time of messages that carry none: by their arrival, by their even pace, by their number; and what is missing.

    arrival, number ─▶ EvenArrivals: a line under the arrivals ─▶ time, error
                  │         while there is none: the arrival less half of the link's bias, and its spread as error
                  └──▶ ArrivalLosses: samples missing before the message

Nothing here reads a clock.
"""

from collections.abc import Callable

from imud.clock.even_arrivals import EvenArrivals
from imud.clock.gaps import ArrivalLosses
from imud.clock.link_delay import ArrivalSpread, LinkDelay


class ArrivalTime:
    """Time of a device's messages without device time. `modulus` is that of their number, 0 without one."""

    __slots__ = ("_even", "_losses", "_numbered", "delay", "error_ns", "missed", "spread")

    def __init__(self, delay: LinkDelay, modulus: int, on_unknown_gap: Callable[[], None]) -> None:
        """`on_unknown_gap` is called for a gap in which the number of missing samples is not known."""
        self.delay = delay
        """Of the link now."""
        self.spread = ArrivalSpread()
        self._even = EvenArrivals()
        self._losses = ArrivalLosses(modulus, on_unknown_gap)
        self._numbered = modulus > 0
        self.error_ns = 0.0
        """One-sigma error of the newest time."""
        self.missed = 0
        """Samples missing right before the newest message."""

    @property
    def resets(self) -> int:
        """How often the number began anew."""
        return self._losses.resets

    def restart(self) -> None:
        """Begin anew after the device or the link was away."""
        self._losses.restart()
        self.missed = 0
        self.change_link(self.delay)

    def change_link(self, delay: LinkDelay) -> None:
        """Go on over a link with other delays."""
        self.delay = delay
        self.spread = ArrivalSpread()
        self._even.restart()

    def date(
        self, number: int | None, arrival_ns: int, size_bytes: int, *, alone: bool, triggered: bool, is_first: bool
    ) -> int:
        """Return the time of a message of `size_bytes` that began to arrive at `arrival_ns`.

        `alone`: no other messages of the device carry time; `triggered`: each follows a pulse of its own; `is_first`:
        the device has sent none before. Sets `error_ns` and `missed`.
        """
        missed = steps = 0
        if self._numbered and number is not None:
            steps = self._losses.add_number(number, arrival_ns, self.spread.period_ns)
            if not steps:
                self.change_link(self.delay)
            missed = self._losses.missed
        elif alone and not self._numbered:
            missed = self._losses.add_arrival(arrival_ns, is_first=is_first)
        self.missed, spread = missed, self.spread
        spread.add_arrival(arrival_ns, steps or 1)
        if alone and self._even.add_arrival(self.delay, arrival_ns, steps, triggered=triggered):
            self.error_ns = self._even.error_ns
            return self._even.t_ns
        t_ns, self.error_ns = self.delay.before(arrival_ns, size_bytes, spread.period_ns, spread.sigma_ns)
        return t_ns
