"""`imud schema`: the fields of a sample, with units and frames."""

import argparse

from imud.cli.connect import add_socket

HEAD = ("FIELD", "TYPE", "UNIT", "MEANING")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud schema`."""
    add_socket(parser)
    parser.add_argument("--json", action="store_true", help="as the socket sends it")
