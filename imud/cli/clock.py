"""`imud clock`: show the source, the error and the limiting cause of each device's time stamps."""

import argparse
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from time import monotonic
from typing import Final

from imud.cli.arguments import CliCommand, add_duration, add_socket, connect, statuses
from imud.cli.output import histogram, paragraph
from imud.client.connection import Client
from imud.contracts.status import ClockStatus, DeviceStatus
from imud.host.log import printable_json
from imud.model.errors import ImudError
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US

KEPT: Final = 2000  # number of newest samples in the histogram of a device
REFRESH_S: Final = 1.0
ONCE_S: Final = 2.0  # time to collect samples for one report without a terminal, s
CLEAR: Final = "\x1b[H\x1b[2J"
ENOUGH: Final = 20  # minimum number of arrivals for a verdict about their spread
# Minimum spread of the arrivals, as a share of the latency timer, that the latency timer explains
HELD_SHARE: Final = 0.5
TOO_FEW: Final = "too few samples for a verdict"
# Maximum spread of the arrivals on an idle host, ns. The usual spread is some ten microseconds.
LOADED_NS: Final = NS_PER_MS
EDGES_ENOUGH: Final = 100  # Minimum number of edges for a verdict. imud cannot assign the first edges to samples.
# Maximum share of edges without a sample. Noise and lost samples cause a smaller share. A wrong wire causes 0.5 or
# more.
UNPAIRED_SHARE: Final = 0.1


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument("device", nargs="*", metavar="DEVICE", help="devices to show (default: all)")
    add_duration(parser, "print one report after this time (default without a terminal: 2 s)")
    parser.add_argument("--json", action="store_true", help="print the clocks once, as the socket reports them")


def run(args: argparse.Namespace) -> int:
    """Print the report every second until Ctrl-C, or once after `--duration` or without a terminal.

    Return 1 if no sample arrived, otherwise 0.
    """
    if args.duration is None and not sys.stdout.isatty():
        args.duration = ONCE_S
    with connect(args) as asking:
        chosen = args.device or [status.name for status in statuses(asking)]
        if not chosen and not args.json:
            raise ImudError("the daemon has no device; configure the attached devices with `imud setup`")
        if args.json:
            clocks = {status.name: status.clock for status in statuses(asking) if status.name in chosen}
            print(printable_json(clocks))
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
    """Append the delay from the measurement to the arrival of each sample to `behind`, ns.

    Yield every REFRESH_S, also if no sample arrives. With `duration_s`, return after this time and do not yield.
    """
    begun = drawn = monotonic()
    # the timeout of `next` causes a report while the device is silent
    samples = client.watch(list(behind), timeout_s=REFRESH_S if duration_s is None else min(REFRESH_S, duration_s))
    while True:
        with suppress(TimeoutError):
            sample = next(samples)
            # the deque drops the oldest value
            behind[sample.device].append(sample.t_rx_ns - sample.t_ns)
        now = monotonic()
        if duration_s is not None and now - begun >= duration_s:
            return
        if duration_s is None and now - drawn >= REFRESH_S:
            drawn = now
            yield


def page(devices: list[DeviceStatus], behind: dict[str, deque[int]]) -> str:
    """Format a block for each shown device, and a line for each device that the configuration no longer contains."""
    gone = [f"{name}: no longer in the configuration" for name in behind if name not in {d.name for d in devices}]
    shown = [block(status, behind[status.name]) for status in devices if status.name in behind]
    return "\n\n".join([*shown, *gone])


def block(status: DeviceStatus, behind_ns: deque[int]) -> str:
    clock = status.clock
    lines = paragraph(f"{status.name}: ", str(status.condition)) if status.has_problem else []
    if clock.sync is Sync.ARRIVAL and not clock.t_err_ns:
        return "\n".join([*lines, *paragraph(f"{status.name}: ", miswired(clock) or "no sample yet")])
    lines += [
        f"{status.name}: time stamps by {clock.sync}, error {clock.t_err_ns / NS_PER_US:.1f} µs (one sigma)",
        f"  offset    {clock.offset_ns / NS_PER_S:+.9f} s (host - device), skew {clock.skew_ppm:+.3f} ppm, "
        f"{clock.resets} resets",
        f"  host      CLOCK_MONOTONIC is steered by {clock.steering_ppm:+.1f} ppm",
        f"  residual  {clock.residual_ns / NS_PER_US:.1f} µs (one sigma)",
        *(f"  {name:<10}{words}" for name, words in aids(status)),
        "  causes of the error (one sigma each):",
    ]
    for one in clock.parts:
        lines += paragraph(f"  {one.name:<10}", f"{one.value_ns / NS_PER_US:.1f} µs. {one.message}")
    lines += [
        f"  delay from measurement to arrival, {len(behind_ns)} samples:",
        *histogram([late_ns / NS_PER_US for late_ns in behind_ns], "µs"),
        *paragraph("  verdict   ", verdict(clock, behind_ns)),
    ]
    return "\n".join(lines)


def aids(status: DeviceStatus) -> Iterator[tuple[str, str]]:
    """Yield name and text of each additional time source of the device."""
    clock, lines, utc = status.clock, status.lines, status.utc
    if lines is not None and "sout" in lines.edges:
        yield (
            "SOUT",
            (
                f"{clock.edges} pulses, {clock.edges_unpaired} without a sample;"
                f" {clock.samples_unpaired} samples without a pulse"
            ),
        )
    if lines is not None and lines.sin:
        yield "SIN", f"{lines.triggers} triggers, {clock.triggers_missed} without a sample"
    if utc is not None and (utc.pulses or utc.pulses_ignored):
        yield "PPS", f"{utc.pulses} pulses, {utc.pulses_ignored} ignored because of their interval"
    if clock.reference_error_ns:
        yield "UTC", f"error of the host clock {clock.reference_error_ns / NS_PER_US:.1f} µs (one sigma)"


def verdict(clock: ClockStatus, behind_ns: Sequence[int]) -> str:
    """Return the limiting cause of the time stamp error. `behind_ns`: delays from measurement to arrival."""
    if mistake := miswired(clock):
        return mistake
    error = f"{clock.t_err_ns / NS_PER_US:.1f} µs"
    if clock.sync is Sync.UTC:
        return f"the device sends UTC; the UTC error of the host limits the time stamps: {error}"
    # the GPIO time stamps include the interrupt latency of the kernel
    if clock.sync is Sync.EDGE:
        return f"the kernel's time stamps of the GPIO line limit the time stamps: {error}"
    if clock.sync is Sync.ARRIVAL:
        return f"imud uses arrival times only, not the device time: {error}; connect SOUT if the device has this pin"
    return _of_arrivals(clock, sorted(behind_ns))


def miswired(clock: ClockStatus) -> str:
    """Return a wiring problem that the counters of the GPIO lines show; empty if the counters match the samples."""
    edges, most = clock.edges, UNPAIRED_SHARE * clock.edges
    if edges < EDGES_ENOUGH:
        return ""
    if clock.triggers_missed > most:
        return (
            f"{clock.triggers_missed} triggers on SIN caused no sample: is the wire connected to SIN, does the device "
            "send a frame on a trigger (`output_on_mark`), is the baud rate high enough for the rate?"
        )
    if clock.edges_unpaired > most:
        return (
            f"{clock.edges_unpaired} of {edges} pulses have no sample: is the wire connected to SOUT of this device, "
            "is the pull-down missing, or are frames lost?"
        )
    if clock.samples_unpaired > most:
        return (
            f"{clock.samples_unpaired} samples have no pulse, {edges} pulses in total: "
            "is the wire connected to SOUT_DIV, which sends one pulse for several samples?"
        )
    if clock.sync in (Sync.ARRIVAL, Sync.REGRESSION):
        return (
            f"{edges} edges in total, but imud cannot match them to samples now: do edges still arrive, is the wire "
            "connected to SOUT of this device, or do frames arrive too late for the rate?"
        )
    return ""


def _of_arrivals(clock: ClockStatus, ordered: Sequence[int]) -> str:
    """Return the verdict for the link from the spread of the arrivals."""
    if len(ordered) < ENOUGH:
        return TOO_FEW
    spread_ns = ordered[int(0.99 * len(ordered))] - ordered[int(0.01 * len(ordered))]  # without 1 % outliers per side
    spread = f"the arrivals spread over {spread_ns / NS_PER_MS:.1f} ms"
    if clock.hold_ns and spread_ns >= HELD_SHARE * clock.hold_ns:
        timer = f"{clock.hold_ns / NS_PER_MS:.0f} ms"
        return (
            f"{spread} because of the latency timer of the USB adapter, {timer}; set `low_latency: true`, use another "
            "adapter, or connect SOUT"
        )
    if spread_ns > LOADED_NS:
        return (
            f"{spread}, and a latency timer does not explain it: the host is loaded; give imud a higher priority, or "
            "connect SOUT"
        )
    return f"{spread}; without SOUT, imud cannot measure the constant delay from measurement to transmission"


CLOCK = CliCommand(add_arguments, run)
