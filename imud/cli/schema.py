"""`imud schema`: the fields of a sample with units and frames, and each driver's conventions. Needs no daemon."""

import argparse

import msgspec

from imud.cli.table import table
from imud.devices import DRIVERS
from imud.sample import SAMPLE_SCHEMA

FIELD_HEAD = ("FIELD", "TYPE", "UNIT", "FRAME", "MEANING")
DRIVER_HEAD = ("DRIVER", "NAVIGATION FRAME", "EULER ANGLES")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud schema`."""
    parser.add_argument("--json", action="store_true", help="one JSON object")


def run(args: argparse.Namespace) -> int:
    """Print both tables."""
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
