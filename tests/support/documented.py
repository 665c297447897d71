"""Values and defaults of keys and device settings, as in the tables of docs/configuration.md and docs/settings.md."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import msgspec

DOCS: Final = Path(__file__).parent.parent.parent / "docs"
RANGE: Final = re.compile(r"(-?[\d.]+) to (-?[\d.]+)")
ABOVE: Final = re.compile(r"above (-?[\d.]+)")
SAME: Final = re.compile(r"as `(\w+)` above(.*)")
WORD: Final = re.compile(r"`([^`]+)`")
KEYS: Final = re.compile(r"keys ([\w, ]+?), each with (?!the keys)")
WRONG: Final = "no such word"


@dataclass(frozen=True)
class Row:
    """A row of a table: the cells after the name."""

    name: str
    values: str
    cells: tuple[str, ...]


REFERENCE = re.compile(r"(`.*`): as in `([\w-]+)`\.")


def rows(page: str, heading: str) -> list[Row]:
    """Return the rows below a heading that starts with `heading`.

    A row can refer to the values of an earlier row. A sentence can refer to rows below another heading.
    """
    found, is_inside, earlier = list[Row](), False, dict[str, str]()
    for line in (DOCS / page).read_text().splitlines():
        if line.startswith("### "):
            is_inside = line.startswith(f"### {heading}")
        if is_inside and (reference := REFERENCE.fullmatch(line)):
            other = rows(page, f"`{reference[2]}`")
            found += [row for row in other if row.name in WORD.findall(reference[1])]
        if not line.startswith("| `"):
            continue
        names, values, *cells = line.strip("| ").split(" | ")
        if same := SAME.fullmatch(values):
            values = earlier[same[1]] + same[2]
        for path in WORD.findall(names):
            name = path.rpartition(".")[2]
            earlier[name] = values
            if is_inside:
                found.append(Row(name, values, tuple(cells)))
    return found


def default_of(cell: str) -> Any:
    text = cell.strip("`")
    return int(text, 8) if re.fullmatch(r"0o\d+", text) else json.loads(text)


def accepts(kind: Any, value: Any) -> bool:
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return False
    return True


def check_values(row: Row, kind: Any) -> None:
    """Assert that `kind` accepts the values of a row, and no value next to them."""
    levels, text = list[list[str]](), row.values
    while found := KEYS.search(text):
        levels.append(found[1].split(", "))
        text = text[found.end() :]
    for path in product(*levels):
        for value, is_valid in examples(text):
            whole = value
            for key in reversed(path):
                whole = {key: whole}
            assert accepts(kind, whole) == is_valid, f"{row.name}: {whole!r} is {'' if is_valid else 'in'}valid"


def examples(text: str) -> Iterator[tuple[Any, bool]]:
    """Generate values for the text of a cell, each with whether it is valid."""
    text = re.sub(r" \([^)]*\)$", "", text)
    words = WORD.findall(text)
    lists = re.search(r"list", text) is not None
    ranges = [(json.loads(low), json.loads(high)) for low, high in RANGE.findall(text)]
    numbers = [] if lists else [int(one) for one in re.findall(r"(?:^|, )(\d+)(?=,|$)", text)]
    yield from ((one, True) for one in (*(words if not lists else ()), *numbers))
    yield None, "null" in text
    for low, high in ranges:
        step = 1 if "integer" in text else 1e-3 * max(abs(low), abs(high)) if low and abs(low) >= 1 else 1e-3
        yield from ((low, "above" not in text), (high, True), (low - step, False), (high + step, False))
    if found := ABOVE.search(text):
        yield from ((json.loads(found[1]), False), (json.loads(found[1]) + 1e-3, True))
    for one in {value + step for value in numbers for step in (-1, 1)} - set(numbers):
        if not any(low <= one <= high for low, high in ranges):
            yield one, False
    if "boolean" in text:
        yield from ((True, True), (False, True), (2, False))
    if "string" not in text:
        yield WRONG, False
    elif "not empty" in text:
        yield from (("", False), ("x", True))
    if count := re.search(r"list of (\d+) numbers", text):
        yield from (([0.5] * (int(count[1]) + more), not more) for more in (-1, 0, 1))


def check_schema(heading: str, schema: type[msgspec.Struct]) -> int:
    """Assert the values and defaults of the keys below a heading of docs/configuration.md. Return their number."""
    fields = {one.name: one for one in msgspec.structs.fields(schema)}
    found = rows("configuration.md", heading)
    for row in found:
        field, default = fields[row.name], row.cells[0]
        check_values(row, field.type)
        if default == "required":
            assert field.required, row.name
        elif default.startswith("`"):
            value = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
            assert msgspec.to_builtins(value) == default_of(default), row.name
    return len(found)
