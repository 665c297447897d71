"""Stored samples of each device in `imud top`."""

import math

import msgspec
import pytest

from imud.cli.top import CURVES, POINTS_MAX, SPAN_NS, DeviceHistories, DeviceHistory, norm
from tests.support.metrics import device
from tests.support.socket_rig import sample


def test_curves() -> None:
    history = DeviceHistory(device("imu0"))
    history.add(msgspec.structs.replace(sample(), euler_rad=(math.pi, 0.0, -math.pi / 2), mag_t=(2e-5, 0.0, -4e-5)))
    shown = {series.curve.name: (series.values, series.curve.unit) for series in history.series()}
    assert list(shown) == [curve.name for curve in CURVES]
    assert shown["roll"] == ([180.0], "°")
    assert shown["yaw"] == ([-90.0], "°")
    assert shown["accel z"] == ([9.75], "m/s²")
    assert shown["gyro x"][0] == pytest.approx([14.3239449])
    assert shown["mag z"][0] == pytest.approx([-40.0])
    history = DeviceHistory(device("imu0"))
    history.add(msgspec.structs.replace(sample(), accel_m_s2=(math.nan, 0.0, math.inf), gyro_rad_s=None))
    values = {series.curve.name: series.values for series in history.series()}
    assert values["accel x"] == values["accel z"] == values["gyro x"] == values["mag x"] == []
    assert values["accel y"] == [0.0]


def test_only_the_last_minute_of_one_start_is_kept() -> None:
    history = DeviceHistory(device("imu0"))
    for seq in range(1, POINTS_MAX + 100):
        history.add(sample(seq=seq))
    assert len(history.series()[3].values) == POINTS_MAX
    newest = history.newest
    assert newest is not None
    history.add(msgspec.structs.replace(newest, t_ns=newest.t_ns + SPAN_NS + 1))
    assert len(history.series()[3].values) == 1
    history = DeviceHistory(device("imu0"))
    history.add(sample(seq=50))
    history.add(sample(seq=1))
    assert len(history.series()[3].values) == 1
    assert history.newest == sample(seq=1)


def test_devices_come_and_go_and_vectors_have_a_length() -> None:
    fleet = DeviceHistories()
    fleet.add(sample("bow"))  # device without a status
    fleet.update([device("stern"), device("bow")], 3)
    assert list(fleet.devices) == ["stern", "bow"]
    assert fleet.devices["bow"].newest is None
    fleet.add(sample("bow"))
    fleet.update([device("bow", 1, rate_hz=5.0)], 2)
    assert list(fleet.devices) == ["bow"]
    assert fleet.devices["bow"].newest == sample("bow")
    assert fleet.devices["bow"].status.rate_hz == 5.0
    assert fleet.clients == 2
    for vector, length in [((3.0, 0.0, 4.0), 5.0), (None, None), ((math.nan, 1.0, 1.0), None)]:
        assert norm(vector) == length
