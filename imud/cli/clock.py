"""`imud clock`: where the time stamps of each device come from, how good they are, and what limits them."""

import argparse
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from time import monotonic
from typing import Final

import msgspec

from imud.cli.arguments import CliCommand, add_socket, connect, finite, statuses
from imud.cli.output import histogram
from imud.client.connection import Client
from imud.contracts.status import ClockStatus, DeviceState, DeviceStatus
from imud.model.errors import ImudError
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

KEPT: Final = 2000
"""Newest samples of a device that the histogram is made of."""
REFRESH_S: Final = 1.0
CLEAR: Final = "\x1b[H\x1b[2J"
ENOUGH: Final = 20
"""Least number of arrivals for a statement about their spread."""
HELD_SHARE: Final = 0.5
"""An adapter that holds bytes for up to its timer spreads arrivals over most of it."""
TOO_FEW: Final = "too few samples to say"
LOADED_NS: Final = NS_PER_MS
"""Arrivals of a wire and an idle system spread over some ten microseconds."""
EDGES_ENOUGH: Final = 100
"""Least number of edges for a judgement: the first ones come before their samples can be assigned."""
UNPAIRED_SHARE: Final = 0.1
"""Noise and losses leave less without their match; another wire or a divided pulse leaves half or more."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud clock`."""
    add_socket(parser)
    parser.add_argument("device", nargs="*", metavar="DEVICE", help="devices to look at (default: all)")
    parser.add_argument("--duration", type=finite, metavar="S", help="listen for S seconds, then print once and end")
    parser.add_argument("--json", action="store_true", help="the clocks once, as the socket sends them")


def run(args: argparse.Namespace) -> int:
    """Show the report, live until interrupted; return 1 when no sample came."""
    with connect(args) as asking:
        chosen = args.device or [status.name for status in statuses(asking)]
        if not chosen and not args.json:
            raise ImudError("the daemon has no device; `imud setup` finds what is attached and configures it")
        if args.json:
            clocks = {status.name: status.clock for status in statuses(asking) if status.name in chosen}
            print(msgspec.json.encode(clocks).decode())
            return 0
        behind: dict[str, deque[int]] = {name: deque(maxlen=KEPT) for name in chosen}
        with connect(args) as listening:
            for _ in listen(listening, behind, args.duration):
                sys.stdout.write(CLEAR + page(statuses(asking), behind) + "\n")
                sys.stdout.flush()
        if args.duration is not None:
            print(page(statuses(asking), behind))
    return 0 if any(behind.values()) else 1


def listen(client: Client, behind: dict[str, deque[int]], duration_s: float | None) -> Iterator[None]:
    """Record how long after its measurement each sample was read; yield whenever a report is due.

    With a duration it ends then, and nothing is drawn. Reports are due in silence, too.
    """
    begun = drawn = monotonic()
    samples = client.watch(list(behind), timeout_s=REFRESH_S if duration_s is None else min(REFRESH_S, duration_s))
    while True:
        with suppress(TimeoutError):
            sample = next(samples)
            behind[sample.device].append(sample.t_rx_ns - sample.t_ns)
        now = monotonic()
        if duration_s is not None and now - begun >= duration_s:
            return
        if duration_s is None and now - drawn >= REFRESH_S:
            drawn = now
            yield


def page(devices: list[DeviceStatus], behind: dict[str, deque[int]]) -> str:
    """Format the blocks of all shown devices; those that left the configuration have a line."""
    gone = [f"{name}: not in the configuration any more" for name in behind if name not in {d.name for d in devices}]
    shown = [block(status, behind[status.name]) for status in devices if status.name in behind]
    return "\n\n".join([*shown, *gone])


def block(status: DeviceStatus, behind_ns: deque[int]) -> str:
    """Format the block of one device."""
    clock = status.clock
    lines = [] if status.state is DeviceState.RUNNING else [f"{status.name} is {status.state}: {status.problem}"]
    lines += [
        f"{status.name}: time stamps by {clock.sync}, error {clock.t_err_ns / NS_PER_US:.1f} µs (one sigma)",
        f"  offset    {clock.offset_ns / NS_PER_S:+.9f} s (host - device), skew {clock.skew_ppm:+.3f} ppm, "
        f"{clock.resets} resets",
        f"  host      CLOCK_MONOTONIC is steered by {clock.steering_ppm:+.1f} ppm",
        f"  residual  {clock.residual_ns / NS_PER_US:.1f} µs (one sigma)",
        *(f"  {name:<10}{words}" for name, words in aids(status)),
        f"  read after measurement, {len(behind_ns)} samples:",
        *histogram([late_ns / NS_PER_US for late_ns in behind_ns], "µs"),
        f"  verdict   {verdict(clock, behind_ns)}",
    ]
    return "\n".join(lines)


def aids(status: DeviceStatus) -> Iterator[tuple[str, str]]:
    """List name and text of each aiding source that the device has."""
    clock, lines, utc = status.clock, status.lines, status.utc
    if lines is not None and "sout" in lines.edges:
        yield (
            "SOUT",
            (
                f"{clock.edges} pulses, {clock.edges_unpaired} belong to no sample;"
                f" {clock.samples_unpaired} samples without theirs"
            ),
        )
    if lines is not None and lines.sin:
        yield "SIN", f"{lines.triggers} triggers, {clock.triggers_missed} not answered by a sample"
    if utc is not None and (utc.pulses or utc.pulses_ignored):
        yield "PPS", f"{utc.pulses} pulses, {utc.pulses_ignored} in step with none"
    if clock.reference_error_ns:
        yield "UTC", f"the host knows it to {clock.reference_error_ns / NS_PER_US:.1f} µs (one sigma)"


def verdict(clock: ClockStatus, behind_ns: Sequence[int]) -> str:
    """Judge the time stamps. `behind_ns`: delays from the measurement to the read, of the newest samples."""
    if mistake := miswired(clock):
        return mistake
    error = f"{clock.t_err_ns / NS_PER_US:.1f} µs"
    if clock.sync is Sync.UTC:
        return f"the device keeps UTC itself; what the host knows of UTC limits: {error}"
    if clock.sync is Sync.EDGE:
        return f"limited by the kernel's stamps of the line: {error}"
    if clock.sync is Sync.ARRIVAL and not clock.t_err_ns:  # no sample came yet
        return TOO_FEW
    if clock.sync is Sync.ARRIVAL:
        return f"the device's time is not used, so arrivals are all there is: {error}; wire SOUT if it has one"
    return _of_arrivals(clock, sorted(behind_ns))


def miswired(clock: ClockStatus) -> str:
    """Judge the wiring of the lines by their counts since start, in one sentence; empty when they fit the samples."""
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
    """Judge the link by the spread of arrivals."""
    if len(ordered) < ENOUGH:
        return TOO_FEW
    spread_ns = ordered[int(0.99 * len(ordered))] - ordered[int(0.01 * len(ordered))]
    spread = f"arrivals spread over {spread_ns / NS_PER_MS:.1f} ms"
    if clock.hold_ns and spread_ns >= HELD_SHARE * clock.hold_ns:
        timer = f"{clock.hold_ns / NS_PER_MS:.0f} ms"
        return f"{spread}: the USB adapter's latency timer of {timer}; `low_latency: true`, another adapter, or SOUT"
    if spread_ns > LOADED_NS:
        return f"{spread}, and no latency timer explains it: a loaded system; give imud a higher priority, or wire SOUT"
    return f"{spread}; the constant delay between measuring and sending stays unseen without SOUT"


CLOCK = CliCommand(add_arguments, run)
