"""`imud check`: read a configuration file as the daemon would, and say what is wrong with it."""

import argparse
from pathlib import Path

from imud import config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud check`."""
    parser.add_argument("file", type=Path, metavar="FILE", help="configuration file")


def run(args: argparse.Namespace) -> int:
    """Print one line when the file is good; the error with line and column goes to standard error."""
    settings = config.load(args.file)
    names = ", ".join(device.name for device in settings.devices) or "none"
    print(f"{args.file}: good; devices: {names}")
    return 0
