"""Fixtures of these tests."""

from tests.support.leaks import _no_open_descriptor

__all__ = ["_no_open_descriptor"]
