"""Makes the tables of docs/commands.md from the drivers' actions: `python -m tests.support.actions_reference`."""

import re
from collections.abc import Iterator

import msgspec

from imud.contracts.action import Action, Actions, parameters_of
from imud.contracts.driver import Driver
from imud.devices import DRIVERS
from imud.signals.line_actions import RESET, TRIGGER
from tests.support.config_reference import docs_of
from tests.support.paths import ROOT

FILE = ROOT / "docs/commands.md"
BEGIN, END = "<!-- actions: begin -->\n", "<!-- actions: end -->\n"


def cell(text: str) -> str:
    """Text that does not end the cell of a table."""
    return text.replace("|", "\\|")


def meanings_of(action: Action) -> dict[str, str]:
    """The meaning of each argument: description and unit of its annotation, or the docstring of the struct's field."""
    found = docs_of(action.params)
    for field in msgspec.structs.fields(action.parameters):
        info = msgspec.inspect.type_info(field.type)
        if isinstance(info, msgspec.inspect.Metadata) and info.extra_json_schema:
            unit = (info.extra or {}).get("unit")
            meaning = info.extra_json_schema.get("description", "")
            found[field.name] = meaning[:1].upper() + meaning[1:] + (f" ({unit})" if unit else "")
    return found


def arguments_of(action: Action) -> str:
    """What it takes, one after the other, each with what it can be and what it means."""
    docs = meanings_of(action)
    words = []
    for parameter in parameters_of(action):
        default = "" if parameter.default is None else f"; default `{parameter.default}`"
        meaning = f": {docs[parameter.name].rstrip('.')}" if parameter.name in docs else ""
        words.append(f"`{parameter.name}` ({parameter.values}{default}){meaning}")
    return cell(".<br>".join(words)) or "none"


def table(actions: Actions) -> Iterator[str]:
    """The lines of a driver's table."""
    yield "| action | arguments | what it does |"
    yield "|---|---|---|"
    for name, action in actions.items():
        yield f"| `{name}` | {arguments_of(action)} | {cell(action.help.rstrip('.'))} |"


def part(driver: Driver) -> list[str]:
    """Title and table of a driver."""
    lines = list(table(driver.actions)) if driver.actions else ["No actions."]
    return [f"### `{driver.name}`: {driver.title}", "", *lines, ""]


def tables() -> str:
    """The whole generated part."""
    lines = [line for driver in DRIVERS.values() for line in part(driver)]
    by_lines = ["### Any device whose `lines` have it", "", *table({"reset": RESET, "trigger": TRIGGER}), ""]
    return "\n".join([*lines, *by_lines])


def whole(page: str) -> str:
    """`page` with its tables made anew."""
    return re.sub(f"(?s){BEGIN}.*{END}", lambda _: f"{BEGIN}\n{tables()}\n{END}", page)


if __name__ == "__main__":
    FILE.write_text(whole(FILE.read_text()))
