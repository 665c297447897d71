"""What intervals cost on a bus."""

import pytest

from imud.devices.hipnuc.common.bus_load import CyclicMessage, refuse_overload
from imud.errors import BadArgument


def test_bits_of_a_message_and_the_limit_of_the_bus() -> None:
    assert CyclicMessage(6, False, 10).bits_per_s == 9500  # 47 + 8 · 6 = 95 bits, 100 times
    assert CyclicMessage(8, True, 5).bits_per_s == 26_200  # 67 + 64 = 131 bits, 200 times
    assert CyclicMessage(8, True, 0).bits_per_s == 0
    messages = {"A": CyclicMessage(8, True, 5), "B": CyclicMessage(8, True, 0)}
    refuse_overload(messages, 0, 26_200)
    refuse_overload(messages, 1e9, 0)
    with pytest.raises(BadArgument, match=r"got 105 % of that: A every 5 ms 105 %; other devices 0 %"):
        refuse_overload(messages, 0, 25_000)
    with pytest.raises(BadArgument, match=r"got 100 % of that: A every 5 ms 26.2 %; other devices 73.8 %"):
        refuse_overload(messages, 73_801, 100_000)
