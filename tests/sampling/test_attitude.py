"""Attitude of the host: angles by hand, gaps, other rates, invalid values, its state, and a device's own attitude."""

import csv
import dataclasses
import subprocess
import sys
from collections.abc import Sequence
from math import cos, inf, isclose, nan, pi, radians, sin
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from imud.attitude.conventions import (
    FLU_LEVEL,
    RFU_ENU,
    UNSETTLED_BIT,
    AttitudeSource,
    Convention,
    DeviceAxes,
    EulerOrder,
)
from imud.attitude.published import published_frame
from imud.drivers import DRIVERS
from imud.formats import kernel
from imud.formats.can import CanFrame
from imud.formats.state import StateError
from imud.model.errors import ImudError
from imud.model.sample import Measurement, Sample, Sync, Vector3
from imud.sampling import attitude
from imud.sampling.attitude import HostAttitude
from imud.sampling.state import ATTITUDE
from tests.bench.attitude import VENDOR_FILE, Figures, against_device, simulated
from tests.sampling.test_path import PathRig
from tests.support.files import hi91

G = 9.80665
STEP_NS = 10_000_000
UNSETTLED = 1 << UNSETTLED_BIT


def sample(t_ns: int, gyro: Vector3 | None = (0, 0, 0), accel: Vector3 | None = (0, 0, G), **more: Any) -> Sample:
    return Sample(
        "bow", t_ns, t_ns, 1, Sync.ARRIVAL, t_ns, t_ns, gyro_rad_s=gyro, accel_m_s2=accel, **more
    )  # fmt: skip


def run(count: int, start_ns: int = STEP_NS, step_ns: int = STEP_NS, **values: Any) -> list[Sample]:
    return [sample(start_ns + step_ns * number, **values) for number in range(count)]


def degrees_of(one: Sample) -> list[float]:
    assert one.euler_rad is not None
    return [round(angle * 180 / pi, 2) + 0.0 for angle in one.euler_rad]


def gravity(roll_deg: float, pitch_deg: float) -> Vector3:
    """Specific force at rest in x forward, y left, z up; ZYX: pitch is positive with the front down."""
    roll, pitch = radians(roll_deg), radians(pitch_deg)
    return (-G * sin(pitch), G * cos(pitch) * sin(roll), G * cos(pitch) * cos(roll))


@pytest.mark.parametrize(
    ("axes", "accel", "expected"),
    [
        (FLU_LEVEL, gravity(0, 0), [0, 0, 0]), (FLU_LEVEL, gravity(30, 0), [30, 0, 0]),
        (FLU_LEVEL, gravity(0, -20), [0, -20, 0]), (FLU_LEVEL, gravity(-150, 40), [-150, 40, 0]),
        # ZXY: pitch about x with the nose up: gravity pulls along -y, the force points to +y
        (RFU_ENU, (0, G / 2, G * cos(pi / 6)), [0, 30, 0]),
        # z down: the force points to -z at rest; with the side of y down, to -y
        (DeviceAxes(order=EulerOrder.ZYX, has_north=False, z_down=True), (0, 0, -G), [0, 0, 0]),
        (DeviceAxes(order=EulerOrder.ZYX, has_north=False, z_down=True), (0, -G / 2, -G * cos(pi / 6)), [30, 0, 0]),
    ],
)  # fmt: skip
def test_gravity_gives_roll_and_pitch_and_the_start_gives_yaw_0(
    axes: DeviceAxes, accel: Vector3, expected: list[float]
) -> None:
    made = HostAttitude(axes).samples(run(400, accel=accel))
    assert degrees_of(made[0]) == degrees_of(made[-1]) == expected
    assert (made[0].status, made[-1].status) == (UNSETTLED, None)
    w, x, y, z = made[-1].quat_wxyz or (0, 0, 0, 0)
    assert isclose(w * w + x * x + y * y + z * z, 1)


@pytest.mark.parametrize("step_ns", [1_000_000, 7_000_000, STEP_NS])
@pytest.mark.parametrize(("rate_deg_s", "axis"), [(200, 2), (-90, 2), (60, 0)])
def test_a_rotation_of_one_second_gives_its_angle(step_ns: int, rate_deg_s: int, axis: int) -> None:
    """The sensor rests for 4 s, then rotates for 1 s about an axis that is vertical (yaw) or level (roll)."""
    rest, turn = 4 * 10**9 // step_ns, 10**9 // step_ns
    host = HostAttitude(FLU_LEVEL)
    made = host.samples(run(rest, step_ns=step_ns))
    assert made[-1].status is None
    before_ns, rate = made[-1].t_ns, rate_deg_s * pi / 180
    gyro = [0.0, 0.0, 0.0]
    gyro[axis] = rate
    for number in range(1, turn + 1):
        angle = rate * number * step_ns / 1e9 * (axis == 0)
        accel = (0.0, G * sin(angle), G * cos(angle))
        made = host.samples([sample(before_ns + number * step_ns, (gyro[0], gyro[1], gyro[2]), accel)])
    expected = [0.0, 0.0, 0.0]
    expected[axis] = (rate_deg_s * turn * step_ns / 1e9 + 180) % 360 - 180
    assert degrees_of(made[0]) == pytest.approx(expected, abs=0.02)


def test_samples_that_are_lost_for_a_short_time_do_not_change_the_angle() -> None:
    host = HostAttitude(FLU_LEVEL)
    at_rest = host.samples(run(400))
    turning = [one for number, one in enumerate(run(100, 401 * STEP_NS, gyro=(0, 0, 1.0)), 1) if number % 20 in (0, 1)]
    made = host.samples(turning)
    assert (at_rest[-1].status, made[-1].status) == (None, None)
    assert made[-1].euler_rad is not None
    assert made[-1].euler_rad[2] == pytest.approx(1.0, abs=1e-3)


def test_unequal_intervals_and_losses_change_neither_the_angle_nor_the_bias() -> None:
    """Intervals of 12, 12, 12 and 4 ms, then a loss of 200 ms each second at rest, with a gyro bias."""
    bias, host = (0.01, -0.008, 0.012), HostAttitude(FLU_LEVEL)
    made = host.samples(run(2000, gyro=bias))
    t_ns = made[-1].t_ns
    for number in range(400):
        t_ns += 4_000_000 if number % 4 == 3 else 12_000_000
        made += host.samples([sample(t_ns, (0.01, -0.008, 1.012))])
    start, turned = made[1999].euler_rad, made[-1].euler_rad
    assert start is not None
    assert turned is not None
    assert (turned[2] - start[2]) % (2 * pi) == pytest.approx(4.0, abs=2e-3)  # 4 s at 1 rad/s
    for number in range(1000):
        t_ns += 200_000_000 if number % 100 == 0 else STEP_NS
        made += host.samples([sample(t_ns, bias)])
    rested = made[-1].euler_rad
    assert rested is not None
    assert rested[2] == pytest.approx(turned[2], abs=2e-3)


@pytest.mark.parametrize("gap_ns", [251_000_000, 3_600_000_000_000])
def test_a_long_gap_restarts_the_filter_with_the_last_yaw(gap_ns: int) -> None:
    host = HostAttitude(FLU_LEVEL)
    made = host.samples([*run(400), *run(50, 401 * STEP_NS, gyro=(0, 0, 1.0))])
    after = host.samples(run(400, made[-1].t_ns + gap_ns, gyro=(0, 0, 0), accel=gravity(20, 10)))
    assert degrees_of(made[-1]) == pytest.approx([0, 0, 28.65], abs=0.02)  # 0.5 rad
    assert degrees_of(after[0]) == pytest.approx([20, 10, 28.65], abs=0.02)
    assert (made[-1].status, after[0].status, after[-1].status) == (None, UNSETTLED, None)


def test_another_sample_rate_starts_the_filter_again() -> None:
    host = HostAttitude(FLU_LEVEL)
    made = host.samples([*run(400), *run(1400, 401 * STEP_NS, 2_500_000)])
    states = [one.status for one in made]
    assert (states[399], states[400 + 63], states[-1]) == (None, UNSETTLED, None)
    slow = HostAttitude(FLU_LEVEL).samples(run(200, step_ns=500_000_000))  # 2 Hz: each interval is a gap at first
    assert (slow[20].status, slow[-1].status) == (UNSETTLED, None)


def test_a_bias_is_found_at_rest_and_motion_alone_does_not_settle() -> None:
    bias = (0.01, -0.008, 0.012)
    host = HostAttitude(FLU_LEVEL)
    made = host.samples(run(3000, gyro=bias))
    assert made[-1].euler_rad is not None
    assert made[2000].euler_rad is not None
    assert made[-1].euler_rad[2] == pytest.approx(made[2000].euler_rad[2], abs=1e-4)  # 0.12 rad without the bias
    moving = HostAttitude(FLU_LEVEL).samples(run(1000, gyro=(0, 0, 1.0)))
    assert {one.status for one in moving} == {UNSETTLED}


@pytest.mark.parametrize(
    ("change", "has_attitude"),
    [
        ({"gyro_rad_s": None}, False), ({"accel_m_s2": None}, False), ({"gyro_rad_s": (nan, 0, 0)}, False),
        ({"accel_m_s2": (0, inf, 0)}, False), ({"accel_m_s2": (inf, -inf, 0)}, False),
        ({"gyro_rad_s": (1e300, 1e300, 0)}, False), ({"accel_m_s2": (0, 0, 0)}, True),
        ({"quat_wxyz": (1, 0, 0, 0)}, True), ({"euler_rad": (1, 2, 3)}, True),
    ],
)  # fmt: skip
def test_a_sample_that_the_filter_cannot_use_changes_nothing(change: dict[str, Any], has_attitude: bool) -> None:
    host = HostAttitude(FLU_LEVEL)
    host.samples(run(400, accel=gravity(10, 0)))
    odd = replace(sample(401 * STEP_NS), **change)
    (made,) = host.samples([odd])
    if "accel_m_s2" not in change or not has_attitude:
        assert made == odd
    after = host.samples(run(400, 402 * STEP_NS, accel=gravity(10, 0)))
    assert degrees_of(after[0]) == degrees_of(after[-1]) == [10, 0, 0]
    assert after[-1].status is None


def test_the_status_of_the_device_stays() -> None:
    host = HostAttitude(FLU_LEVEL)
    made = host.samples(run(400, status=0x8000_0005))
    assert (made[0].status, made[-1].status) == (0x8000_0005 | UNSETTLED, 0x8000_0005)


def noisy(count: int) -> list[Sample]:
    """Samples with jitter, gaps, another rate and a rotation."""
    made, t_ns = [], 0
    for number in range(count):
        t_ns += (7_000_000 if number < 900 else 3_000_000) + number * 7919 % 1_000_000 + 400_000_000 * (number == 700)
        turn = 0.5 * (number > 600)
        made.append(sample(t_ns, (0.01, turn * sin(number / 50), turn), gravity(number * 31 % 7 / 100, 5)))
    return made


@given(st.lists(st.integers(0, 1500), max_size=8))
def test_the_batches_have_no_influence(cuts: list[int]) -> None:
    samples, host = noisy(1500), HostAttitude(FLU_LEVEL)
    made: list[Sample] = []
    for start, end in zip([0, *sorted(cuts)], [*sorted(cuts), 1500], strict=True):
        made += host.samples(samples[start:end])
    assert made == WHOLE


WHOLE = HostAttitude(FLU_LEVEL).samples(noisy(1500))


def restored(host: HostAttitude, **changes: Any) -> HostAttitude:
    """Return a filter that continues from the state of a filter, with other values of some fields."""
    host.save()
    made = HostAttitude(FLU_LEVEL)
    numbers = {field.name: field.number for field in ATTITUDE.fields}
    ATTITUDE.load(ATTITUDE.save(host) | {numbers[name]: value for name, value in changes.items()}, made)
    return made


@pytest.mark.parametrize("at", [0, 1, 20, 350, 650, 701, 920])
def test_a_restored_filter_continues_bit_for_bit(at: int) -> None:
    host = HostAttitude(FLU_LEVEL)
    host.samples(noisy(1500)[:at])
    assert restored(host).samples(noisy(1500)[at:]) == WHOLE[at:]


@pytest.mark.parametrize(
    "changes",
    [
        {"_period_ns": 0}, {"_period_ns": -1}, {"_period_ns": 1.5}, {"_period_ns": 10**12}, {"saved": {}},
        {"_turn": [1.0, 0.0]}, {"_turn": "1"}, {"_turn": 4 * [0.0]},
        {"_intervals_ns": 32 * [1]}, {"_intervals_ns": ["1"]},
        {"_yaw_rad": None}, {"_settled": 1}, {"_started_ns": None}, {"_newest_ns": 0.5},
        {"saved": {"gyrQuat": [1.0]}}, {"saved": None}, {"saved": [1]},
        {"saved": HostAttitude(FLU_LEVEL)._filter.state | {"gyrQuat": [1.0, 0.0]}},
        {"saved": HostAttitude(FLU_LEVEL)._filter.state | {"restT": "1"}},
        {"saved": HostAttitude(FLU_LEVEL)._filter.state | {"gyrQuat": 4 * [0.0]}},
    ],
)  # fmt: skip
def test_an_invalid_state_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(StateError):
        restored(HostAttitude(FLU_LEVEL), **changes)


def rig_with_host(driver: str, convention: Convention | None = None) -> PathRig:
    rig = PathRig(driver)
    axes = published_frame(None, convention, None, DRIVERS[driver].axes)
    rig.context = dataclasses.replace(rig.context, attitude=AttitudeSource.HOST, frame=axes)
    return rig


def test_a_path_publishes_other_axes_than_its_newest_sample_has() -> None:
    """x right, y forward, z up (ZXY), published as NED and FRD. The force to the right: the right side is up by 30°."""
    rig = rig_with_host("hipnuc-canopen", Convention.NED_FRD)
    path = rig.can()
    measured = Measurement(8, 0, None, accel_m_s2=(G / 2, 0.0, G * cos(pi / 6)), gyro_rad_s=(0.0, 0.0, 0.0))
    for number in range(400):
        rig.codec.results.append(([measured], 0))
        path.on_frames([CanFrame(0x188, False, bytes(8), rig.now + number * STEP_NS, False)])
    (first,), (last,) = rig.batches[0], rig.batches[-1]
    assert (first.status, last.status) == (UNSETTLED, None)
    assert last.accel_m_s2 == pytest.approx((0, G / 2, -G * cos(pi / 6)))
    assert degrees_of(last)[:2] == [-30, 0]
    assert path.newest is not None
    assert path.newest.accel_m_s2 == measured.accel_m_s2
    assert degrees_of(path.newest) == [-30, 0, 0]


@pytest.mark.parametrize("has_kernel", [True, False])
def test_frames_with_an_attitude_are_the_same_with_and_without_the_key(
    has_kernel: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not has_kernel:
        monkeypatch.setattr(kernel, "present", kernel.present._replace(module=None))
    found = []
    for rig in (rig_with_host("hipnuc-uart"), PathRig("hipnuc-uart")):
        path = rig.stream()
        for number in range(300):
            path.gather(hi91(1000 + number), rig.now + number * 1_000_000)
            if number % 7 == 0:
                path.publish_gathered()
        found.append([one for batch in rig.batches for one in batch])
    assert found[0] == found[1]
    assert found[0][-1].quat_wxyz is not None


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vqf", None)
    with pytest.raises(ImudError, match=r"cannot import vqf; .* attitude: .* install 'imud\[attitude\]'$"):
        attitude.check_extra()
    with pytest.raises(ImudError):
        HostAttitude(FLU_LEVEL)


def test_a_path_without_the_key_imports_nothing() -> None:
    code = (
        "import sys, imud.daemon, imud.sampling.path, imud.config; "
        "print([m for m in ('numpy', 'vqf', 'imud.sampling.attitude') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


# --- accuracy (docs/attitude.md) --------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [100, 200])
def test_a_simulated_motion_has_the_errors_of_the_page(rate_hz: int) -> None:
    """Limits: five times the figures of docs/attitude.md, because another seed gives other errors."""
    worst = Figures.worst(simulated(rate_hz))
    assert worst.rest_tilt_deg < 0.1
    assert worst.rest_yaw_deg < 0.1
    assert worst.turn_tilt_deg < 0.1
    assert worst.turn_yaw_deg < 0.2


def vendor_rows() -> Sequence[dict[str, str]]:
    if not Path(VENDOR_FILE).is_file():
        pytest.skip(f"{VENDOR_FILE} is missing: a recording of the vendor, which the repository does not contain")
    with Path(VENDOR_FILE).open() as file:
        return list(csv.DictReader(file))


def test_a_device_has_the_same_attitude() -> None:
    """A HI91 recording: 1 s at rest, 6 s of rotation at up to 460 °/s by hand, 2 s at rest."""
    found = against_device(vendor_rows())
    assert found.rest_tilt_deg < 0.2
    assert found.end_tilt_deg < 3
