"""`imud probe`: list what is attached. Writes nothing to a port that it was not told to ask."""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `imud probe`."""
