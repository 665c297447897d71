"""Generate parts of the documents from the code: `python -m docs.generate.references`.

| document | source |
|---|---|
| docs/configuration.md | classes of the configuration |
| docs/commands.md, docs/calibration.md, docs/settings.md | commands, calibrations and device settings of the drivers |
| docs/shm.md | layout of shared memory |
| docs/monitoring.md | rules for Prometheus |
| docs/fleet-database.md | tables and views of the fleet database |
| docs/fleet-operation.md | metrics of the collector (imud/fleet/metrics.py) and rules for Prometheus |
| docs/stability.md | versions of the interfaces (tests/stability/interfaces.py) |
| docs/python.md, docs/simulators.md | docstrings and signatures (docs/generate/python_reference.py) |
| docs/socket.schema.json | messages of the socket (docs/generate/socket_schema.py) |
"""

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, groupby
from typing import Final, NamedTuple

import msgspec

import imud.client
import imud.sim
from docs.generate.alert_table import alert_table
from docs.generate.python_reference import python_reference
from docs.generate.settings_parts import docs_of, settings_parts
from docs.generate.socket_schema import socket_schema
from imud.contracts.command import Handling, Proof, Verb, Verbs, parameters_of
from imud.contracts.driver import Driver
from imud.device.settings_plan import described_settings
from imud.drivers import DRIVERS
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import COMPONENTS, Column
from imud.fleet.database.tables import TABLES as DATABASE_TABLES
from imud.fleet.database.views import views
from imud.fleet.metrics import COLLECTOR_METRICS, FLEET_METRICS, CollectorMetric
from imud.fleet.statistics import MEASURES
from imud.formats.ring import (
    HEADER_BYTES,
    HEADER_FIELDS,
    HEARTBEAT_LIMIT_NS,
    LEDGER_ROOM,
    MAGIC,
    RING_LAYOUT_VERSION,
    STATE_CLOSED,
    STATE_LIVE,
)
from imud.formats.slot import PRESENT_BITS, SLOT_BYTES, SLOT_FIELDS, SLOT_LAYOUT_VERSION, SYNC_CODES, SlotField
from imud.lines.sync import RESET, TRIGGER
from imud.model.ledger import LEDGER_FIELDS
from imud.model.options import Options, expected, shown
from tests.monitoring.prometheus import FLEET_RULES, RULES
from tests.stability.interfaces import INTERFACES
from tests.support.files import ROOT

# --- values in cells --------------------------------------------------------------------------------------------------

SHORT_WORDS: Final = (
    (r"\ba whole number from (\S+) to (\S+?)(?=[,);]|\s|$)", r"integer \1 to \2"),
    (r"\ba whole number from (\S+?)(?=[,);]|\s|$)", r"integer from \1"),
    (r"\ba number from (\S+) to (\S+?)(?=[,);]|\s|$)", r"\1 to \2"),
    (r"\ba number to (\S+) above (\S+?)(?=[,);]|\s|$)", r"above \2 to \1"),
    (r"\ba number above", "above"),
    (r"\ba list of (\S+), each item a number\b", r"list of \1 numbers"),
    (r"\ba list, each item a number(?! )", "list of numbers"),
    (r"\ba list( of [\w ]+), each item text\b", r"list\1 strings"),
    (r"\ba list, each item text\b", "list of strings"),
    (r"\ba list( of [\w ]+)?, each item (a )?", r"list\1: "),
    (r"\btext that is not empty\b", "string, not empty"),
    (r"\btext\b", "string"),
    (r"\btrue or false\b", "boolean"),
    (r"\bone of (?=\S)", ""),
)
"""Pattern and replacement of the words of `expected`, for table cells."""


REPEATED_CHARACTERS: Final = 100
"""Minimum length of a list of values that a page does not repeat, characters."""
PARTS_CHARACTERS: Final = 80
"""Maximum length of the description of an entry with keys, characters; a longer one contains only the names."""


def short(words: str) -> str:
    """Shorten the description of accepted values for a table cell."""
    for pattern, replacement in SHORT_WORDS:
        words = re.sub(pattern, replacement, words)
    if "the keys " in words and len(words) > PARTS_CHARACTERS:
        words = re.sub(r" \((?:[^()]|\([^()]*\))*\)", "", words)
    return re.sub(r'"([^"]+)"', r"`\1`", words)


class LongLists:
    """Long lists of values of a page: the second cell with the same list refers to the first cell."""

    def __init__(self) -> None:
        self._first_of: dict[str, str] = {}

    def cell(self, words: str, owner: str) -> str:
        """Return the cell for a description of values; `owner`: name of the key, argument or setting."""
        values, null, _ = cell(short(words)).partition(", or null")
        if len(values) < REPEATED_CHARACTERS:
            return values + null
        if values in self._first_of:
            return f"as {self._first_of[values]} above{null}"
        self._first_of[values] = owner
        return values + null


# --- docs/configuration.md --------------------------------------------------------------------------------------------


def default_of(field: msgspec.structs.FieldInfo) -> str:
    if field.required:
        return "required"
    default = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
    if isinstance(default, Options):
        return "below"
    if isinstance(default, dict) and len(shown(default)) > PARTS_CHARACTERS:
        return "see [imud.yaml](../etc/imud.yaml)"
    octal = field.name == "mode" and isinstance(default, int)
    return f"`{default:#o}`" if octal else f"`{shown(default)}`"


def settings_tables() -> str:
    """Make a table for each section of the configuration.

    A row that an earlier line, link or driver has with the same words is replaced by a reference to that table.
    """
    text, first_of, lists = [], dict[tuple[str, ...], str](), LongLists()
    for title, path, schema in settings_parts():
        if title == "Link `memory`":  # only for tests of imud
            continue
        docs, rows, repeated = docs_of(schema), [], dict[str, list[str]]()
        for field in msgspec.structs.fields(schema):
            is_part = isinstance(field.default, Options)
            words = "keys below" if is_part else expected(field.type)
            rest = f"{default_of(field)} | {docs[field.name]} |"
            group = title.partition(" ")[0]  # Link, Line, Options, …
            first = first_of.setdefault((group, field.name, words, rest), title)
            if first == title:
                rows.append(f"| `{path}{field.name}` | {lists.cell(words, f'`{field.name}`')} | {rest}")
            else:
                repeated.setdefault(first.partition(":")[0], []).append(f"`{field.name}`")
        text += [f"### {title}", ""]
        if rows:
            text += ["| key | values | default | meaning |", "|---|---|---|---|", *rows, ""]
        for first, names in repeated.items():
            text += [f'{", ".join(names)}: as in "{first}".', ""]
        if not rows and not repeated:
            text += ["No keys.", ""]
    declared = "[device settings of each driver](settings.md#the-settings-of-each-driver)"
    text += [f"### `devices.NAME.settings.…`: {declared}", ""]
    return "\n".join(text)


# --- docs/fleet.md ----------------------------------------------------------------------------------------------------


def collector_table() -> str:
    docs, lists = docs_of(CollectorSettings), LongLists()
    rows = ["| key | values | default | meaning |", "|---|---|---|---|"]
    for field in msgspec.structs.fields(CollectorSettings):
        values = lists.cell(expected(field.type), f"`{field.name}`")
        rows.append(f"| `{field.name}` | {values} | {default_of(field)} | {docs[field.name]} |")
    return "\n".join(rows)


# --- docs/commands.md -------------------------------------------------------------------------------------------------


def cell(text: str) -> str:
    """Escape the characters that end a table cell."""
    return text.replace("|", "\\|")


def meanings_of(action: Verb) -> dict[str, str]:
    found = {}
    for field in msgspec.structs.fields(action.parameters):
        info = msgspec.inspect.type_info(field.type)
        if isinstance(info, msgspec.inspect.Metadata) and info.extra_json_schema:
            unit = (info.extra or {}).get("unit")
            meaning = info.extra_json_schema.get("description", "")
            found[field.name] = meaning[:1].upper() + meaning[1:] + (f" ({unit})" if unit else "")
    return found


def arguments_of(action: Verb, lists: LongLists) -> str:
    """Return the cell of the arguments of an action: name, values and meaning."""
    docs = meanings_of(action)
    words = []
    for parameter in parameters_of(action):
        default = "" if parameter.default is None else f"; default `{parameter.default}`"
        meaning = f": {docs[parameter.name].rstrip('.')}" if parameter.name in docs else ""
        values = lists.cell(parameter.values, f"`{parameter.name}`")
        words.append(f"`{parameter.name}` ({values}{default}){cell(meaning)}")
    return ".<br>".join(words) or "none"


def actions_table(actions: Verbs, lists: LongLists) -> Iterator[str]:
    yield "| command | arguments | effect | evidence |"
    yield "|---|---|---|---|"
    for name, action in actions.items():
        arguments = arguments_of(action, lists)
        yield f"| `{name}` | {arguments} | {cell(action.help.rstrip('.'))} | {cell(evidence_of(action))} |"


# Evidence that imud accepts for the effect of a command
EVIDENCE: Final[Mapping[Proof, str]] = {
    Proof.VALUE: "the reply is the result",
    Proof.RESTART: "the device counter restarts",
    Proof.SETTINGS: "the device reports other settings, and none was unsaved before",
    Proof.SAMPLES: "the samples at rest have the set value, and did not have it before",
    Proof.STREAM: "a sample arrives, and none arrived for 1.5 s before",
    Proof.ONE_SAMPLE: "a sample arrives, and none arrived for 1.5 s before",
}


def evidence_of(action: Verb) -> str:
    """Return the evidence for the effect of an action, or the reason why there is none."""
    if action.proof is Proof.NONE:
        return f"none: {action.evidence}"
    return action.evidence or EVIDENCE[action.proof]


def actions_part(driver: Driver, lists: LongLists, first_of: dict[str, str]) -> list[str]:
    """Return title and table of the commands of a driver; a table that an earlier driver has becomes a reference."""
    table = "\n".join(actions_table(driver.verbs, lists))
    first = first_of.setdefault(table, driver.name)
    return [f"### `{driver.name}`: {driver.title}", "", f"As `{first}`." if first != driver.name else table, ""]


def actions_tables() -> str:
    lists, first_of = LongLists(), dict[str, str]()
    lines = [line for driver in DRIVERS.values() if driver.verbs for line in actions_part(driver, lists, first_of)]
    without = ", ".join(f"`{driver.name}`" for driver in DRIVERS.values() if not driver.verbs)
    by_lines = [
        "### Any device with the line `reset` or `sin`",
        "",
        *actions_table({"reset": RESET, "trigger": TRIGGER}, lists),
        "",
    ]
    return "\n".join([*lines, *by_lines, f"{without}: no commands."])


# --- docs/calibration.md ----------------------------------------------------------------------------------------------


def calibrations_table() -> str:
    rows = ["| driver | kind | effect | device | result lasts |", "|---|---|---|---|---|"]
    for driver in DRIVERS.values():
        for kind, one in driver.calibrations.items():
            hold = {Handling.REST: "at rest", Handling.SPIN: "turned level", Handling.TURN: "turned"}[one.handling]
            rows.append(f"| `{driver.name}` | `{kind}` | {cell(one.help)} | {hold} | {one.kept} |")
    return "\n".join(rows)


# --- docs/settings.md -------------------------------------------------------------------------------------------------


class SettingRow(NamedTuple):
    """A row of the table of device settings."""

    name: str
    cells: tuple[str, ...]
    """Values with unit, effect."""
    meaning: str

    @property
    def group(self) -> tuple[str, tuple[str, ...]]:
        """Key of the rows that one row can replace: `tpdo1_by`, `tpdo2_by`, …"""
        return self.name.partition("_")[2], self.cells

    def __str__(self) -> str:
        return f"| {self.name} | {' | '.join(self.cells)} | {self.meaning} |"


def setting_rows(driver: Driver, lists: LongLists) -> Iterator[SettingRow]:
    assert driver.device_settings is not None
    for one in described_settings(driver.device_settings, {}, None):
        force = str(one.effect) + (", last" if one.connection else "") if one.declarable else "read only"
        if not one.readable:
            force += ", not readable"
        values = lists.cell(one.values, f"`{one.name}`") + (f" ({one.unit})" if one.unit else "")
        yield SettingRow(one.name, (values, force), cell(one.description))


def common_words(texts: Sequence[list[str]]) -> int:
    """Return the number of first words that all texts have in common."""
    return next((n for n, words in enumerate(zip(*texts, strict=False)) if len(set(words)) > 1), min(map(len, texts)))


def merged(rows: Sequence[SettingRow]) -> Iterator[SettingRow]:
    """Replace three or more rows that differ only in some words by one row."""
    for _, same in groupby(rows, lambda row: row.group):
        group = list(same)
        texts = [row.meaning.split() for row in group]
        first = common_words(texts)
        last = common_words([words[first:][::-1] for words in texts])
        if len(group) >= 3:
            different = [" ".join(words[first : len(words) - last]).rstrip(",") for words in texts]
            comma = "," * texts[0][-last - 1].endswith(",")
            words = [*texts[0][:first], " / ".join(different) + comma, *texts[0][len(texts[0]) - last :]]
            group = [SettingRow("`, `".join(row.name for row in group), group[0].cells, " ".join(words))]
        yield from (row._replace(name=f"`{row.name}`") for row in group)


def device_settings_part(driver: Driver, lists: LongLists, first_of: dict[tuple[str, str, str], str]) -> list[str]:
    """Return title and table of the device settings of a driver, without the rows of an earlier driver."""
    title = [f"### `{driver.name}`: {driver.title}", ""]
    found, repeated = [], dict[str, list[str]]()
    for row in setting_rows(driver, lists):
        first = first_of.setdefault((row.name, row.cells[-1], row.meaning), driver.name)
        if first == driver.name or not row.cells[0].startswith("as "):
            found.append(row)
        else:
            repeated.setdefault(first, []).append(f"`{row.name}`")
    references = [f"{', '.join(names)}: as in `{first}`." for first, names in repeated.items()]
    if not found:
        return [*title, *references, ""]
    rows = [*merged(found), *(["", *references] if references else [])]
    return [*title, "| setting | values | in force | meaning |", "|---|---|---|---|", *map(str, rows), ""]


def device_settings_tables() -> str:
    lists, first_of = LongLists(), dict[tuple[str, str, str], str]()
    parts = (device_settings_part(driver, lists, first_of) for driver in DRIVERS.values() if driver.device_settings)
    without = ", ".join(f"`{driver.name}`" for driver in DRIVERS.values() if not driver.device_settings)
    return "\n".join([*chain.from_iterable(parts), f"{without}: no device settings."])


# --- docs/shm.md ------------------------------------------------------------------------------------------------------

C_TYPES = {
    "Q": "uint64_t", "q": "int64_t", "I": "uint32_t", "H": "uint16_t", "B": "uint8_t", "d": "double", "s": "char",
}  # fmt: skip


def layout(fields: Sequence[SlotField]) -> str:
    rows = ["| offset | type | field |", "|---|---|---|"]
    for field in fields:
        if not field.name.startswith("reserved"):
            count = f"[{field.count}]" if field.count > 1 else ""
            rows.append(f"| {field.offset} | `{C_TYPES[field.code]}{count}` | `{field.name}` |")
    return "\n".join(rows)


def constants() -> str:
    rows = [
        ("`magic`", f"`{MAGIC[:-1].decode()}` and a zero byte"),
        ("`layout_version`", str(RING_LAYOUT_VERSION)),
        ("`slot_layout_version`", str(SLOT_LAYOUT_VERSION)),
        ("`header_bytes`", str(HEADER_BYTES)),
        ("`slot_bytes`", str(SLOT_BYTES)),
        ("`state`", f"{STATE_LIVE} live, {STATE_CLOSED} closed"),
        ("`seq`, `ledger_update` during a write", "18446744073709551615 (2⁶⁴ - 1)"),
        ("maximum age of the heartbeat", f"{HEARTBEAT_LIMIT_NS} ns"),
        ("maximum number of counters in `ledger`", str(LEDGER_ROOM)),
    ]
    return "\n".join(["| constant | value |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])


def layout_tables() -> dict[str, str]:
    return {
        "constants": constants(),
        "header": layout(HEADER_FIELDS),
        "slot": layout(SLOT_FIELDS),
        "present": ", ".join(f"`{name}` {bit:#x}" for name, bit in PRESENT_BITS.items()),
        "sync": ", ".join(f"{code} `{sync}`" for sync, code in SYNC_CODES.items()),
        "ledger": ", ".join(f"`{name}`" for name in LEDGER_FIELDS),
    }


# --- docs/fleet-database.md -------------------------------------------------------------------------------------------

COMPONENT_OF: Final = {one.column(measure): one for one in COMPONENTS for measure in ("", *MEASURES)}


def column_rows(columns: Sequence[Column]) -> Iterator[tuple[str, str]]:
    """Yield names and other cells of the columns. One row contains all components and statistics of a field."""
    for _, group in groupby(
        columns, lambda one: COMPONENT_OF[one.name].field if one.name in COMPONENT_OF else one.name
    ):
        same = list(group)
        components = dict.fromkeys(COMPONENT_OF[one.name] for one in same if one.name in COMPONENT_OF)
        names = [one.name for one in same]
        if len(names) > len(components) > 0:
            names = [one.column("…") for one in components]
        meaning = same[0].comment if not components else next(iter(components)).comment.partition("; component")[0]
        yield ", ".join(f"`{name}`" for name in names), f"{same[0].type} | {cell(meaning)}"


def database_part(
    name: str, comment: str, columns: Sequence[Column], primary: Sequence[str], first_of: dict[tuple[str, str], str]
) -> Iterator[str]:
    """Yield title and table of a table or view. A row of an earlier table becomes a reference to that table."""
    yield from (f"### `{name}`", "", f"{comment[:1].upper()}{comment[1:]}.", "")
    if primary:
        yield from (f"Primary key: {', '.join(f'`{one}`' for one in primary)}.", "")
    rows, repeated = [], dict[str, list[str]]()
    for names, cells in column_rows(columns):
        first = first_of.setdefault((names, cells), name)
        if first == name:
            rows.append(f"| {names} | {cells} |")
        else:
            repeated.setdefault(first, []).append(names)
    if rows:
        yield from ("| column | type | meaning |", "|---|---|---|", *rows, "")
    for first, found in repeated.items():
        yield from (f"{', '.join(found)}: as in `{first}`.", "")


def database_parts() -> dict[str, str]:
    def text(parts: Iterable[tuple[str, str, Sequence[Column], Sequence[str]]]) -> str:
        first_of = dict[tuple[str, str], str]()
        return "\n" + "\n".join(chain.from_iterable(database_part(*part, first_of) for part in parts))

    return {
        "tables": text((one.name, one.comment, one.columns, one.primary) for one in DATABASE_TABLES),
        "database views": text((one.name, one.comment, one.columns, ()) for one in views(with_timescale=False)),
    }


# --- docs/fleet-operation.md ------------------------------------------------------------------------------------------


def metrics_table(metrics: Sequence[CollectorMetric]) -> str:
    rows = [f"| `{one.name}` | {' '.join(f'`{label}`' for label in one.labels)} | {one.help} |" for one in metrics]
    return "\n".join(["| name | labels | meaning |", "|---|---|---|", *rows])


# --- docs/stability.md ------------------------------------------------------------------------------------------------


def versions() -> str:
    rows = [f"| [{name}](#{name}) | {one.version} | {one.read} |" for name, one in INTERFACES.items()]
    return "\n".join(["| interface | version | a program reads it from |", "|---|---|---|", *rows])


# --- docs/simulators.md -----------------------------------------------------------------------------------------------


def simulators_table() -> str:
    rows = ["| name | device | table |", "|---|---|---|"]
    rows += [f"| `{one.name}` | {one.title} | `SIMULATORS` |" for one in imud.sim.SIMULATORS.values()]
    rows += [f"| `{one.name}` | {one.title} | `CAN_SIMULATORS` |" for one in imud.sim.CAN_SIMULATORS.values()]
    return "\n".join(rows)


# --- all --------------------------------------------------------------------------------------------------------------

PAGES: Final[Mapping[str, Callable[[], Mapping[str, str]]]] = {
    "docs/configuration.md": lambda: {"keys": "\n" + settings_tables()},
    "docs/fleet.md": lambda: {"collector": collector_table()},
    "docs/commands.md": lambda: {"actions": "\n" + actions_tables()},
    "docs/calibration.md": lambda: {"calibrations": calibrations_table()},
    "docs/settings.md": lambda: {"settings": "\n" + device_settings_tables()},
    "docs/shm.md": layout_tables,
    "docs/monitoring.md": lambda: {"alerts": alert_table(RULES)},
    "docs/fleet-database.md": database_parts,
    "docs/fleet-operation.md": lambda: {
        "collector": metrics_table(COLLECTOR_METRICS),
        "fleet": metrics_table(FLEET_METRICS),
        "alerts": alert_table(FLEET_RULES),
    },
    "docs/stability.md": lambda: {"versions": versions()},
    "docs/python.md": lambda: {"reference": "\n" + python_reference(imud.client)},
    "docs/simulators.md": lambda: {"devices": simulators_table(), "reference": "\n" + python_reference(imud.sim)},
}


def current(page: str) -> str:
    return (ROOT / page).read_text()


def generated(page: str) -> str:
    text = current(page)
    for name, content in PAGES[page]().items():
        text = _replaced(text, name, content)
    return text


def _replaced(text: str, name: str, content: str) -> str:
    before, begin, rest = text.partition(f"<!-- {name} -->\n")
    _, end, after = rest.partition(f"\n<!-- end of {name} -->")
    assert begin, f"no mark of {name}"
    assert end, f"no mark of the end of {name}"
    return f"{before}{begin}{content}{end}{after}"


WHOLE_FILES: Final[Mapping[str, Callable[[], str]]] = {"docs/socket.schema.json": socket_schema}


if __name__ == "__main__":
    os.environ["IMUD_PLUGINS"] = "off"  # the result must not depend on installed drivers and outputs
    for name, made in WHOLE_FILES.items():
        (ROOT / name).write_text(made())
    for name in PAGES:
        (ROOT / name).write_text(generated(name))
