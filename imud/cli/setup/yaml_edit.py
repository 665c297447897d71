"""Devices added to the text of a configuration: what a person wrote stays, comments included.

The new block goes behind the key `devices`, in the indentation of the devices that are there. Afterwards the text is
read again, and refused unless it has exactly the old content and the new devices: a notation that this module does not
know (`devices: {bow: …}`) is left alone, and the block is for the person to paste.
"""

import re
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from imud.config.yaml_tree import YamlTree, plain, read_yaml
from imud.errors import ImudError

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
