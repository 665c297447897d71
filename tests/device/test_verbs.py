"""Headings of verbs. tests/device/test_evidence.py tests the evidence of verbs."""

from collections.abc import Mapping
from math import degrees, radians, remainder
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.attitude.conventions import FLU_LEVEL, FLU_NWU, RFU_ENU, Convention, DeviceAxes
from imud.attitude.published import FrameOptions, MountingAxes, PublishedAxes, axes_of, mounting_of
from imud.contracts.command import Verb
from imud.device.verbs import VerbRun
from imud.drivers import DRIVERS
from imud.model.errors import BadArgument
from imud.model.sample import Sample, Sync, Vector3

YAW = DRIVERS["hipnuc-uart"].verbs["yaw"]
HEADING = DRIVERS["imu61x-uart"].verbs["heading"]


def sample_of(euler: Vector3 | None) -> Sample:
    return Sample("bow", 1, 0, 0, Sync.ARRIVAL, 0, 0, euler_rad=euler)


def device_yaw_deg(axes: PublishedAxes | None, newest: Sample | None, verb: Verb, given: Mapping[str, Any]) -> float:
    """Return the yaw that the device gets."""
    path = None if axes is None else SimpleNamespace(frame=axes)
    transport = SimpleNamespace(path=path, samples=SimpleNamespace(newest=newest))
    run = VerbRun(cast(Any, None), cast(Any, transport))
    arguments = msgspec.structs.asdict(run._with_device_yaw(verb, verb.arguments(given)))
    return float(arguments[verb.heading])


angles = st.floats(-170, 170)


@given(
    st.sampled_from([RFU_ENU, FLU_NWU, FLU_LEVEL, DeviceAxes(z_down=True)]),
    st.sampled_from([None, *Convention]),
    st.sampled_from([None, 5.0, -12.0]),
    st.sampled_from([FrameOptions(), FrameOptions(axes=MountingAxes(x="y", y="-x", z="z"))]),
    st.tuples(st.floats(-40, 40), st.floats(-40, 40), angles),
    angles,
)
def test_device_gets_the_yaw_of_the_published_heading(
    device: DeviceAxes,
    convention: Convention | None,
    declination_deg: float | None,
    mounting: FrameOptions,
    euler_deg: Vector3,
    heading_deg: float,
) -> None:
    """With each convention, declination and mounting: after the command, the samples have the requested heading."""
    device = axes_of(mounting, device)
    axes = PublishedAxes(device, mounting_of(mounting, device), convention, declination_deg)
    roll, pitch, yaw = map(radians, euler_deg)
    yaw_deg = device_yaw_deg(axes, sample_of((roll, pitch, yaw)), YAW, {"angle_deg": heading_deg})
    turned = sample_of((roll, pitch, radians(yaw_deg)))
    published = axes.rotation.sample(turned) if axes.rotation is not None else turned
    assert published.euler_rad is not None
    assert remainder(degrees(published.euler_rad[2]) - heading_deg, 360) == pytest.approx(0, abs=1e-6)


def test_relative_angle_has_the_published_sense() -> None:
    ned = PublishedAxes(RFU_ENU, RFU_ENU.to_body, Convention.NED_FRD, 5.0)
    newest = sample_of((0.0, 0.0, 0.3))
    assert device_yaw_deg(ned, newest, YAW, {"angle_deg": 10, "relative": True}) == -10
    assert device_yaw_deg(ned, newest, YAW, {"angle_deg": 90}) == pytest.approx(-85)
    assert device_yaw_deg(ned, newest, HEADING, {"heading_deg": 350}) == pytest.approx(-345)


def test_heading_without_samples() -> None:
    """Without convention and declination, the device gets the value. Otherwise imud needs a sample with a heading."""
    as_sent = PublishedAxes(RFU_ENU, RFU_ENU.to_body, None, None)
    for axes in (None, as_sent):
        assert device_yaw_deg(axes, None, YAW, {"angle_deg": 90}) == 90
    ned = PublishedAxes(RFU_ENU, RFU_ENU.to_body, Convention.NED_FRD, None)
    for newest in (None, sample_of(None)):
        with pytest.raises(BadArgument, match="angle_deg: expected a sample with a heading, got none"):
            device_yaw_deg(ned, newest, YAW, {"angle_deg": 90})
