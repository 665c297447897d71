"""`imud sim`: simulate a device on a pseudo-terminal, or devices on a CAN interface, without a sensor."""

import argparse

from imud.cli.arguments import CliCommand
from imud.sim.__main__ import run_simulator
from imud.sim.control import add_arguments


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C or the command `quit`. Return 2 for unsupported options, otherwise 0."""
    return run_simulator(args, stays=True)


SIM = CliCommand(add_arguments, run)
