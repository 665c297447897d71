"""Facts of an interface: a line of text for each name that a program can use, made from types and source code."""

import ast
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, Final, TypeGuard

import msgspec

Facts = dict[str, str]
"""Facts by name. The text of a fact starts with REQUIRED if a program must supply the named part."""
Schema = Mapping[str, Any]

REQUIRED: Final = "required"
INPUT: Final = ("optional", REQUIRED)
"""Words for the absence and presence of a member in data that imud receives."""
OUTPUT: Final = ("sometimes", "always")
"""Words for the absence and presence of a member in data that imud sends."""
BOUNDS: Final = (
    "minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum", "minLength", "maxLength", "minItems", "maxItems",
    "pattern", "const", "contentEncoding",
)  # fmt: skip

# --- JSON Schema ------------------------------------------------------------------------------------------------------


def type_facts(kind: Any, path: str, words: Sequence[str]) -> Facts:
    """Return the facts of a type of messages or options. `path`: name of the object."""
    (schema,), components = msgspec.json.schema_components(
        [kind], ref_template="#/$defs/{name}", schema_hook=lambda _: {"type": "any"}
    )
    return schema_facts(schema, components, path, words)


def schema_facts(
    schema: Schema, components: Mapping[str, Schema], path: str, words: Sequence[str], presence: str = ""
) -> Facts:
    """Return the facts of a JSON Schema. The names of `components` are not part of the interface."""
    types, bounds, found = set[str](), list[str](), Facts()
    default = schema.get("default")
    for one in _alternatives(schema, components):
        given = one.get("type", "object" if "properties" in one else "value" if "enum" in one else "any")
        types |= {given} if isinstance(given, str) else {*given}
        bounds += [f"{name} {one[name]}" for name in BOUNDS if name in one]
        found |= {f"{path}: {value}": "value" for value in (*one.get("enum", ()), *one.get("examples", ()))}
        for name, part in one.get("properties", {}).items():
            word = words[name in one.get("required", ())]
            found |= schema_facts(part, components, f"{path}.{name}", words, word)
        inner = {f"{path}.NAME": one.get("additionalProperties"), f"{path}[]": one.get("items")}
        inner |= {f"{path}[{place}]": part for place, part in enumerate(one.get("prefixItems", ()))}
        for name, part in inner.items():
            if isinstance(part, Mapping):
                found |= schema_facts(part, components, name, words)
    texts = [presence, " or ".join(sorted(types)), *bounds]
    if "default" in schema and not isinstance(default, dict):
        texts.append(f"default {msgspec.json.encode(default).decode()}")
    return {path: ", ".join(filter(None, texts))} | found


def _alternatives(schema: Schema, components: Mapping[str, Schema]) -> Iterator[Schema]:
    if "$ref" in schema:
        yield from _alternatives(components[schema["$ref"].rpartition("/")[2]], components)
    elif "anyOf" in schema:
        for one in schema["anyOf"]:
            yield from _alternatives(one, components)
    else:
        yield schema


# --- Python modules ---------------------------------------------------------------------------------------------------

OPERATORS: Final = frozenset({"__call__", "__enter__", "__iter__", "__len__", "__next__"})
LITERAL_CHARACTERS: Final = 60
"""Maximum length of the value of a constant that is a fact. A longer value is a table."""
Function = ast.FunctionDef | ast.AsyncFunctionDef


def module_facts(name: str) -> Facts:
    """Return the facts of the public names of a module: `__all__`, otherwise the names without `_` that it defines."""
    module = import_module(name)
    listed = getattr(module, "__all__", None)
    if listed is None:
        return _facts_of(_definitions(name), name)
    return dict(chain.from_iterable(name_facts(_home(name, one), one, name).items() for one in listed))


def name_facts(module: str, name: str, prefix: str = "") -> Facts:
    """Return the facts of one name. `module` defines it, programs import it from `prefix`."""
    return _facts_of({name: _definitions(module)[name]}, prefix or module)


def member_facts(module: str, place: str, path: str) -> Facts:
    """Return the names in all dictionaries that a function writes. `place`: its name, or `Class.method`."""
    node: ast.AST = _definitions(module)[place.partition(".")[0]]
    if "." in place:
        (node,) = (one for one in ast.walk(node) if getattr(one, "name", "") == place.partition(".")[2])
    keys = [
        str(key.value)
        for one in ast.walk(node)
        for key in (one.keys if isinstance(one, ast.Dict) else [one.slice] if _is_store(one) else [])
        if isinstance(key, ast.Constant)
    ]
    assert keys, f"{module}.{place} writes no dictionary"
    return {f"{path}: {key}": "member" for key in keys}


def _is_store(node: ast.AST) -> TypeGuard[ast.Subscript]:
    return isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store)


def _home(module: str, name: str) -> str:
    """Return the module that defines a name of `module`."""
    if name in _definitions(module):
        return module
    sources = [node.module for node in _body(module) if isinstance(node, ast.ImportFrom) and _has(node, name)]
    # a module that imports its names later has no such line
    return _home(str(sources[0]), name) if sources else str(getattr(import_module(module), name).__module__)


def _has(node: ast.ImportFrom, name: str) -> bool:
    return any(alias.name == name for alias in node.names)


@cache
def _body(module: str) -> list[ast.stmt]:
    file = sys.modules[import_module(module).__name__].__file__
    assert file is not None
    return ast.parse(Path(file).read_text()).body


def _definitions(module: str) -> dict[str, ast.stmt]:
    return {name: node for node in _body(module) for name in _names(node)}


def _names(node: ast.stmt) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", node)]
    return [str(name) for one in targets if (name := getattr(one, "id", getattr(one, "name", "")))]


def _facts_of(definitions: Mapping[str, ast.stmt], prefix: str) -> Facts:
    found = Facts()
    for name, node in definitions.items():
        if name.startswith("_"):
            continue
        if isinstance(node, ast.ClassDef):
            found |= _class_facts(node, f"{prefix}.{name}")
        elif isinstance(node, Function):
            found |= _function_facts(node, f"{prefix}.{name}", ("optional", REQUIRED), "function")
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            found[f"{prefix}.{name}"] = f"constant {_constant(node)}".strip()
    return found


def _constant(node: ast.Assign | ast.AnnAssign) -> str:
    """Return the value of a short constant; otherwise its annotation."""
    value = "" if node.value is None else ast.unparse(node.value)
    if len(value) <= LITERAL_CHARACTERS:
        return value
    return ast.unparse(node.annotation) if isinstance(node, ast.AnnAssign) else ""


def _class_facts(node: ast.ClassDef, name: str) -> Facts:
    bases = [ast.unparse(base) for base in node.bases]
    # another package implements a protocol: a new member of the protocol breaks its class
    required = REQUIRED if any(base.startswith("Protocol") for base in bases) else "member"
    found = {name: f"class of {', '.join(bases) or 'object'}"}
    for one in node.body:
        (member, *_), own = [*_names(one), ""], f"{name}.{''.join(_names(one)[:1])}"
        if isinstance(one, Function) and member == "__init__":
            found |= _function_facts(one, name, ("optional", REQUIRED), found[name])
            found |= {f"{name}.{attribute}": "attribute" for attribute in _attributes(one)}
        elif isinstance(one, Function) and (not member.startswith("_") or member in OPERATORS):
            decorated = {ast.unparse(decorator) for decorator in one.decorator_list}
            kind = "property" if decorated & {"property", "cached_property"} else "method"
            found |= _function_facts(one, own, ("optional", REQUIRED), f"{required} {kind}")
        elif isinstance(one, ast.AnnAssign) and not member.startswith("_"):
            word = "optional" if one.value is not None else REQUIRED
            default = "" if one.value is None else f" = {ast.unparse(one.value)}"
            found[own] = f"{word} field: {ast.unparse(one.annotation)}{default}"
        elif isinstance(one, ast.Assign) and not member.startswith("_"):
            found[own] = f"value {ast.unparse(one.value)}"
    return found


def _attributes(init: Function) -> Iterator[str]:
    """Yield the public attributes that a constructor sets."""
    for node in ast.walk(init):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and not node.attr.startswith("_"):
            yield node.attr


def _function_facts(node: Function, name: str, words: Sequence[str], kind: str) -> Facts:
    returns = "" if node.returns is None or node.name == "__init__" else f" -> {ast.unparse(node.returns)}"
    found = {name: f"{kind}{returns}"}
    arguments = node.args
    plain = [*arguments.posonlyargs, *arguments.args]
    defaults = [*[None] * (len(plain) - len(arguments.defaults)), *arguments.defaults, *arguments.kw_defaults]
    both = zip([*plain, *arguments.kwonlyargs], defaults, strict=True)
    for place, (one, default) in enumerate(both):
        if one.arg in ("self", "cls") and not place:
            continue
        word = words[default is None]
        kept = "" if default is None else f" = {ast.unparse(default)}"
        where = "by name" if one in arguments.kwonlyargs else f"place {place}"
        found[f"{name}({one.arg})"] = f"{word}, {where}: {_annotation(one)}{kept}"
    for more, star in ((arguments.vararg, "*"), (arguments.kwarg, "**")):
        if more is not None:
            found[f"{name}({star})"] = f"optional: {_annotation(more)}"
    return found


def _annotation(argument: ast.arg) -> str:
    return "Any" if argument.annotation is None else ast.unparse(argument.annotation)
