"""Test the documents: commands, configurations, programs, links, generated tables."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import pytest

from docs.generate import pictures, references
from imud import config
from imud.cli import COMMANDS, build_parser
from imud.drivers import DRIVERS
from imud.model.sample import Sample
from tests.support.daemon_process import LIMIT_S, sending_daemon
from tests.support.files import ROOT, hi91

FIRST_PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")]
PAGES = [*FIRST_PAGES, *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^ *```(\w+)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
ANCHOR_LINK = re.compile(r"\]\(([^)#:]*)#([^)]+)\)")


class Example(NamedTuple):
    """A fenced block of a page."""

    page: Path
    language: str
    text: str


def examples(*languages: str) -> list[Example]:
    found = [(page, match[1], match[2]) for page in PAGES for match in FENCE.finditer(page.read_text())]
    return [Example(page, name, textwrap.dedent(text)) for page, name, text in found if name in languages]


def without_packages(found: list[Example]) -> list[Example]:
    """Return the examples that need no other package. `test_example_package.py` tests the other examples."""
    return [example for example in found if example.page.name != "drivers.md"]


def imud_lines() -> Iterator[list[str]]:
    """Yield the words of each `imud …` command line in the shell examples, without comments and redirection."""
    for example in without_packages(examples("sh")):
        for line in example.text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["imud"]:
                yield words[1 : words.index(">")] if ">" in words else words[1:]


def test_links_and_their_anchors_lead_somewhere() -> None:
    targets = [(page, target) for page in PAGES for target in LINK.findall(page.read_text()) if "://" not in target]
    assert [(page.name, target) for page, target in targets if not (page.parent / target).exists()] == []
    for page in PAGES:
        for target, anchor in ANCHOR_LINK.findall(page.read_text()):
            linked = page.parent / target if target else page
            if linked.suffix == ".md":
                assert anchor in anchors(linked), f"{page.name}: {target}#{anchor}"


def anchors(page: Path) -> set[str]:
    """Return the anchors of the titles of a page, as GitHub makes them."""
    text = re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    named = re.findall(r'<a (?:id|name)="([^"]+)"', text)
    return {
        re.sub(r"[^\w\- ]", "", re.sub(r"\]\([^)]*\)", "", title).lower()).replace(" ", "-") for title in titles
    } | {*named}


def test_command_lines_are_accepted(capsys: pytest.CaptureFixture[str]) -> None:
    parser, refused = build_parser(), []
    for words in imud_lines():
        try:
            parser.parse_args(words)
        except SystemExit as error:
            if error.code != 0:  # 0: --help
                refused.append((words, capsys.readouterr().err))
    assert not refused


def test_configurations_are_good() -> None:
    for example in without_packages(examples("yaml")):
        if not example.text.startswith("# "):
            config.parse(example.text, f"{example.page.name}:{example.text.splitlines()[0]}")


@pytest.mark.live
def test_examples_read_from_a_running_daemon(tmp_path: Path) -> None:
    texts = [e.text for e in examples("python") if e.page.name == "README.md"]
    commands = [[sys.executable, "-u", "-c", text] for text in texts]
    assert len(commands) == 2
    if shutil.which("cc") is not None:
        commands.append([compiled_reader(tmp_path)])
    places = {"IMUD_SOCKET": str(tmp_path / "imud.sock"), "IMUD_SHM": str(tmp_path)}
    with sending_daemon(tmp_path, lambda number: hi91(10 * number)):
        for command in commands:
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | places) as process:
                assert process.stdout is not None
                line = process.stdout.readline()
                process.kill()
            assert "9.8" in line, line
    assert len(commands) == 2 or re.fullmatch(r"\d+ ns: 9\.800000 m/s2\n", line)


def compiled_reader(folder: Path) -> str:
    """Compile the C example with the command of the page. Return the path of the program."""
    (example,) = examples("c")
    (folder / "reader.c").write_text(example.text.replace('"bow")', f'"{folder}/imud.bow")'))
    (folder / "imud").symlink_to(ROOT / "imud")
    lines = [line for block in examples("sh") for line in block.text.splitlines()]
    (compile_line,) = [line for line in lines if line.startswith("cc ")]
    subprocess.run([*shlex.split(compile_line), "-Werror"], check=True, timeout=LIMIT_S, cwd=folder)
    assert "./reader" in lines
    return str(folder / "reader")


def test_pictures_are_well_formed_and_shown() -> None:
    pages = "".join(page.read_text() for page in PAGES)
    for file in pictures.FOLDER.glob("*.svg"):
        root = ElementTree.parse(file).getroot()
        assert root.tag.endswith("svg"), file
        assert root[0].text, file
        assert f"pictures/{file.name})" in pages, file


def test_the_picture_of_time_stamps_shows_what_the_readme_says() -> None:
    samples = pictures.stamps()
    assert 7 < min(s.arrival_ms for s in samples) < max(s.arrival_ms for s in samples) < 24
    assert sum(abs(s.off_ms) <= 2 * s.error_ms for s in samples) >= 0.95 * len(samples)
    assert samples[-1].error_ms < samples[100].error_ms / 2
    assert pictures.time_stamps(samples).count("<path") > 10


def test_pages_name_every_command_driver_field_and_page() -> None:
    readme = (ROOT / "README.md").read_text()
    for text in (readme, (ROOT / "docs/cli.md").read_text()):
        assert [command for command in COMMANDS if f"`imud {command}" not in text] == []
    assert [driver for driver in DRIVERS if f"`{driver}`" not in readme] == []
    fields = (ROOT / "docs/sample.md").read_text()
    assert [field for field in Sample.__struct_fields__ if f"`{field}`" not in fields] == []
    linked = set(LINK.findall((ROOT / "docs/index.md").read_text()))
    assert {page.name for page in (ROOT / "docs").glob("*.md")} - linked == {"index.md"}
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"^make (\w+)", readme, re.MULTILINE):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_generated_parts_are_those_of_the_code_with_its_actions_and_layouts() -> None:
    for page in references.PAGES:
        assert references.generated(page) == references.current(page), "run python -m docs.generate.references"
    text = references.current("docs/commands.md")
    for driver in DRIVERS.values():
        assert f"\n### `{driver.name}`: " in text if driver.verbs else f"`{driver.name}`" in text
        for action in driver.verbs:
            assert f"\n| `{action}` | " in text, action
    assert "| 0 | `uint64_t` | `seq` |" in references.current("docs/shm.md")
