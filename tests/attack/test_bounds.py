"""`make attack` reports each exceeded limit."""

from dataclasses import replace

import pytest

from tests.attack.bounds import FDS_LEFT_LIMIT, FDS_LIMIT, P99_LIMIT_MS, RSS_LIMIT_MB, Measured, exceeded
from tests.attack.hostile import Deeds

GOOD = Measured(Deeds(256), samples=1000)
AT_THE_BOUNDS = replace(
    GOOD, reply_p99_ms=P99_LIMIT_MS, sample_p99_ms=P99_LIMIT_MS, above_mb=RSS_LIMIT_MB, fds=FDS_LIMIT,
    fds_left=FDS_LEFT_LIMIT, ledger_lost=1,
)  # fmt: skip
STARVED = replace(GOOD, stops=4, lost=400, port_refused=400, ledger_lost=400, reply_p99_ms=700.0, sample_p99_ms=700.0)


def test_kept() -> None:
    for seen in (GOOD, AT_THE_BOUNDS, STARVED, replace(STARVED, lost=410, dropped=10)):
        assert exceeded(seen) == []
    assert exceeded(replace(GOOD, reply_p99_ms=9.0, sample_p99_ms=9.0), delays=False) == []


@pytest.mark.parametrize(
    ("seen", "problem"),
    [
        (replace(GOOD, lost=1, dropped=1), "1 samples lost, 1 of them dropped"),
        (replace(GOOD, port_refused=1), "1 rejected by the port"),
        (replace(GOOD, samples=0), "no samples"),
        (replace(GOOD, reply_p99_ms=5.1), "replies 5.1 ms, expected at most 5 ms"),
        (replace(GOOD, sample_p99_ms=5.1), "samples 5.1 ms, expected at most 5 ms"),
        (replace(GOOD, above_mb=RSS_LIMIT_MB + 1), "memory above idle"),
        (replace(GOOD, fds=FDS_LIMIT + 1), "descriptors above idle 1345, expected at most 1344"),
        (replace(GOOD, fds_left=FDS_LEFT_LIMIT + 1), "descriptors left over"),
        (replace(GOOD, failed=1), "errors in the daemon"),
        (replace(GOOD, ledger_lost=2), "the ledger has 2 lost samples, the port rejected 0"),
        (replace(GOOD, ledger_unknown=1), "1 gaps of unknown size"),
        (replace(STARVED, ledger_lost=398), "the ledger has 398 lost samples, the port rejected 400"),
        (replace(STARVED, ledger_lost=402), "expected a difference of at most 1"),
        (replace(STARVED, lost=402), "the good client missed 402 samples"),
    ],
)
def test_exceeded(seen: Measured, problem: str) -> None:
    (found,) = exceeded(seen)
    assert problem in found
