"""Reference of a Python package from docstrings, comments and signatures, for docs/python.md and docs/simulators.md.

`__all__` of the package lists the public names. Each public name, method, attribute and field needs a description: a
docstring, or a comment at or above its line. The reference cannot be generated without it.
"""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from enum import Enum
from importlib import import_module
from types import ModuleType
from typing import Any, Final, NamedTuple

from imud.model.sample import Sample

WIDTH: Final = 100
"""Maximum length of a line of a signature, characters."""
OTHER_PAGES: Final = {Sample: "The fields are on the page [sample](sample.md#fields)."}
"""Classes whose fields another page describes."""


class Attribute(NamedTuple):
    """A field, an attribute, a property or a member of an enumeration."""

    name: str
    form: str  # type and default as in the source
    meaning: str


def python_reference(package: ModuleType) -> str:
    """Return a section for each public name, in the order of the source of the package, and a table of exceptions."""
    source = inspect.getsource(package)
    names = sorted(package.__all__, key=lambda name: len(re.split(rf"\b{name}\b", source)[0]))
    public = [(name, getattr(package, name)) for name in names]
    errors = [one for _, one in public if inspect.isclass(one) and issubclass(one, BaseException)]
    lines = [line for name, one in public if one not in errors for line in (*section(package, name, one), "")]
    if errors:
        lines += ["### Exceptions", "", "| exception | base class | meaning |", "|---|---|---|"]
        for error in errors:
            base = error.__bases__[0].__name__
            lines.append(f"| `{error.__name__}` | `{base}` | {cell(meaning_of(error, error.__name__))} |")
    text = re.sub(r"\n{3,}", "\n\n", "\n".join(lines).rstrip())
    return re.sub(r"\bdocs/(\w+)\.md", r"[\1](\1.md)", text)


def section(package: ModuleType, name: str, one: Any) -> Iterator[str]:
    yield f"### `{name}`"
    yield ""
    if inspect.isclass(one):
        yield from class_section(one)
    elif callable(one):
        yield from function_section(one, name)
    else:
        text = inspect.getsource(home_of(name, package))
        (found,) = [one for one in attributes(ast.parse(text).body, text.splitlines()) if one.name == name]
        yield described(found.meaning, name)


def home_of(name: str, package: ModuleType) -> ModuleType:
    """Return the module from which a package imports a constant; the package itself if it makes the constant."""
    for node in ast.parse(inspect.getsource(package)).body:
        if isinstance(node, ast.ImportFrom) and node.module and name in [one.name for one in node.names]:
            return import_module(node.module)
    return package


def class_section(one: type) -> Iterator[str]:
    lines, node = class_source(one)
    made = next((child for child in functions(node) if child.name == "__init__"), None)
    if made is not None:
        yield from code(signature(lines, made).replace("__init__", one.__name__, 1).removesuffix(" -> None"))
    yield described(ast.get_docstring(node) or "", one.__name__)
    yield ""
    if made is not None and ast.get_docstring(made):
        yield ast.get_docstring(made) or ""
        yield ""
    if one in OTHER_PAGES:
        yield OTHER_PAGES[one]
        return
    found = list(own_attributes(one))
    if found:
        yield "| member | value | meaning |" if issubclass(one, Enum) else "| attribute | type | meaning |"
        yield "|---|---|---|"
        for field in found:
            form = repr(getattr(one, field.name).value) if issubclass(one, Enum) else field.form
            meaning = cell(described(field.meaning, f"{one.__name__}.{field.name}"))
            yield f"| `{field.name}` | {f'`{cell(form)}`' if form else ''} | {meaning} |"
        yield ""
    for child in functions(node):
        if not child.name.startswith("_") and not is_property(child):
            yield f"#### `{one.__name__}.{child.name}`"
            yield ""
            yield from function_section(getattr(one, child.name), f"{one.__name__}.{child.name}")
            yield ""


def function_section(one: Any, name: str) -> Iterator[str]:
    lines = textwrap.dedent(inspect.getsource(one)).splitlines()
    (node,) = ast.parse("\n".join(lines)).body
    assert isinstance(node, ast.FunctionDef)
    yield from code(signature(lines, node))
    yield described(ast.get_docstring(node) or "", name)


def own_attributes(one: type) -> Iterator[Attribute]:
    """Yield the public attributes of a class and of its public base classes in the same package."""
    for base in reversed(one.__mro__):
        same = base.__module__.partition(".")[0] == one.__module__.partition(".")[0]
        if same and not base.__name__.startswith("_"):
            lines, node = class_source(base)
            yield from attributes(node.body, lines)
            for child in functions(node):
                if child.name == "__init__":
                    yield from attributes(child.body, lines, owner="self.")
                elif is_property(child) and not child.name.startswith("_"):
                    form = ast.unparse(child.returns) if child.returns else ""
                    yield Attribute(child.name, form, ast.get_docstring(child) or "")


def attributes(body: list[ast.stmt], lines: list[str], owner: str = "") -> Iterator[Attribute]:
    """Yield the public names that `body` assigns: variables, or with `owner`, attributes of this object."""
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        form = ast.unparse(node.annotation) if isinstance(node, ast.AnnAssign) else ""
        if not owner and node.value is not None and form:
            form += f" = {ast.unparse(node.value)}"
        target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
        for part in target.elts if isinstance(target, ast.Tuple) else [target]:
            path = ast.unparse(part)
            name = path.removeprefix(owner)
            if path.startswith(owner) and name.isidentifier() and not name.startswith("_"):
                yield Attribute(name, form.removeprefix("Final = "), description(node, after, lines))


def description(node: ast.stmt, after: ast.stmt | None, lines: list[str]) -> str:
    """Return the docstring below a statement, the comment at its end, or the comment above it."""
    if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
        return " ".join(after.value.value.split())
    last = (node.end_lineno or node.lineno) - 1
    comment = lines[last].encode()[node.end_col_offset or 0 :].decode().strip()
    if comment.startswith("# ") and comment != "# fmt: skip":
        return comment.removeprefix("# ")
    above: list[str] = []
    for line in reversed(lines[: node.lineno - 1]):
        if not line.strip().startswith("# ") or line.strip().startswith("# ---"):
            break
        above.insert(0, line.strip().removeprefix("# "))
    return " ".join(above)


def class_source(one: type) -> tuple[list[str], ast.ClassDef]:
    lines = textwrap.dedent(inspect.getsource(one)).splitlines()
    (node,) = ast.parse("\n".join(lines)).body
    assert isinstance(node, ast.ClassDef)
    return lines, node


def functions(node: ast.ClassDef) -> list[ast.FunctionDef]:
    return [child for child in node.body if isinstance(child, ast.FunctionDef)]


def is_property(node: ast.FunctionDef) -> bool:
    return any(ast.unparse(one) == "property" for one in node.decorator_list)


def signature(lines: list[str], node: ast.FunctionDef) -> str:
    """Return name, parameters and result of a function, without `self`."""
    text = " ".join(" ".join(lines[node.lineno - 1 : node.body[0].lineno - 1]).replace("# fmt: skip", "").split())
    text = text.removeprefix("def ").removesuffix("...").rstrip().removesuffix(":")
    return re.sub(r"\(\s*(?:self(?:, )?)?(.*?),?\s*\)( ->|$)", r"(\1)\2", text, count=1)


def code(text: str) -> Iterator[str]:
    text = re.sub(r"(?<!,) ", "\N{NO-BREAK SPACE}", text)  # a line ends after a comma
    yield "```text"
    for line in textwrap.wrap(text, WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False):
        yield line.replace("\N{NO-BREAK SPACE}", " ")
    yield "```"
    yield ""


def meaning_of(one: type, name: str) -> str:
    return described(" ".join((one.__doc__ or "").split()), name)


def described(text: str, name: str) -> str:
    """Return a description with a capital letter. Raises ValueError if it is empty."""
    if not text:
        raise ValueError(
            f"{name}: expected a docstring or a comment, got none; this name is in the reference of Python"
        )
    return text if text.startswith("imud") else text[:1].upper() + text[1:]


def cell(text: str) -> str:
    """Escape the characters that end a table cell."""
    return text.replace("|", "\\|")
