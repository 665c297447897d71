"""Reading of keys against schemas; problems are collected with their positions."""

import re
from collections.abc import Iterator, Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import msgspec

from imud.config.schema import Row
from imud.config.yaml_tree import PROBLEMS_MAX, Problem, YamlTree
from imud.config.yaml_tree import Path as KeyPath
from imud.contracts.settings import Settings, disagreements, expected, got, unknown_name, value_problem

S = TypeVar("S", bound=Settings)

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")


class Keys:
    """The keys of a file and the problems found with them so far."""

    def __init__(self, tree: YamlTree) -> None:
        self.tree = tree
        self.problems: list[Problem] = []

    def problems_besides(self, known: Sequence[Problem]) -> Iterator[Problem]:
        """List the problems, without those that only follow from a `known` one at the same place or inside it."""
        paths = [problem.path for problem in known]
        return (p for p in self.problems if not any(path[: len(p.path)] == p.path for path in paths))

    def mapping(self, path: KeyPath, data: object) -> Mapping[str, Any] | None:
        """Return `data` if it is a mapping; otherwise add a problem and return None."""
        if isinstance(data, dict):
            return data
        self.problem(path, f"expected keys and values, got {got(data)}")
        return None

    def unknown_keys(self, path: KeyPath, keys: Mapping[str, Any], known: Sequence[str]) -> None:
        """Add a problem for each key that is not `known`."""
        for key in keys:
            if key not in known and len(self.problems) < PROBLEMS_MAX:
                self.problem((*path, key), unknown_name("a key", key, known), at_key=True)

    def row(self, table: Mapping[str, Row], name: str, data: object, path: KeyPath | None = None) -> Settings | None:
        """Read the settings of row `name`; an empty value means its defaults."""
        path = path or (name,)
        try:
            schema = table[name].settings
        except ImportError as error:
            self.problem(path, f"expected the parts of {name} to be installed, got: {error}", at_key=True)
            return None
        return self.part(schema, data, path)

    def part(self, schema: type[S], data: object, path: KeyPath) -> S | None:
        """Read the settings of one part by its schema; an empty value means its defaults."""
        keys = self.mapping(path, {} if data is None else data)
        if keys is None:
            return None
        self.unknown_keys(path, keys, schema.__struct_fields__)
        return self.settings(schema, path, {key: keys[key] for key in schema.__struct_fields__ if key in keys})

    def settings(self, schema: type[S], path: KeyPath, keys: Mapping[str, Any]) -> S | None:
        """Convert the known `keys` to `schema`, each by itself, so that every bad value is reported."""
        good = True
        for field in msgspec.structs.fields(schema):
            if field.name in keys:
                good &= self._value_fits((*path, field.name), keys[field.name], field.type)
            elif field.required:
                self.problem(path, f"expected the key {field.name} ({expected(field.type)}), got none", at_key=True)
                good = False
        if not good:
            return None
        for name, message in disagreements(schema, keys):
            self.problem((*path, name) if name else path, message)
            return None
        return msgspec.convert(keys, schema)

    def problem(self, path: KeyPath, message: str, *, at_key: bool = False) -> None:
        """Add a problem at `path`, with its value or with the key itself."""
        mark = self.tree.key_mark(path) if at_key else self.tree.mark(path)
        self.problems.append(Problem(mark, path, message))

    def _value_fits(self, path: KeyPath, value: object, field_type: Any) -> bool:
        before = len(self.problems)
        if isinstance(value, dict):
            self._check_inside(path, value, field_type)
        if len(self.problems) > before:
            return False
        if problem := value_problem(value, field_type):
            self.problem(path, problem)
            return False
        text = _controlling(value)
        if text is not None:
            self.problem(path, f"expected text without control characters, got {got(text)}")
        return text is None

    def _check_inside(self, path: KeyPath, values: Mapping[str, Any], field_type: Any) -> None:
        """Add the problems of keys and values in a mapping, each at its own place, where `field_type` has mappings."""
        for choice in _choices(field_type):
            if isinstance(choice, type) and issubclass(choice, Settings):
                self.part(choice, values, path)
            elif get_origin(choice) is dict:
                key_type, value_type = get_args(choice)
                known = get_args(key_type) if get_origin(key_type) is Literal else None
                if known is not None:
                    self.unknown_keys(path, values, known)
                for key, value in values.items():
                    if (known is None or key in known) and len(self.problems) < PROBLEMS_MAX:
                        self._value_fits((*path, key), value, value_type)


def _choices(field_type: Any) -> Iterator[Any]:
    """List the types of a union, or the one type, without annotations."""
    origin = get_origin(field_type)
    if origin is Annotated:
        yield from _choices(get_args(field_type)[0])
    elif origin is Union or origin is UnionType:
        for one in get_args(field_type):
            yield from _choices(one)
    else:
        yield field_type


def _controlling(value: object) -> str | None:
    """A text in `value` that has control characters (no path or name has any, the kernel refuses NUL); else None."""
    if isinstance(value, str):
        return value if _CONTROL.search(value) else None
    parts = value if isinstance(value, list) else value.values() if isinstance(value, dict) else ()
    return next((text for text in map(_controlling, parts) if text is not None), None)
