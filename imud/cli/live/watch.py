"""`imud watch`: print samples as they come, as a table for people, as JSON lines, or as CSV."""

import argparse
import sys
from collections.abc import Callable, Iterable
from time import monotonic
from typing import Final, Protocol

from imud.cli.arguments import CliCommand, add_socket
from imud.cli.live.fields import as_csv, as_json, chosen_fields, csv_head
from imud.cli.live.following import LOOK_S, DeviceNotes, keep_connected
from imud.cli.live.table import SampleTable
from imud.cli.streams import raise_if_unread
from imud.client import Client
from imud.frames.conventions import Convention
from imud.sample import SAMPLE_FIELDS, Sample

TABLE_HZ: Final = 10.0
"""Rate of the table without `--rate`: more cannot be read."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud watch`."""
    add_socket(parser)
    parser.add_argument("device", nargs="*", metavar="DEVICE", help="devices to watch (default: all)")
    parser.add_argument(
        "--rate", type=float, default=None, metavar="HZ",
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
        "--latency", type=float, default=None, metavar="MS",
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


class SampleOutput(Protocol):
    """A format of samples."""

    def begin(self, devices: Iterable[str]) -> str:
        """Return what precedes the samples of these devices; called with every connection."""
        ...

    def text(self, sample: Sample) -> str:
        """Format a sample, with its line end."""
        ...


class _Table:
    def __init__(self, fields: tuple[str, ...] | None) -> None:
        self._table = SampleTable(fields)

    def begin(self, devices: Iterable[str]) -> str:
        self._table.add_devices(devices)
        return ""

    def text(self, sample: Sample) -> str:
        return self._table.text(sample)


class _JsonLines:
    def __init__(self, fields: tuple[str, ...] | None) -> None:
        self._fields = fields

    def begin(self, _devices: Iterable[str]) -> str:
        return ""

    def text(self, sample: Sample) -> str:
        return as_json(sample, self._fields) + "\n"


class _Csv:
    def __init__(self, fields: tuple[str, ...] | None) -> None:
        self._fields = SAMPLE_FIELDS if fields is None else fields
        self._begun = False

    def begin(self, _devices: Iterable[str]) -> str:
        begun, self._begun = self._begun, True
        return "" if begun else csv_head(self._fields)

    def text(self, sample: Sample) -> str:
        return as_csv(sample, self._fields)


OUTPUTS: Final[dict[str, Callable[[tuple[str, ...] | None], SampleOutput]]] = {
    "table": _Table,
    "json": _JsonLines,
    "csv": _Csv,
}
"""What makes each format, of these fields or of all."""


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
