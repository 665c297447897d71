"""All gateways at a glance, as a table: which are there, what they send, what was lost, how old the newest is."""

from collections import deque
from collections.abc import Callable
from time import monotonic_ns, time_ns
from typing import Final

from imud.cli.output import table
from imud.fleet import Fleet, FleetBatch
from imud.formats.fleet.messages import GatewayClock
from imud.formats.fleet.state import GatewayState, StreamAccount
from imud.formats.fleet.topics import Stream
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US

TOP_HEAD: Final = (
    "GATEWAY",
    "STATE",
    "DEVICES",
    "SAMPLES/S",
    "LOST",
    "MISSING",
    "SPOOL",
    "AGE S",
    "ERROR µs",
    "UTC ms",
)
NOT_SET: Final = "not set"
RATE_NS: Final = 5 * NS_PER_S
"""Rates are over so much time."""


class FleetOverview:
    """What is shown of the gateways of a fleet. Synchronization: one thread."""

    def __init__(
        self, fleet: Fleet, now_ns: Callable[[], int] = monotonic_ns, utc_ns: Callable[[], int] = time_ns
    ) -> None:
        """`now_ns`: CLOCK_MONOTONIC; `utc_ns`: CLOCK_REALTIME."""
        self._fleet = fleet
        self._now_ns, self._utc_ns = now_ns, utc_ns
        self._counts: dict[tuple[str, Stream], deque[tuple[int, int]]] = {}
        """Samples that came, by gateway and stream: when, and how many."""
        self._newest_ns: dict[str, int] = {}
        self._error_ns: dict[str, int] = {}
        self._clocks: dict[str, GatewayClock] = {}
        """What the last message of each gateway said of its wall clock."""

    def add(self, batch: FleetBatch) -> None:
        """Note what came."""
        message = batch.message
        name = message.gateway
        if message.clock is not None:
            self._clocks[name] = message.clock
        self._newest_ns[name] = max(message.utc_ns, self._newest_ns.get(name, 0))
        if batch.stream is not Stream.EVENTS:
            counts = self._counts.setdefault((name, batch.stream), deque())
            counts.append((self._now_ns(), message.last - message.first + 1))
        errors = [sample.t_err_ns for sample in message.samples] or [one.t_err_ns for one in message.intervals]
        if errors:
            self._error_ns[name] = max(errors)

    def text(self) -> str:
        """The table, those that are away first, and below it how many there are and what is wrong with the broker."""
        fleet = self._fleet
        if not fleet.states:
            return f"no gateway yet; {fleet.problem or 'connected'}"
        found: dict[str, list[StreamAccount]] = {}
        for key, account in fleet.accounts.items():
            found.setdefault(key.gateway, []).append(account)
        order = sorted(fleet.states, key=lambda key: (fleet.states[key].online, key))
        rows = [self._row(key, found.get(key[1], [])) for key in order]
        away = sum(not state.online for state in fleet.states.values())
        line = f"{len(rows)} gateway{'s' * (len(rows) != 1)}, {away} away" + (
            f"; {fleet.problem}" * bool(fleet.problem)
        )
        return f"{table(TOP_HEAD, rows)}\n\n{line}"

    def _row(self, key: tuple[str, str], found: list[StreamAccount]) -> tuple[str, ...]:
        state, name = self._fleet.states[key], key[1]
        newest_ns, error_ns = self._newest_ns.get(name), self._error_ns.get(name)
        return (
            "/".join(key),
            "online" if state.online else state.reason or "away",
            str(len(state.devices)),
            f"{self._rate_hz(name):.1f}",
            str(sum(sum(one.counts.dropped.values()) for one in found)),
            str(sum(one.counts.missing for one in found)),
            str(sum(one.in_spool for one in found)),
            "-" if newest_ns is None else f"{max(self._utc_ns() - newest_ns, 0) / NS_PER_S:.1f}",
            "-" if error_ns is None else f"{error_ns / NS_PER_US:.0f}",
            self._utc_text(name, state),
        )

    def _utc_text(self, name: str, state: GatewayState) -> str:
        """The error of a gateway's wall clock, by what came last; nothing of one that does not speak of it."""
        clock = self._clocks.get(name, state.clock)
        if clock is None or (clock.synchronised and clock.error_ns is None):
            return "-"
        return f"{clock.error_ns / NS_PER_MS:.3g}" if clock.synchronised and clock.error_ns is not None else NOT_SET

    def _rate_hz(self, name: str) -> float:
        """Samples a second that came, or that statistics and status count: the same samples can be in both streams."""
        begin_ns, most = self._now_ns() - RATE_NS, 0
        for stream in (Stream.SAMPLES, Stream.STATISTICS):
            counts = self._counts.get((name, stream), deque())
            while counts and counts[0][0] < begin_ns:
                counts.popleft()
            most = max(most, sum(count for _, count in counts))
        return most * NS_PER_S / RATE_NS
