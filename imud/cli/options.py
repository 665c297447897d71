"""`--option NAME=VALUE`: settings of a driver on the command line, those that stand below `options` of a device."""

import argparse
from collections.abc import Mapping, Sequence

import msgspec

from imud.cli.command import argument
from imud.config.keys import choose
from imud.contracts.driver import Driver
from imud.contracts.settings import Settings, expected, got
from imud.errors import BadArgument


def add_option(parser: argparse.ArgumentParser) -> None:
    """The argument, which may be given several times."""
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the driver, as below `options` in the configuration; may be given several times",
    )


def given_options(driver: Driver, words: Sequence[str]) -> dict[str, object]:
    """The options by name, each checked. Raises BadArgument naming what was expected."""
    options = dict(map(argument, words))
    fields = {field.name: field for field in msgspec.structs.fields(driver.settings)}
    for name, value in options.items():
        if name not in fields:
            raise BadArgument(f"--option {name}: {choose(f'an option of {driver.name}', name, list(fields))}")
        try:
            msgspec.convert(value, fields[name].type)
        except msgspec.ValidationError:
            raise BadArgument(f"--option {name}: expected {expected(fields[name].type)}, got {got(value)}") from None
    return options


def driver_settings(driver: Driver, options: Mapping[str, object]) -> Settings:
    """The driver's settings with these options. Raises BadArgument for some that do not go together."""
    try:
        return msgspec.convert(options, driver.settings)
    except msgspec.ValidationError as error:
        raise BadArgument(f"--option: {error}") from None
