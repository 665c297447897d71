"""`imud status`: state, rate, clock, losses and ledger of each device."""

import argparse

import msgspec

from imud.cli.connect import add_socket, connect, statuses
from imud.kit.status import DeviceStatus, PollingStatus
from imud.ledger import bytes_open, frames_open
from imud.units import NS_PER_MS, NS_PER_US


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud status`."""
    add_socket(parser)
    parser.add_argument("--json", action="store_true", help="everything, as the socket sends it")


def run(args: argparse.Namespace) -> int:
    """Print one block per device; 1 when a ledger does not close or a device does not run."""
    with connect(args) as client:
        devices = statuses(client)
    if args.json:
        print(msgspec.json.encode(devices).decode())
    else:
        print("\n\n".join(block(device) for device in devices))
    return 0 if all(d.state in ("running", "finished") and closes(d.ledger) for d in devices) else 1


def block(status: DeviceStatus) -> str:
    """One device for people."""
    clock, ledger = status.clock, status.ledger
    words = " ".join(dict.fromkeys(status.identity.values())) or "not known"
    lines = [
        f"{status.name}: {status.state}" + (f" ({status.problem})" if status.problem else ""),
        f"  link      {status.link}, driver {status.driver}, opened {status.connects} times",
        f"  identity  {words}",
        f"  rate      {status.rate_hz:.1f} Hz seen, {status.expected_rate_hz:.1f} Hz by the device's clock",
        f"  clock     {clock.sync}, skew {clock.skew_ppm:+.2f} ppm, residual {clock.residual_ns / NS_PER_US:.1f} µs, "
        f"error {clock.t_err_ns / NS_PER_MS:.3f} ms, {clock.resets} resets",
        f"  latency   {latency(status)}",
        f"  samples   {ledger['samples']}; lost {sum(v for k, v in ledger.items() if k.startswith('lost_'))}"
        f" (device {ledger['lost_gap_device']}, damaged {ledger['lost_crc']},"
        f" overrun {ledger['lost_overrun']}, queue {ledger['lost_queue']})",
        f"  bytes     {ledger['bytes_in']} = {ledger['bytes_in_good_frames']} in good frames"
        f" + {ledger['bytes_in_bad_frames']} in bad frames + {ledger['bytes_skipped']} skipped"
        f" + {ledger['bytes_pending']} pending: {'closed' if closes(ledger) else 'DOES NOT CLOSE'}",
        f"  kernel    {status.kernel.overrun} overruns, {status.kernel.framing} framing, {status.kernel.parity} parity",
    ]
    if status.polling is not None:
        lines.append(f"  polling   {polling(status.polling)}")
    return "\n".join(lines)


def polling(polls: PollingStatus) -> str:
    """How the reading of a polled device goes."""
    return (
        f"{polls.polls} reads, {polls.late} late, {polls.missed} missed, {polls.stale} stale, {polls.failed} failed;"
        f" {polls.late_mean_ns / NS_PER_US:.1f} µs after the deadline, {polls.late_worst_ns / NS_PER_US:.1f} at worst;"
        f" vanished {polls.vanished} times"
    )


def closes(ledger: dict[str, int]) -> bool:
    """Whether both sums of a ledger as shown are zero."""
    return bytes_open(ledger) == 0 and frames_open(ledger) == 0


def latency(status: DeviceStatus) -> str:
    """Mean time from measurement to publication."""
    count = sum(status.latency_buckets)
    return f"{status.latency_sum_ns / count / NS_PER_MS:.3f} ms mean over {count} samples" if count else "no samples"
