"""Check that the lists of the Debian lab match the package and the tests of this repository."""

import ast
import re
import sys
from collections.abc import Iterator
from importlib.metadata import packages_distributions, requires
from pathlib import Path

from tests.lab.host.environment import ROOT
from tests.lab_debian.host import packages, unit_tests, user_mode
from tests.lab_debian.host.release import AMD64, PYTHONS


def imported(path: Path, seen: set[Path]) -> Iterator[str]:
    if path in seen:
        return
    seen.add(path)
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            names = [one.name for one in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{one.name}" for one in node.names)]
        else:
            continue
        for name in names:
            yield name.partition(".")[0]
            helper = ROOT / f"{name.replace('.', '/')}.py"
            if name.startswith("tests.") and helper.exists():
                yield from imported(helper, seen)


def distribution(requirement: str) -> str:
    """Return the normalised name of the distribution in a requirement."""
    found = re.match(r"[\w.-]+", requirement)
    assert found, requirement
    return found[0].lower().replace("_", "-")


def test_arm64_has_the_libraries_that_its_tests_import() -> None:
    """A missing library ends pytest after 760 s under qemu-user. WHEELS and the package contain the libraries."""
    paths = [ROOT / name for part in unit_tests.PARTS.values() for name in part]
    assert all(path.exists() for path in paths)
    files = [one for path in paths for one in (sorted(path.rglob("*.py")) if path.is_dir() else [path])]
    seen: set[Path] = set()
    names = {name for file in [ROOT / "tests/conftest.py", *files] for name in imported(file, seen)}
    assert {"pytest", "imud"} <= names
    owners = packages_distributions()
    foreign = names - set(sys.stdlib_module_names) - {"imud", "tests"}
    wanted = {name: {distribution(one) for one in owners.get(name, [name])} for name in foreign}
    given = {distribution(one) for one in (*user_mode.WHEELS, *(requires("imud") or ())) if "extra ==" not in one}
    assert {name: who for name, who in wanted.items() if not who & given} == {}


def test_the_lab_boots_the_releases_that_packages_are_built_for() -> None:
    script = packages.BUILD.read_text(encoding="utf-8")
    for suite, version in PYTHONS.items():
        assert f"{suite}) version={version}" in script
    assert {release.suite for release in AMD64} == PYTHONS.keys()
