"""YAML as plain data with the position of each value, without the implicit conversions of YAML.

imud builds a tree from parser events with an explicit stack. `yaml.compose` recurses in C and ends the process
with a segmentation fault at 200 000 open brackets (measured, PyYAML 6.0.3 with libyaml). The rules of YAML for plain
words turn `1:20` into 80, `010` into 8 and `no` into false, and the last of two equal keys wins. imud refuses
such words with line and column, unless they are quoted.

No library meets these needs. 500 devices (124 kB) take 63 ms here, 809 ms in ruamel.yaml 0.19.1 and 10.7 s in
strictyaml 1.7.3. Both libraries end with RecursionError at 1000 brackets, stop at the first problem, and accept `010`,
`no` and `1:20`.
"""

import codecs
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from re import compile as pattern
from typing import Final, Protocol, cast

import msgspec
import yaml

from imud.model.options import shown

FILE_BYTES_MAX: Final = 1 << 20  # Maximum size of a file, bytes. 256 devices with all keys need 0.1 MB.
DEPTH_MAX: Final = 32  # Maximum depth of the tree. A configuration needs five levels.
# Maximum number of problems. The comparison of their places takes time in proportion to the square of their number.
PROBLEMS_MAX: Final = 1000
EVENTS_PER_TURN: Final = 64  # number of parser events between two calls of `pause`: a third of a millisecond

Path = tuple[str | int, ...]  # keys and indices from the top of the file to a value


@dataclass(frozen=True, slots=True, order=True)
class SourcePosition:
    """Position in a file. Lines and columns (characters) count from 1."""

    line: int
    column: int


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """Problem of a file with its position."""

    mark: SourcePosition
    path: Path
    message: str


@dataclass(slots=True)
class YamlTree:
    """The document of a file: mappings with text keys, lists, text, numbers, true, false, null."""

    data: object = None  # root of the tree; None if a problem prevents reading
    # False if the reader stopped at the last problem. Then `data` contains only the values before it.
    complete: bool = True
    problems: list[Problem] = field(default_factory=list)
    values: dict[Path, SourcePosition] = field(default_factory=dict)  # position of the value at each path
    keys: dict[Path, SourcePosition] = field(default_factory=dict)  # position of the key of the value at each path

    def mark(self, path: Path) -> SourcePosition:
        """Return the position of the value at `path`, or of its nearest parent that exists."""
        while path and path not in self.values:
            path = path[:-1]
        return self.values.get(path, SourcePosition(1, 1))

    def key_mark(self, path: Path) -> SourcePosition:
        """Return the position of the key of the value at `path`. In a list, return the position of the value."""
        return self.keys.get(path) or self.mark(path)


def no_pause() -> None:
    """Return immediately: no other thread waits."""


def read_yaml(content: bytes, pause: Callable[[], None] = no_pause) -> YamlTree:
    """Read one YAML document. Never raises: `problems` contains all problems of the readable part.

    imud calls `pause` after each EVENTS_PER_TURN events.
    """
    tree = YamlTree()
    try:
        text = _text(content)
        _Builder(tree).build(_events(text), pause)
    except _Refused as refused:
        tree.complete = False
        tree.problems.append(refused.problem)
    return tree


def path_text(path: Path) -> str:
    """Format a path for messages: `devices.front.uart.baud`, `devices.front.ids[2]`."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{_name(part)}" for part in path)
    return text.removeprefix(".")


def _name(key: str) -> str:
    """Format a key, in quotes and with escapes if it is not one word."""
    return key if re.fullmatch(r"[\w()-]+", key) else shown(key)


class _Refused(Exception):
    """A problem that stops the reader."""

    def __init__(self, mark: SourcePosition, message: str, path: Path = ()) -> None:
        super().__init__(message)
        self.problem = Problem(mark, path, message)


class _Event(Protocol):
    """Fields of PyYAML's events that imud uses. The stubs of PyYAML do not type them."""

    start_mark: yaml.Mark
    anchor: str | None
    tag: str | None
    value: str
    style: str | None


def _text(content: bytes) -> str:
    if len(content) > FILE_BYTES_MAX:
        raise _Refused(
            SourcePosition(1, 1), f"expected at most {FILE_BYTES_MAX} bytes, got more: is this the right file?"
        )
    content = content.removeprefix(codecs.BOM_UTF8)
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        mark = _mark_at(content[: error.start].decode(), error.start)
        raise _Refused(mark, f"expected UTF-8 text, got byte 0x{content[error.start]:02x}") from None
    odd = yaml.reader.Reader.NON_PRINTABLE.search(text)
    if odd:
        raise _Refused(_mark_at(text, odd.start()), f"expected printable text, got character U+{ord(odd[0]):04X}")
    return text


def _mark_at(text: str, index: int) -> SourcePosition:
    before = text[:index]
    return SourcePosition(before.count("\n") + 1, len(before) - (before.rfind("\n") + 1) + 1)


def _events(text: str) -> Iterator[_Event]:
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        yield from cast(Iterator[_Event], yaml.parse(text, Loader=loader))
    except yaml.MarkedYAMLError as error:
        raise _syntax_problem(error, text) from None


def _syntax_problem(error: yaml.MarkedYAMLError, text: str) -> _Refused:
    at = error.problem_mark or error.context_mark
    mark = SourcePosition(at.line + 1, at.column + 1) if at else SourcePosition(1, 1)
    lines = text.splitlines() or [""]
    for number in range(mark.line, min(mark.line + 2, len(lines) + 1)):
        tab = re.match(r" *\t", lines[number - 1])  # libyaml reports the previous line if it detects the tab late
        if tab:
            return _Refused(
                SourcePosition(number, tab.end()), "expected spaces at the beginning of the line, got a tab"
            )
    context = f", but {error.context}" if error.context else ""
    return _Refused(mark, f"expected YAML{context}: {error.problem}")


@dataclass(slots=True)
class _Open:
    """An open mapping or list."""

    path: Path
    into: dict[str, object] | list[object]
    key: str | None = None  # key of the next value in a mapping
    again: bool = False  # True if the mapping already contains the key. The reader then only checks the value.


class _Builder:
    """Builder of the tree from events. The explicit stack cannot overflow the stack of the process."""

    def __init__(self, tree: YamlTree) -> None:
        self._tree = tree
        self._stack: list[_Open] = []
        self._documents = 0

    def build(self, events: Iterator[_Event], pause: Callable[[], None]) -> None:
        for number, event in enumerate(events, start=1):
            if number % EVENTS_PER_TURN == 0:
                pause()
            mark = SourcePosition(event.start_mark.line + 1, event.start_mark.column + 1)
            if isinstance(event, yaml.DocumentStartEvent):
                self._documents += 1
                if self._documents > 1:
                    raise _Refused(mark, "expected one document, got a second one after ---")
            elif isinstance(event, yaml.ScalarEvent):
                self._scalar(event, mark)
            elif isinstance(event, yaml.AliasEvent):
                alias = f"the alias *{event.anchor}"
                raise _Refused(mark, f"expected a value, got {alias}: write the value out", self._at())
            elif isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
                self._begin(event, mark)
            elif isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
                self._stack.pop()
        if not self._documents:
            raise _Refused(SourcePosition(1, 1), "expected keys and values, got an empty file")

    def _at(self) -> Path:
        """Return the path of the value of the next event."""
        if not self._stack:
            return ()
        top = self._stack[-1]
        if isinstance(top.into, list):
            return (*top.path, len(top.into))
        if top.key is None:
            return top.path
        return (*top.path, top.key, "(again)") if top.again else (*top.path, top.key)

    def _begin(self, event: _Event, mark: SourcePosition) -> None:
        top = self._stack[-1] if self._stack else None
        if top and isinstance(top.into, dict) and top.key is None:
            raise _Refused(mark, "expected a key of plain text, got a mapping or list", top.path)
        if len(self._stack) >= DEPTH_MAX:
            raise _Refused(mark, f"expected at most {DEPTH_MAX} levels of nesting, got more", self._at()[:3])
        path = self._at()
        self._refuse_tag(event, mark, path)
        into: dict[str, object] | list[object] = {} if isinstance(event, yaml.MappingStartEvent) else []
        self._value(into, mark)
        self._stack.append(_Open(path, into))

    def _scalar(self, event: _Event, mark: SourcePosition) -> None:
        path = self._at()
        self._refuse_tag(event, mark, path)
        quoted = bool(event.style)  # None or an empty text for plain words, depending on the parser
        top = self._stack[-1] if self._stack else None
        try:
            value = event.value if quoted else plain(event.value)
        except ValueError as error:
            self._problem(mark, path, str(error))
            value = event.value if top and isinstance(top.into, dict) and top.key is None else None
        if top and isinstance(top.into, dict) and top.key is None:
            self._key(top, value, event.value, mark)
        else:
            self._value(value, mark)

    def _key(self, top: _Open, key: object, as_written: str, mark: SourcePosition) -> None:
        if not isinstance(key, str):
            self._problem(mark, top.path, f"expected a key of text, got {as_written}: put it in quotes")
            key = as_written
        if key == "<<":
            self._problem(mark, top.path, "expected a key, got the merge key <<: write the keys out")
        path = (*top.path, key)
        top.again = path in self._tree.keys
        if top.again:
            first = self._tree.keys[path]
            self._problem(
                mark, path, f"expected each key once, got {_name(key)} again: it stands in line {first.line} too"
            )
        else:
            self._tree.keys[path] = mark
        top.key = key

    def _value(self, value: object, mark: SourcePosition) -> None:
        self._tree.values.setdefault(self._at(), mark)
        if not self._stack:
            self._tree.data = value
            return
        top = self._stack[-1]
        if isinstance(top.into, list):
            top.into.append(value)
        elif top.key is not None:
            if not top.again:
                top.into[top.key] = value
            top.key = None

    def _refuse_tag(self, event: _Event, mark: SourcePosition, path: Path) -> None:
        if event.tag is not None:
            self._problem(mark, path, f"expected a plain value, got the tag {event.tag}: leave it out")

    def _problem(self, mark: SourcePosition, path: Path, message: str) -> None:
        if len(self._tree.problems) >= PROBLEMS_MAX:
            raise _Refused(mark, f"expected at most {PROBLEMS_MAX} problems, got more: the rest is not read", path)
        self._tree.problems.append(Problem(mark, path, message))


_NULL = re.compile(r"~|null|Null|NULL|")
_BOOL = re.compile(r"true|True|TRUE|false|False|FALSE")
_INT = re.compile(r"[-+]?(0|[1-9][0-9]*)|0x[0-9a-fA-F]+|0o[0-7]+")
_FLOAT = re.compile(r"[-+]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?")
# Maximum length of a number. All 64-bit numbers are shorter in any notation. Python refuses more than 4300 digits.
_NUMBER_CHARACTERS_MAX = 40
_TRAPS = (
    (re.compile(r"yes|no|on|off", re.IGNORECASE), "expected true or false, or text in quotes, got {0}"),
    (
        re.compile(r"[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?"),
        "expected a number or text in quotes, got {0}, which some readers of YAML take for a number to the base 60",
    ),
    (re.compile(r"[-+]?\.inf|\.nan|[-+]?infinity|nan|[-+]?inf", re.IGNORECASE), "expected a finite number, got {0}"),
    (
        re.compile(r"[-+]?0[0-9]+"),
        "expected a number without leading zeros, got {0}: write 0o… for octal, or put text in quotes",
    ),
    (re.compile(r"[-+]?[0-9][0-9_]*_[0-9_]*(\.[0-9_]*)?"), "expected a number without underscores, got {0}"),
)


def plain(word: str) -> object:
    """Return the value of an unquoted word: null, truth value, number, text. Raises ValueError if ambiguous."""
    for trap, message in _TRAPS:
        if trap.fullmatch(word):
            raise ValueError(message.format(word[:_NUMBER_CHARACTERS_MAX]))
    if _NULL.fullmatch(word):
        return None
    if _BOOL.fullmatch(word):
        return word.lower() == "true"
    if not _INT.fullmatch(word) and not _FLOAT.fullmatch(word):
        return word
    if len(word) > _NUMBER_CHARACTERS_MAX:
        raise ValueError(f"expected a number of at most {_NUMBER_CHARACTERS_MAX} characters, got {len(word)}")
    if _INT.fullmatch(word):
        return int(word, 0)
    number = float(word)
    if not math.isfinite(number):
        raise ValueError(f"expected a finite number, got {word}, which is too large")
    return number


PLAIN_KEY: Final = pattern(r"[A-Za-z_][A-Za-z0-9_]*")
# Words that some readers of YAML do not read as text.
WORDS: Final = frozenset({"yes", "no", "on", "off", "true", "false", "null", "nan", "inf", "infinity", "y", "n"})


def yaml_block(values: Mapping[str, object], indent: int = 0) -> str:
    """Format keys and values: each mapping of the first level as a block, all deeper values in flow style."""
    lines = []
    for name, value in values.items():
        head = f"{' ' * indent}{_key(name)}:"
        if isinstance(value, Mapping) and value and not indent:
            lines += [head, yaml_block(value, indent + 2)]
        else:
            lines.append(f"{head} {yaml_flow(value)}")
    return "\n".join(lines)


def yaml_flow(value: object) -> str:
    """Format a value in one line of flow style."""
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
    """Format a scalar as JSON, which is valid YAML. Escape characters that some readers refuse."""
    text = msgspec.json.encode(value).decode()
    return "".join(one if one.isprintable() else _escaped(one) for one in text)


def _escaped(one: str) -> str:
    code = ord(one)
    return f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
