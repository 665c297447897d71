"""Error frames of CAN controllers, by the bits of linux/can/error.h."""

import pytest

from imud.links.socketcan import BusState, ControllerState


def frame(status: int) -> bytes:
    return bytes([0, status, 0, 0, 0, 0, 0, 0])


def news_of(bus: BusState, classes: int, status: int = 0) -> str:
    """Return the change of state that an error frame causes."""
    bus.news.clear()
    assert bus.add_error_frame(classes, frame(status)) is bool(status & 0x01 and classes == 0x4)
    assert all(problem == bus.problem for _, problem in bus.news)
    return "".join(news for news, _ in bus.news)


def test_life_of_a_controller() -> None:
    bus = BusState("can0", 0)
    assert bus.problem == ""
    assert news_of(bus, 0x4, 0x08) == "can0 is near its error limit (warning)"
    assert bus.problem == ""
    assert news_of(bus, 0x4, 0x20).startswith("can0 is error-passive: ")
    assert news_of(bus, 0x4, 0x10) == ""  # the state has not changed
    assert "terminated" in bus.problem
    assert news_of(bus, 0x40).startswith("can0 is bus-off: ")
    assert "`ip link set can0 down`, then `ip link set can0 up type can restart-ms 100`" in bus.problem
    assert news_of(bus, 0x100) == "can0 is error-active again"
    assert bus.problem == ""
    assert (bus.passive_count, bus.bus_off_count) == (1, 1)


def test_a_frame_without_news_changes_no_state() -> None:
    bus = BusState("can0", 0)
    assert news_of(bus, 0x4, 0x01) == ""
    assert (bus.overflows, bus.state) == (1, ControllerState.ACTIVE)
    bus = BusState("can0", 2)
    assert news_of(bus, 0x80, 0x20 | 0x01) == ""
    assert (bus.overflows, bus.state) == (0, ControllerState.PASSIVE)


@pytest.mark.parametrize(("number", "state"), [(3, ControllerState.BUS_OFF), (None, ControllerState.ACTIVE), (5, 0)])
def test_state_at_the_start(number: int | None, state: int) -> None:
    assert BusState("can0", number).state == state
