"""Every example in README.md and docs/ is run or read by what it is meant for; every link leads somewhere."""

import os
import re
import select
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest

from imud import config
from imud.cli import COMMANDS, build_parser
from imud.devices import DRIVERS
from tests.support import pictures, references
from tests.support.daemon_process import LIMIT_S, running_daemon
from tests.test_daemon import cable, device

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")


class Example(NamedTuple):
    """A fenced block of a page."""

    page: Path
    language: str
    text: str


def examples(*languages: str) -> list[Example]:
    found = [Example(page, *match.groups()) for page in PAGES for match in FENCE.finditer(page.read_text())]
    return [example for example in found if example.language in languages]


def name(example: Example) -> str:
    return f"{example.page.name}:{example.text.splitlines()[0][:40]}"


def imud_lines() -> Iterator[list[str]]:
    """Every `imud …` command line of the shell examples, without comments and without where its output goes."""
    for example in examples("sh"):
        for line in example.text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["imud"]:
                yield words[1 : words.index(">")] if ">" in words else words[1:]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("words", list(imud_lines()), ids=" ".join)
def test_command_lines_are_accepted(words: list[str]) -> None:
    build_parser().parse_args(words)


@pytest.mark.parametrize("example", [e for e in examples("yaml") if not e.text.startswith("# ")], ids=name)
def test_configurations_are_good(example: Example) -> None:
    config.parse(example.text, example.page.name)


@pytest.mark.parametrize("example", [e for e in examples("python") if e.page.name == "README.md"], ids=name)
def test_python_reads_from_a_running_daemon(example: Example, tmp_path: Path) -> None:
    places = {"IMUD_SOCKET": str(tmp_path / "imud.sock"), "IMUD_SHM": str(tmp_path)}
    with cable(tmp_path) as port, running_daemon(tmp_path, {"bow": device(port.name)}) as daemon:
        daemon.wait_for("bow", "searching")
        port.send(1)
        daemon.wait_for("bow", "running")
        argv = [sys.executable, "-u", "-c", example.text]
        with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True, env=os.environ | places) as process:
            assert process.stdout is not None
            feeding = True
            while feeding:  # until the example prints its first line
                port.send(1)
                feeding = not select.select([process.stdout], [], [], 0.02)[0]
            line = process.stdout.readline()
            process.kill()
    assert "9.8" in line, line


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine")
def test_c_reads_from_a_running_daemon(tmp_path: Path) -> None:
    (example,) = examples("c")
    source = tmp_path / "reader.c"
    source.write_text(example.text.replace('"bow")', f'"{tmp_path}/imud.bow")'))
    (tmp_path / "imud").symlink_to(ROOT / "imud")
    lines = [line for block in examples("sh") for line in block.text.splitlines()]
    (compile_line,) = [line for line in lines if line.startswith("cc ")]
    argv = [*shlex.split(compile_line), "-Werror"]
    subprocess.run(argv, check=True, timeout=LIMIT_S, cwd=tmp_path)
    assert "./reader" in lines
    with cable(tmp_path) as port, running_daemon(tmp_path, {"bow": device(port.name)}) as daemon:
        daemon.wait_for("bow", "searching")
        port.send(1)
        daemon.wait_for("bow", "running")
        done = subprocess.run([tmp_path / "reader"], capture_output=True, text=True, timeout=LIMIT_S, check=True)
    assert re.fullmatch(r"\d+ ns: 9\.800000 m/s2\n", done.stdout)


@pytest.mark.parametrize("file", sorted(pictures.FOLDER.glob("*.svg")), ids=lambda file: file.name)
def test_pictures_are_well_formed_and_shown(file: Path) -> None:
    root = ElementTree.parse(file).getroot()
    assert root.tag.endswith("svg")
    assert root[0].text
    assert any(f"pictures/{file.name})" in page.read_text() for page in PAGES)


def test_the_picture_of_time_stamps_shows_what_the_readme_says() -> None:
    samples = pictures.stamps()
    assert 7 < min(s.arrival_ms for s in samples) < max(s.arrival_ms for s in samples) < 24
    assert sum(abs(s.off_ms) <= 2 * s.error_ms for s in samples) >= 0.95 * len(samples)
    assert samples[-1].error_ms < samples[100].error_ms / 2
    assert pictures.time_stamps(samples).count("<path") > 10


def test_tables_of_the_readme_name_every_command_and_driver() -> None:
    text = (ROOT / "README.md").read_text()
    for command in COMMANDS:
        assert f"`imud {command}" in text or f"`{command}`" in text, command
    for driver in DRIVERS:
        assert f"`{driver}`" in text, driver


def test_make_targets_of_the_readme_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"^make (\w+)", (ROOT / "README.md").read_text(), re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


@pytest.mark.parametrize("page", references.PAGES)
def test_generated_parts_are_those_of_the_code(page: str) -> None:
    assert references.generated(page) == references.current(page), "run python -m tests.support.references"


def test_layout_tables_have_their_fields() -> None:
    assert "| 0 | `uint64_t` | `seq` |" in references.current("docs/shm.md")


def test_tables_of_actions_are_those_of_the_drivers() -> None:
    text = references.current("docs/commands.md")
    assert text.count("\n### `") == len(DRIVERS)
    for driver in DRIVERS.values():
        for action in driver.actions:
            assert f"\n| `{action}` | " in text, action
