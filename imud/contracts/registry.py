"""Registry: name → "module:NAME". imud imports a row at its first use, so a missing library disables one row only."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, Generic, TypeVar, cast

T = TypeVar("T")


def load(row: str) -> Any:
    """Import and return the object `module:NAME`."""
    module, _, attribute = row.partition(":")
    return getattr(import_module(module), attribute)


class Registry(Mapping[str, T], Generic[T]):
    """Mapping from a name to the object of its row. A new plug-in needs one module and one row. Raises KeyError for an
    unknown name; the message lists the known names."""

    def __init__(self, kind: str, rows: Mapping[str, str]) -> None:
        self.kind = kind
        self.rows = dict(rows)

    def __getitem__(self, name: str) -> T:
        try:
            row = self.rows[name]
        except KeyError:
            raise KeyError(f"no {self.kind} named {name!r}; expected one of: {', '.join(sorted(self.rows))}") from None
        return cast(T, load(row))

    def __iter__(self) -> Iterator[str]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)
