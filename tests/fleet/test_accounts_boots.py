"""UTC time of records: from the clock of their message, from the clock of their boot, or unknown."""

import msgspec
import pytest

from imud.fleet.accounts import (
    BOOTS_MAX,
    BootClocks,
    BootKey,
    BootOffset,
    GatewayState,
    PlacedTime,
    boot_of,
    offset_of,
    placed,
)
from imud.fleet.messages import CLOCK_SET_NS, FleetMessage, GatewayClock
from tests.fleet.fleet_gateway import UTC_NS, event_message, intervals_message, not_set, samples_message, synchronised

SET = GatewayClock(0, UTC_NS, synchronised=True, error_ns=40)
NOT_SET = GatewayClock(0, 123, synchronised=False)
KNOWN = BootOffset(1_000_000, UTC_NS, 40)


@pytest.mark.parametrize(
    ("utc_ns", "t_ns", "clock", "known", "expected"),
    [
        (UTC_NS + 5, 5, SET, None, PlacedTime(UTC_NS + 5, True, 40)),
        # the time and the offset were read microseconds apart
        (UTC_NS + 9_000, 5, SET, None, PlacedTime(UTC_NS + 9_000, True, 40)),
        (77, 5, SET, None, PlacedTime(UTC_NS + 5, True, 40)),  # the clock stepped after the sample, within one message
        (77, 5, NOT_SET, None, PlacedTime(77, False, None)),
        # systemd set the clock to a wrong time after 2020
        (CLOCK_SET_NS + 5, 5, NOT_SET, None, PlacedTime(CLOCK_SET_NS + 5, False, None)),
        (77, 5_000_000, NOT_SET, KNOWN, PlacedTime(UTC_NS + 5_000_000, True, 40 + 2_000)),  # 4 ms at 500 ppm: 2 us
        (77, None, NOT_SET, KNOWN, PlacedTime(77, False, None)),
        (CLOCK_SET_NS, 5, None, None, PlacedTime(CLOCK_SET_NS, True, None)),  # a gateway with an earlier version
        (CLOCK_SET_NS - 1, 5, None, None, PlacedTime(CLOCK_SET_NS - 1, False, None)),
        (0, 5, None, BootOffset(0, UTC_NS, None), PlacedTime(UTC_NS + 5, True, None)),
    ],
)
def test_utc_time_of_a_record(
    utc_ns: int, t_ns: int | None, clock: GatewayClock | None, known: BootOffset | None, expected: PlacedTime
) -> None:
    assert placed(utc_ns, t_ns, clock, known) == expected


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (synchronised(event_message(1, 5), t_ns=3, error_ns=40), BootOffset(3, UTC_NS, 40)),
        (not_set(samples_message(1, 2)), None), (samples_message(1, 2), BootOffset(2_000_000, UTC_NS, None)),
        (intervals_message(4, 6), BootOffset(4_000_000, UTC_NS, None)), (intervals_message(4, 6, utc_ns=0), None),
        (event_message(1, 5), None),
        (
            intervals_message(4, 6, utc_ns=CLOCK_SET_NS - 4_000_000),
            BootOffset(4_000_000, CLOCK_SET_NS - 4_000_000, None),
        ),
    ],
)  # fmt: skip
def test_clock_offset_of_a_message(message: FleetMessage, expected: BootOffset | None) -> None:
    assert offset_of(message) == expected


def test_a_boot_is_fresh_once_and_the_newest_offset_is_used() -> None:
    clocks = BootClocks()
    assert clocks.take(not_set(samples_message(1, 2))) is None
    assert clocks.take_fresh() == {}
    first = BootOffset(2, UTC_NS, 9)
    assert clocks.take(synchronised(samples_message(3, 4, boot="1-2"), t_ns=2, error_ns=9)) == first
    assert clocks.take_fresh() == {BootKey("gw", "1"): first}
    later = BootOffset(5, UTC_NS, 3)
    assert clocks.take(synchronised(samples_message(5, 6), t_ns=5, error_ns=3)) == later
    assert clocks.take(not_set(samples_message(7, 8))) == later
    assert clocks.take_fresh() == {}
    assert clocks.take(samples_message(1, 2, boot="2", utc_ns=0)) is None
    assert boot_of(samples_message(1, 1, boot="00ff-3")) == BootKey("gw", "00ff"), (
        "a device with a restarted count belongs to the boot"
    )


def test_a_state_contains_the_clock_offset() -> None:
    clocks, state = BootClocks(), GatewayState(v=1, online=True, boot="1", clock=SET)
    clocks.take_state("gw", msgspec.structs.replace(state, clock=NOT_SET))
    clocks.take_state("gw", msgspec.structs.replace(state, clock=None))
    assert clocks.offsets == {}
    clocks.take_state("gw", state)
    assert clocks.take_fresh() == clocks.offsets == {BootKey("gw", "1"): BootOffset(0, UTC_NS, 40)}
    clocks = BootClocks()
    for number in range(BOOTS_MAX + 1):
        clocks.take_state(f"gw-{number}", state)
    assert len(clocks.offsets) == BOOTS_MAX
    assert BootKey("gw-0", "1") not in clocks.offsets
    assert BootKey(f"gw-{BOOTS_MAX}", "1") in clocks.offsets
    assert len(clocks.take_fresh()) == BOOTS_MAX, "a reader may never take the offsets"
