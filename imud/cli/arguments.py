"""Parts that several commands share: the type of a command, the daemon's socket, and arguments `NAME=VALUE`."""

import argparse
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from math import hypot, isfinite, nan, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from imud.client.connection import Client, default_path
from imud.contracts.status import Deviations, DeviceStatus
from imud.host.files import read_regular
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.model.options import Options, unknown_name, value_problem, wrong_values
from imud.model.sample import SAMPLE_FIELDS

FILE_BYTES_MAX: Final = 64 << 20
"""A report has every point of its curves: some MB."""


class _Spread(msgspec.Struct):
    """Standard deviation of the samples of one axis, SI."""

    value: float


class _Axis(msgspec.Struct):
    spread: _Spread


class _Sensor(msgspec.Struct):
    axes: dict[str, _Axis]


class _Measurement(msgspec.Struct):
    device: str


class _Report(msgspec.Struct):
    """The members of the report that are used."""

    measurement: _Measurement
    sensors: dict[str, _Sensor]


def read_noise(path: Path) -> tuple[str, Deviations]:
    """Return the device of a report, and the deviations of its sensors: the quadratic mean of the three axes'.

    The standard deviation of samples at rest has in it what drifted during the measurement. Raises ImudError.
    """
    try:
        report = msgspec.json.decode(read_regular(path, FILE_BYTES_MAX), type=_Report)
    except (OSError, ValueError) as error:
        raise ImudError(f"{path}: expected a report of `imud noise --json`: {reason_of(error)}") from error
    return report.measurement.device, Deviations(
        accel_m_s2=_sigma(report.sensors.get("accel")), gyro_rad_s=_sigma(report.sensors.get("gyro"))
    )


def _sigma(sensor: _Sensor | None) -> float | None:
    """None for a sensor that was not measured, or whose values never changed."""
    if sensor is None or not sensor.axes:
        return None
    spreads = [axis.spread.value for axis in sensor.axes.values()]
    return hypot(*spreads) / sqrt(len(spreads)) or None


if TYPE_CHECKING:  # what drivers promise takes as long to import as all that `imud status` needs
    from imud.contracts.driver import Driver
    from imud.contracts.status import Deviations

SECONDS_OF: Final = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
DURATION: Final = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)")


class CliCommand(NamedTuple):
    """One command of the command line."""

    add_arguments: Callable[[argparse.ArgumentParser], None]
    """Adds its arguments to its parser."""
    run: Callable[[argparse.Namespace], int]
    """Carries it out and returns the exit status. Raises ImudError."""


# --- the running daemon ---------------------------------------------------------------------------------------------


def add_socket(parser: argparse.ArgumentParser) -> None:
    """Add `--socket PATH`, with the environment variable IMUD_SOCKET as its default."""
    parser.add_argument(
        "--socket",
        default=default_path(),
        metavar="PATH",
        help="the daemon's socket (default: $IMUD_SOCKET or %(default)s)",
    )


def connect(args: argparse.Namespace) -> Client:
    """Connect to the daemon. Raises LinkMissing, LinkDenied, ServerError with what to look at."""
    return Client(args.socket)


def statuses(client: Client) -> list[DeviceStatus]:
    """Ask for the status of every device."""
    return msgspec.convert(client.status()["devices"], list[DeviceStatus])


# --- questions ------------------------------------------------------------------------------------------------------


def confirmed(what: str, risk: str, *, yes: bool) -> bool:
    """Ask on the terminal whether to do something; True at once with `yes`. Say so where it is not done.

    Raises BadArgument where there is no terminal to ask on.
    """
    if yes:
        return True
    if not sys.stdin.isatty():
        raise BadArgument(f"{risk}: expected a terminal to ask on, or --yes")
    if input(f"{risk}; {what}? [y/N] ").strip().lower() in ("y", "yes"):
        return True
    print("nothing was done")
    return False


# --- numbers ---------------------------------------------------------------------------------------------------------


def finite(text: str) -> float:
    """Read a number. Raises ArgumentTypeError, also for infinity and for what is not a number."""
    try:
        number = float(text)
    except ValueError:
        number = nan
    if not isfinite(number):
        raise argparse.ArgumentTypeError(f"expected a number, got {text!r}")
    return number


PORT_MAX: Final = 65535


def check_port(port: int) -> None:
    """Check the `--port` of a server, 0 for any. Raises BadArgument."""
    if not 0 <= port <= PORT_MAX:
        raise BadArgument(f"--port: expected 0 to {PORT_MAX}, got {port}")


# --- durations ----------------------------------------------------------------------------------------------------


def duration_s(text: str) -> float:
    """Read a duration, for example `10min`, `90s` or `2h`; a number alone is seconds. Raises ArgumentTypeError."""
    found = DURATION.fullmatch(text.strip())
    seconds = float(found[1]) * SECONDS_OF.get(found[2], 0.0) if found is not None else 0.0
    if not seconds or not isfinite(seconds):  # so many digits that they are infinity
        raise argparse.ArgumentTypeError(f"expected a duration as 90s, 10min or 2h, got {text!r}")
    return seconds


# --- NAME=VALUE -----------------------------------------------------------------------------------------------------


def argument(text: str) -> tuple[str, object]:
    """Parse `name=value`: numbers, true, false, null and lists as in JSON, everything else text. Raises BadArgument."""
    name, sign, value = text.partition("=")
    if not name or not sign:
        raise BadArgument(f"expected NAME=VALUE, got {text!r}")
    try:
        return name, msgspec.json.decode(value)
    except msgspec.DecodeError:
        return name, value


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add an argument that may be given several times."""
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the driver, as below `options` in the configuration; may be given several times",
    )


def given_options(driver: "Driver", words: Sequence[str]) -> dict[str, object]:
    """Check the options; return them by name. Raises BadArgument naming what was expected."""
    options = dict(map(argument, words))
    fields = {field.name: field for field in msgspec.structs.fields(driver.settings)}
    for name, value in options.items():
        if name not in fields:
            raise BadArgument(f"--option {name}: {unknown_name(f'an option of {driver.name}', name, list(fields))}")
        if problem := value_problem(value, fields[name].type):
            raise BadArgument(f"--option {name}: {problem}")
    return options


def driver_settings(driver: "Driver", options: Mapping[str, object]) -> Options:
    """Make the driver's settings from these options. Raises BadArgument for options that exclude each other."""
    for wrong in wrong_values(driver.settings, options, "option"):
        raise BadArgument(f"--option {wrong}")
    return msgspec.convert(options, driver.settings)


# --- noise ------------------------------------------------------------------------------------------------------------


def add_noise(parser: argparse.ArgumentParser) -> None:
    """Add the option --noise."""
    parser.add_argument(
        "--noise", action="append", type=Path, default=[], metavar="REPORT",
        help="report of `imud noise --json`: its standard deviations become covariances; may be given several times",
    )  # fmt: skip


def noise_by_device(reports: Sequence[Path]) -> "dict[str, Deviations]":
    """Return what reports say, by the name of the device; of two of one device the later wins. Raises ImudError."""
    # not part of every command's start

    return dict(map(read_noise, reports))


# --- samples ----------------------------------------------------------------------------------------------------------


def chosen_fields(text: str) -> tuple[str, ...]:
    """Return the names in a list separated by commas, in its order. Raises BadArgument for one that is not known."""
    names = tuple(name.strip() for name in text.split(","))
    for number, name in enumerate(names):
        if name not in SAMPLE_FIELDS:
            raise BadArgument(f"--fields: {unknown_name('a field', name, SAMPLE_FIELDS)} (`imud schema` explains them)")
        if name in names[:number]:
            raise BadArgument(f"--fields: expected each field once, got {name} twice")
    return names
