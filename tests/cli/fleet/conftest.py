"""The fixtures of `tests/fleet`."""

from tests.fleet.conftest import broker

__all__ = ["broker"]
