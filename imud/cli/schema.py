"""`imud schema`: meaning, unit and coordinate frame of the fields of a sample, and the conventions of each driver."""

import argparse
from typing import Final, NamedTuple

from imud.attitude.conventions import AttitudeSource
from imud.cli.arguments import CliCommand
from imud.cli.output import table
from imud.contracts.driver import Driver, status_bits_of
from imud.drivers import DRIVERS
from imud.host.log import printable_json
from imud.model.sample import SAMPLE_SCHEMA

FIELD_HEAD: Final = ("FIELD", "TYPE", "UNIT", "FRAME", "MEANING")
DRIVER_HEAD: Final = ("DRIVER", "ATTITUDE", "NAVIGATION FRAME", "EULER ANGLES")
STATUS_HEAD: Final = ("DRIVER", "STATUS BIT", "MEANING IF SET")


class DriverSchema(NamedTuple):
    """Conventions of the samples of one driver."""

    navigation_frame: str
    euler_convention: str
    status_bits: dict[str, str]  # names of the bits of `status`, by bit number
    attitude: str  # source of the attitude: `device`, or `host` if only imud can compute it (key `attitude: host`)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(args: argparse.Namespace) -> int:
    """Print the fields and the conventions of each driver. The daemon does not need to run."""
    drivers = driver_schemas()
    if args.json:
        objects = {name: one._asdict() for name, one in drivers.items()}
        print(printable_json({"fields": SAMPLE_SCHEMA, "drivers": objects}))
    else:
        print(page(drivers))
    return 0


def driver_schemas() -> dict[str, DriverSchema]:
    """Return the conventions of all drivers by name."""
    return {
        name: DriverSchema(
            driver.navigation_frame, driver.euler_convention,
            {str(number): bit.name for number, bit in status_bits_of(driver, source).items()}, source,
        )
        for name, driver in DRIVERS.items()
        for source in [_source(driver)]
    }  # fmt: skip


def _source(driver: Driver) -> AttitudeSource:
    return AttitudeSource.DEVICE if driver.sends_attitude(driver.settings()) else AttitudeSource.HOST


def page(drivers: dict[str, DriverSchema]) -> str:
    """Format the fields, the conventions and the status bits as tables."""
    bits = [(name, number, words) for name, one in drivers.items() for number, words in one.status_bits.items()]
    return "\n\n".join(
        [
            table(FIELD_HEAD, [(f.name, f.type, f.unit, f.frame, f.meaning) for f in SAMPLE_SCHEMA]),
            table(
                DRIVER_HEAD,
                [(name, one.attitude, one.navigation_frame, one.euler_convention) for name, one in drivers.items()],
            ),
            table(STATUS_HEAD, bits),
        ]
    )


SCHEMA = CliCommand(add_arguments, run)
