"""What is to be changed so that imud serves what was found: configuration, adapters, group, service.

Devices are added, nothing is taken away: what a person wrote in the configuration stays. The one exception are the
devices of the example that the package installs, which nobody wrote. A machine that is as it should be has no changes.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import msgspec

from imud import config
from imud.cli.doctor.ports import entries
from imud.cli.doctor.surroundings import Surroundings
from imud.cli.setup.changes import Change, CommandChange, FileChange, Words, content_of
from imud.cli.setup.hardware import Attached, state
from imud.config.yaml import YamlTree, plain, read_yaml
from imud.model.errors import ImudError

RULES: Final = "/etc/udev/rules.d/61-imud-setup.rules"
RULES_HEAD: Final = "# Made by `imud setup` for the adapters of its devices; `imud setup --undo` removes it."
FTDI: Final = "ftdi_sio"
MODEM_MANAGER: Final = "ModemManager.service"
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_.:/ -]")


class UsbAdapter(NamedTuple):
    """The USB device that a serial port is of."""

    node: str
    """Of the port, for example `ttyUSB0`."""
    driver: str
    """The kernel's driver of the port."""
    vendor: str
    """Number of the vendor, four hexadecimal digits."""
    product: str
    serial: str
    """Serial number; empty where it has none."""


def usb_adapter(at: Surroundings, node: str) -> UsbAdapter | None:
    """Find the adapter of a port by its node; None for a port that is none of USB."""
    name = node.rpartition("/")[2]
    device = at.at(f"/sys/class/tty/{name}/device")
    if not device.exists():
        return None
    driver = (device / "driver").resolve().name if (device / "driver").exists() else ""
    real = device.resolve()
    for parent in (real, *real.parents):
        if vendor := at.text(at.outside(parent / "idVendor")):
            product, serial = (at.text(at.outside(parent / key)) or "" for key in ("idProduct", "serial"))
            return UsbAdapter(name, driver, vendor, product, serial)
        if parent == at.root:
            break
    return None


def rules(at: Surroundings, adapters: Sequence[UsbAdapter]) -> FileChange | None:
    """Return what these adapters need in the file of rules; None where it has all. Raises ChangeRefused, OSError."""
    before = (content_of(at, RULES) or b"").decode("utf-8", "replace")
    present = before.splitlines()
    ignore_modems = modem_manager_runs(at)
    wanted = [line for adapter in adapters for line in _lines(adapter, ignore_modems=ignore_modems)]
    missing = [line for line in dict.fromkeys(wanted) if line not in present]
    if not missing:
        return None
    lines = [*(present or [RULES_HEAD]), *missing]
    what = [
        words
        for word, words in (
            ("latency_timer", "adapters send bytes after 1 ms"),
            ("ID_MM_", "ModemManager leaves them alone"),
        )
        if any(word in line for line in missing)
    ]
    nodes = dict.fromkeys(f"--sysname-match={adapter.node}" for adapter in adapters)
    then: tuple[Words, ...] = (("udevadm", "control", "--reload"),)
    then += (
        ("udevadm", "trigger", "--action=add", "--subsystem-match=tty", "--subsystem-match=usb-serial", *nodes),
        ("udevadm", "settle", "--timeout=5"),
    )
    return FileChange(", ".join(what), RULES, ("\n".join(lines) + "\n").encode(), then)


def modem_manager_runs(at: Surroundings) -> bool:
    """Whether ModemManager runs, or will after the next start of the machine."""
    words = ["systemctl", "show", MODEM_MANAGER, "--property=LoadState,ActiveState,UnitFileState"]
    try:
        states = at.run(words).text.split()
    except OSError:
        return False
    return "LoadState=loaded" in states and ("ActiveState=active" in states or "UnitFileState=enabled" in states)


def _lines(adapter: UsbAdapter, *, ignore_modems: bool) -> list[str]:
    which = f'ATTRS{{idVendor}}=="{_pattern(adapter.vendor)}", ATTRS{{idProduct}}=="{_pattern(adapter.product)}"'
    if adapter.serial:
        which += f', ATTRS{{serial}}=="{_pattern(adapter.serial)}"'
    lines = []
    if adapter.driver == FTDI:
        lines.append(f'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="{FTDI}", {which}, ATTR{{latency_timer}}="1"')
    if ignore_modems:
        properties = 'ENV{ID_MM_DEVICE_IGNORE}="1", ENV{ID_MM_PORT_IGNORE}="1"'
        lines.append(f'ACTION!="remove", SUBSYSTEM=="tty", {which}, {properties}')
    return lines


def _pattern(text: str) -> str:
    """A text as a pattern of udev: what means something there matches any character."""
    return _UNSAFE.sub("?", text)


Blocks = Mapping[str, Mapping[str, Any]]
"""Keys of each device by its name."""

INDENT: Final = 2
EXAMPLE: Final = {"imu": {"uart": {"port": "/dev/ttyUSB0"}}}
"""The devices of etc/imud.yaml, which the package installs: nobody has written them."""
FILE_HEAD: Final = """\
# Made by `imud setup`, yours to change: docs/configuration.md has every key.
# `imud check FILE` says whether it is good, `systemctl reload imud` makes the daemon read it again.
"""
_SAFE: Final = re.compile(r"[A-Za-z0-9_/.][A-Za-z0-9_/.:@+-]*")


def is_example(content: bytes) -> bool:
    """Whether the configuration has the devices of the example, as the package installs it, and no others."""
    data = read_yaml(content).data
    return isinstance(data, dict) and data.get("devices") == EXAMPLE


def device_names(content: bytes | None) -> list[str]:
    """Names of all devices, disabled ones included."""
    return list(_devices_of(read_yaml(content).data)) if content is not None else []


def with_devices(content: bytes | None, blocks: Blocks, *, replace: str = "") -> bytes:
    """Return the configuration with these devices, without the one named `replace`; None is no configuration yet.

    Raises ImudError with the block to paste where the text cannot be changed safely.
    """
    if content is None:
        return (FILE_HEAD + "devices:\n" + "\n".join(_block(blocks, INDENT)) + "\n").encode()
    tree = read_yaml(content)
    text = content.decode("utf-8-sig")
    end = "\r\n" if "\r\n" in text else "\n"
    lines = text.splitlines()
    changed = end.join([*_inserted(lines, tree, blocks, replace), ""]).encode()
    wanted = _devices_of(tree.data)
    wanted.pop(replace, None)
    if not _has(changed, tree.data, {**wanted, **blocks}):
        paste = "\n".join(["devices:", *_block(blocks, INDENT)])
        raise ImudError(
            f"the configuration is written in a way that only you can add to; add below `devices`:\n{paste}"
        )
    return changed


def _devices_of(data: object) -> dict[str, Any]:
    devices = data.get("devices") if isinstance(data, dict) else None
    return dict(devices) if isinstance(devices, dict) else {}


def _has(content: bytes, before: object, devices: Mapping[str, object]) -> bool:
    """Whether the text has these devices and everything else of `before`."""
    tree = read_yaml(content)
    others = {key: value for key, value in before.items() if key != "devices"} if isinstance(before, dict) else {}
    return not tree.problems and tree.data == {**others, "devices": devices}


def _inserted(lines: list[str], tree: YamlTree, blocks: Blocks, replace: str) -> list[str]:
    key = tree.keys.get(("devices",))
    if key is None:
        return [*lines, *([""] if lines and lines[-1].strip() else []), "devices:", *_block(blocks, INDENT)]
    at, column = key.line, INDENT
    if names := list(_devices_of(tree.data)):
        column = tree.keys["devices", names[0]].column - 1
    head = re.sub(r"^(devices:)\s*(\{\s*\}|null|~)", r"\1", lines[at - 1])
    rest = lines[at:]
    if replace:
        first = tree.keys["devices", replace].line - at - 1
        last = first + 1
        while last < len(rest) and rest[last].strip() and _indent(rest[last]) > column:
            last += 1
        return [*lines[: at - 1], head, *rest[:first], *_block(blocks, column), *rest[last:]]
    return [*lines[: at - 1], head, *_block(blocks, column), *([""] if names else []), *rest]


def _indent(line: str) -> int:
    return len(line) - len(line.lstrip(" "))


def _block(blocks: Blocks, column: int) -> list[str]:
    lines: list[str] = []
    for name, keys in blocks.items():
        lines += [""] * bool(lines) + [f"{' ' * column}{name}:", *_keys(keys, column + INDENT)]
    return lines


def _keys(keys: Mapping[str, Any], column: int) -> list[str]:
    lines: list[str] = []
    for key, value in keys.items():
        if isinstance(value, Mapping):
            lines += [f"{' ' * column}{key}:", *_keys(value, column + INDENT)]
        else:
            lines.append(f"{' ' * column}{key}: {_scalar(value)}")
    return lines


def _scalar(value: object) -> str:
    """A value as YAML; text in quotes unless every reader takes it for text without them."""
    if isinstance(value, str) and _SAFE.fullmatch(value):
        try:
            if plain(value) == value:
                return value
        except ValueError:
            pass
    return msgspec.json.encode(value).decode()


UNIT: Final = "imud.service"
RELOAD: Final = ("systemctl", "try-reload-or-restart", UNIT)
READERS: Final = "imud"
"""Group that may read samples."""
CONTROLLERS: Final = "imud-control"
"""Group that may also change settings of modules."""
SYSTEMD: Final = "/run/systemd/system"
UDEV: Final = "/run/udev"
EXAMPLE_NAME: Final = "imu"
EXAMPLE_NODE: Final = "/dev/ttyUSB0"


@dataclass(frozen=True, slots=True)
class SetupPlan:
    """Changes in the order in which they are made, and what people should know of them."""

    changes: list[Change] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Wishes:
    """What the user decided."""

    devices: Mapping[str, Attached]
    """Devices to add, by name."""
    user: str = ""
    """The user that ran sudo; empty for none."""
    control: bool = False
    """Whether that user may also change settings of modules."""
    date: str = ""
    """For the name of the backup, for example `2026-11-22T13-05-01`."""


def real_path(at: Surroundings, path: str) -> str:
    """Follow the links of a file's path; the configuration may be one, into a folder under version control."""
    return at.outside(at.at(path).resolve())


def example_is_untouched(at: Surroundings) -> bool:
    """Whether the configuration is that of the package, and the daemon does not use it."""
    content = content_of(at, real_path(at, str(at.config_file)))
    return content is not None and is_example(content) and at.status is None


def proposed_names(found: Sequence[Attached], taken: Sequence[str]) -> list[str]:
    """Return a name for each device: imu, imu2, imu3, without those that are taken."""
    names: list[str] = []
    number = 1
    for _ in found:
        while (name := f"imu{number if number > 1 else ''}") in (*taken, *names):
            number += 1
        names.append(name)
    return names


def plan(at: Surroundings, wishes: Wishes) -> SetupPlan:
    """Plan all changes. Raises ImudError where the configuration cannot be added to, ChangeRefused, OSError."""
    made = SetupPlan()
    _adapters(at, wishes, made)
    _configuration(at, wishes, made)
    _groups(at, wishes, made)
    _service(at, made)
    return made


def _configuration(at: Surroundings, wishes: Wishes, made: SetupPlan) -> None:
    if not wishes.devices:
        return
    path = real_path(at, str(at.config_file))
    before = content_of(at, path)
    replace = EXAMPLE_NAME if example_is_untouched(at) else ""
    after = with_devices(before, {name: one.keys for name, one in wishes.devices.items()}, replace=replace)
    config.parse(after, path)  # what is written is good
    names = ", ".join(wishes.devices)
    if before is not None:
        made.changes.append(FileChange(f"a copy of {path} as it is", f"{path}.{wishes.date}", before, copy_of=path))
    then = (RELOAD,) if at.at(SYSTEMD).exists() and at.installed and service_reads(at) else ()
    made.changes.append(FileChange(f"device{'s' if len(wishes.devices) > 1 else ''} {names}", path, after, then))


def used_adapters(at: Surroundings, wishes: Wishes) -> list[UsbAdapter]:
    """The USB adapters of all devices, present and new."""
    paths = [getattr(one.link_settings, "port", "") or getattr(one.link_settings, "line", "")
             for one in (at.config.devices if at.config and not example_is_untouched(at) else ())]  # fmt: skip
    nodes = [real_path(at, path) for path in paths if path.startswith("/")]
    nodes += [real_path(at, one.node) for one in wishes.devices.values() if one.node.startswith("/")]
    found = (usb_adapter(at, node) for node in dict.fromkeys(nodes))
    return [adapter for adapter in found if adapter is not None]


def _adapters(at: Surroundings, wishes: Wishes, made: SetupPlan) -> None:
    adapters = used_adapters(at, wishes)
    if adapters and not at.at(UDEV).exists():
        made.notes.append("udev does not run: the latency timer of USB adapters is left as it is")
    elif adapters and (change := rules(at, adapters)) is not None:
        made.changes.append(change)


def _groups(at: Surroundings, wishes: Wishes, made: SetupPlan) -> None:
    wanted = (READERS, CONTROLLERS) if wishes.control else (READERS,)
    groups = members(at)
    for name in wanted if wishes.user else ():
        if name not in groups:
            made.notes.append(f"there is no group {name} here, so {wishes.user} is not made a member: docs/install.md")
        elif wishes.user not in groups[name]:
            what = "may read samples" if name == READERS else "may change settings of modules"
            words = ("usermod", "--append", "--groups", name, wishes.user)
            back = (("gpasswd", "--delete", wishes.user, name),)
            made.changes.append(
                CommandChange(f"{wishes.user} {what}", words, back, ("getent", "group", name), optional=True)
            )
            made.notes.append(f"{wishes.user} has to log in again before the group {name} counts")


def members(at: Surroundings) -> dict[str, list[str]]:
    """Members of each group of /etc/group by its name."""
    return {entry[0]: entry[3].split(",") for entry in entries(at, "group")}


def _service(at: Surroundings, made: SetupPlan) -> None:
    if not at.at(SYSTEMD).exists():
        made.notes.append("systemd does not run here, so no service is started: `imud run` runs the daemon")
        return
    if not at.installed:
        made.notes.append(f"systemd does not know {UNIT}, so nothing is started: docs/install.md has the steps")
        return
    if not service_reads(at):
        made.notes.append(
            f"{UNIT} reads another configuration than {at.config_file}, so it is left as it is: "
            f"`imud run --config {at.config_file}` runs the daemon with this one"
        )
        return
    if (enabled := state(at, UNIT, "is-enabled")) != "enabled":
        if enabled == "masked":
            raise ImudError(f"{UNIT} is masked: `sudo systemctl unmask {UNIT}` first")
        words = ("systemctl", "enable", UNIT)
        back = (("systemctl", "disable", UNIT),)
        made.changes.append(
            CommandChange("imud starts with the machine", words, back, ("systemctl", "is-enabled", UNIT))
        )
    if (activity := state(at, UNIT, "is-active")) != "active":
        if activity == "failed":  # too many starts are refused for ten minutes else
            words = ("systemctl", "reset-failed", UNIT)
            made.changes.append(CommandChange("its failures are forgotten", words, (), ("true",)))
        words = ("systemctl", "restart", UNIT)
        back = (("systemctl", "stop", UNIT),)
        made.changes.append(CommandChange("imud starts now", words, back, ("systemctl", "is-active", UNIT)))


def service_reads(at: Surroundings) -> bool:
    """Whether the service runs with the configuration that is set up; True where its command line does not say."""
    started = at.unit_value("ExecStart")
    return "--config" not in started or str(at.config_file) in started


def present_names(at: Surroundings) -> list[str]:
    """Names of the devices that the configuration has, without those of the example."""
    content = content_of(at, real_path(at, str(at.config_file)))
    return [] if example_is_untouched(at) else device_names(content)
