"""`imud settings`: compare device settings with declared settings; apply, save, back up and restore device settings."""

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from imud.bridges.status import times
from imud.cli.arguments import CliCommand, add_socket, confirmed, named_values
from imud.cli.output import table, terminal_width
from imud.client.connection import Client, decoded
from imud.config.yaml import FILE_BYTES_MAX, no_pause, read_yaml, yaml_block, yaml_comment
from imud.contracts.setting import AppliedSettings, SettingInfo, SettingsPlan, SettingsReport, SettingsState, value_text
from imud.device.flash import backup_text
from imud.formats.jsonrpc import Code, RpcError
from imud.host.files import read_regular, replace_file
from imud.host.log import printable_json
from imud.model.errors import BadArgument

HEAD: Final = ("SETTING", "DECLARED", "ACTUAL", "")
MORE: Final = ("UNIT", "MANUAL", "IN FORCE", "VALUES")
LIMIT_S: Final = 180.0  # Time limit of a request, s. A long plan with a restart and a new baud rate takes about 10 s.


def settings_arguments(parser: argparse.ArgumentParser) -> None:
    add_socket(parser)
    parser.add_argument("device", nargs="?", metavar="DEVICE", help="name of the device")
    operation = parser.add_mutually_exclusive_group()
    operation.add_argument(
        "--apply", action="store_true", help="set the settings that differ from the declared settings"
    )
    operation.add_argument(
        "--set",
        nargs="+",
        action="extend",
        metavar="NAME=VALUE",
        help="set these settings; NAME.PART=VALUE sets one part, for example output.hi91=200 or 'output={hi91: 200}'",
    )
    operation.add_argument(
        "--yaml", action="store_true", help="print the device settings as YAML for the configuration"
    )
    operation.add_argument(
        "--backup", metavar="FILE", type=Path, help="write the device settings and the identity to a file"
    )
    operation.add_argument("--restore", metavar="FILE", type=Path, help="set the device settings from a backup")
    parser.add_argument(
        "--save", action="store_true", help="save the settings in the device's flash; restart the device if necessary"
    )
    parser.add_argument("--yes", action="store_true", help="do not ask for confirmation, for scripts")
    parser.add_argument("--verbose", action="store_true", help="also print units, manual sections and accepted values")
    parser.add_argument("--json", action="store_true", help="print the reply of the socket as JSON")


def settings(args: argparse.Namespace) -> int:
    """Print, set, save, back up or restore device settings. Return 1 if a setting differs or an operation failed."""
    if args.device is None:
        args.device = device_after(args.set or [])
    with Client(args.socket, timeout_s=LIMIT_S) as client:
        if args.restore is not None:
            return _restore(client, args)
        if args.apply or args.set or (args.save and not args.yaml and args.backup is None):
            return _change(client, args, None if args.apply else given_values(args.set or ()))
        report = _report(client, args.device, needed=args.yaml or args.backup is not None)
    if args.yaml:
        print(_yaml(report))
        return 0
    if args.backup is not None:
        return _back_up(report, args)
    print(printable_json(report) if args.json else _shown(report, verbose=args.verbose))
    return 1 if report.status.state in (SettingsState.DIFFER, SettingsState.UNKNOWN) else 0


def device_after(words: list[str]) -> str:
    """Remove the device from the words after `--set` and return it. Raises BadArgument without a device."""
    names = [word for word in words if "=" not in word]
    if len(names) != 1 or len(words) == 1:
        raise BadArgument(
            f"expected one device, as in `imud settings bow`, got {' '.join(words) or 'none'}; see `imud devices`"
        )
    words.remove(names[0])
    return names[0]


def given_values(words: Sequence[str]) -> dict[str, object]:
    """Return the values of NAME=VALUE by name. A value can also be in the notation of `--yaml`. Raises BadArgument."""
    return {name: _yaml_value(name, value) for name, value in named_values(words).items()}


def _yaml_value(name: str, value: object) -> object:
    """Return the value of a mapping or a list in YAML; other values unchanged. Raises BadArgument."""
    if not isinstance(value, str) or not value.startswith(("{", "[")):
        return value
    tree = read_yaml(f"value: {value}\n".encode(), no_pause)
    if tree.problems or not isinstance(tree.data, dict) or not tree.complete:
        reason = tree.problems[0].message if tree.problems else "incomplete text"
        raise BadArgument(f"{name}: expected YAML, for example {{hi91: 50}}, got {value!r}: {reason}")
    return tree.data["value"]


# --- report -----------------------------------------------------------------------------------------------------------


def _report(client: Client, device: str, *, needed: bool) -> SettingsReport:
    """Return the settings: from the device if this user may control devices, otherwise from the last report.

    Raises ImudError if `needed` is set and imud cannot read the settings now.
    """
    # reading from the device sends requests, which needs the right to control
    fresh = "control" in client.hello.rights
    try:
        found = client.call("settings.get", device=device, fresh=fresh)
    except RpcError as error:
        # for example, the device is missing: print the last report instead
        if needed or not fresh or error.code is not Code.FAILED:
            raise
        print(f"{error}; imud prints the last reported settings:", file=sys.stderr)
        found = client.call("settings.get", device=device)
    report = decoded(found, SettingsReport, "settings.get")
    if needed and report.status.read_ns is None:
        raise BadArgument(
            f"{device} has not reported its settings yet, and only members of the control group can request them"
        )
    return report


def _shown(report: SettingsReport, *, verbose: bool) -> str:
    """Format the table of the settings and a summary."""
    rows = [_row(one, verbose=verbose) for one in report.settings]
    status, count = report.status, len(report.status.differences)
    words = {
        SettingsState.UNDECLARED: "the configuration declares no settings; --yaml prints them for the configuration",
        SettingsState.UNKNOWN: "the device has not reported its settings",
        SettingsState.AGREE: "all readable settings are as declared",
        SettingsState.DIFFER: f"{count} of {len(report.settings)} differ; set them with --apply, save them with --save",
    }[status.state]
    lines = [table((*HEAD, *MORE) if verbose else HEAD, rows, terminal_width()), "", words]
    if status.problem:
        lines.append(f"problem: {status.problem}")
    lines.append(f"imud wrote the flash {times(status.flash_writes)}, {status.flash_writes_day} within 24 hours")
    return "\n".join(lines)


def _row(one: SettingInfo, *, verbose: bool) -> Sequence[str]:
    actual = _value(one.actual) if one.readable or one.actual is not None else "(not reported)"
    mark = "differs" if one.differs else "" if one.declarable else "read-only"
    row = (one.name, _value(one.declared), actual, mark)
    return (*row, one.unit, one.section, str(one.effect), one.values) if verbose else row


def _value(value: Any) -> str:
    """Format a value for people."""
    return "-" if value is None else value_text(value)


def _settable(report: SettingsReport) -> dict[str, Any]:
    """Return the values that can be set again, without values that imud does not know."""
    return {
        one.name: one.actual
        for one in report.settings
        if one.declarable and one.actual is not None and one.actual in one.schema.get("enum", [one.actual])
    }


def _yaml(report: SettingsReport) -> str:
    """Format the device settings as the key `settings` of the configuration."""
    who = " ".join(dict.fromkeys(report.identity.get(key, "") for key in ("product", "serial_number", "firmware")))
    comment = f"Settings of {report.device} ({report.driver} {who.strip()}); paste below `{report.device}:`"
    lines = [yaml_comment(comment)]
    notes = {one.name: _note(one) for one in report.settings}
    for line in yaml_block({"settings": _settable(report)}).splitlines():
        note = notes.get(line.strip().partition(":")[0], "")
        lines.append(f"{line}   # {note}" if note else line)
    return "\n".join(lines)


def _note(one: SettingInfo) -> str:
    """Return the comment of a setting: description, unit, section of the manual."""
    texts = (one.description, one.unit, f"manual {one.section}" if one.section else "")
    return "; ".join("".join(c if c.isprintable() else " " for c in text) for text in texts if text)


# --- backup and restore -----------------------------------------------------------------------------------------------


def _back_up(report: SettingsReport, args: argparse.Namespace) -> int:
    text = backup_text(report.device, report.driver, report.identity, _settable(report), time.time_ns())
    if str(args.backup) == "-":
        print(text, end="")
        return 0
    if args.backup.exists() and not confirmed(f"replace {args.backup}", "the file exists", yes=args.yes):
        return 1
    replace_file(args.backup, text.encode())
    print(f"wrote {len(_settable(report))} settings of {report.device} to {args.backup}")
    return 0


def _restore(client: Client, args: argparse.Namespace) -> int:
    """Set the settings of a backup. Ask the user first if the backup is from another device."""
    backup = _read_backup(args.restore)
    report = _report(client, args.device, needed=True)
    others = _other_device(backup, report)
    if backup.get("driver", report.driver) != report.driver:
        raise BadArgument(
            f"{args.restore}: expected a backup of driver {report.driver}, which {args.device} uses; "
            f"got {backup['driver']}"
        )
    given, known = backup["settings"], {one.name for one in report.settings if one.declarable}
    unknown = [name for name in given if name not in known]
    for words in (*others, *(f"ignored: {name}; {report.driver} cannot set it" for name in unknown)):
        print(words, file=sys.stderr)
    if others and not confirmed(f"restore {args.device}", "the backup is from another device", yes=args.yes):
        return 1
    return _change(client, args, {name: value for name, value in given.items() if name in known})


def _read_backup(file: Path) -> dict[str, Any]:
    """Read a backup, or the output of `--yaml`. Raises BadArgument with the position of the first error."""
    tree = read_yaml(read_regular(file, FILE_BYTES_MAX + 1), no_pause)
    if tree.problems:
        problem = tree.problems[0]
        raise BadArgument(f"{file}:{problem.mark.line}:{problem.mark.column}: {problem.message}")
    if not isinstance(tree.data, dict) or not isinstance(tree.data.get("settings"), dict):
        raise BadArgument(f"{file}: expected the key settings with values, as in a file of `imud settings --backup`")
    return tree.data


def _other_device(backup: Mapping[str, Any], report: SettingsReport) -> list[str]:
    """Return the differences between the identity in a backup and the identity of the device."""
    identity = backup.get("identity")
    if not isinstance(identity, dict):
        return []
    return [
        f"{name.replace('_', ' ')}: the backup contains {identity[name]}, {report.device} has {report.identity[name]}"
        for name in ("product", "serial_number", "firmware")
        if name in identity and name in report.identity and identity[name] != report.identity[name]
    ]


# --- change -----------------------------------------------------------------------------------------------------------


def _change(client: Client, args: argparse.Namespace, given: Mapping[str, Any] | None) -> int:
    """Print the plan, ask the user if the plan has a risk, then apply the plan. Return the exit status."""
    params = {"device": args.device, "settings": given, "save": args.save}
    plan = decoded(client.call("settings.plan", **params), SettingsPlan, "settings.plan")
    if not args.json:
        print(_planned(plan))
    if plan.empty:
        if args.json:
            print(printable_json(AppliedSettings(left_out=plan.left_out)))
        return 1 if plan.left_out else 0
    if plan.risk and not confirmed(f"change {args.device}", plan.risk, yes=args.yes):
        return 1
    done = decoded(client.call("settings.apply", **params), AppliedSettings, "settings.apply")
    print(printable_json(done) if args.json else _account(done))
    # also 1 if the device did not keep a value
    return 1 if done.failure else 0


def _planned(plan: SettingsPlan) -> str:
    lines = [f"  {one.name}: {_value(one.before)} → {_value(one.value)}" for one in plan.steps]
    lines += ["  save to flash"] * plan.save + ["  restart"] * plan.restart
    lines = ["plan:", *lines] if lines else [] if plan.left_out else ["no changes needed"]
    lines += [f"not set: {name} {why} (add --save)" for name, why in plan.left_out.items()]
    return "\n".join([*lines, *([f"then: {plan.advice}"] if plan.advice else [])])


def _account(done: AppliedSettings) -> str:
    lines = [f"  {one.name}: {one.outcome}" + (f": {one.message}" if one.message else "") for one in done.steps]
    lines += [f"  {end}" for end in done.ends]
    if done.problem:
        lines.append(f"FAILED: {done.problem}")
    now = (f"{name} is {_value(one.actual)}, expected {_value(one.declared)}" for name, one in done.differences.items())
    lines += [words for words in (done.not_saved, done.advice) if words]
    return "\n".join(["done:" if not done.problem else "tried:", *lines, *now])


SETTINGS = CliCommand(settings_arguments, settings)
