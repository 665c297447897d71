"""Wall clocks of gateways: when a boot's is known, and where on UTC a record lies that came before it was.

    utc_ns = t_ns + utc_offset_ns        the offset is one number of a boot: CLOCK_REALTIME less CLOCK_MONOTONIC

A gateway without a battery for its clock starts at any time: 1970, or where systemd lifts it to. Its messages say
whether the kernel counts the clock as synchronised; the first that does gives the offset of the boot, with which
everything else of that boot is placed, before and after. Further away from the moment of synchronisation the error
is larger, by as much as an oscillator may be off.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

from imud.formats.fleet.messages import FleetMessage, GatewayClock
from imud.formats.fleet.state import GatewayState
from imud.units import NS_PER_MS, NS_PER_S

CLOCK_SET_NS: Final = 1_577_836_800 * NS_PER_S
"""2020: of a message that does not speak of the clock, because it was made by an earlier version, a `utc_ns` before it
is of a clock that is not set."""
STEP_NS: Final = NS_PER_MS
"""A `utc_ns` that is further from the offset in its message was made before the clock was stepped: offsets are read
within microseconds."""
DRIFT: Final = 2000
"""500 ppm: the kernel's own bound of how far a clock that nothing keeps is off in frequency (adjtimex(2))."""
BOOTS_MAX: Final = 100_000
"""Boots whose offset is kept; the oldest go first. As many as there may be streams."""


class BootKey(NamedTuple):
    """A start of the daemon of a gateway."""

    gateway: str
    boot: str
    """Without the number of a device that was made anew."""


class BootOffset(NamedTuple):
    """The wall clock of a boot, from a moment at which it was synchronised."""

    t_ns: int
    """CLOCK_MONOTONIC of that moment."""
    utc_offset_ns: int
    """CLOCK_REALTIME less CLOCK_MONOTONIC."""
    utc_err_ns: int | None
    """One-sigma error of it; None where the gateway does not say."""

    def error_at(self, t_ns: int) -> int | None:
        """The error of a time that is placed by it."""
        return None if self.utc_err_ns is None else self.utc_err_ns + abs(t_ns - self.t_ns) // DRIFT


class PlacedTime(NamedTuple):
    """Where a record lies on UTC."""

    utc_ns: int
    is_set: bool
    """Whether that is so; otherwise it is only what a clock said that nothing had set."""
    error_ns: int | None
    """One-sigma error of the clock; None where it is not known."""


def boot_of(message: FleetMessage) -> BootKey:
    """The boot of a message."""
    return BootKey(message.gateway, message.boot.partition("-")[0])


def offset_of(message: FleetMessage) -> BootOffset | None:
    """What a message says of the wall clock of its boot; None while the clock is not set."""
    if message.clock is not None:
        return _offset(message.clock)
    pairs = [(one.t_ns, one.utc_ns) for one in message.samples[-1:]]
    pairs += [(one.begin_t_ns, one.begin_utc_ns) for one in message.intervals[-1:]]
    for t_ns, utc_ns in pairs:
        if utc_ns >= CLOCK_SET_NS:
            return BootOffset(t_ns, utc_ns - t_ns, None)
    return None


def placed(utc_ns: int, t_ns: int | None, clock: GatewayClock | None, known: BootOffset | None) -> PlacedTime:
    """Where a record of a message lies. `clock` is that of the message, `known` what is known of the boot now.

    `t_ns` is None where the message does not say it.
    """
    if clock is None and utc_ns >= CLOCK_SET_NS:
        return PlacedTime(utc_ns, True, None)
    if clock is not None and clock.synchronised:
        if t_ns is not None and abs(utc_ns - t_ns - clock.utc_offset_ns) > STEP_NS:
            utc_ns = t_ns + clock.utc_offset_ns
        return PlacedTime(utc_ns, True, clock.error_ns)
    if known is not None and t_ns is not None:
        return PlacedTime(t_ns + known.utc_offset_ns, True, known.error_at(t_ns))
    return PlacedTime(utc_ns, False, None)


class BootClocks:
    """What is known of the wall clocks of all boots. Synchronization: one thread."""

    def __init__(self) -> None:
        self._known: dict[BootKey, BootOffset] = {}
        self._fresh: dict[BootKey, BootOffset] = {}

    @property
    def offsets(self) -> Mapping[BootKey, BootOffset]:
        """The newest offset of each boot whose clock was synchronised."""
        return self._known

    def take(self, message: FleetMessage) -> BootOffset | None:
        """Note what a message says; return what is known of its boot."""
        key = boot_of(message)
        self._note(key, offset_of(message))
        return self._known.get(key)

    def take_state(self, gateway: str, state: GatewayState) -> None:
        """Note what a state says."""
        if state.clock is not None:
            self._note(BootKey(gateway, state.boot), _offset(state.clock))

    def take_fresh(self) -> Mapping[BootKey, BootOffset]:
        """Offsets of boots of which none was known the last time."""
        fresh, self._fresh = self._fresh, {}
        return fresh

    def _note(self, key: BootKey, offset: BootOffset | None) -> None:
        if offset is None:
            return
        if key not in self._known:
            self._fresh[key] = offset
            while len(self._known) >= BOOTS_MAX:
                oldest = next(iter(self._known))
                del self._known[oldest]
                self._fresh.pop(oldest, None)
        self._known[key] = offset


def _offset(clock: GatewayClock) -> BootOffset | None:
    return BootOffset(clock.t_ns, clock.utc_offset_ns, clock.error_ns) if clock.synchronised else None
