"""Claims of ports and addresses, CAN frames of two devices, and which links a driver can use."""

import pytest

from imud.contracts.driver import Driver
from imud.contracts.link import CanUse, Claim, LinkType, conflict_of
from imud.drivers import DRIVERS
from imud.formats.can import CanFilter, CyclicFrame
from imud.links import LINKS
from imud.model.options import NoOptions
from tests.support.fake_drivers import FAKE_DRIVER, fake_can_driver


def claim(part: int | None, place: str = "/dev/b", *, shared: bool = True, **terms: object) -> Claim:
    return Claim(place=place, key="line", shared=shared, part=part, part_key="address", terms=terms)


@pytest.mark.parametrize(
    ("mine", "other", "conflict"),
    [
        (claim(1), claim(2), None),
        (claim(None), claim(None), None),
        (claim(1), claim(1), ("address", "expected an unused address on /dev/b, got 1; bow uses it")),
        (claim(1), claim(2, shared=False), ("line", "expected an unused line, got /dev/b; bow uses it")),
        (claim(1, shared=False), claim(2), ("line", "expected an unused line, got /dev/b; bow uses it")),
        (claim(1, baud=9600, echo="on"), claim(2, parity="even", baud=9600), None),
        (
            claim(1, echo="on", baud=9600), claim(1, baud=115200),
            ("baud", "expected the same baud for all devices of /dev/b, got 9600; bow has 115200"),
        ),
    ],
)  # fmt: skip
def test_two_devices_of_a_place_need_other_addresses_and_equal_terms(
    mine: Claim, other: Claim, conflict: tuple[str, str] | None
) -> None:
    assert conflict_of(mine, other, "bow") == conflict


def use(*filters: tuple[int, int], bus: str = "can0", extended: bool = False) -> CanUse:
    cyclic = [CyclicFrame(can_id, extended, b"", 1_000_000) for can_id, _ in filters]
    return CanUse(bus, [CanFilter(*one, extended) for one in filters], cyclic)


@pytest.mark.parametrize(
    ("one", "other", "receive", "send"),
    [
        (use((0x80, 0x7FF)), use((0x80, 0x7FF)), "0x080", "0x080"),
        (use((0x80, 0x7FF)), use((0x81, 0x7FF)), "", ""),
        (use((0x80, 0x7FF)), use((0x80, 0x7FF), extended=True), "", ""),
        (use((0x80, 0x7FF)), use((0x80, 0x7FF), bus="can1"), "", ""),
        (use((0x80, 0x7FF), extended=True), use((0x80, 0x7FF), extended=True), "0x00000080", "0x00000080"),
        # equal masks, and an identifier with bits outside the mask
        (use((0x85, 0x7F0)), use((0x81, 0x7F0)), "0x085", ""),
        # masks that differ between the devices, and within each device
        (use((0x80, 0x700)), use((0x81, 0x7FF)), "0x081", ""),
        (use((0x80, 0x700), (0x200, 0x7FF)), use((0x81, 0x7FF), (0x400, 0x700)), "0x081", ""),
        (use((0x80, 0x700), (0x200, 0x7FF)), use((0x381, 0x7FF), (0x400, 0x700)), "", ""),
    ],
)
def test_devices_of_one_bus_differ_in_their_identifiers(one: CanUse, other: CanUse, receive: str, send: str) -> None:
    assert (one.both_receive(other), other.both_receive(one)) == (receive, receive)
    assert (one.both_send(other), other.both_send(one)) == (send, send)
    wanted = other.filters[0]
    assert other.receives(wanted.can_id, wanted.extended)
    assert not other.receives(wanted.can_id, not wanted.extended)


def test_a_link_serves_the_drivers_that_it_can_carry() -> None:
    drivers: list[Driver] = [FAKE_DRIVER, fake_can_driver(), DRIVERS["imu61x-i2c"], DRIVERS["hipnuc-modbus"]]
    none = LinkType("none", NoOptions)
    facts = {
        name: (one.searchable, one.polled, one.frames_only, [i for i, driver in enumerate(drivers) if one.fits(driver)])
        for name, one in {**LINKS, "none": none}.items()
    }  # fmt: skip
    assert facts == {
        "uart": (True, False, False, [0]), "socketcan": (True, False, True, [1]), "i2c": (True, True, False, [2]),
        "spi": (True, True, False, []), "rs485": (True, True, False, [3]), "replay": (True, False, False, [0, 1]),
        "memory": (True, False, False, [0, 1]), "none": (False, False, False, []),
    }  # fmt: skip
    assert none.claims(NoOptions()) == ()
