"""The keys frame, convention, declination_deg and noise: all forms of a rotation, and errors with their place."""

# ruff: noqa: E501 - a row of the table has the whole message

import pytest

from imud import config
from imud.attitude.conventions import Convention, EulerOrder
from imud.attitude.published import FrameOptions, MountingAngles, MountingAxes
from imud.config.model import DeviceConfig
from imud.contracts.status import Deviations
from imud.model.errors import ConfigError

HEAD = """\
devices:
  bow:
    driver: {driver}
    uart: {{port: /dev/ttyUSB0}}
"""


def device(keys: str, driver: str = "hipnuc-uart") -> DeviceConfig:
    (made,) = config.parse(HEAD.format(driver=driver) + keys, "f.yaml").devices
    return made


def problem(keys: str, driver: str = "hipnuc-uart") -> str:
    with pytest.raises(ConfigError) as caught:
        device(keys, driver)
    (line,) = str(caught.value).splitlines()
    return line


def test_the_keys_of_a_frame_are_part_of_the_device() -> None:
    plain = device("")
    assert (plain.frame, plain.convention, plain.declination_deg, plain.noise) == (None, None, None, None)
    assert device("    noise: {gyro_rad_s: 0.001, mag_t: 2.0e-7}\n").noise == Deviations(gyro_rad_s=0.001, mag_t=2e-7)
    before, after = (config.parse(HEAD.format(driver="auto") + keys, "f.yaml") for keys in ("", "    frame: {}\n"))
    assert config.differences(before, after).devices_changed == ("bow",)


def test_every_way() -> None:
    axes = device("    frame: {axes: {x: y, y: -x, z: z}}\n    convention: ned-frd\n    declination_deg: -3.5\n")
    assert axes.frame == FrameOptions(axes=MountingAxes(x="y", y="-x", z="z"))
    assert (axes.convention, axes.declination_deg) == (Convention.NED_FRD, -3.5)
    angles = device("    frame: {euler: {roll_deg: 90, yaw_deg: -30.5}, level_roll_deg: 0.4}\n").frame
    assert angles == FrameOptions(euler=MountingAngles(roll_deg=90.0, yaw_deg=-30.5), level_roll_deg=0.4)
    quat = device("    frame: {quat_wxyz: [0, 1, 0, 0], heading_offset_deg: 3, level_at_rest: false}\n").frame
    assert quat == FrameOptions(quat_wxyz=[0.0, 1.0, 0.0, 0.0], heading_offset_deg=3.0, level_at_rest=False)
    down = device("    frame: {z_down: true, euler_order: zxy}\n", "imu61x-uart").frame
    assert down == FrameOptions(z_down=True, euler_order=EulerOrder.ZXY)
    assert device("    frame: {}\n").frame == FrameOptions()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("noise: {gyro_rad_s: 0}", "devices.bow.noise.gyro_rad_s"),
        ("noise: {gyro: 1}", "gyro"),
        ("noise: 3", "devices.bow.noise"),
        ("frame: {axes: {x: x, y: y, z: z}, quat_wxyz: [1, 0, 0, 0]}", "f.yaml:5:39: devices.bow.frame.quat_wxyz: expected one key for the rotation (axes, euler, quat_wxyz), got axes and quat_wxyz"),
        ("frame: {axes: {x: y, y: x, z: z}}", "f.yaml:5:19: devices.bow.frame.axes: expected right-handed axes, got a mirror image"),
        ("frame: {axes: {x: y, y: x, z: z}}", "with these x and y, z is -z"),
        ("frame: {axes: {x: x, y: x, z: z}}", "three different axes"),
        ("frame: {quat_wxyz: [1, 1, 0, 0]}", "of length 1"),
        ("frame: {axes: {x: u, y: x, z: z}}", 'f.yaml:5:23: devices.bow.frame.axes.x: expected one of "-x", "-y", "-z", "x", "y", "z", got "u"'),
        ("frame: {axes: {x: y, y: x}}", "expected the key z"),
        ("frame: {euler: {yaw: 3}}", "did you mean yaw_deg?"),
        ("frame: {roll_deg: 3}", "did you mean level_roll_deg?"),
        ("convention: enu", 'expected one of "enu-flu", "ned-frd", or null, got "enu"'),
        ("frame: upside-down", "expected keys and values"),
        ("frame: {axes: z_up}", "expected keys and values"),
        ("frame: {level_pitch_deg: 90}", "from -45 to 45"),
        ("frame: {quat_wxyz: [1, 0, 0]}", "quat_wxyz"),
        ("frame: {euler: {yaw_deg: 360.5}}", "devices.bow.frame.euler.yaw_deg: expected a number from -360 to 360"),
        ("frame: {euler: {yaw_deg: -360.5}}", "from -360 to 360"),
        ("declination_deg: 181", "from -180 to 180"),
    ],
)  # fmt: skip
def test_what_is_refused(keys: str, message: str) -> None:
    assert message in problem(f"    {keys}\n")


def test_a_declination_needs_a_magnetic_heading() -> None:
    assert device("    declination_deg: 3\n").declination_deg == 3.0
    line = problem("    declination_deg: 3\n", "imu61x-uart")
    assert line.endswith("got imu61x-uart, whose heading is relative to power-on")
    assert line.startswith("f.yaml:5:5: devices.bow.declination_deg: ")
    assert "the name of a driver next to declination_deg" in problem("    declination_deg: 3\n", "auto")
    nmea = "devices:\n  bow:\n    driver: hipnuc-nmea2000\n    socketcan: {interface: can0}\n    declination_deg: 1\n"
    assert config.parse(nmea, "f.yaml").devices[0].declination_deg == 1
    with pytest.raises(ConfigError, match="whose heading is already true"):
        config.parse(nmea + "    options: {heading: 'true'}\n", "f.yaml")
