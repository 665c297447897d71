"""Values as counts of a signed field, valid air pressures, and the load of a bus."""

from math import inf, nan
from types import SimpleNamespace

import pytest

from imud.attitude.conventions import Heading
from imud.contracts.command import RestMeans, Target, Verb
from imud.drivers import DRIVERS
from imud.drivers.hipnuc import common
from imud.drivers.hipnuc.bus_load import CyclicMessage, refuse_overload
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.common import counts_of, heading_by_mode, inclinometer_zero, pressure_of, temperature_beside
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from imud.drivers.hipnuc.nmea2000 import HipnucNmea2000Options
from imud.model.errors import BadArgument
from tests.support.simulated_modules import CanopenBench


def test_nearest_count_in_the_range_and_nan_has_none() -> None:
    for value, bits, counts in (
        (0.4, 16, 0), (-1.6, 16, -2), (32767.4, 16, 32767), (1e9, 16, 32767), (-32768.0, 16, -32768),
        (-inf, 16, -32768), (inf, 32, 2**31 - 1), (-(2.0**40), 32, -(2**31)),
    ):  # fmt: skip
        assert counts_of(value, bits) == counts
    with pytest.raises(ValueError, match="NaN"):
        counts_of(nan, 16)


def test_status_bits_with_an_event() -> None:
    """A range, a disturbance, or a state before convergence. The other bits describe the present state."""
    for name in ("hipnuc-uart", "hipnuc-modbus"):
        assert [bit for bit, one in DRIVERS[name].status_bits.items() if one.notable] == [3, 4, 5, 6, 7]


VALID_PA = (1_000.0, 33_000.0, 101_325.0, 120_000.0)


@pytest.mark.parametrize(
    ("value_pa", "temperature_c"),
    [*((valid_pa, 21) for valid_pa in VALID_PA), (0.0, 21), (999.0, 21), (9.99, None), (999.9, None),
     (120_000.1, None), (-4.2e-25, None), (nan, None),
     (inf, None), (-101_325.0, None)],
)  # fmt: skip
def test_valid_and_invalid_pressures(value_pa: float, temperature_c: float | None) -> None:
    assert pressure_of(value_pa) == (value_pa if value_pa in VALID_PA else None)
    assert temperature_beside(21, value_pa) == temperature_c
    assert temperature_beside(0, value_pa) == (0 if temperature_c and value_pa else None)


def test_bits_of_a_message_and_the_limit_of_the_bus() -> None:
    assert CyclicMessage(6, False, 10).bits_per_s == 9500  # 47 + 8 · 6 = 95 bits, 100 times
    assert CyclicMessage(8, True, 5).bits_per_s == 26_200  # 67 + 64 = 131 bits, 200 times
    assert CyclicMessage(8, True, 0).bits_per_s == 0
    messages = {"A": CyclicMessage(8, True, 5), "B": CyclicMessage(8, True, 0)}
    refuse_overload(messages, 0, 26_200)
    refuse_overload(messages, 1e9, 0)
    with pytest.raises(BadArgument, match=r"got 105 % of it: A every 5 ms 105 %; other devices 0 %"):
        refuse_overload(messages, 0, 25_000)
    with pytest.raises(BadArgument, match=r"got 100 % of it: A every 5 ms 26.2 %; other devices 73.8 %"):
        refuse_overload(messages, 73_801, 100_000)


def test_angles_that_show_the_effect_of_level_and_zero() -> None:
    for kind, names in (("cancel", []), ("relative", ["roll", "pitch"])):
        assert [one.name for one in common.levelled(SimpleNamespace(level=kind))] == names
    for kind, names in (("cancel", []), ("relative", ["inclination"])):
        assert [one.name for one in common.zeroed(SimpleNamespace(zero=kind))] == names


def test_heading_by_mode_and_of_drivers_that_know_it_beforehand() -> None:
    for values, heading in (
        ({"mode": "6-axis"}, Heading.RELATIVE), ({"mode": "9-axis"}, Heading.MAGNETIC), ({}, Heading.UNKNOWN),
    ):  # fmt: skip
        assert heading_by_mode(None, values) is heading
    for name in ("hipnuc-uart", "hipnuc-modbus"):
        assert DRIVERS[name].heading(None, {"mode": "9-axis"}) is Heading.MAGNETIC
    for name in ("imu61x-uart", "imu61x-can", "imu61x-i2c", "imu61x-spi"):
        assert DRIVERS[name].heading(None, {}) is Heading.RELATIVE
    nmea = DRIVERS["hipnuc-nmea2000"].heading
    assert nmea(HipnucNmea2000Options(heading="true"), {}) is Heading.TRUE
    assert nmea(HipnucNmea2000Options(heading="magnetic"), {}) is Heading.MAGNETIC
    assert nmea(HipnucNmea2000Options(), {}) is Heading.UNKNOWN
    assert nmea(None, {}) is Heading.UNKNOWN
    assert DRIVERS["hipnuc-canopen"].heading(None, {}) is Heading.UNKNOWN


def test_the_zero_is_made_of_actions_on_both_buses() -> None:
    verbs = {
        "zero": Verb("zero", lambda _target, *, zero: f"zero {zero}"), "save": Verb("save", lambda _target: "saved"),
    }  # fmt: skip
    zero = inclinometer_zero("5.4.1", verbs)["zero"]
    target = Target(None, 0)
    assert str(zero.begin(target)) == "zero here"
    assert zero.save is not None
    assert str(zero.save(target)) == "saved"
    (expectation,) = zero.expected
    assert expectation.value(RestMeans(None, None, None, (0.001, -0.02))) == 0.02
    assert expectation.value(RestMeans(None, None, (0.0, 0.0, 0.0))) is None
    bench = CanopenBench()
    zero = DRIVERS["hipnuc-canopen"].calibrations["zero"]
    bench.run_script(zero.begin(Target(HipnucCanopenOptions(node=bench.module.node), 500_000)))
    assert len(bench.sent) >= 1
    assert zero.section[0] == "5"
    zero = DRIVERS["hipnuc-j1939"].calibrations["zero"]
    request = next(zero.begin(Target(HipnucJ1939Options(), 250_000)))
    assert request.payload
    assert zero.section[0] == "6"
