"""Table of `imud top`: width, order, filter."""

import msgspec
import pytest

from imud.cli.top import AGE, CONDITION, LOST, NAME, RATE, VIEWS, WIDTH, DeviceHistory, chosen, duration, head, row
from imud.contracts.status import DeviceState
from imud.model.sample import Sync
from imud.model.units import NS_PER_S
from tests.support.metrics import device
from tests.support.socket_rig import sample

NOW_NS = sample().t_ns + NS_PER_S // 4


def history(name: str = "imu0", number: int = 0, **changes: object) -> DeviceHistory:
    one = DeviceHistory(device(name, number, **changes))
    one.add(msgspec.structs.replace(sample(name), euler_rad=(0.5, -0.25, 3.0)))
    return one


def test_a_row_has_its_values_below_their_titles() -> None:
    columns = VIEWS["motion"]
    assert head(columns) == "DEVICE     CONDITION     HZ   AGE  LOST   ±µs  ROLL° PITCH°   YAW°   |a|  |ω|°"
    assert row(history(), columns, NOW_NS) == (
        "imu0       ok         999.5 0.25s  4066    12   28.6  -14.3  171.9  9.76  53.6"
    )
    words = row(DeviceHistory(device("imu0", state=DeviceState.MISSING)), VIEWS["motion"], NOW_NS).split()
    assert words == ["imu0", "missing", "999.5", "-", "4066", "-", "-", "-", "-", "-", "-"]


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("value", [1e-9, 12.3456, 9_999_999.0, 1e15])
def test_every_row_is_as_wide_as_its_titles_and_fits_80_columns(view: str, value: float) -> None:
    ledger = dict.fromkeys(device("x").ledger, int(value))
    one = history(
        "a-name-that-is-much-longer-than-the-column", ledger=ledger, rate_hz=value, temperature_c=-value,
        expected_rate_hz=value, connects=int(value), state=DeviceState.SEARCHING,
    )  # fmt: skip
    one.add(
        msgspec.structs.replace(
            sample(seq=2), euler_rad=(-value,) * 3, accel_m_s2=(value,) * 3, gyro_rad_s=(value,) * 3,
            t_err_ns=int(value * 1000), sync=Sync.REGRESSION,
        )
    )  # fmt: skip
    columns = VIEWS[view]
    text = row(one, columns, NOW_NS + int(value) * NS_PER_S)
    assert len(text) <= len(head(columns)) <= WIDTH
    assert len(text.split()) == len(columns)


def names(devices: list[DeviceHistory]) -> list[str]:
    return [one.status.name for one in devices]


def test_ages_order_and_filter() -> None:
    seconds = (0.0, 9.994, 10.0, 999.9, 1000.0, 59_900.0, 60_000.0, 360_000.0, 8.64e7)
    ages = [duration(one) for one in seconds]
    assert ages == ["0.00s", "9.99s", "10s", "1000s", "17m", "998m", "17h", "4d", "1000d"]
    devices = [history("b", 1), history("c", 0, state=DeviceState.FAILED), history("a", 2)]
    assert names(chosen(devices, NAME, NOW_NS)) == ["a", "b", "c"]
    assert names(chosen(devices, NAME, NOW_NS, backwards=True)) == ["c", "b", "a"]
    assert names(chosen(devices, RATE, NOW_NS)) == ["a", "b", "c"]
    assert names(chosen(devices, LOST, NOW_NS, backwards=True)) == ["c", "b", "a"]
    assert names(chosen(devices, CONDITION, NOW_NS)) == ["c", "a", "b"]
    devices = [history("a"), DeviceHistory(device("b"))]
    assert names(chosen(devices, AGE, NOW_NS)) == ["b", "a"], "a device without samples is the oldest"
    devices = [history("bow", 0), history("stern", 1, problem="has no power")]
    for words, found in {
        "": ["bow", "stern"], "BOW": ["bow"], "ttyusb1": ["stern"], "hi13 ok": ["bow"], "bow stern": [],
        "hi13 /dev": ["bow", "stern"], "power": ["stern"],
    }.items():  # fmt: skip
        assert names(chosen(devices, NAME, NOW_NS, words=words)) == found
