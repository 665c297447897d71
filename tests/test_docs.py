"""Test the documents: commands, configurations, programs, links, generated tables."""

import configparser
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import pytest

from docs.generate import pictures, python_reference, references
from imud import config
from imud.cli import COMMANDS, build_parser, main
from imud.drivers import DRIVERS
from imud.model.sample import Sample
from tests.support.daemon_process import LIMIT_S, daemon_with_module, sending_daemon
from tests.support.files import ROOT, hi91

FIRST_PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")]
PAGES = [*FIRST_PAGES, *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)#]+)(?:#[^)]*)?\)")
ANCHOR_LINK = re.compile(r"\]\(([^)#:]*)#([^)]+)\)")


SEPARATORS = ("|", "&&", "||", ";", "&")

HOST = "changes or reads the host with root, systemd or hardware; the lab of Debian tests such steps"
NETWORK = "needs a package index, a broker, a database or another host"
NOT_RUN = {
    **dict.fromkeys(("apt", "apt-get", "dpkg-query", "usermod", "systemctl", "systemd-sysusers", "udevadm"), HOST),
    **dict.fromkeys(("journalctl", "systemd-analyze", "sudoedit", "nano", "modprobe", "ip", "stty", "candump"), HOST),
    **dict.fromkeys(("gpspipe", "timeout", "systemd-tmpfiles", "groupadd"), HOST),
    **dict.fromkeys(("podman", "podman-compose"), "packaging/image/try"),
    **dict.fromkeys(("gpg", "packaging/release"), "tests/packaging, with a key and commands of the tests"),
    **dict.fromkeys(("pipx", "curl", "rsync", "ssh", "nc", "socat", "mosquitto_passwd", "ros2"), NETWORK),
    **dict.fromkeys((".", "export", "echo", "printf", "base64", "openssl", "grep"), "a tool of the shell"),
    **dict.fromkeys(("cp", "rm", "ln", "install", "mkdir"), "a tool of the shell; `bash -n` checks its syntax"),
    **dict.fromkeys(("tar", "tee", "stat"), "a tool of the shell; `bash -n` checks its syntax"),
    "python": "tests/stability/test_stability.py",
    "cc": "test_examples_read_from_a_running_daemon",
    "./reader": "test_examples_read_from_a_running_daemon",
    "sh": "tests/packaging/test_apt.py",
    "promtool": "tests/monitoring/test_rules.py", "amtool": "tests/monitoring/test_rules.py",
}  # fmt: skip
"""Programs of shell examples that no test of this module starts or parses, with the reason or the test."""

CHECKED_HERE = (
    "sh",
    "yaml",
    "console",
    "ini",
    "c",
    "text",
    "python README.md",
    "python reader.md",
    "python python.md",
    "python simulators.md",
)
"""Languages, or languages and pages, that this module or `test_example_package.py` (drivers.md) checks.

`text` is output, or a file of another program.
"""

TESTED_ELSEWHERE = {
    "yaml prometheus.yml": "tests/monitoring/test_rules.py",
    "yaml imud-targets.yml": "tests/monitoring/test_rules.py",
    "yaml my.rules.yml": "tests/monitoring/test_rules.py",
    "yaml collector.yaml": "tests/fleet/database/test_upkeep.py",
    "yaml sheet.yaml": "tests/cli/test_noise.py",
    "python captures.md": "tests/formats/test_capture.py",
    "sql fleet-database.md": "tests/fleet/database/test_views_page.py",
    "python fleet-database.md": "tests/fleet/database/test_views_page.py",
    "python fleet.md": "tests/fleet/test_reader.py",
    "python recording.md": "tests/cli/test_record.py",
    "python socket.md": "tests/publishers/socket/test_documentation.py",
    "json socket.md": "tests/publishers/socket/test_documentation.py",
    "json fleet.md": "tests/fleet/test_commands.py",
    "acl fleet.md": "tests/fleet/test_commands.py",
    "python drivers.md": "tests/test_example_package.py",
    "yaml release": "tests/packaging/test_release.py",
    "toml drivers.md": "tests/test_example_package.py",
}
"""Examples by language and page, or by language and file name, with the module that tests them."""

TASK_PAGES = (
    "first-sensor.md", "reader.md", "lost-samples.md", "time-stamp-error.md", "replace.md", "mounting.md", "week.md",
    "tilt.md", "gnss.md", "problem.md", "ros2.md",
)  # fmt: skip
"""Pages whose commands run on a daemon with a simulated device, from top to bottom."""

INSTEAD = {
    "run": "the daemon runs already",
    "probe": "the daemon uses the port",
    "fleet": "tests/cli/test_fleet.py, with a broker",
}
"""Commands of the task pages that do not run on the daemon of the test, with the reason."""


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


def shell_commands() -> Iterator[tuple[str, list[str]]]:
    """Yield page and words of each command in the shell examples, without `sudo`, variables and redirections."""
    for page, language, text in without_packages(examples("sh", "console")):
        lines = text.replace("\\\n", " ").splitlines()
        for line in (line.removeprefix("$ ") for line in lines if language == "sh" or line.startswith("$ ")):
            tokens = shlex.shlex(line, posix=True, punctuation_chars=True)
            tokens.whitespace_split = True
            for is_end, group in groupby(tokens, lambda token: token in SEPARATORS):
                words = list(group)
                while words[0] == "sudo" or re.match(r"[A-Z_]+=", words[0]):
                    del words[0]
                if not is_end:
                    yield page.name, words[: next((n for n, word in enumerate(words) if word in {">", ">>"}), None)]


def imud_lines() -> Iterator[list[str]]:
    """Yield the arguments of each `imud …` command in the shell examples."""
    return (words[1:] for _, words in shell_commands() if words[0] == "imud")


def all_pages() -> list[Path]:
    """Return all Markdown files of the repository."""
    return [
        *ROOT.glob("*.md"),
        *(page for part in ("docs", "packaging", "tests") for page in (ROOT / part).rglob("*.md")),
    ]


def test_links_and_their_anchors_lead_somewhere() -> None:
    pages = all_pages()
    assert {*PAGES, ROOT / "tests/lab/README.md"} <= {*pages}
    targets = [(page, target) for page in pages for target in LINK.findall(prose(page)) if "://" not in target]
    assert [(page.name, target) for page, target in targets if not (page.parent / target).exists()] == []
    for page in pages:
        for target, anchor in ANCHOR_LINK.findall(prose(page)):
            linked = page.parent / target if target else page
            if linked.suffix == ".md":
                assert anchor in anchors(linked), f"{page.name}: {target}#{anchor}"


def without_blocks(page: Path) -> str:
    return re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def prose(page: Path) -> str:
    """Return the text of a page without code, which can look like a link: `MOTIONS[name](9.8)`."""
    return re.sub(r"`[^`\n]*`", "", without_blocks(page))


def anchors(page: Path) -> set[str]:
    """Return the anchors of the titles of a page, as GitHub makes them."""
    text = without_blocks(page)
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


def test_each_example_is_checked_or_has_a_reason() -> None:
    unchecked = set[str]()
    for page, language, text in examples(*{match[1] for file in PAGES for match in FENCE.finditer(file.read_text())}):
        title = re.match(r"# ([\w.-]+)", text) if language == "yaml" else None
        key = f"{language} {title[1] if title else page.name}"
        if key not in CHECKED_HERE and (title or language not in CHECKED_HERE):
            unchecked |= {key} - TESTED_ELSEWHERE.keys()
    assert not unchecked, "expected a test, or a row of TESTED_ELSEWHERE"
    for key, module in TESTED_ELSEWHERE.items():
        name = key.split()[1] if key.endswith(".md") else ""
        assert name in (ROOT / module).read_text(), f"{module} does not read {name}"
    shown = {example.text for example in examples("text")}
    assert not [text for text in shown if re.search(r"^(sudo|imud \w+ (?!\w+:))", text, re.MULTILINE)], "use sh"


def test_shell_examples_have_valid_syntax_known_programs_files_and_targets(tmp_path: Path) -> None:
    (tmp_path / "all.sh").write_text("".join(example.text for example in examples("sh")))
    subprocess.run(["bash", "-n", str(tmp_path / "all.sh")], check=True, timeout=LIMIT_S)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for name, words in shell_commands():
        program = Path(words[0]).name if words[0].endswith(("pip", "python3", "imud")) else words[0]
        if program == "make":
            assert [word for word in words[1:] if "=" not in word and word not in targets] == [], name
        elif program in {"pip", "pipx"}:
            asked = {name for word in words for found in re.findall(r"\[([\w,]+)\]", word) for name in found.split(",")}
            assert asked <= extras.keys(), name
        elif program == "python3":
            code = words[words.index("-c") + 1] if "-c" in words else ""
            compile(code, name, "exec")
        else:
            assert program == "imud" or program in NOT_RUN, f"{name}: expected a test of {words}, or a row of NOT_RUN"
        folders = ("etc/", "systemd/", "imud/", "docs/", "tests/")
        assert [word for word in words if word.startswith(folders) and not (ROOT / word).exists()] == [], name


def test_units_have_sections_and_directives() -> None:
    for page, _, text in examples("ini"):
        unit = configparser.ConfigParser(delimiters="=", interpolation=None)
        unit.read_string(text)
        assert [name for name in unit.sections() if not unit[name]] == [], page.name


def runnable(words: Sequence[str], folder: Path, duration: str) -> list[str]:
    """Return a command of a task page with the port, the files and the duration of the test."""
    places = {"/etc/imud.yaml": str(folder / "imud.yaml"), "bow.yaml": str(folder / "imud.yaml")}
    short = [duration if before == "--duration" else
             "sample.imudrec" if re.fullmatch(r"\d+T\d+Z-\S+\.imudrec", word) else
             str(folder / "port") if word.startswith("/dev/") else places.get(word, word)
             for before, word in pairwise(["", *words])]  # fmt: skip
    if "--follow" in short:
        short[short.index("--follow") :] = ["--count", "1"] if short[0] == "watch" else ["--since", "1h"]
    return short + (["--yes"] if "--restore" in short else [])


@pytest.mark.live
def test_commands_of_task_pages_run_on_a_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("IMUD_SOCKET", str(tmp_path / "imud.sock"))
    with daemon_with_module(tmp_path):
        for page in TASK_PAGES:
            for duration in ("0.3", "3", "30"):  # a slow host may send no sample in a short time
                (tmp_path / f"{page}-{duration}").mkdir()
                monkeypatch.chdir(tmp_path / f"{page}-{duration}")
                failed = []
                for words in [words[1:] for name, words in shell_commands() if name == page and words[0] == "imud"]:
                    if words[0] not in INSTEAD and not succeeds(runnable(words, tmp_path, duration)):
                        failed.append((words, capsys.readouterr()))
                if not failed:
                    break
            assert not failed, page


def succeeds(argv: Sequence[str]) -> bool:
    """Run a command of imud. `doctor` may find problems of the host of the test."""
    try:
        return main(argv) in ({0, 1, 2} if argv[0] == "doctor" else {0})
    except SystemExit as end:  # --version
        return end.code == 0


@pytest.mark.live
def test_the_reader_continues_after_a_restart(tmp_path: Path) -> None:
    (code,) = (example.text for example in examples("python") if example.page.name == "reader.md")
    places = {"IMUD_SOCKET": str(tmp_path / "imud.sock")}
    argv = [sys.executable, "-u", "-c", code]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True, env=os.environ | places) as reader:
        assert reader.stdout is not None
        epochs, lines = set[str](), iter(reader.stdout)
        try:
            for _ in range(2):
                with sending_daemon(tmp_path, lambda number: hi91(10 * number)):
                    epochs.add(next(line for line in lines if line.startswith("connected, epoch")))
                    assert "9.8" in next(lines)
        finally:
            reader.kill()
    assert len(epochs) == 2


@pytest.mark.live
def test_examples_read_from_a_running_daemon(tmp_path: Path) -> None:
    texts = [e.text for e in examples("python") if e.page.name in ("README.md", "python.md")]
    commands = [[sys.executable, "-u", "-c", text] for text in texts]
    assert len(commands) == 5
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
    assert len(commands) == 5 or re.fullmatch(r"\d+ ns: 9\.800000 m/s2\n", line)


def simulator_examples() -> list[str]:
    return [example.text for example in examples("python") if example.page.name == "simulators.md"]


@pytest.mark.live
def test_example_of_a_test_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    exec(simulator_examples()[0], names)
    names["test_a_removed_cable"](tmp_path)
    assert re.search(r"^no samples for [\d.]+ s$", capsys.readouterr().out, re.MULTILINE)


def test_examples_of_simulators_print_the_values_of_the_page(capsys: pytest.CaptureFixture[str]) -> None:
    page = " ".join((ROOT / "docs/simulators.md").read_text().split())
    for text in simulator_examples()[1:]:
        exec(text, {})
    printed, truth = capsys.readouterr().out.splitlines()
    assert f"`{printed}`" in page
    assert truth.startswith("(3.55")


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
    rows = re.findall(r"^\| \[[\w-]+\]\(([\w-]+\.md)\)", (ROOT / "docs/index.md").read_text(), re.MULTILINE)
    assert {page.name for page in (ROOT / "docs").glob("*.md")} - {*rows} == {"index.md"}
    assert [name for name in {*rows} if rows.count(name) > 1] == [], "expected each page in one group"
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


PACKAGE = '''
"""A package."""
from typing import NamedTuple
__all__ = ["Level", "LIMIT", "Broken", "height"]
LIMIT = 3  # maximum level, m
class Broken(ValueError):
    """Broken level."""
class Level(NamedTuple):
    """A level."""
    low_m: float  # lower end, m
    # upper end, m
    high_m: float = 1.0
    def span(self, scale: float = 1.0) -> float:
        """Return the difference, m."""
        return scale * (self.high_m - self.low_m)
def height() -> float:
    """Return the height, m."""
    return 0.0
'''


def reference_of(source: str, folder: Path) -> str:
    name = f"made_{len(source)}"
    file = folder / f"{name}.py"
    file.write_text(source)
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(package)
    sys.modules[name] = package  # inspect finds the source of a class by its module
    try:
        return python_reference.python_reference(package)
    finally:
        del sys.modules[name]


def test_reference_of_python_has_a_description_of_each_public_name(tmp_path: Path) -> None:
    text = reference_of(PACKAGE, tmp_path)
    assert "| `low_m` | `float` | Lower end, m |\n| `high_m` | `float = 1.0` | Upper end, m |" in text
    assert "#### `Level.span`\n\n```text\nspan(scale: float = 1.0) -> float\n```\n\nReturn the difference, m." in text
    assert "### `LIMIT`\n\nMaximum level, m" in text
    assert text.endswith("| `Broken` | `ValueError` | Broken level. |")
    for words in ("# maximum level, m", "# lower end, m", '"""Return the difference, m."""', '"""Broken level."""'):
        without = PACKAGE.replace(words, "0" if words.startswith('"') else "#")
        with pytest.raises(ValueError, match="expected a docstring or a comment"):
            reference_of(without, tmp_path)
