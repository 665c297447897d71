"""`imud devices`: one line per device of the running daemon."""

import argparse

from imud.cli.connect import add_socket, connect, statuses
from imud.cli.table import table

HEAD = ("DEVICE", "STATE", "RATE HZ", "DRIVER", "PRODUCT", "SERIAL NUMBER", "LINK")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud devices`."""
    add_socket(parser)


def run(args: argparse.Namespace) -> int:
    """Print the table; 1 when no device is running."""
    with connect(args) as client:
        devices = statuses(client)
    rows = [
        (
            d.name,
            d.state,
            d.rate_hz,
            d.driver,
            d.identity.get("product", "-"),
            d.identity.get("serial_number", "-"),
            d.link,
        )
        for d in devices
    ]
    print(table(HEAD, rows))
    return 0 if any(d.state == "running" for d in devices) else 1
