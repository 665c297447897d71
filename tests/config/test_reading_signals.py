"""GPIO lines and coordinate frames of a device in the configuration: accepted values, each error with its place."""

# ruff: noqa: E501 - a row of the table is a device and the whole message for it

import sys

import pytest

from imud import config
from imud.attitude.conventions import Convention, EulerOrder
from imud.attitude.published import FrameOptions, MountingAngles, MountingAxes
from imud.config.model import DeviceConfig
from imud.contracts import lines as contracts_lines
from imud.contracts.status import Deviations
from imud.drivers import DRIVERS
from imud.model.errors import ConfigError
from imud.utc import RMC_SOURCES
from imud.utc.receivers import RmcOptions


def parse(*devices: str) -> tuple[DeviceConfig, ...]:
    """Parse the devices a, b, …, one per line."""
    text = "".join(f"  {name}: {{{keys}}}\n" for name, keys in zip("abc", devices, strict=False))
    return config.parse("devices:\n" + text, "f").devices


HIPNUC = "driver: hipnuc-uart, uart: {port: x}"


def hipnuc(lines: str, port: str = "x") -> str:
    return f"driver: hipnuc-uart, uart: {{port: {port}}}, lines: {{{lines}}}"


def spi(lines: str) -> str:
    return f"driver: imu61x-spi, spi: {{port: y}}, lines: {{{lines}}}"


def errors(*devices: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse(*devices)
    return [line.removeprefix("f:") for line in str(caught.value).splitlines()]


def test_every_line() -> None:
    bow, gimbal = parse(
        hipnuc(
            "sout: {line: 17, chip: gpiochip0, bias: pull-down}, sout_div: {line: D, divisor: 64}, "
            "sin: {line: S, rate_hz: 0}, alarm: {line: A, active_low: true}, pps: {line: P, chrony: /run/chrony.imud.sock}"
        ),
        spi("reset: {line: R, hold_ms: 5, open_drain: true}, data_ready: {line: Y, edge: falling}"),
    )
    assert bow.lines == contracts_lines.DeviceLines(
        sout=contracts_lines.SoutOptions(line=17, chip="gpiochip0", bias="pull-down"), sout_div=contracts_lines.DividedOptions(line="D", divisor=64),
        sin=contracts_lines.TriggerOptions(line="S", rate_hz=0.0), alarm=contracts_lines.InputOptions(line="A", active_low=True),
        pps=contracts_lines.PpsOptions(line="P", chrony="/run/chrony.imud.sock"),
    )  # fmt: skip
    assert gimbal.lines == contracts_lines.DeviceLines(
        reset=contracts_lines.ResetOptions(line="R", hold_ms=5.0, open_drain=True),
        data_ready=contracts_lines.ReadyOptions(line="Y", edge="falling"),
    )


def test_defaults_and_lines_of_drivers() -> None:
    for keys in ("driver: hipnuc-uart, uart: {port: x}", hipnuc("")):
        assert parse(keys)[0].lines is None
    for name, driver in DRIVERS.items():
        assert driver.lines <= set(contracts_lines.LINE_SCHEMAS), name
    assert DRIVERS["hipnuc-uart"].lines == {"sout", "sout_div", "sin", "alarm", "pps"}
    assert DRIVERS["imu61x-i2c"].lines == {"reset", "data_ready"}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (hipnuc("sut: {line: A}"), '2:53: devices.a.lines.sut: expected a key that imud knows, got "sut"; did you mean sout? known: alarm, data_ready, pps, reset, sin, sout, sout_div'),
        (hipnuc("reset: {line: A}"), '2:53: devices.a.lines.reset: expected a line of hipnuc-uart devices (sout, sout_div, sin, alarm, pps), got "reset"'),
        (spi("sout: {line: A}"), '2:51: devices.a.lines.sout: expected a line of imu61x-spi devices (reset, data_ready), got "sout"'),
        ("driver: imu61x-uart, uart: {port: x}, lines: {data_ready: {line: A}}", "expected a line of imu61x-uart devices (reset), got"),
        ("driver: imu61x-can, socketcan: {interface: c}, lines: {reset: {line: A}}", "expected a line of imu61x-can devices (none), got"),
        ("uart: {port: x}, lines: {sout: {line: A}}", "2:24: devices.a.lines: expected the name of a driver next to lines, got auto; drivers with lines: hipnuc-uart"),
        ("driver: nobody, uart: {port: x}, lines: {sout: {line: A}}", 'expected a driver that imud knows, got "nobody"'),
        (hipnuc("sout: {line: 17}"), "2:59: devices.a.lines.sout: expected the key chip next to the number of a line, got no chip"),
        (hipnuc("sout: {chip: gpiochip0}"), "2:53: devices.a.lines.sout: expected the key line (a whole number from 0 to 1023, or text that is not empty), got none"),
        (hipnuc("sout: {line: -1, chip: c}"), "expected a whole number from 0 to 1023, or text that is not empty, got -1"),
        (hipnuc("sout: {line: A, rate_hz: 5}"), 'devices.a.lines.sout.rate_hz: expected a key that imud knows, got "rate_hz"; known: active_low, bias, bias_us, chip, line, offset_us, width_us'),
        (hipnuc("sout: GPIO17"), '2:59: devices.a.lines.sout: expected keys and values, got "GPIO17"'),
        (hipnuc("sout: "), "devices.a.lines.sout: expected keys and values, got nothing"),
        (hipnuc("sout_div: {line: A, divisor: 65}"), "devices.a.lines.sout_div.divisor: expected a whole number from 1 to 64, got 65"),
        (hipnuc("sout_div: {line: A, divisor: 0}"), "expected a whole number from 1 to 64, got 0"),
        (hipnuc("sin: {line: A, rate_hz: 1001}"), "devices.a.lines.sin.rate_hz: expected a number from 0 to 1000, got 1001"),
        (hipnuc("sin: {line: A, rate_hz: .nan}"), "expected a finite number, got .nan"),
        (hipnuc("sin: {line: A, bias: pull-up}"), 'got "bias"; did you mean bias_us? known: active_low, bias_us, chip, line, offset_us, open_drain, pulse_ms, rate_hz'),
        (hipnuc("alarm: {line: A, bias: up}"), 'expected one of "as-is", "disabled", "pull-down", "pull-up", got "up"'),
        (hipnuc('sout: {line: "A\\0"}'), "devices.a.lines.sout.line: expected text without control characters, got"),
        (spi("reset: {line: A, hold_ms: 0}"), "devices.a.lines.reset.hold_ms: expected a number from 0.01 to 10000, got 0"),
        (spi("data_ready: {line: A, edge: both}"), 'expected one of "falling", "rising", got "both"'),
        (hipnuc("sout_div: {line: D, divisor: 4}") + ", settings: {sout_divisor: 8}", "2:53: devices.a.lines.sout_div: with the declared settings, expected divisor 4 from the configuration, got 8"),
        ("driver: imu61x-uart, uart: {port: x}, rmc: {source: gpsd}", '2:45: devices.a.rmc: expected rmc only with the link uart and a device with SIN/PPS, got driver "imu61x-uart"'),
        ("driver: hipnuc-uart, replay: {path: x}, rmc: {source: gpsd}", "2:47: devices.a.rmc: expected rmc only with the link uart"),
        ("uart: {port: x}, rmc: {source: gpsd}", "2:24: devices.a.rmc: expected the name of a driver next to rmc, got auto"),
        ("driver: nobody, uart: {port: x}, rmc: {source: gpsd}, settings: {mode: 6-axis}", '2:15: devices.a.driver: expected a driver that imud knows, got "nobody"'),
        # a device that imud triggers has no pulse per second
        (hipnuc("sin: {line: GPIO17}") + ", rmc: {source: gpsd}", "2:75: devices.a.rmc: expected the pulse per second of a receiver on SIN with rmc, got lines.sin, with which imud drives SIN (line 2); remove one of the keys"),
        (hipnuc("")[:-2] + "5", "devices.a.lines: expected keys and values, got 5"),
        (HIPNUC + ", rmc: {}", "expected the key source"),
        (HIPNUC + ", rmc: {source: ntp}", 'expected one of "gpsd", "nmea", "system"'),
        (HIPNUC + ", rmc: {source: nmea}", "expected the key port for source nmea"),
        (HIPNUC + ", rmc: {source: gpsd, rate_hz: 11}", "rate_hz"),
        (HIPNUC + ", rmc: {source: gpsd, rate_hz: 0}", "rate_hz"),
        (HIPNUC + ", rmc: {source: gpsd, tcp_port: 0}", "tcp_port"),
        (HIPNUC + ", rmc: {source: gpsd, error_ms: .nan}", "error_ms"),
        (HIPNUC + ", rmc: {source: gpsd, speed: 1}", "speed"),
    ],
)  # fmt: skip
def test_refusals(keys: str, message: str) -> None:
    (found,) = errors(keys)
    assert found.startswith("2:")
    assert message in found


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("line: 17, chip: gpiochip0", "line: 17, chip: gpiochip0"),
        ("line: 17, chip: gpiochip0", "line: 17, chip: /dev/gpiochip0, active_low: true"), ("line: A", "line: A"),
        ("line: A, chip: gpiochip0", "line: A"),
    ],
)  # fmt: skip
def test_one_wire_under_two_keys(one: str, other: str) -> None:
    (found,) = errors(hipnuc(f"sout: {{{one}}}, pps: {{{other}}}"))
    assert "devices.a.lines.pps: expected an unused line, got " in found
    assert found.endswith(", which a.lines.sout (line 2) uses")
    (found,) = errors(hipnuc(f"sout: {{{one}}}"), hipnuc(f"sout: {{{other}}}", "z"))
    assert "3:53: devices.b.lines.sout: expected an unused line" in found
    assert found.endswith(", which a.lines.sout (line 2) uses")


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("line: 17, chip: gpiochip0", "line: 17, chip: gpiochip1"),
        ("line: 17, chip: gpiochip0", "line: 18, chip: gpiochip0"),
        ("line: A, chip: gpiochip0", "line: A, chip: gpiochip1"), ("line: A", "line: B"),
    ],
)  # fmt: skip
def test_two_wires(one: str, other: str) -> None:
    assert parse(hipnuc(f"sout: {{{one}}}, pps: {{{other}}}"))
    assert parse(hipnuc(f"sout: {{{one}}}"), hipnuc(f"sout: {{{one}}}", "z") + ", enabled: false"), "has no wire"


@pytest.mark.parametrize(
    ("keys", "rmc"),
    [
        (HIPNUC, None),
        (HIPNUC + ", rmc: {source: gpsd}", RmcOptions(source="gpsd")),
        (HIPNUC + ", rmc: {source: system, rate_hz: 5, error_ms: 10}",
         RmcOptions(source="system", rate_hz=5, error_ms=10.0)),
        (HIPNUC + ", rmc: {source: nmea, port: /dev/ttyUSB1, baud: 38400}",
         RmcOptions(source="nmea", port="/dev/ttyUSB1", baud=38400)),
        (hipnuc("pps: {line: GPIO17}") + ", rmc: {source: gpsd}", RmcOptions(source="gpsd")),
    ],
)  # fmt: skip
def test_each_rmc_source(keys: str, rmc: RmcOptions | None) -> None:
    assert parse(keys)[0].rmc == rmc
    assert set(RMC_SOURCES) == set(RmcOptions.__annotations__["source"].__args__)
    assert all(map(callable, RMC_SOURCES.values()))


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


def test_the_keys_of_frame_and_lines_are_part_of_the_device() -> None:
    plain = device("")
    assert (plain.frame, plain.convention, plain.declination_deg, plain.noise) == (None, None, None, None)
    assert device("    noise: {gyro_rad_s: 0.001, mag_t: 2.0e-7}\n").noise == Deviations(gyro_rad_s=0.001, mag_t=2e-7)
    before, after = (config.parse(HEAD.format(driver="auto") + keys, "f.yaml") for keys in ("", "    frame: {}\n"))
    assert config.differences(before, after).devices_changed == ("bow",)
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
    before, after = (
        config.parse(f"devices:\n  a: {{{hipnuc(keys)}}}\n", "f") for keys in ("sout: {line: A}", "sout: {line: B}")
    )
    assert config.differences(before, after).devices_changed == ("a",)


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


RAW = "devices:\n  bow:\n    driver: {}\n    {}\n    attitude: host\n"


@pytest.mark.parametrize(
    ("driver", "keys", "message"),
    [
        ("imu61x-spi", "spi: {port: /dev/spidev0.0}", ""), ("imu61x-i2c", "i2c: {bus: 1}", ""),
        ("imu61x-spi", "spi: {port: /dev/spidev0.0}\n    options: {burst: registers}", ""),
        ("imu61x-spi", "spi: {port: /dev/spidev0.0}\n    options: {burst: extended}",
         "expected a device without an attitude of its own (imu61x-i2c, imu61x-spi), got imu61x-spi with these options"),
        ("hipnuc-uart", "uart: {port: x}", "got hipnuc-uart with these options; remove the key"),
        ("auto", "uart: {port: x}", "expected the name of a driver next to attitude: host, got auto"),
    ],
)  # fmt: skip
def test_the_host_computes_an_attitude_only_for_raw_samples(driver: str, keys: str, message: str) -> None:
    text = RAW.format(driver, keys)
    if not message:
        assert config.parse(text, "f.yaml").devices[0].attitude == "host"
        return
    with pytest.raises(ConfigError) as caught:
        config.parse(text, "f.yaml")
    assert str(caught.value).startswith(f"f.yaml:{text.count(chr(10))}:5: devices.bow.attitude: ")
    assert message in str(caught.value)


def test_a_missing_library_of_the_attitude_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "vqf", None)
    with pytest.raises(ConfigError, match=r"devices.bow.attitude: cannot import vqf; .* attitude: .* install "):
        config.parse(RAW.format("imu61x-i2c", "i2c: {bus: 1}"), "f.yaml")
    config.parse(RAW.format("imu61x-i2c", "i2c: {bus: 1}").replace("host", "device"), "f.yaml")


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
