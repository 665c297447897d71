"""Names of topics and coordinate frames, covariances of sensor_msgs/Imu, and the filter of steady values."""

from imud.attitude.conventions import Convention
from imud.bridges.channel import MessageFrames, StampedEvent, Steady, covariance, topic
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S


def test_topics_frames_covariances_and_steady_values() -> None:
    for device, expected in [("bow", "/bow/imu/data"), ("a-b", "/a_b/imu/data"), ("2nd", "/_2nd/imu/data")]:
        assert topic(device, "imu/data") == expected
    assert MessageFrames("bow").body == "bow"
    assert MessageFrames("bow").navigation == "enu"
    assert MessageFrames("bow", Convention.NED_FRD).body == "bow_frd"
    assert MessageFrames("bow", Convention.NED_FRD).navigation == "ned"
    assert MessageFrames("bow", has_north=False).navigation == "bow_level"
    assert MessageFrames("bow", Convention.NED_FRD, has_north=False).navigation == "bow_level_ned"
    assert covariance(None) == 9 * (0.0,)  # unknown noise
    assert covariance(None, present=False) == (-1.0, *(8 * (0.0,)))  # value not present
    assert covariance(0.5) == (0.25, 0, 0, 0, 0.25, 0, 0, 0, 0.25)
    assert covariance(0.5, present=False)[0] == -1
    assert StampedEvent(Event(1, "bow", EventKind.DOWN, "gone"), 2).is_warning
    assert not StampedEvent(Event(1, "bow", EventKind.UP, "there"), 2).is_warning
    steady = Steady()
    passed = [steady.passes(20.0 if t < 5 else 21.0, t * NS_PER_S // 4) for t in range(13)]
    assert [t for t, one in enumerate(passed) if one] == [0, 4, 5, 9]
    steady = Steady()
    assert steady.passes(20.0, 100 * NS_PER_S)
    assert steady.passes(20.0, 50 * NS_PER_S)
    assert not steady.passes(20.0, 50 * NS_PER_S + 1)
    assert not steady.passes(20.0, 49 * NS_PER_S + 1)
    assert steady.passes(20.0, 49 * NS_PER_S)  # a step back by the period
