"""The comparison of two checkouts; the measurements themselves are no part of `make test`."""

import subprocess

import pytest

from tests.bench.compare import Compared, checked_out, compare


def test_medians_of_what_both_have_are_compared() -> None:
    base = [{"clock": 20.0, "old": 1.0}, {"clock": 30.0, "old": 1.0}, {"clock": 22.0, "old": 1.0}]
    here = [{"new": 1.0, "clock": 11.0}, {"new": 1.0, "clock": 99.0}, {"new": 1.0, "clock": 10.0}]
    assert compare(base, here) == [Compared("clock", 22.0, 11.0)]


def test_a_line_has_the_ratio_of_here_to_base() -> None:
    assert str(Compared("clock", 22.0, 11.0)).endswith(" 0.500")
    assert str(Compared("samples lost", 0.0, 0.0)).endswith("–")


def test_a_commit_that_is_not_known_is_refused() -> None:
    with pytest.raises(subprocess.CalledProcessError), checked_out("no-such-commit"):
        raise AssertionError("it was checked out")
