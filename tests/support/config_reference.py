"""Makes the tables of docs/configuration.md from the settings classes: `python -m tests.support.config_reference`."""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator

import msgspec

from imud.config import TABLES, DeviceGeneral, General
from imud.contracts.lines import LINE_SCHEMAS, DeviceLines
from imud.contracts.settings import Settings, expected, shown
from imud.utc.source import RmcSettings
from tests.support.paths import ROOT

FILE = ROOT / "docs/configuration.md"
BEGIN, END = "<!-- keys: begin -->\n", "<!-- keys: end -->\n"


def docs_of(schema: type[Settings]) -> dict[str, str]:
    """The docstring below each field, its own and those it has from a base class."""
    found: dict[str, str] = {}
    for base in reversed(schema.__mro__):
        if issubclass(base, Settings):
            found |= _own_docs_of(base)
    return found


def _own_docs_of(schema: type[Settings]) -> dict[str, str]:
    (made,) = ast.parse(textwrap.dedent(inspect.getsource(schema))).body
    assert isinstance(made, ast.ClassDef)
    found, name = {}, ""
    for node in made.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name = node.target.id
        elif name and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            found[name] = " ".join(str(node.value.value).split())
            name = ""
    return found


LINE_TITLES = {name: text.rstrip(".") for name, text in docs_of(DeviceLines).items()}


def parts() -> Iterator[tuple[str, str, type[Settings]]]:
    """Title, path in the file, and schema of every part."""
    yield "The daemon", "", General
    for name, publisher in TABLES.publishers.items():
        yield f"Output `{name}`", f"{name}.", publisher.settings
    yield "Each device", "devices.NAME.", DeviceGeneral
    for name, link in TABLES.links.items():
        yield f"Link `{name}`", f"devices.NAME.{name}.", link.settings
    for name, driver in TABLES.drivers.items():
        yield f"Options of driver `{name}`", "devices.NAME.options.", driver.settings
    for name, schema in LINE_SCHEMAS.items():
        yield f"Line `{name}`: {LINE_TITLES[name]}", f"devices.NAME.lines.{name}.", schema
    yield "RMC sentences for a device (`docs/time.md`)", "devices.NAME.rmc.", RmcSettings


def default_of(field: msgspec.structs.FieldInfo) -> str:
    """The default as one would write it; file modes in octal."""
    if field.required:
        return "needed"
    octal = field.name == "mode" and isinstance(field.default, int)
    return f"`{field.default:#o}`" if octal else f"`{shown(field.default)}`"


def tables() -> str:
    """The whole generated part."""
    text = []
    for title, path, schema in parts():
        text += [f"### {title}", "", "| key | expected | default | meaning |", "|---|---|---|---|"]
        docs = docs_of(schema)
        for field in msgspec.structs.fields(schema):
            words = expected(field.type).replace("|", "\\|")
            text.append(f"| `{path}{field.name}` | {words} | {default_of(field)} | {docs[field.name]} |")
        if not msgspec.structs.fields(schema):
            text.append("| (none) | | | |")
        text.append("")
    return "\n".join(text)


def whole(page: str) -> str:
    """`page` with its tables made anew."""
    return re.sub(f"(?s){BEGIN}.*{END}", lambda _: f"{BEGIN}\n{tables()}\n{END}", page)


if __name__ == "__main__":
    FILE.write_text(whole(FILE.read_text()))
