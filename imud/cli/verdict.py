"""What limits the time stamps of a device, and what would make them better: one sentence from what is known."""

from collections.abc import Sequence
from typing import Final

from imud.contracts.status import ClockStatus
from imud.sample import Sync
from imud.units import NS_PER_MS, NS_PER_US

ENOUGH: Final = 20
"""Fewer arrivals say nothing about their spread."""
HELD_SHARE: Final = 0.5
"""An adapter that holds bytes for up to its timer spreads arrivals over most of it."""
LOADED_NS: Final = NS_PER_MS
"""Arrivals of a wire and an idle system spread over some ten microseconds."""


EDGES_ENOUGH: Final = 100
"""Fewer edges say nothing: the first ones come before it is known which samples they belong to."""
UNPAIRED_SHARE: Final = 0.1
"""Noise and losses leave less without their match; another wire or a divided pulse leaves half or more."""


def verdict(clock: ClockStatus, behind_ns: Sequence[int]) -> str:
    """`behind_ns`: how much later than the time of measurement each of the newest samples was read."""
    if mistake := miswired(clock):
        return mistake
    error = f"{clock.t_err_ns / NS_PER_US:.1f} µs"
    if clock.sync is Sync.UTC:
        return f"the device keeps UTC itself; what the host knows of UTC limits: {error}"
    if clock.sync is Sync.EDGE:
        return f"limited by the kernel's stamps of the line: {error}"
    if clock.sync is Sync.ARRIVAL:
        return f"the device's time is not used, so arrivals are all there is: {error}; wire SOUT if it has one"
    return _of_arrivals(clock, sorted(behind_ns))


def miswired(clock: ClockStatus) -> str:
    """What the counts since start say of the wires, one sentence; empty when they fit the samples."""
    edges, most = clock.edges, UNPAIRED_SHARE * clock.edges
    if edges < EDGES_ENOUGH:
        return ""
    if clock.triggers_missed > most:
        return (
            f"{clock.triggers_missed} triggers on SIN were not answered: is the wire at SIN, is a message sent on mark "
            "(`output_on_mark`), can the line carry the rate?"
        )
    if clock.edges_unpaired > most:
        return (
            f"{clock.edges_unpaired} of {edges} pulses belong to no sample: is the wire at SOUT of this device, "
            "is its pull-down missing, or are its frames lost?"
        )
    if clock.samples_unpaired > most:
        return (
            f"{clock.samples_unpaired} samples came without the pulse of theirs, {edges} pulses in all: "
            "is the wire at SOUT_DIV, which has one for several samples?"
        )
    if clock.sync in (Sync.ARRIVAL, Sync.REGRESSION):
        return (
            f"{edges} edges came, and none is matched to a sample now: do they still come, is the wire at SOUT of this "
            "device, or do its bytes come too late for its rate?"
        )
    return ""


def _of_arrivals(clock: ClockStatus, ordered: Sequence[int]) -> str:
    """What the spread of arrivals says about the way they come."""
    if len(ordered) < ENOUGH:
        return "too few samples to tell"
    spread_ns = ordered[int(0.99 * len(ordered))] - ordered[int(0.01 * len(ordered))]
    spread = f"arrivals spread over {spread_ns / NS_PER_MS:.1f} ms"
    if clock.hold_ns and spread_ns >= HELD_SHARE * clock.hold_ns:
        timer = f"{clock.hold_ns / NS_PER_MS:.0f} ms"
        return f"{spread}: the USB adapter's latency timer of {timer}; `low_latency: true`, another adapter, or SOUT"
    if spread_ns > LOADED_NS:
        return f"{spread}, and no latency timer explains it: a loaded system; give imud a higher priority, or wire SOUT"
    return f"{spread}; the constant delay between measuring and sending stays unseen without SOUT"
