"""Imports go left only, type-only imports included; device files name no I/O module; there is no cycle."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "imud"

LAYERS: tuple[tuple[str, ...], ...] = (
    ("imud", "imud.units"),
    ("imud.sample", "imud.errors", "imud.ledger", "imud.event"),
    ("imud.attitude", "imud.permissions", "imud.worker", "imud.notify"),
    ("imud.formats",),
    ("imud.contracts",),
    ("imud.devices", "imud.clock", "imud.links", "imud.publishers", "imud.utc"),
    ("imud.sim", "imud.config", "imud.client"),
    ("imud.signals",),
    ("imud.runtime",),
    ("imud.daemon",),
    ("imud.cli", "imud.__main__"),
)
LEAVES_LAYER = next(number for number, names in enumerate(LAYERS) if "imud.devices" in names)
LEAVES = LAYERS[LEAVES_LAYER]
IO_MODULES = {
    "asyncio", "fcntl", "io", "os", "pathlib", "select", "serial", "socket", "subprocess", "termios", "threading",
    "time",
}  # fmt: skip


def modules() -> dict[str, Path]:
    """Every module of the package by name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ("imud", *path.relative_to(PACKAGE).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


def imports(path: Path) -> set[str]:
    """Full names of everything that a module imports, at any depth of its code."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            base = node.module or ""
            for alias in node.names:
                full = f"{base}.{alias.name}"
                found.add(full if full in MODULES else base)
    return found


def layer_of(module: str) -> int:
    """Number of the layer that a module belongs to, by the longest matching prefix."""
    best, number = "", -1
    for index, names in enumerate(LAYERS):
        for name in names:
            if (module == name or (module.startswith(name + ".") and name != "imud")) and len(name) > len(best):
                best, number = name, index
    assert number >= 0, f"{module} is in no layer; add its package to LAYERS"
    return number


@pytest.mark.parametrize("module", MODULES)
def test_imports_go_left(module: str) -> None:
    mine = layer_of(module)
    for target in imports(MODULES[module]):
        if target in MODULES:
            assert layer_of(target) <= mine, f"{module} imports {target}, which lies to its right"


@pytest.mark.parametrize("module", [m for m in MODULES if layer_of(m) == LEAVES_LAYER])
def test_leaves_do_not_import_each_other(module: str) -> None:
    family = next(leaf for leaf in LEAVES if module == leaf or module.startswith(leaf + "."))
    for target in imports(MODULES[module]):
        if target in MODULES and layer_of(target) == LEAVES_LAYER:
            assert target == family or target.startswith(family + "."), f"{module} imports {target}"


@pytest.mark.parametrize("module", [m for m in MODULES if m.startswith(("imud.devices.", "imud.clock."))])
def test_codecs_and_clock_do_no_io(module: str) -> None:
    used = {name.partition(".")[0] for name in imports(MODULES[module])} & IO_MODULES
    assert not used, f"{module} imports {used}"


def test_there_is_no_import_cycle() -> None:
    graph = {name: sorted(imports(path) & MODULES.keys() - {name}) for name, path in MODULES.items()}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, f"import cycle: {' → '.join([*trail[trail.index(name) :], name])}"
        if name not in done:
            for target in graph[name]:
                visit(target, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_only_one_module_imports_gpiod() -> None:
    assert {m for m in MODULES if "gpiod" in imports(MODULES[m])} <= {"imud.signals.gpio.chips"}
