"""`imud noise`: noise of a device at rest, in the units of data sheets. `imud spectrum`: vibration by frequency."""

import argparse
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from imud.cli.arguments import CliCommand, add_driver, add_duration, add_interface, add_option, add_socket, duration_s
from imud.cli.output import complain
from imud.host.installation import needs_extra
from imud.host.log import printable_json
from imud.model.errors import BadArgument

BAND: Final = re.compile(r"(\d+(?:\.\d*)?)-(\d+(?:\.\d*)?)")
SENSORS: Final = ("accel", "gyro")


def bands_hz(text: str) -> tuple[tuple[float, float], ...]:
    """Parse frequency bands, for example `5-50,50-200`. Raises ArgumentTypeError if the text has another form."""
    found = [BAND.fullmatch(one.strip()) for one in text.split(",")]
    if not all(found):
        raise argparse.ArgumentTypeError(f"expected bands in Hz, for example 5-50,50-200, got {text!r}")
    return tuple((float(one[1]), float(one[2])) for one in found if one is not None)


def common_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of both commands."""
    add_socket(parser)
    parser.add_argument("input", metavar="FILE|DEVICE", help="recording, capture, or device of the running daemon")
    add_duration(parser, "length of the analysed part (default: the complete file; a device until Ctrl-C)")
    parser.add_argument(
        "--skip", type=duration_s, metavar="DURATION",
        help="ignore the samples of this time at the start, for example while the device warms up",
    )  # fmt: skip
    parser.add_argument("--device", metavar="NAME", help="device in a recording of several devices")
    add_driver(parser, "driver for a capture (default: hipnuc-uart)")
    parser.add_argument("--baud", type=int, help="baud rate of a raw capture (default: 115200)")
    add_option(parser)
    add_interface(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object in SI units")


def noise_arguments(parser: argparse.ArgumentParser) -> None:
    common_arguments(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="write a report to a file: .html (self-contained), .svg, .png"
    )
    parser.add_argument(
        "--sheet", type=Path, metavar="FILE", help="YAML file with the values of a data sheet, for a comparison"
    )


def spectrum_arguments(parser: argparse.ArgumentParser) -> None:
    common_arguments(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write a picture to a file: .svg, .png")
    parser.add_argument(
        "--sensor", choices=SENSORS, help="analyse this sensor only (default: both; live: the accelerometer)"
    )
    parser.add_argument(
        "--resolution", type=float, metavar="HZ", help="distance of two frequencies (default: by the number of samples)"
    )
    parser.add_argument(
        "--bands", type=bands_hz, metavar="HZ-HZ,…", help="frequency bands of the RMS (default: octaves)"
    )


def loaded(name: str) -> Any:
    """Import a module of `imud.cli` that needs the extra. Raises BadArgument if a library of the extra is missing."""
    with needs_extra("analysis"):
        return import_module(f"imud.cli.{name}")


def noise(args: argparse.Namespace) -> int:
    """Print the noise of a device. With `-o`, write a report file."""
    module = loaded("noise")
    # check the arguments first: samples of a live device take minutes
    kind = module.kind_of(args.output) if args.output is not None else ""
    given = module.read_sheet(args.sheet) if args.sheet is not None else None
    sample_set = take(args)
    product = sample_set.identity.get("product", "")
    report = module.noise_report(sample_set, module.figures_for(sample_set.sheet, product, given))
    if args.output is not None:
        module.write_file(args.output, module.noise_file(report, kind))
    show(args, report, module)
    if report.motion:
        complain(f"imud noise: the device was not at rest: {report.motion}; measure again with the device at rest")
        return 1
    return 0


def spectrum(args: argparse.Namespace) -> int:
    """Print the vibration of a device. With `-o`, write a picture.

    Without a duration, redraw the spectrum of a live device on a terminal until Ctrl-C.
    """
    module, files = loaded("spectrum"), loaded("noise")
    kind = files.kind_of(args.output) if args.output is not None else ""
    if kind == ".html":
        raise BadArgument(f"{args.output}: expected a file name that ends in .svg or .png")
    sensors = SENSORS if args.sensor is None else (args.sensor,)
    options = module.SpectrumOptions(sensors, args.resolution, args.bands)
    if is_live(args) and args.duration is None and not args.json and args.output is None and sys.stdout.isatty():
        return int(module.live(args, options))
    report = module.spectrum_report(take(args), options)
    if args.output is not None:
        files.write_file(args.output, module.spectrum_file(report, kind))
    return show(args, report, module)


def is_live(args: argparse.Namespace) -> bool:
    """Return whether the input is a device. If a file of this name exists, the input is the file."""
    return not Path(args.input).exists()


def take(args: argparse.Namespace) -> Any:
    """Read the samples. Raises BadArgument if the input is a device and an option applies to files only."""
    samples = loaded("sample_set")
    if not is_live(args):
        return samples.take_file(args)
    for option, default in (
        ("device", None), ("driver", None), ("baud", None), ("option", []), ("interface", None),
    ):  # fmt: skip
        # daemon and recording define these values for live samples
        if getattr(args, option) != default:
            raise BadArgument(f"--{option} applies to files only; the file {args.input} does not exist")
    return samples.take_live(args, samples.progress)


def show(args: argparse.Namespace, report: Any, module: Any) -> int:
    """Print a report. Return the exit status."""
    text: Callable[[Any], str] = module.text
    print(printable_json(module.as_object(report)) if args.json else text(report))
    return 0


NOISE = CliCommand(noise_arguments, noise)
SPECTRUM = CliCommand(spectrum_arguments, spectrum)
