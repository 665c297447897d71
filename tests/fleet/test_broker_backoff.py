"""Random pauses that grow, and the order of the brokers."""

import random

import pytest

from imud.fleet.broker import FIRST_S, STABLE_NS, BrokerTurn
from imud.fleet.settings import Broker

A, B = (Broker(name, 1883, False, False, "") for name in "ab")


def longest(_low: float = 0.0) -> float:
    return 1.0


def test_pauses_double_up_to_the_maximum() -> None:
    turn = BrokerTurn([A], 60.0, longest)
    assert [turn.failed(0) for _ in range(6)] == [4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    for _ in range(1100):  # 2.0 to the power of this number exceeds a float
        assert turn.failed(0) == 60.0
    draw = random.Random(25).random
    pauses = [BrokerTurn([A], 60.0, draw).failed(0) for _ in range(500)]
    in_second = [sum(second <= pause < second + 1 for pause in pauses) for second in range(4)]
    assert sum(in_second) == 500
    assert max(in_second) < 170


def test_brokers_take_turns() -> None:
    turn = BrokerTurn([A, B], 60.0, longest)
    seen, pauses = [], []
    for _ in range(4):
        seen.append(turn.broker)
        pauses.append(turn.failed(0))
    assert seen == [A, B, A, B]
    assert pauses == [4.0, 4.0, 8.0, 8.0]
    turn = BrokerTurn([A, B], 60.0, longest)
    turn.failed(0)
    assert turn.broker == B
    turn.connected(0)
    turn.failed(STABLE_NS)
    assert turn.broker == B
    turn.failed(STABLE_NS)
    assert turn.broker == A


@pytest.mark.parametrize(("held_ns", "pause_s"), [(STABLE_NS, FIRST_S), (STABLE_NS - 1, 32.0)])
def test_only_a_stable_connection_resets_the_pause(held_ns: int, pause_s: float) -> None:
    turn = BrokerTurn([A], 60.0, longest)
    for _ in range(3):
        turn.failed(0)
    turn.connected(0)
    assert turn.failed(held_ns) == pause_s
