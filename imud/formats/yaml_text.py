"""Writes values of settings as YAML that imud's configuration reads back as the same: blocks outside, flow inside.

    settings:
      mode: "6-axis"
      output: {hi91: 100, imusol: 0}

Texts are always in quotes, so that none is taken for a number or a truth value by any reader. Scalars are written as
JSON, which is YAML as well.
"""

from collections.abc import Mapping, Sequence
from re import compile as pattern
from typing import Final

import msgspec

PLAIN_KEY: Final = pattern(r"[A-Za-z_][A-Za-z0-9_]*")
WORDS: Final = frozenset({"yes", "no", "on", "off", "true", "false", "null", "nan", "inf", "infinity", "y", "n"})
"""What some readers of YAML do not take for text."""


def yaml_block(values: Mapping[str, object], indent: int = 0) -> str:
    """Format keys and values, each mapping of the first level as a block and everything inside as flow."""
    lines = []
    for name, value in values.items():
        head = f"{' ' * indent}{_key(name)}:"
        if isinstance(value, Mapping) and value and not indent:
            lines += [head, yaml_block(value, indent + 2)]
        else:
            lines.append(f"{head} {yaml_flow(value)}")
    return "\n".join(lines)


def yaml_flow(value: object) -> str:
    """Format a value in one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(str(name))}: {yaml_flow(one)}" for name, one in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(map(yaml_flow, value)) + "]"
    return _scalar(value)


def yaml_comment(text: str) -> str:
    """Format text as comment lines."""
    return "\n".join(f"# {line}".rstrip() for line in text.splitlines())


def _key(name: str) -> str:
    return name if PLAIN_KEY.fullmatch(name) and name.lower() not in WORDS else _scalar(name)


def _scalar(value: object) -> str:
    """A scalar as JSON, which is YAML too, with what some readers refuse escaped."""
    text = msgspec.json.encode(value).decode()
    return "".join(one if one.isprintable() else _escaped(one) for one in text)


def _escaped(one: str) -> str:
    code = ord(one)
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
