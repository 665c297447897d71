"""Plan of the changes of `imud setup`: configuration, udev rules of adapters, group, service.

The plan only adds devices to the configuration. It replaces only the device of the example configuration that the
package installs. If the host is already set up, the plan contains no changes.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from imud import config
from imud.cli.doctor.ports import entries
from imud.cli.doctor.surroundings import Surroundings
from imud.cli.setup.changes import Change, CommandChange, FileChange, Words, content_of
from imud.cli.setup.hardware import Attached, state
from imud.config.yaml import YamlTree, plain, read_yaml
from imud.host.log import printable_json
from imud.model.errors import ImudError

RULES: Final = "/etc/udev/rules.d/61-imud-setup.rules"
RULES_HEAD: Final = "# Created by `imud setup` for the adapters of its devices; remove it with `imud setup --undo`."
FTDI: Final = "ftdi_sio"
MODEM_MANAGER: Final = "ModemManager.service"
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_.:/ -]")


class UsbAdapter(NamedTuple):
    """USB adapter of a serial port."""

    node: str  # node of the port without its folder, for example `ttyUSB0`
    driver: str  # kernel driver of the port
    vendor: str  # USB vendor id, four hexadecimal digits
    product: str
    serial: str  # serial number; empty for an adapter without a serial number


def usb_adapter(at: Surroundings, node: str) -> UsbAdapter | None:
    """Return the adapter of a port; None if the port is not a USB port."""
    name = node.rpartition("/")[2]
    device = at.at(f"/sys/class/tty/{name}/device")
    if not device.exists():
        return None
    driver = (device / "driver").resolve().name if (device / "driver").exists() else ""
    real = device.resolve()
    # the USB device is above the port and its interface in /sys
    for parent in (real, *real.parents):
        if vendor := at.text(at.outside(parent / "idVendor")):
            product, serial = (at.text(at.outside(parent / key)) or "" for key in ("idProduct", "serial"))
            return UsbAdapter(name, driver, vendor, product, serial)
        if parent == at.root:
            break
    return None


def rules(at: Surroundings, adapters: Sequence[UsbAdapter]) -> FileChange | None:
    """Return the change of the udev rules for these adapters; None if no change is needed.

    Raises ChangeRefused, OSError.
    """
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
            ("latency_timer", "set the latency timer of adapters to 1 ms"),
            ("ID_MM_", "make ModemManager ignore adapters"),
        )
        if any(word in line for line in missing)
    ]
    nodes = dict.fromkeys(f"--sysname-match={adapter.node}" for adapter in adapters)
    then: tuple[Words, ...] = (("udevadm", "control", "--reload"),)
    # trigger: apply the rules to adapters that are already plugged in
    then += (
        ("udevadm", "trigger", "--action=add", "--subsystem-match=tty", "--subsystem-match=usb-serial", *nodes),
        ("udevadm", "settle", "--timeout=5"),
    )
    return FileChange(", ".join(what), RULES, ("\n".join(lines) + "\n").encode(), then)


def modem_manager_runs(at: Surroundings) -> bool:
    """Return whether ModemManager runs, or will run after the next boot."""
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
    """Return a text as a udev pattern. `?` replaces each special character."""
    return _UNSAFE.sub("?", text)


Blocks = Mapping[str, Mapping[str, Any]]  # keys of each device, by name

INDENT: Final = 2
# Devices of etc/imud.yaml, the example that the package installs
EXAMPLE: Final = {"imu": {"uart": {"port": "/dev/ttyUSB0"}}}
FILE_HEAD: Final = """\
# Created by `imud setup`. You can change this file. docs/configuration.md describes every key.
# Check the file with `imud check FILE`, then reload the daemon with `systemctl reload imud`.
"""
_SAFE: Final = re.compile(r"[A-Za-z0-9_/.][A-Za-z0-9_/.:@+-]*")


def is_example(content: bytes) -> bool:
    """Return whether the configuration contains exactly the devices of the installed example."""
    data = read_yaml(content).data
    return isinstance(data, dict) and data.get("devices") == EXAMPLE


def device_names(content: bytes | None) -> list[str]:
    """Return the names of all devices, including disabled devices."""
    return list(_devices_of(read_yaml(content).data)) if content is not None else []


def with_devices(content: bytes | None, blocks: Blocks, *, replace: str = "") -> bytes:
    """Return the configuration with these devices added and the device `replace` removed.

    `content`: None if there is no configuration yet. Raises ImudError with the lines to add if imud cannot change the
    text safely.
    """
    if content is None:
        return (FILE_HEAD + "devices:\n" + "\n".join(_block(blocks, INDENT)) + "\n").encode()
    tree = read_yaml(content)
    text = content.decode("utf-8-sig")
    # keep the line ends of the file
    end = "\r\n" if "\r\n" in text else "\n"
    lines = text.splitlines()
    changed = end.join([*_inserted(lines, tree, blocks, replace), ""]).encode()
    wanted = _devices_of(tree.data)
    wanted.pop(replace, None)
    # read the result again: all other keys must be unchanged
    if not _has(changed, tree.data, {**wanted, **blocks}):
        paste = "\n".join(["devices:", *_block(blocks, INDENT)])
        raise ImudError(
            f"cannot add the devices to the configuration because of its YAML style; add these lines:\n{paste}"
        )
    return changed


def _devices_of(data: object) -> dict[str, Any]:
    devices = data.get("devices") if isinstance(data, dict) else None
    return dict(devices) if isinstance(devices, dict) else {}


def _has(content: bytes, before: object, devices: Mapping[str, object]) -> bool:
    """Return whether the text contains these devices and all other keys of `before`."""
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
    # an empty mapping becomes a block
    head = re.sub(r"^(devices:)\s*(\{\s*\}|null|~)", r"\1", lines[at - 1])
    rest = lines[at:]
    if replace:
        first = tree.keys["devices", replace].line - at - 1
        last = first + 1
        # deeper lines belong to the replaced device
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
    """Format a value as YAML. Put a string in quotes if a reader could read it as another type."""
    if isinstance(value, str) and _SAFE.fullmatch(value):
        try:
            if plain(value) == value:
                return value
        except ValueError:
            pass
    # JSON is YAML
    return printable_json(value)


UNIT: Final = "imud.service"
RELOAD: Final = ("systemctl", "try-reload-or-restart", UNIT)
READERS: Final = "imud"  # group with the right to read samples
CONTROLLERS: Final = "imud-control"  # group with the right to control devices
SYSTEMD: Final = "/run/systemd/system"
UDEV: Final = "/run/udev"
EXAMPLE_NAME: Final = "imu"
EXAMPLE_NODE: Final = "/dev/ttyUSB0"


@dataclass(frozen=True, slots=True)
class SetupPlan:
    """Changes in the order of execution, and notes for the user."""

    changes: list[Change] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Wishes:
    """Decisions of the user."""

    devices: Mapping[str, Attached]  # devices to add, by name
    user: str = ""  # user of sudo; empty if there is none
    control: bool = False  # whether this user gets the right to control devices
    date: str = ""  # date in the name of the backup, for example `2026-11-22T13-05-01`


def real_path(at: Surroundings, path: str) -> str:
    """Resolve symbolic links. The configuration can be a link to a folder under version control."""
    return at.outside(at.at(path).resolve())


def example_is_untouched(at: Surroundings) -> bool:
    """Return whether the configuration is the example of the package, and no daemon uses it."""
    content = content_of(at, real_path(at, str(at.config_file)))
    return content is not None and is_example(content) and at.status is None


def proposed_names(found: Sequence[Attached], taken: Sequence[str]) -> list[str]:
    """Return a new name for each device: imu, imu2, imu3 and so on."""
    names: list[str] = []
    number = 1
    for _ in found:
        while (name := f"imu{number if number > 1 else ''}") in (*taken, *names):
            number += 1
        names.append(name)
    return names


def plan(at: Surroundings, wishes: Wishes) -> SetupPlan:
    """Plan all changes. Raises ImudError if imud cannot change the configuration, ChangeRefused, OSError."""
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
    config.parse(after, path)  # raises ConfigError: never write an invalid file
    names = ", ".join(wishes.devices)
    if before is not None:
        made.changes.append(FileChange(f"backup of {path}", f"{path}.{wishes.date}", before, copy_of=path))
    then = (RELOAD,) if at.at(SYSTEMD).exists() and at.installed and service_reads(at) else ()
    made.changes.append(FileChange(f"add device{'s' if len(wishes.devices) > 1 else ''} {names}", path, after, then))


def used_adapters(at: Surroundings, wishes: Wishes) -> list[UsbAdapter]:
    """Return the USB adapters of all configured and new devices."""
    paths = [getattr(one.link_settings, "port", "") or getattr(one.link_settings, "line", "")
             for one in (at.config.devices if at.config and not example_is_untouched(at) else ())]  # fmt: skip
    nodes = [real_path(at, path) for path in paths if path.startswith("/")]
    nodes += [real_path(at, one.node) for one in wishes.devices.values() if one.node.startswith("/")]
    found = (usb_adapter(at, node) for node in dict.fromkeys(nodes))
    return [adapter for adapter in found if adapter is not None]


def _adapters(at: Surroundings, wishes: Wishes, made: SetupPlan) -> None:
    adapters = used_adapters(at, wishes)
    if adapters and not at.at(UDEV).exists():
        made.notes.append("udev does not run, so imud does not change the latency timer of USB adapters")
    elif adapters and (change := rules(at, adapters)) is not None:
        made.changes.append(change)


def _groups(at: Surroundings, wishes: Wishes, made: SetupPlan) -> None:
    wanted = (READERS, CONTROLLERS) if wishes.control else (READERS,)
    groups = members(at)
    for name in wanted if wishes.user else ():
        if name not in groups:
            made.notes.append(
                f"the group {name} does not exist, so imud cannot add {wishes.user} to it: see docs/install.md"
            )
        elif wishes.user not in groups[name]:
            right = "read samples" if name == READERS else "change device settings"
            words = ("usermod", "--append", "--groups", name, wishes.user)
            back = (("gpasswd", "--delete", wishes.user, name),)
            made.changes.append(
                CommandChange(f"allow {wishes.user} to {right}", words, back, ("getent", "group", name), optional=True)
            )
            made.notes.append(f"{wishes.user} must log in again before the group {name} takes effect")


def members(at: Surroundings) -> dict[str, list[str]]:
    """Return the members of each group in /etc/group, by name."""
    return {entry[0]: entry[3].split(",") for entry in entries(at, "group")}


def _service(at: Surroundings, made: SetupPlan) -> None:
    if not at.at(SYSTEMD).exists():
        made.notes.append("systemd does not run, so imud starts no service; start the daemon with `imud run`")
        return
    if not at.installed:
        made.notes.append(f"systemd does not know {UNIT}, so imud starts no service: see docs/install.md")
        return
    if not service_reads(at):
        made.notes.append(
            f"{UNIT} uses another configuration than {at.config_file}, so imud does not change the service; start the "
            f"daemon with `imud run --config {at.config_file}`"
        )
        return
    if (enabled := state(at, UNIT, "is-enabled")) != "enabled":
        if enabled == "masked":
            raise ImudError(f"{UNIT} is masked; first run `sudo systemctl unmask {UNIT}`")
        words = ("systemctl", "enable", UNIT)
        back = (("systemctl", "disable", UNIT),)
        made.changes.append(CommandChange("start imud at every boot", words, back, ("systemctl", "is-enabled", UNIT)))
    if (activity := state(at, UNIT, "is-active")) != "active":
        if activity == "failed":  # otherwise systemd refuses further starts for ten minutes
            words = ("systemctl", "reset-failed", UNIT)
            made.changes.append(CommandChange("reset the failures of the service", words, (), ("true",)))
        words = ("systemctl", "restart", UNIT)
        back = (("systemctl", "stop", UNIT),)
        made.changes.append(CommandChange("start imud now", words, back, ("systemctl", "is-active", UNIT)))


def service_reads(at: Surroundings) -> bool:
    """Return whether the service uses this configuration. True if its command line contains no --config."""
    started = at.unit_value("ExecStart")
    return "--config" not in started or str(at.config_file) in started


def present_names(at: Surroundings) -> list[str]:
    """Return the names of the configured devices without the device of the example."""
    content = content_of(at, real_path(at, str(at.config_file)))
    return [] if example_is_untouched(at) else device_names(content)
