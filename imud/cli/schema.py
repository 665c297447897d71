"""`imud schema`: what the fields of a sample mean, in which units and frames, and how drivers differ in that."""

import argparse
from typing import Final, NamedTuple

import msgspec

from imud.cli.arguments import CliCommand
from imud.cli.output import table
from imud.drivers import DRIVERS
from imud.model.sample import SAMPLE_SCHEMA

FIELD_HEAD: Final = ("FIELD", "TYPE", "UNIT", "FRAME", "MEANING")
DRIVER_HEAD: Final = ("DRIVER", "NAVIGATION FRAME", "EULER ANGLES")
STATUS_HEAD: Final = ("DRIVER", "STATUS BIT", "MEANING WHILE IT IS SET")


class DriverSchema(NamedTuple):
    """What the values of a driver's samples mean where drivers differ."""

    navigation_frame: str
    euler_convention: str
    status_bits: dict[str, str]
    """Names of the bits of `status` by number."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud schema`."""
    parser.add_argument("--json", action="store_true", help="one JSON object")


def run(args: argparse.Namespace) -> int:
    """Print the fields and each driver's conventions. Needs no daemon."""
    drivers = driver_schemas()
    if args.json:
        objects = {name: one._asdict() for name, one in drivers.items()}
        print(msgspec.json.encode({"fields": SAMPLE_SCHEMA, "drivers": objects}).decode())
    else:
        print(page(drivers))
    return 0


def driver_schemas() -> dict[str, DriverSchema]:
    """Return the conventions of every driver by its name."""
    return {
        name: DriverSchema(
            driver.navigation_frame, driver.euler_convention,
            {str(number): bit.name for number, bit in driver.status_bits.items()},
        )
        for name, driver in DRIVERS.items()
    }  # fmt: skip


def page(drivers: dict[str, DriverSchema]) -> str:
    """Format the fields, the conventions and the status bits as tables."""
    bits = [(name, number, words) for name, one in drivers.items() for number, words in one.status_bits.items()]
    return "\n\n".join(
        [
            table(FIELD_HEAD, [(f.name, f.type, f.unit, f.frame, f.meaning) for f in SAMPLE_SCHEMA]),
            table(DRIVER_HEAD, [(name, one.navigation_frame, one.euler_convention) for name, one in drivers.items()]),
            table(STATUS_HEAD, bits),
        ]
    )


SCHEMA = CliCommand(add_arguments, run)
