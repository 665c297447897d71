"""The manual pages match `--help` and the option classes, in valid roff. Each shell accepts its completions."""

import argparse
import re
import shutil
import subprocess
from pathlib import Path

import msgspec
import pytest

from docs.generate.completions import FILES, completions, every_parser
from docs.generate.manual_pages import escaped, help_of, marked, pages, sentence
from docs.generate.settings_parts import settings_parts
from imud.cli import COMMANDS, build_parser
from imud.cli.doctor.command import STATUS
from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

REQUESTS = ("ad", "TH", "SH", "SS", "TP", "PP", "EX", "EE")

PAGES = pages()


def plain(text: str) -> str:
    words = re.sub(r"\\f[BIR]|\\&", "", text).replace("\\-", "-").replace("\\(ha", "^").replace("\\(ti", "~")
    return " ".join(words.replace("\\e", "\\").split())


def test_pages_are_valid_roff() -> None:
    assert set(PAGES) == {"imud.1", "imud.yaml.5", *(f"imud-{name}.1" for name in COMMANDS)}
    for name in PAGES:
        for line in PAGES[name].splitlines():
            assert not line.startswith("'")
            if line.startswith("."):
                assert line[1:].split()[0] in (*REQUESTS, "br"), line
    roff = [escaped(text) for text in ("--json", ".5", "'a'", "a\\b", "~^")]
    assert roff == ["\\-\\-json", "\\&.5", "\\&'a'", "a\\eb", "\\(ti\\(ha"]
    assert sentence("list attached devices") == "List attached devices."
    assert marked("see `imud check`.") == "see \\fBimud check\\fR."


@pytest.mark.parametrize("name", COMMANDS)
def test_a_page_has_every_argument_with_its_help(name: str) -> None:
    text = plain(PAGES[f"imud-{name}.1"])
    arguments = 0
    for parser in every_parser(build_parser([name])):
        if parser.prog.split()[1:2] != [name]:
            continue
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                continue
            arguments += 1
            for word in action.option_strings:
                assert word in text
            assert plain(escaped(help_of(action, parser))) in text
    assert arguments > 0


def test_synopsis_commands_and_summary() -> None:
    synopsis = plain(PAGES["imud-settings.1"].partition(".SH DESCRIPTION")[0])
    assert "[--apply | --set NAME=VALUE" in synopsis
    text = plain(PAGES["imud-modbus.1"])
    assert ".SS imud modbus scan List the device at each address." in text
    assert ".SS imud modbus assign" in text
    assert PAGES["imud-watch.1"].startswith('.TH "IMUD\\-WATCH" "1" ')
    assert ".SH NAME\nimud\\-watch \\- print samples\n" in PAGES["imud-watch.1"]
    assert "RS\\-485" in PAGES["imud-modbus.1"]


def test_exit_statuses_are_those_of_each_command() -> None:
    doctor, setup = (PAGES[f"imud-{name}.1"].partition(".SH EXIT STATUS")[2] for name in ("doctor", "setup"))
    for severity, status in STATUS.items():
        assert f"\\fB{status}\\fR\nA{'n' * (severity[0] in 'aeiou')} {severity}: " in doctor
    assert "The command ran" not in doctor + setup
    assert "not undone" in setup
    rows = re.findall(r"^\| (\d+) \|", (ROOT / "docs/operate.md").read_text(), re.MULTILINE)
    part = PAGES["imud-run.1"].partition(".SH EXIT STATUS")[2]
    assert re.findall(r"^\\fB(\d+)\\fR$", part, re.MULTILINE) == rows


def test_the_configuration_page_has_every_key_in_words_that_fit_a_line() -> None:
    text = PAGES["imud.yaml.5"]
    keys = [path + field.name for _, path, one in settings_parts() for field in msgspec.structs.fields(one)]
    assert len(keys) > 100
    for key in keys:
        assert f".TP\n\\fB{escaped(key)}\\fR\n" in text, key
    assert "Expected: a whole number from 1 to 4096; default 256." in plain(text)
    words = re.sub(r"\\f[BIR]", "", PAGES["imud.yaml.5"]).split()
    assert max(map(len, words)) <= 60, max(words, key=len)


@pytest.mark.live
@pytest.mark.skipif(shutil.which("mandoc") is None, reason="cannot find mandoc")
@pytest.mark.parametrize("name", PAGES)
def test_mandoc_finds_nothing_wrong(name: str) -> None:
    argv = ["mandoc", "-T", "lint", "-W", "warning"]
    done = subprocess.run(argv, input=PAGES[name], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert not [line for line in done.stdout.splitlines() if "missing date" not in line]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the completions of each shell."""
    pytest.importorskip("shtab", reason="cannot find shtab (extra dev)")
    path = tmp_path_factory.mktemp("completions")
    for file, text in completions().items():
        (path / file).parent.mkdir()
        (path / file).write_text(text)
    return path


@pytest.mark.live
def test_every_shell_can_read_its_file_and_knows_all_commands(folder: Path) -> None:
    for shell in FILES:
        text = (folder / FILES[shell]).read_text()
        assert [word for word in (*COMMANDS, "scan", "assign", "convention", "ned-frd") if word not in text] == []
    for shell in FILES:
        if shutil.which(shell) is None:
            pytest.skip(f"cannot find {shell}")
        subprocess.run([shell, "-n", str(folder / FILES[shell])], check=True, timeout=LIMIT_S)


def completed_by_bash(folder: Path, *words: str) -> list[str]:
    script = 'source "$1"; shift; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _shtab_imud; echo "${COMPREPLY[@]}"'
    argv = ["bash", "--norc", "-c", script, "bash", str(folder / FILES["bash"]), *words]
    return subprocess.run(argv, capture_output=True, text=True, check=True, timeout=LIMIT_S).stdout.split()


@pytest.mark.live
@pytest.mark.skipif(shutil.which("bash") is None, reason="cannot find bash")
def test_bash_completes_commands_options_values_and_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert completed_by_bash(folder, "imud", "wa") == ["watch"]
    assert completed_by_bash(folder, "imud", "watch", "--conv") == ["--convention"]
    assert completed_by_bash(folder, "imud", "watch", "--convention", "n") == ["ned-frd"]
    (folder / "boat.yaml").touch()
    monkeypatch.chdir(folder)
    assert completed_by_bash(folder, "imud", "check", "boa") == ["boat.yaml"]
