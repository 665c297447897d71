"""`imud watch`: print samples as they come, as a table for people, as JSON lines, or as CSV."""

import argparse
import sys
from time import monotonic
from typing import Final

from imud.cli.arguments import CliCommand, add_socket, chosen_fields, finite
from imud.cli.live.following import LOOK_S, DeviceNotes, keep_connected
from imud.cli.live.formats import OUTPUTS, SampleOutput
from imud.cli.streams import raise_if_unread
from imud.client import Client
from imud.frames.conventions import Convention

TABLE_HZ: Final = 10.0
"""Rate of the table without `--rate`: more cannot be read."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud watch`."""
    add_socket(parser)
    parser.add_argument("device", nargs="*", metavar="DEVICE", help="devices to watch (default: all)")
    parser.add_argument(
        "--rate", type=finite, default=None, metavar="HZ",
        help=f"at most this many samples a second each; 0: every sample (default: table {TABLE_HZ:g}, json and csv 0)",
    )  # fmt: skip
    parser.add_argument(
        "--fields", type=str, default=None, metavar="NAME,…",
        help="these fields of a sample, in this order (`imud schema` lists them)",
    )  # fmt: skip
    form = parser.add_mutually_exclusive_group()
    form.add_argument(
        "--format", choices=sorted(OUTPUTS), default="table",
        help="table: local time, degrees, µT; json: an object per line; csv: RFC 4180; both in SI units "
        "(default: %(default)s)",
    )  # fmt: skip
    form.add_argument("--json", dest="format", action="store_const", const="json", help="the same as --format json")
    parser.add_argument(
        "--convention", choices=[str(one) for one in Convention], default=None,
        help="axes and angles of the samples (default: as configured)",
    )  # fmt: skip
    parser.add_argument(
        "--latency", type=finite, default=None, metavar="MS",
        help="samples may be so late, which costs less CPU (default: a period of the rate, at most 20; without one, 0)",
    )  # fmt: skip
    parser.add_argument("--count", type=int, default=None, metavar="N", help="stop after N samples")
    parser.add_argument(
        "--follow", action="store_true", help="wait for the daemon where it does not run, and go on after its restarts"
    )


def run(args: argparse.Namespace) -> int:
    """Print until interrupted, until N samples came, or until the daemon ends; with `--follow` also after that."""
    fields = None if args.fields is None else chosen_fields(args.fields)
    watching = _Watching(args, OUTPUTS[args.format](fields))
    keep_connected("imud watch", args.socket, watching.work, follow=args.follow)
    return 0


class _Watching:
    """What goes on from one connection to the next: the output, and how many samples are left."""

    def __init__(self, args: argparse.Namespace, output: SampleOutput) -> None:
        self._args = args
        self._output = output
        self._left: int | None = args.count
        rate_hz: float | None = args.rate
        self._rate_hz = TABLE_HZ if rate_hz is None and args.format == "table" else rate_hz

    def work(self, client: Client) -> None:
        """Print the samples of one connection."""
        args = self._args
        samples = client.watch(
            args.device or None, rate_hz=self._rate_hz, timeout_s=LOOK_S, convention=args.convention,
            latency_ms=args.latency,
        )  # fmt: skip
        notes = DeviceNotes(client, args.device)
        samples.on_dropped = notes.add_dropped
        self._write(self._output.begin(samples.device_ids))
        while self._left is None or self._left > 0:
            notes.look(monotonic())
            try:
                sample = next(samples)
            except TimeoutError:  # silence: its reason is looked for
                raise_if_unread()
                continue
            self._write(self._output.text(sample))
            if self._left is not None:
                self._left -= 1

    @staticmethod
    def _write(text: str) -> None:
        sys.stdout.write(text)
        sys.stdout.flush()


WATCH = CliCommand(add_arguments, run)
