"""`imud watch`: print samples as they come; `imud schema`: what their fields mean, in which units and frames."""

import argparse
from typing import Final

import msgspec

from imud.cli.arguments import CliCommand, add_socket, connect
from imud.cli.output import table
from imud.devices import DRIVERS
from imud.frames.conventions import Convention
from imud.sample import SAMPLE_SCHEMA, Sample
from imud.units import NS_PER_MS, NS_PER_S, RAD_PER_DEG

FIELD_HEAD: Final = ("FIELD", "TYPE", "UNIT", "FRAME", "MEANING")
DRIVER_HEAD: Final = ("DRIVER", "NAVIGATION FRAME", "EULER ANGLES")


def watch_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud watch`."""
    add_socket(parser)
    parser.add_argument("device", nargs="*", metavar="DEVICE", help="devices to watch (default: all)")
    parser.add_argument(
        "--rate", type=float, default=None, metavar="HZ", help="at most this many samples a second each"
    )
    parser.add_argument(
        "--convention", choices=[str(one) for one in Convention], default=None,
        help="axes and angles of the samples (default: as configured)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="one JSON object per line, SI units")
    parser.add_argument("--count", type=int, default=None, metavar="N", help="stop after N samples")


def watch(args: argparse.Namespace) -> int:
    """Print until interrupted, until N samples came, or until the daemon ends."""
    show = as_json if args.json else as_text
    with connect(args) as client:
        samples = client.watch(args.device or None, rate_hz=args.rate, convention=args.convention)
        for number, sample in enumerate(samples, start=1):
            print(show(sample), flush=True)
            if number == args.count:
                break
    return 0


def as_json(sample: Sample) -> str:
    """Format a sample as the socket sends it."""
    return msgspec.json.encode(sample).decode()


def as_text(sample: Sample) -> str:
    """Format a sample as one line: seconds, degrees, °/s; acceleration stays in m/s²."""
    words = [
        f"{sample.device:12} {sample.t_ns / NS_PER_S:14.6f} s ±{sample.t_err_ns / NS_PER_MS:6.3f} ms {sample.sync:10}"
    ]
    if sample.euler_rad is not None:
        words.append("rpy " + " ".join(f"{a / RAD_PER_DEG:8.3f}" for a in sample.euler_rad) + " °")
    if sample.gyro_rad_s is not None:
        words.append("gyro " + " ".join(f"{w / RAD_PER_DEG:8.3f}" for w in sample.gyro_rad_s) + " °/s")
    if sample.accel_m_s2 is not None:
        words.append("accel " + " ".join(f"{a:7.3f}" for a in sample.accel_m_s2) + " m/s²")
    return "  ".join(words)


def schema_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud schema`."""
    parser.add_argument("--json", action="store_true", help="one JSON object")


def schema(args: argparse.Namespace) -> int:
    """Print the fields and each driver's conventions. Needs no daemon."""
    conventions = {
        name: {"navigation_frame": driver.navigation_frame, "euler_convention": driver.euler_convention}
        for name, driver in DRIVERS.items()
    }
    if args.json:
        print(msgspec.json.encode({"fields": SAMPLE_SCHEMA, "drivers": conventions}).decode())
        return 0
    print(table(FIELD_HEAD, [(f.name, f.type, f.unit, f.frame, f.meaning) for f in SAMPLE_SCHEMA]))
    print()
    print(table(DRIVER_HEAD, [(name, c["navigation_frame"], c["euler_convention"]) for name, c in conventions.items()]))
    return 0


WATCH = CliCommand(watch_arguments, watch)
SCHEMA = CliCommand(schema_arguments, schema)
