"""Common code of the commands: the type of a command, the socket of the daemon, arguments `NAME=VALUE`."""

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import hypot, isfinite, nan, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from imud.contracts.registry import problems_of
from imud.contracts.status import Deviations, DeviceStatus
from imud.formats.jsonrpc import DEFAULT_PATH, default_path
from imud.host.files import read_regular
from imud.model.errors import BadArgument, ImudError, reason_of
from imud.model.options import Options, json_or_text, shown, unknown_name, value_problem, wrong_values
from imud.model.sample import SAMPLE_FIELDS

# Maximum size of a noise report, bytes. A report contains every point of its curves and has a few MB.
FILE_BYTES_MAX: Final = 64 << 20


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
    """Used members of a noise report."""

    measurement: _Measurement
    sensors: dict[str, _Sensor]
    motion: str | None = None


def read_noise(path: Path) -> tuple[str, Deviations]:
    """Return the device and the standard deviations in a report of `imud noise`. Raises ImudError.

    The deviation of a sensor is the quadratic mean of its three axes. It includes the drift during the measurement.
    """
    try:
        report = msgspec.json.decode(read_regular(path, FILE_BYTES_MAX), type=_Report)
    except (OSError, ValueError) as error:
        raise ImudError(f"{path}: expected a report of `imud noise --json`, got: {reason_of(error)}") from error
    if report.motion:
        raise ImudError(f"{path}: expected a measurement at rest, got motion ({report.motion}); measure again at rest")
    return report.measurement.device, Deviations(
        accel_m_s2=_sigma(report.sensors.get("accel")), gyro_rad_s=_sigma(report.sensors.get("gyro"))
    )


def _sigma(sensor: _Sensor | None) -> float | None:
    """Return the deviation of a sensor. None if the report does not contain the sensor, or if all values are equal."""
    if sensor is None or not sensor.axes:
        return None
    spreads = [axis.spread.value for axis in sensor.axes.values()]
    # `or None`: a constant value has no measurable noise
    return hypot(*spreads) / sqrt(len(spreads)) or None


if TYPE_CHECKING:  # importing contracts.driver would double the start time of `imud status`
    from imud.client.connection import Client
    from imud.contracts.driver import Driver

SECONDS_OF: Final = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
DURATION: Final = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)")


class CliCommand(NamedTuple):
    """One command of the command line."""

    add_arguments: Callable[[argparse.ArgumentParser], None]  # adds the arguments of the command to a parser
    run: Callable[[argparse.Namespace], int]  # Runs the command and returns the exit status. Raises ImudError.


# --- the running daemon ---------------------------------------------------------------------------------------------


def add_socket(parser: argparse.ArgumentParser) -> None:
    """Add `--socket PATH`, with the environment variable IMUD_SOCKET as its default."""
    parser.add_argument(
        "--socket",
        default=default_path(),
        metavar="PATH",
        help=f"socket of the daemon (default: $IMUD_SOCKET or {DEFAULT_PATH})",
    )


def connect(args: argparse.Namespace) -> "Client":
    """Connect to the daemon. Raises LinkMissing, LinkDenied or ServerError. The error names the next step."""
    from imud.client.connection import Client  # the daemon does not need it

    return Client(args.socket)


def statuses(client: "Client") -> list[DeviceStatus]:
    """Return the status of every device."""
    from imud.client.connection import decoded

    return decoded(client.status()["devices"], list[DeviceStatus])


# --- questions ------------------------------------------------------------------------------------------------------


def confirmed(operation: str, risk: str, *, yes: bool) -> bool:
    """Ask the user on the terminal to confirm an operation. Return True without a question if `yes` is set.

    Raises BadArgument if standard input is not a terminal.
    """
    if yes:
        return True
    if not sys.stdin.isatty():
        raise BadArgument(f"{risk}: cannot ask for confirmation without a terminal; confirm with --yes")
    if input(f"{risk}; {operation}? [y/N] ").strip().lower() in ("y", "yes"):
        return True
    print("imud changed nothing")
    return False


# --- numbers ---------------------------------------------------------------------------------------------------------


def finite(text: str) -> float:
    """Parse a finite number. Raises ArgumentTypeError for other texts, infinity and NaN."""
    try:
        number = float(text)
    except ValueError:
        number = nan
    if not isfinite(number):
        # argparse prints the message after the name of the argument
        raise argparse.ArgumentTypeError(f"expected a number, got {text!r}")
    return number


PORT_MAX: Final = 65535


def check_port(port: int) -> None:
    """Check the `--port` of a server; 0 selects a free port. Raises BadArgument if the port is out of range."""
    if not 0 <= port <= PORT_MAX:
        raise BadArgument(f"--port: expected 0 to {PORT_MAX}, got {port}")


# --- durations ----------------------------------------------------------------------------------------------------


def duration_s(text: str) -> float:
    """Parse a duration: `10min`, `90s` or `2h`. A number without a unit is in seconds. Raises ArgumentTypeError."""
    found = DURATION.fullmatch(text.strip())
    seconds = float(found[1]) * SECONDS_OF.get(found[2], 0.0) if found is not None else 0.0
    if not seconds or not isfinite(seconds):  # float() returns infinity for more than 308 digits
        raise argparse.ArgumentTypeError(f"expected a duration, for example 90s, 10min or 2h, got {text!r}")
    return seconds


def add_duration(parser: argparse.ArgumentParser, purpose: str) -> None:
    """Add `--duration DURATION`, also as `--for`. The result is `duration`, s, or None."""
    parser.add_argument(
        "--duration", "--for", type=duration_s, metavar="DURATION", help=f"{purpose}; 90s, 10min, 2h or seconds"
    )


# --- NAME=VALUE -----------------------------------------------------------------------------------------------------


def argument(text: str) -> tuple[str, object]:
    """Parse `name=value`. The value is JSON if possible, otherwise a string. Raises BadArgument without `=`."""
    # only the first "=" separates: values can contain "="
    name, sign, value = text.partition("=")
    if not name or not sign:
        raise BadArgument(f"expected NAME=VALUE, got {text!r}")
    return name, json_or_text(value)


def named_values(words: Iterable[str]) -> dict[str, object]:
    """Return the values of the arguments NAME=VALUE by name. Raises BadArgument if a name occurs twice."""
    values: dict[str, object] = {}
    for name, value in map(argument, words):
        if name in values:
            raise BadArgument(f"{name}: expected one value, got {shown(values[name])} and {shown(value)}")
        values[name] = value
    return values


def add_driver(parser: argparse.ArgumentParser, purpose: str, *, required: bool = False) -> None:
    """Add the option `--driver`. `purpose` is its help."""
    from imud.drivers import DRIVERS  # most commands need no driver

    def driver(text: str) -> str:
        if text not in DRIVERS and text in problems_of(DRIVERS):
            raise argparse.ArgumentTypeError(problems_of(DRIVERS)[text])
        return text

    parser.add_argument("--driver", required=required, choices=sorted(DRIVERS), type=driver, help=purpose)


def add_option(parser: argparse.ArgumentParser) -> None:
    """Add `--option NAME=VALUE`."""
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="option of the driver, as in the key `options` of the configuration; repeat for more options",
    )


def add_interface(parser: argparse.ArgumentParser) -> None:
    """Add `--interface`."""
    parser.add_argument("--interface", metavar="NAME", help="interface in a CAN log of several interfaces, as can0")


def chosen_interface(driver: "Driver", interface: str | None) -> str:
    """Return the value of `--interface`; empty if it is not given. Raises BadArgument if the driver is not for CAN."""
    from imud.contracts.driver import CanDriver  # most commands need no driver

    if interface is not None and not isinstance(driver, CanDriver):
        raise BadArgument(f"--interface applies to logs of a CAN bus; {driver.name} is not a driver for CAN")
    return interface or ""


def given_options(driver: "Driver", words: Sequence[str]) -> dict[str, object]:
    """Return the values of `--option` by name. Raises BadArgument if the driver does not accept a name or a value."""
    options = named_values(words)
    fields = {field.name: field for field in msgspec.structs.fields(driver.settings)}
    for name, value in options.items():
        if name not in fields:
            raise BadArgument(f"--option {name}: {unknown_name(f'an option of {driver.name}', name, list(fields))}")
        if problem := value_problem(value, fields[name].type):
            raise BadArgument(f"--option {name}: {problem}")
    return options


def driver_settings(driver: "Driver", options: Mapping[str, object]) -> Options:
    """Return the options object of the driver. Raises BadArgument if two options exclude each other."""
    # the first problem is enough: the user corrects one at a time
    for wrong in wrong_values(driver.settings, options, "option"):
        raise BadArgument(f"--option {wrong}")
    return msgspec.convert(options, driver.settings)


# --- noise ------------------------------------------------------------------------------------------------------------


def add_noise(parser: argparse.ArgumentParser) -> None:
    """Add `--noise REPORT`."""
    parser.add_argument(
        "--noise", action="append", type=Path, default=[], metavar="REPORT",
        help="report of `imud noise --json`; imud publishes its standard deviations as covariances; repeat for more "
        "devices",
    )  # fmt: skip


def noise_by_device(reports: Sequence[Path]) -> dict[str, Deviations]:
    """Return the deviations in the reports by device. The last report of a device wins. Raises ImudError."""
    return dict(map(read_noise, reports))


# --- samples ----------------------------------------------------------------------------------------------------------


def chosen_fields(text: str) -> tuple[str, ...]:
    """Return the field names in a comma-separated list. Raises BadArgument for an unknown or repeated name."""
    names = tuple(name.strip() for name in text.split(","))
    for number, name in enumerate(names):
        if name not in SAMPLE_FIELDS:
            raise BadArgument(
                f"--fields: {unknown_name('a field', name, SAMPLE_FIELDS)}; `imud schema` lists all fields"
            )
        if name in names[:number]:
            raise BadArgument(f"--fields: expected each field once, got {name} twice")
    return names
