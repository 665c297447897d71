"""Configuration: accepted values, each error with its place, the shipped file, and changes between two files."""

# ruff: noqa: E501 - a row of the table is a whole file and the whole message for it

import builtins
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from docs.generate.settings_parts import settings_parts
from imud import config
from imud.attitude.conventions import Heading
from imud.attitude.published import FrameOptions, MountingAngles, MountingAxes
from imud.config.model import Config, DeviceConfig
from imud.config.schema import TABLES, Tables
from imud.config.yaml import read_yaml
from imud.contracts.driver import KeyProblem
from imud.contracts.lines import LINE_SCHEMAS, DeviceLines
from imud.contracts.link import Claim
from imud.contracts.publisher import OutputListener
from imud.contracts.setting import SettingsTable
from imud.drivers import DRIVERS
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions
from imud.drivers.imu61x.uart.raw import RawFrame
from imud.links import LINKS
from imud.model.errors import ConfigError
from imud.model.options import NoOptions, Options
from imud.publishers import PUBLISHERS
from tests.support.files import ROOT

SHIPPED = ROOT / "etc/imud.yaml"


class PortSettings(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    port: Annotated[str, Meta(min_length=1)]
    baud: Annotated[int, Meta(ge=50, le=4_000_000)] | Literal["auto"] = "auto"
    wait_ms: Annotated[float, Meta(ge=0, le=100)] = 0.0


class FileSettings(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    path: str
    speed: Literal["real", "maximum"] = "real"
    repeat: bool = False

    def __post_init__(self) -> None:
        if self.repeat and self.speed == "maximum":
            raise ValueError("repeat: expected false at speed maximum, got true")
        if self.path == "/":
            raise ValueError("this is not a file")


class OutSettings(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    path: str = "/run/x"
    ids: tuple[int, ...] = ()
    names: tuple[str, ...] = ()


class DriverSettings(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    range_g: Annotated[int, Meta(ge=2, le=16)] = 8


@dataclass(frozen=True)
class FakeRow:
    settings: type[Options]
    searchable: bool = True
    lines: frozenset[str] = frozenset()
    heading: Callable[[Any, Mapping[str, str]], Heading] = lambda _settings, _read_back: Heading.UNKNOWN
    refuses: type[Options] | None = None
    """Options of a driver that does not fit this link."""
    faults: tuple[KeyProblem, ...] = ()
    """Problems that the driver reports for all options."""
    device_settings: SettingsTable | None = None
    declared_line_differences: Callable[[Mapping[str, Any], DeviceLines], Mapping[str, str]] = lambda _declared, _: {}

    def bus_of(self, settings: Options) -> str:
        return ""

    def problems(self, options: Options, link: Options) -> Sequence[KeyProblem]:
        return self.faults

    claims: Callable[[Any], Sequence[Claim]] = lambda _settings: ()
    listeners: Callable[[Any], Sequence[OutputListener]] = lambda _settings: ()
    wanted: Callable[[Any], bool] = lambda _settings: True
    used_lines: Callable[[Any], Sequence[Any]] = lambda _settings: ()
    problem: Callable[[Any, bool], str] = lambda _settings, _frames: ""
    check: Callable[[Any, Any], Mapping[tuple[str, ...], str]] = lambda _settings, _drivers: {}

    def fits(self, driver: "FakeRow") -> bool:
        return driver.settings is not self.refuses


def fake_row(*args: Any, **kwargs: Any) -> Any:
    """Return a `FakeRow`, typed as the row of any table."""
    return FakeRow(*args, **kwargs)


class Broken(Mapping[str, Any]):
    """A registry with a row that needs a missing library."""

    def __getitem__(self, name: str) -> Any:
        raise ModuleNotFoundError(f"No module named {name!r}")

    def __iter__(self) -> Iterator[str]:
        return iter(["exotic"])

    def __len__(self) -> int:
        return 1


FAKE = Tables(
    drivers={"acme-uart": fake_row(DriverSettings), "plain-uart": fake_row(NoOptions)},
    links={
        "port": fake_row(PortSettings, claims=lambda port: [Claim(place=port.port, key="port")]),
        "file": fake_row(FileSettings),
    },
    publishers={"out": fake_row(OutSettings), "none": fake_row(NoOptions)},
)
GOOD = """\
log_level: debug
out:
  path: /tmp/out
devices:
  front:
    driver: acme-uart
    options: {range_g: 4}
    port: {port: /dev/ttyUSB0, baud: 9600, wait_ms: 2}
  rear:
    identify: false
    file: {path: a.bin}
  spare:
    enabled: false
    port: {port: /dev/ttyUSB0}
"""


def parse(text: str, tables: Tables = FAKE) -> Config:
    return config.parse(text, "f.yaml", tables)


def errors(text: str, tables: Tables = FAKE) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse(text, tables)
    return str(caught.value).splitlines()


def test_a_good_file_and_defaults() -> None:
    assert parse(GOOD) == Config(
        log_level="debug",
        state_dir="/var/lib/imud",
        publishers={"out": OutSettings(path="/tmp/out"), "none": NoOptions()},
        devices=(
            DeviceConfig(
                "front", "acme-uart", DriverSettings(range_g=4), True, "port",
                PortSettings(port="/dev/ttyUSB0", baud=9600, wait_ms=2.0), line=5,
            ),
            DeviceConfig("rear", "auto", None, False, "file", FileSettings(path="a.bin"), line=9),
        ),
        disabled=("spare",),
    )  # fmt: skip
    made = parse("devices: {}")
    assert (made.log_level, made.state_dir, made.devices) == ("info", "/var/lib/imud", ())
    assert made.publishers == {"out": OutSettings(), "none": NoOptions()}
    assert parse("out:\ndevices: {}").publishers["out"] == OutSettings()
    (device,) = parse("devices: {a: {driver: acme-uart, port: {port: x}}}").devices
    assert device.options == DriverSettings(), "options of a named driver need not be written"
    assert config.parse(GOOD, "f", FAKE) == config.parse(GOOD.encode(), "f", FAKE)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("log_level: loud\ndevices: {}", '1:12: log_level: expected one of "debug", "error", "info", "warning", got "loud"'),
        ("state_dir: 3\ndevices: {}", "1:12: state_dir: expected text that is not empty, got 3"),
        ("devices:\n  a:\n    port: {port: x, baud: fast}", '3:27: devices.a.port.baud: expected a whole number from 50 to 4000000, or "auto", got "fast"'),
        ("devices:\n  a:\n    port: {port: x, baud: 49}", '3:27: devices.a.port.baud: expected a whole number from 50 to 4000000, or "auto", got 49'),
        ("devices:\n  a:\n    port: {port: x, baud: true}", '3:27: devices.a.port.baud: expected a whole number from 50 to 4000000, or "auto", got true'),
        ("devices:\n  a:\n    port: {port: x, wait_ms: 101}", "3:30: devices.a.port.wait_ms: expected a number from 0 to 100, got 101"),
        ("devices:\n  a:\n    port: {port: x, wait_ms: '5'}", '3:30: devices.a.port.wait_ms: expected a number from 0 to 100, got "5"'),
        ("devices:\n  a:\n    port: {port: x, wait_ms: .nan}", "3:30: devices.a.port.wait_ms: expected a finite number, got .nan"),
        ("devices:\n  a:\n    port: {port: }", "3:18: devices.a.port.port: expected text that is not empty, got nothing"),
        ("devices:\n  a:\n    port:\n      baud: 9600", "3:5: devices.a.port: expected the key port (text that is not empty), got none"),
        ("devices:\n  a:\n    port: /dev/ttyUSB0", '3:11: devices.a.port: expected keys and values, got "/dev/ttyUSB0"'),
        ("devices:\n  a:\n    file: {path: x, repeat: no}", "3:29: devices.a.file.repeat: expected true or false, or text in quotes, got no"),
        ("devices:\n  a:\n    file: {path: x, repeat: true, speed: maximum}", "3:29: devices.a.file.repeat: expected false at speed maximum, got true"),
        ("devices:\n  a:\n    file: {path: /}", "3:11: devices.a.file: this is not a file"),
        ("devices:\n  a:\n    identify: 1\n    port: {port: x}", "3:15: devices.a.identify: expected true or false, got 1"),
        ("devices:\n  a: {driver: auto}", "2:3: devices.a: expected exactly one link (port, file), got none"),
        ("devices:\n  a:\n    port: {port: x}\n    file: {path: x}", "2:3: devices.a: expected exactly one link (port, file), got port and file"),
        ("devices:\n  a: 5", "2:6: devices.a: expected keys and values, got 5"),
        ("devices:\n  a:\n", "2:5: devices.a: expected keys and values, got nothing"),
        ("devices:\n  a: {driver: acme-urat, port: {port: x}}", '2:15: devices.a.driver: expected a driver that imud knows, got "acme-urat"; did you mean acme-uart? known: acme-uart, auto, plain-uart'),
        ("devices:\n  a: {driver: 5, port: {port: x}}", "2:15: devices.a.driver: expected text, got 5"),
        ("devices:\n  a: {options: {range_g: 4}, port: {port: x}}", "2:7: devices.a.options: expected the name of a driver next to options, got auto; drivers: acme-uart, plain-uart"),
        ("devices:\n  a: {driver: plain-uart, port: {port: x}, firmware: new.hex}", '2:44: devices.a.firmware: expected a key that imud knows, got "firmware"; did you mean frame? known: attitude, condition, convention, declination_deg, driver, enabled, file, frame, identify, lines, noise, on_difference, options, port, rmc, settings'),
        ("devices:\n  a: {driver: plain-uart, options: {range_g: 4}, port: {port: x}}", '2:37: devices.a.options.range_g: expected a key that imud knows, got "range_g"; known: none'),
        ("devices:\n  a: {driver: acme-uart, options: {range_g: 17}, port: {port: x}}", "2:45: devices.a.options.range_g: expected a whole number from 2 to 16, got 17"),
        ("devices:\n  A: {port: {port: x}}", '2:3: devices.A: expected a device name of 1 to 32 characters of a-z, 0-9, _ and -, starting with a letter or digit, got "A"'),
        ("devices:\n  a: {port: {port: x}}\n  b: {port: {port: x}}", "3:20: devices.b.port.port: expected an unused port, got x; a (line 2) uses it"),
        ("devices:\n  a: {port: {port: x}}\n  a: {port: {port: y}}", "3:3: devices.a: expected each key once, got a again: it stands in line 2 too"),
        ("devices:\n", "1:9: devices: expected a name and keys for each device, got nothing; write {} for no device"),
        ("devices: [a]", "1:10: devices: expected keys and values, got a list"),
        ("log_level: info\n", "1:1: expected the key devices with a name and keys for each device, got none"),
        ("just text", '1:1: expected keys and values, got "just text"'),
        ("", "1:1: expected keys and values, got an empty file"),
        ("divices: {}\ndevices: {}", '1:1: divices: expected a key that imud knows, got "divices"; did you mean devices? known: devices, log_level, none, out, state_dir'),
        ("out: {ids: [1, x]}\ndevices: {}", "1:12: out.ids: expected a list, each item a whole number, got a list with \"x\" at [1]"),
        ('out: {names: [a, "b\\0"]}\ndevices: {}', '1:14: out.names: expected text without control characters, got "b\\u0000"'),
        ("logg: 1\nb: c: d\n", "2:5: expected YAML: mapping values are not allowed in this context"),
        ("out: 5\ndevices: {}", "1:6: out: expected keys and values, got 5"),
    ],
)  # fmt: skip
def test_error_with_its_place(text: str, line: str) -> None:
    assert errors(text) == ["f.yaml:" + line]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("recorder: {flight: {enable: true}}", '1:21: recorder.flight.enable: expected a key that imud knows, got "enable"; did you mean enabled?'),
        ("recorder:\n  flight:\n    minutes: 10min", '3:14: recorder.flight.minutes: expected a number from 0.1 to 1440, got "10min"'),
        ("recorder: {flight: {line: {chip: x}}}", "1:21: recorder.flight.line: expected the key line (a whole number from 0 to 1023, or text that is not empty), got none"),
        ("nmea0183: {sentences: {HTD: 1}}", '1:24: nmea0183.sentences.HTD: expected a key that imud knows, got "HTD"; did you mean HDT?'),
        ("nmea0183:\n  sentences: {HDT: 1, ROT: 1000}", "2:28: nmea0183.sentences.ROT: expected a number from 0.01 to 100, got 1000"),
        ("mqtt: {commands: {per_minute: 0}}", "1:31: mqtt.commands.per_minute: expected a whole number from 1 to 600, got 0"),
        ("mqtt: {commands: {actions: [save, bow/output, rate, settings, reset]}}", '1:28: mqtt.commands.actions: expected a command, got "bow/output", which is a setting now; use bow/set.output; expected a command, got "rate", which is a setting now; use set.output_rate_hz; expected a command, got "settings", which is a setting now; remove it'),
        ("mqtt: {commands: {actions: [set, bow/set.mode, restrat]}}", '1:28: mqtt.commands.actions: expected a command that imud knows, got "restrat"; did you mean restart?'),
        ("mqtt: {commands: {actions: [bow/firmware]}}", '1:28: mqtt.commands.actions: expected a command that imud knows, got "firmware"'),
        ("mqtt: {commands: {actions: [set.mod]}}", '1:28: mqtt.commands.actions: expected a setting after set. that imud knows, got "mod"; did you mean mode?'),
        ("mqtt: {commands: {actions: [direction]}}", '1:28: mqtt.commands.actions: expected a command, got "direction", which is a setting now; use set.incli_x_reversed, set.incli_y_reversed, set.x_reversed, set.y_reversed'),
        ("mqtt: {devices: {bow: {rate: 1}}}", '1:24: mqtt.devices.bow.rate: expected a key that imud knows, got "rate"; did you mean rate_hz?'),
        ("mqtt: {devices: {bow: {rate_hz: fast}}}", '1:33: mqtt.devices.bow.rate_hz: expected a number from 0.01 to 100, or null, got "fast"'),
    ],
)  # fmt: skip
def test_a_problem_inside_of_a_value_has_its_own_key_and_place(text: str, line: str) -> None:
    (found,) = errors(text + "\ndevices: {}", TABLES)
    assert found.startswith("f.yaml:" + line)


def test_all_errors_are_reported_in_the_order_of_the_file() -> None:
    text = (
        "log_levle: info\nout: {path: 1, ids: no}\ndevices:\n  a: {port: {prot: x, baud: 1}}\n  B: {file: {path: x}}\n"
    )
    places = [re.match(r"f\.yaml:(\d+:\d+): (\S+):", line) for line in errors(text)]
    assert [place.groups() for place in places if place] == [
        ("1:1", "log_levle"), ("2:13", "out.path"), ("2:21", "out.ids"), ("4:7", "devices.a.port"),
        ("4:14", "devices.a.port.prot"), ("4:29", "devices.a.port.baud"), ("5:3", "devices.B"),
    ]  # fmt: skip
    text = "mqtt: {devices: {a: {whole: xml, batch_s: 0}, b: {event: 1}}}\ndevices: {}"
    keys = [line.split(": ")[1] for line in errors(text, TABLES)]
    assert keys == ["mqtt.devices.a.whole", "mqtt.devices.a.batch_s", "mqtt.devices.b.event"]


def test_names_and_number_of_devices() -> None:
    for name in ("0", "a-b_c", "a" * 32):
        assert [d.name for d in parse(f"devices: {{'{name}': {{file: {{path: x}}}}}}").devices] == [name]
    for name in ("a" * 33, "-a", "_a", "é", "a.b", "a b", "a/b", "../a", "", "a\\n"):
        assert "device name" in errors(f'devices: {{"{name}": {{file: {{path: x}}}}}}')[0]

    def text(count: int) -> str:
        return "devices:\n" + "".join(f"  d{n}: {{file: {{path: x}}}}\n" for n in range(count))

    assert len(parse(text(256)).devices) == 256
    assert "at most 256 devices, got 257" in errors(text(257))[0]


def test_a_part_that_is_not_installed_or_not_searchable() -> None:
    tables = replace(FAKE, links=Broken())
    assert errors("devices: {a: {exotic: {x: 1}}}", tables) == [
        "f.yaml:1:15: devices.a.exotic: expected the installed packages of exotic, got: No module named 'exotic'"
    ]
    tables = Tables(FAKE.drivers, {"port": fake_row(PortSettings, searchable=False)}, FAKE.publishers)
    (line,) = errors("devices:\n  a: {port: {port: x}}", tables)
    assert "expected the name of a driver for port (acme-uart, plain-uart), got auto" in line


def test_load(tmp_path: Path) -> None:
    file, loop, fifo = tmp_path / "imud.yaml", tmp_path / "a", tmp_path / "fifo"
    file.write_text(GOOD)
    assert config.load(file, FAKE) == parse(GOOD)
    with pytest.raises(ConfigError, match=r"No such file or directory; look elsewhere$"):
        config.load(tmp_path / "none.yaml", FAKE, missing="look elsewhere")
    file.write_bytes(b"# " + b"x" * (2 << 20))
    loop.symlink_to("a")
    os.mkfifo(fifo)
    for path, words in (
        (tmp_path / "none.yaml", r"cannot read .*none\.yaml: No such file or directory; is the path right\?$"),
        (tmp_path, r"cannot read .*: Is a directory; is the path right\?"),
        (loop, r"Too many levels of symbolic links; is the path right\?"),
        (fifo, r"cannot read .*fifo: is a FIFO, expected a regular file"),
        (Path("/dev/zero"), "is a character device"),
        (file, "at most 1048576 bytes"),
    ):
        with pytest.raises(ConfigError, match=words):
            config.load(path, FAKE)


def test_differences() -> None:
    old = parse(GOOD)
    assert str(config.differences(old, old)) == "nothing differs"
    moved = parse("# one line more\n" + GOOD)
    assert moved.devices != old.devices
    assert str(config.differences(old, moved)) == "nothing differs"
    new = parse(
        GOOD.replace("  rear:", "  side:").replace("range_g: 4", "range_g: 2").replace("/tmp/out", "/tmp/o")
        .replace("debug", "info")
    )  # fmt: skip
    found = config.differences(old, new)
    assert found == config.Differences(("side",), ("rear",), ("front",), ("out",), ("log_level",))
    assert str(found) == (
        "devices added: side; devices removed: rear; devices changed: front; publishers changed: out; "
        "keys changed: log_level"
    )
    disabled = parse(GOOD.replace("identify: false", "enabled: false"))
    assert config.differences(old, disabled).devices_removed == ("rear",)
    assert config.differences(disabled, old).devices_added == ("rear",)


def refused(content: bytes) -> list[str]:
    try:
        config.parse(content, "f", FAKE)
    except ConfigError as error:
        return str(error).splitlines()
    return []


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.text("ab\n\x1b\u2028.", max_size=5) | st.sampled_from(["auto", "acme-uart", "x"]),
        lambda inner: st.lists(inner, max_size=3)
        | st.dictionaries(
            st.text("a\n\u2028", max_size=3)
            | st.sampled_from(["devices", "out", "a", "driver", "options", "port", "file", "path", "baud", "ids"]), inner,
            max_size=4,
        ),
        max_leaves=10,
    )
)  # fmt: skip
def test_any_tree_is_a_configuration_or_a_config_error(tree: Any) -> None:
    text = msgspec.json.encode(tree)
    for wrapped in (text, b'{"devices": {"a": ' + text + b"}}"):
        for line in refused(wrapped):
            assert line.startswith(("f:", "… and "))


def uncommented(text: str) -> str:
    """Return the shipped file with all its examples active: remove each `#` directly before a key or list."""
    return re.sub(r"^( *)#(?=( {2})*([a-z_0-9]+|\"\*\"):)", r"\1", text, flags=re.MULTILINE)


def test_shipped_file_shows_the_defaults() -> None:
    plain, full = config.load(SHIPPED), config.parse(uncommented(SHIPPED.read_text()), "etc/imud.yaml")
    assert ([device.name for device in plain.devices], set(plain.publishers)) == (["imu"], set(PUBLISHERS))
    assert full.publishers == plain.publishers
    assert (full.log_level, full.state_dir) == (plain.log_level, plain.state_dir)
    named = {device.name: device for device in full.devices}
    assert replace(named["imu"], line=0) == replace(plain.devices[0], line=0)
    for device in full.devices:
        if device.name == "tiller":
            layout = RawFrame(type="f32", accel_at=4, gyro_at=16, accel_g_per_lsb=1, gyro_deg_s_per_lsb=1)
            assert device.options == Imu61xUartOptions(raw_frame=layout)
        elif device.options is not None:
            assert device.options == DRIVERS[device.driver].settings()
    assert named["recorded"].link_settings == msgspec.convert(
        {"path": "/var/lib/imud/drive.cap"}, LINKS["replay"].settings
    )
    assert named["mast"].link_settings == msgspec.convert({"interface": "can0"}, LINKS["socketcan"].settings)
    assert named["gimbal"].link_settings == msgspec.convert({"port": "/dev/spidev0.0"}, LINKS["spi"].settings)
    for name, link in (("keel", "i2c"), ("nothing", "memory")):
        assert named[name].link_settings == LINKS[link].settings()
    assert {device.link for device in full.devices} == set(LINKS)
    frames = {device.name: device.frame for device in full.devices if device.frame is not None}
    assert frames == {
        "crane": FrameOptions(axes=MountingAxes(x="y", y="-x", z="z")), "pole": FrameOptions(euler=MountingAngles()),
        "mirror": FrameOptions(quat_wxyz=[1.0, 0.0, 0.0, 0.0]),
    }  # fmt: skip
    assert {(device.convention, device.declination_deg) for device in full.devices} == {(None, None)}
    lines = [device.lines for device in full.devices if device.lines]
    shown = {name: made for one in lines for name in LINE_SCHEMAS if (made := getattr(one, name)) is not None}
    assert shown == {name: LINE_SCHEMAS[name](line=made.line, chip=made.chip) for name, made in shown.items()}
    assert set(shown) == set(LINE_SCHEMAS)


def test_shipped_file_has_every_key_of_every_row() -> None:
    tree = read_yaml(uncommented(SHIPPED.read_text()).encode())
    present = {
        tuple("NAME" if i and p[i - 1] == "devices" else part for i, part in enumerate(p)) for p in tree.keys
    }  # fmt: skip
    for _title, path, schema in settings_parts():
        for field in schema.__struct_fields__:
            assert (*path.split(".")[:-1], field) in present, f"{path}{field} is missing in etc/imud.yaml"
    titles = {path for _title, path, _schema in settings_parts()}
    assert {f"{name}." for name in PUBLISHERS} | {f"devices.NAME.{name}." for name in LINKS} <= titles
    assert TABLES.drivers is DRIVERS


def test_loading_opens_only_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[object] = []
    for module, name in ((builtins, "open"), (os, "open"), (os, "stat")):
        original = getattr(module, name)

        def watch(path: object, *args: Any, original: Any = original, **kwargs: Any) -> Any:
            opened.append(path)
            return original(path, *args, **kwargs)

        monkeypatch.setattr(module, name, watch)
    config.load(SHIPPED)
    assert not [path for path in opened if str(path).startswith("/dev")]
    assert SHIPPED in opened


@pytest.mark.parametrize("part", ["link", "options"])
def test_what_a_driver_says_of_options_and_link_stands_at_their_keys(part: str) -> None:
    row = fake_row(DriverSettings, faults=(KeyProblem(part, "range_g" if part == "options" else "baud", "too much"),))
    tables = Tables({"acme-uart": row}, FAKE.links, FAKE.publishers)
    text = "devices:\n  a:\n    driver: acme-uart\n    options: {range_g: 4}\n    port: {port: x, baud: 9600}\n"
    place = {"link": "5:27: devices.a.port.baud", "options": "4:24: devices.a.options.range_g"}[part]
    assert errors(text, tables) == [f"f.yaml:{place}: too much"]


# I2C at 400 kHz: address, register, address, 32 bytes, nine bits each, and start, start, stop: 318 bits = 795 µs
# SPI, standard burst: 16 words at 1 MHz = 256 µs; extended: 26 words at 200 kHz = 2080 µs
@pytest.mark.parametrize(
    ("devices", "message"),
    [
        (["{driver: hipnuc-uart, socketcan: {interface: can0}}"], "expected a link that hipnuc-uart can use (uart, "),
        (["{driver: imu61x-can, uart: {port: x}}"], "expected a link that imu61x-can can use (socketcan, "),
        (["{driver: imu61x-can, socketcan: {interface: c, bitrate: 500000}}"], "expected no value with backend socketcan"),
        (["{driver: imu61x-uart, uart: {port: x, baud: 9600}}"], "a.uart.baud: expected a baud rate of imu61x-uart (115200, 230400, 460800, 921600, 1500000) or auto, got 9600"),
        (["{driver: hipnuc-uart, uart: {port: x, baud: 57600}}"], "a.uart.baud: expected a baud rate of hipnuc-uart (9600, "),
        (["{driver: imu61x-i2c, i2c: {address: 0x20}}"], "a.i2c.address: expected an address of an IMU61x (0x18, 0x19, 0x1a, 0x1b) or auto, got 0x20"),
        (["{driver: imu61x-i2c, i2c: {rate_hz: 1300}}"],
         "devices.a.i2c.rate_hz: expected at most 1257, got 1300: a read takes at least 795 µs of /dev/i2c-1"),
        (["{driver: imu61x-i2c, i2c: {address: 0x18, rate_hz: 1000}}", "{driver: imu61x-i2c, i2c: {address: 0x19, rate_hz: 300}}"],
         "devices.b.i2c.rate_hz: expected at most 257, got 300: a read takes at least 795 µs of /dev/i2c-1, and other devices use 80% of it"),
        (["{driver: imu61x-spi, options: {burst: extended}, spi: {port: /dev/spidev0.0, speed_hz: 200000, rate_hz: 500}}"],
         "devices.a.spi.rate_hz: expected at most 480, got 500: a read takes at least 2080 µs of /dev/spidev0"),
        (["{driver: imu61x-spi, options: {burst: registers}, spi: {port: /dev/spidev0.0, rate_hz: 3000}}"],
         "devices.a.spi.rate_hz: expected at most 2403, got 3000: a read takes at least 416 µs"),
    ],
)  # fmt: skip
def test_what_a_device_or_a_bus_cannot_do_is_refused(devices: list[str], message: str) -> None:
    text = "devices:\n" + "".join(f"  {name}: {device}\n" for name, device in zip("ab", devices, strict=False))
    assert message in "\n".join(errors(text, TABLES))


@pytest.mark.parametrize(
    ("devices", "driver"),
    [
        (["{driver: imu61x-uart, uart: {port: x, baud: 1500000}}"], "imu61x-uart"),
        (["{driver: imu61x-i2c, i2c: {address: 0x1B}}"], "imu61x-i2c"),
        (["{driver: imu61x-i2c, i2c: {rate_hz: 1200}}", "{driver: imu61x-i2c, i2c: {bus: 2, rate_hz: 1200}}"], "imu61x-i2c"),
        (["{driver: imu61x-spi, spi: {port: /dev/spidev0.0, rate_hz: 3906.25}}",
          "{driver: imu61x-spi, spi: {port: /dev/spidev1.0, rate_hz: 3900}}"], "imu61x-spi"),
        (["{socketcan: {interface: can0}}"], "auto"),  # imud searches for a device that sends
        (["{driver: imu61x-can, socketcan: {interface: can0}}"], "imu61x-can"),
        (["{driver: imu61x-can, replay: {path: a.log}}"], "imu61x-can"),
        (["{driver: imu61x-can, memory: {}}"], "imu61x-can"),
    ],
)  # fmt: skip
def test_what_a_device_and_a_bus_can_do_is_accepted(devices: list[str], driver: str) -> None:
    text = "devices:\n" + "".join(f"  {name}: {device}\n" for name, device in zip("ab", devices, strict=False))
    made = config.parse(text, "x.yaml").devices
    assert [(device.name, device.driver) for device in made] == [(name, driver) for name in "ab"[: len(devices)]]
    assert driver != "auto" or made[0].options is None


@pytest.mark.parametrize("line", ["d{0}: no", "d{0}: {{baud: 1}}", "same: 1", "? {0}", "d{0}: [!a b, !c d]"])
def test_a_file_of_nothing_but_problems_is_refused_soon(line: str) -> None:
    """The reader stops after 1000 problems. Without this limit, the comparison of their places takes an hour."""
    found = errors("\n".join(line.format(number) for number in range(10_000)))
    assert (len(found), found[-1]) == (21, "… and 981 more problems")
    assert errors("devices: {}\n" + "".join(f"x{n}: 1\n" for n in range(50)))[-1] == "… and 30 more problems"


def test_pauses_between_pieces_of_work() -> None:
    """imud pauses twice per device, and after every 64 events of the parser. A list adds six events to its items."""
    pauses: list[None] = []
    for items, count in ((57, 0), (58, 1), (121, 1), (122, 2)):
        read_yaml(f"[{'0, ' * items}]".encode(), lambda: pauses.append(None))
        assert len(pauses) == count
        pauses.clear()
    text = "devices:\n" + "".join(f"  d{n}: {{uart: {{port: /dev/tty{n}}}}}\n" for n in range(256))
    config.parse(text, "f.yaml", pause=lambda: pauses.append(None))
    assert len(pauses) == 2 * 256 + 256 * 8 // 64
