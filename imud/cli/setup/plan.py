"""What is to be changed so that imud serves what was found: configuration, adapters, group, service.

Devices are added, nothing is taken away: what a person wrote in the configuration stays. The one exception are the
devices of the example that the package installs, which nobody wrote. A machine that is as it should be has no changes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from imud import config
from imud.cli.doctor.access import entries
from imud.cli.doctor.surroundings import Surroundings
from imud.cli.setup.attached import Attached
from imud.cli.setup.changes import Change, CommandChange, FileChange, content_of
from imud.cli.setup.udev import UsbAdapter, rules, usb_adapter
from imud.cli.setup.ways import state
from imud.cli.setup.yaml_edit import device_names, is_example, with_devices
from imud.errors import ImudError

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
