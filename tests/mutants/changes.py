"""The mutants of imud: which small changes are possible, and which of them a seed chooses.

The choice depends on `imud/` and the seed only. A change of one function does not change the choice in other functions.
"""

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from difflib import unified_diff
from functools import cache
from itertools import accumulate, chain
from pathlib import Path
from random import Random
from typing import Any, Final

Change = tuple[str, int, int, str]
"""Kind, start, end and new text."""
ROOT: Final = Path(__file__).parent.parent.parent
OPERATORS: Final = {
    "<": "<=", "<=": "<", ">": ">=", ">=": ">", "==": "!=", "!=": "==", "is": "is not", "is not": "is",
    "in": "not in", "not in": "in", "and": "or", "or": "and",
}  # fmt: skip
OPERATOR: Final = re.compile(rb"<=|>=|==|!=|<|>|\b(?:is not|not in|is|in|and|or)\b")
LAYOUT: Final = re.compile(r"[<>][0-9a-zA-Z?]*[hHiIlLqQefd][0-9a-zA-Z?]*")
"""Format of `struct` in which the order of the bytes matters."""
CLOSING: Final = re.compile(r"_?(a?close\w*|cancel\w*|remove_\w+|release|unlink|terminate|kill|shutdown|stop)")
UNCHANGED: Final = {"annotation", "returns", "decorator_list"}
WEIGHTS: Final = {"changed result": 1, "swapped bytes": 4}
"""Weights of kinds in the choice; 2 if absent. Most tests of a function detect another result."""
LEAVING: Final = (ast.Raise, ast.Return, ast.Continue, ast.Break)
LINES_MAX: Final = 40
"""Maximum weight of a function or constant in the choice: a table of 200 lines is not 5 functions."""


@cache
def source_of(path: str) -> bytes:
    """Return a file as it was at its first use, because a user can edit the tree in the meantime."""
    return (ROOT / path).read_bytes()


@dataclass(frozen=True)
class Mutant:
    """A change: the bytes from `start` to `end` of a file become `new`."""

    path: str
    line: int
    unit: str
    kind: str
    start: int
    end: int
    new: str

    def apply(self, source: bytes) -> bytes:
        return source[: self.start] + self.new.encode() + source[self.end :]

    def diff(self) -> list[str]:
        old = source_of(self.path)
        sides = old.decode().splitlines(), self.apply(old).decode().splitlines()
        return list(unified_diff(*sides, self.path, self.path, lineterm="", n=0))

    def __str__(self) -> str:
        """Return the place, the kind, and the first removed and added line."""
        lines = self.diff()[3:]
        old, new = ([text[1:].strip() for text in lines if text[0] == sign] for sign in "-+")
        before = old[0] + (" …" if len(old) > 1 else "")
        return f"{self.path}:{self.line}  {self.kind}  {before}  ->  {new[0] if new else ''}"


class Finder:
    """All mutants of one file, by unit. A unit is a function, a method, or a constant."""

    def __init__(self, path: str) -> None:
        self.path, self.source = path, source_of(path)
        self.starts = [0, *accumulate(len(line) for line in self.source.splitlines(keepends=True))]
        self.mutants: dict[str, list[Mutant]] = defaultdict(list)
        self.weights: Counter[str] = Counter()
        self._visit_body(ast.parse(self.source).body, "")

    def _visit_body(self, body: Iterable[ast.stmt], prefix: str) -> None:
        for node in body:
            match node:
                case ast.ClassDef() if "Protocol" not in {ast.unparse(base).partition("[")[0] for base in node.bases}:
                    self._visit_body(node.body, f"{prefix}{node.name}.")
                case ast.FunctionDef() | ast.AsyncFunctionDef() if node.name not in ("__repr__", "__str__"):
                    self._add_unit(node, prefix + node.name)
                case ast.Assign(targets=[target, *_]) | ast.AnnAssign(target=target):
                    self._add_unit(node, prefix + ast.unparse(target))

    def _add_unit(self, node: ast.stmt, unit: str) -> None:
        assert node.end_lineno
        self.weights[unit] = min(self.weights[unit] + node.end_lineno - node.lineno + 1, LINES_MAX)
        for changed, parent in walk(node):
            for change in chain(self._values(changed, parent), self._operators(changed), self._statements(changed)):
                self.mutants[unit].append(Mutant(self.path, changed.lineno, unit, *change))

    def _at(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        end = self.starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        return self.starts[node.lineno - 1] + node.col_offset, end

    def _text(self, node: ast.expr | ast.stmt) -> str:
        return self.source[slice(*self._at(node))].decode()

    def _operator(self, left: ast.expr, right: ast.expr) -> tuple[int, int, str]:
        found = OPERATOR.search(self.source, self._at(left)[1], self._at(right)[0])
        assert found
        return *found.span(), OPERATORS[found.group().decode()]

    def _values(self, node: Any, parent: ast.AST) -> Iterator[Change]:
        match node:
            case ast.Constant(value=bool()):
                if isinstance(parent, ast.Call | ast.keyword | ast.arguments | ast.Return):
                    yield "inverted flag", *self._at(node), str(not node.value)
            case ast.Constant(value=int() | float()) if node.value and is_quantity(node, parent):
                yield "wrong scale", *self._at(node), f"({self._text(node)} * 2)"
            case ast.Constant(value="little" | "big"):
                yield "swapped bytes", *self._at(node), '"big"' if node.value == "little" else '"little"'
            case ast.Constant(value=str() as layout):
                if LAYOUT.fullmatch(layout) and self._text(node)[1] == layout[0]:
                    at = self._at(node)[0] + 1
                    yield "swapped bytes", at, at + 1, ">" if layout[0] == "<" else "<"
            case ast.Name() if node.id.isupper() and len(node.id) > 1 and isinstance(parent, ast.BinOp):
                if isinstance(parent.op, ast.Mult | ast.Div | ast.FloorDiv | ast.Mod):
                    yield "wrong scale", *self._at(node), f"(2 * {node.id})"

    def _operators(self, node: Any) -> Iterator[Change]:
        bounds: list[tuple[ast.expr | None, str]] = []
        match node:
            case ast.Compare():
                for left, right, one in zip([node.left, *node.comparators], node.comparators, node.ops, strict=False):
                    is_order = isinstance(one, ast.Lt | ast.LtE | ast.Gt | ast.GtE)
                    yield "off by one" if is_order else "== and !=", *self._operator(left, right)
            case ast.BoolOp(values=[left, right, *_]):
                yield "and/or", *self._operator(left, right)
            case ast.BinOp(op=ast.Add() | ast.Sub(), right=ast.Constant(value=1)):
                yield "off by one", *self._at(node.right), "0"
            case ast.Slice():
                bounds = [(node.lower, "+ 1"), (node.upper, "- 1")]
            case ast.Call(func=ast.Name(id="range")):
                bounds = [(node.args[min(1, len(node.args) - 1)], "- 1")]
        for bound, shift in bounds:
            if bound:
                yield "off by one", *self._at(bound), f"({self._text(bound)}) {shift}"

    def _statements(self, node: Any) -> Iterator[Change]:
        match node:
            case ast.Expr() | ast.AugAssign() if kind := lost(node):
                yield kind, *self._at(node), "pass"
            case ast.If() | ast.IfExp():
                leaves = isinstance(node, ast.If) and not node.orelse and isinstance(node.body[-1], LEAVING)
                if leaves and not self._text(node).startswith("elif"):
                    yield "removed check", *self._at(node), "pass"
                yield "negated condition", *self._at(node.test), f"(not ({self._text(node.test)}))"
            case ast.Return(value=ast.expr() as value) if new := other_result(value, self._text(value)):
                yield "changed result", *self._at(value), new


def walk(node: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, ast.AST]]:
    """Generate the nodes that may change, each with its parent: no annotations, texts, messages or assertions."""
    for field, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or field in UNCHANGED or is_text(child):
                continue
            if isinstance(child, ast.expr | ast.stmt):
                yield child, node
            yield from walk(child)


def is_text(node: ast.AST) -> bool:
    """Return whether a node is a log line, an error message, a formatted text, or a check of types."""
    match node:
        case ast.Assert() | ast.Raise() | ast.JoinedStr() | ast.Import() | ast.ImportFrom() | ast.ClassDef():
            return True
        case ast.Expr(value=ast.Call(func=ast.Attribute(value=ast.Name(id=name)))):
            return name in ("log", "logger", "warnings")
        case ast.keyword(arg="strict"):  # of `zip`
            return True
        case ast.If(test=test):
            return "TYPE_CHECKING" in ast.unparse(test) or "__name__" in ast.unparse(test)
    return False


def is_quantity(node: ast.Constant, parent: ast.AST) -> bool:
    """Return whether a number is a value, not an index, sign or key. A 1 is often a step or avoids a division by 0."""
    if node.value == 1:
        return isinstance(parent, ast.Assign | ast.AnnAssign | ast.keyword)
    if isinstance(parent, ast.Dict):
        return node not in parent.keys
    return not isinstance(parent, ast.Subscript | ast.Slice | ast.UnaryOp | ast.pattern | ast.Return)


def lost(node: ast.Expr | ast.AugAssign) -> str:
    """Return the kind of change if a statement is removed; empty if the statement stays."""
    value = node.value.value if isinstance(node.value, ast.Await) else node.value
    if isinstance(value, ast.Yield):
        return "lost event" if value.value else ""
    if isinstance(value, ast.Call):
        name = value.func.attr if isinstance(value.func, ast.Attribute) else ast.unparse(value.func)
        return "" if name == "__init__" else "removed close" if CLOSING.fullmatch(name) else "lost event"
    return "lost event" if isinstance(node, ast.AugAssign) or isinstance(value, ast.YieldFrom) else ""


def other_result(value: ast.expr, text: str) -> str:
    """Return another value for a `return`; empty if the value is a text or already nothing."""
    match value:
        case ast.Constant(value=bool() | None | str() | bytes()) | ast.JoinedStr():
            return ""
        case ast.Compare() | ast.BoolOp() | ast.UnaryOp(op=ast.Not()):
            return f"not ({text})"
        case ast.Constant() | ast.BinOp(op=ast.Sub() | ast.Mult() | ast.Div() | ast.FloorDiv()):
            return f"({text}) + 1"
        case ast.List() | ast.ListComp():
            return "[]" if text != "[]" else ""
        case ast.Dict() | ast.DictComp():
            return "{}" if text != "{}" else ""
    return "None"


def choose(seed: int, number: int, only: str) -> list[Mutant]:
    """Choose mutants: for each package in proportion to its lines, at most one for each unit."""
    ranked: dict[str, list[tuple[float, str, list[Mutant]]]] = defaultdict(list)
    lines: Counter[str] = Counter()
    for file in sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "imud").rglob("*.py")):
        if file.startswith(only.rstrip("/")):
            finder = Finder(file)
            lines[package_of(file)] += len(finder.starts)
            for unit, mutants in finder.mutants.items():
                luck = Random(f"{seed} {file} {unit}").random() ** (1 / finder.weights[unit])
                ranked[package_of(file)].append((luck, unit, mutants))
    chosen = []
    for package, quota in quotas(lines, number).items():
        for _, unit, mutants in sorted(ranked[package], key=lambda entry: entry[:2], reverse=True)[:quota]:
            random = Random(f"{seed} {mutants[0].path} {unit} change")
            kinds = sorted({mutant.kind for mutant in mutants})
            kind = random.choices(kinds, [WEIGHTS.get(kind, 2) for kind in kinds])[0]
            chosen.append(random.choice([mutant for mutant in mutants if mutant.kind == kind]))
    return sorted(chosen, key=lambda mutant: (mutant.path, mutant.line))


def package_of(path: str) -> str:
    """Return the package of a module: the folder in `imud/`, or `imud` for modules at the top."""
    parts = path.split("/")
    return "/".join(parts[:2]) if len(parts) > 2 else "imud"


def quotas(lines: Counter[str], number: int) -> dict[str, int]:
    """Distribute a number over packages in proportion to their lines (largest remainders)."""
    shares = {package: number * own / lines.total() for package, own in lines.items()}
    result = {package: int(share) for package, share in shares.items()}
    by_rest = sorted(shares, key=lambda package: (result[package] - shares[package], package))
    return {package: result[package] + (package in by_rest[: number - sum(result.values())]) for package in shares}
