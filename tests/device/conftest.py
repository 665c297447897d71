"""Fixtures of tests/device."""

from tests.support.leaks import _no_open_descriptor

__all__ = ["_no_open_descriptor"]
