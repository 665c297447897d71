"""Claims, conflicts and bus load of the devices of one CAN bus."""

from imud.device.can_transport import CanBuses
from imud.formats.can import CanFilter, CyclicFrame

SYNC = CyclicFrame(0x80, False, b"", 10_000_000)


def filters(*can_ids: int) -> list[CanFilter]:
    return [CanFilter(can_id, 0x7FF, False) for can_id in can_ids]


def test_frames_of_others_on_the_same_bus_are_claimed() -> None:
    buses = CanBuses()
    buses.join("front", "can0", filters(0x181), ())
    buses.join("rear", "can1", filters(0x182), ())
    claimed = buses.claimed("mast", "can0")
    assert claimed(0x181, False)
    assert not claimed(0x181, True)
    assert not claimed(0x182, False)
    assert not buses.claimed("front", "can0")(0x181, False)
    buses.leave("front")
    buses.leave("front")
    assert not claimed(0x181, False)


def test_the_second_of_two_devices_with_equal_frames_is_refused() -> None:
    buses = CanBuses()
    buses.join("front", "can0", (), [SYNC])
    buses.join("rear", "can0", (), [CyclicFrame(0x80, False, b"", 20_000_000)])
    buses.join("other", "can1", (), [SYNC])
    buses.join("far", "can0", (), [CyclicFrame(0x80, True, b"", 1_000_000)])
    assert [buses.conflict(name) for name in ("front", "other", "far", "nobody")] == [""] * 4
    assert (
        buses.conflict("rear") == "front and rear would both send 0x080 on can0; configure only one of them to send it"
    )
    buses.join("more", "can0", (), [CyclicFrame(0x80, True, b"", 1_000_000)])
    assert "far and more would both send 0x00000080" in buses.conflict("more")
    buses.leave("front")
    assert buses.conflict("rear") == ""
    buses = CanBuses()
    buses.join("found", "can0", filters(0x181, 0x281), ())
    buses.join("named", "can0", filters(0x381, 0x281), ())
    buses.join("other", "can1", filters(0x281), ())
    assert "found and named would receive the same device on can0, which sends 0x281" in buses.conflict("named")
    assert buses.conflict("found") == buses.conflict("other") == ""
