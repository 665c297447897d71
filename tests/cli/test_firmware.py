"""`imud firmware`: files of the vendor, and an update through a running daemon with a simulated device."""

import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from intelhex import IntelHex

from imud.cli.firmware import _show, read_image
from imud.contracts.firmware import IMAGE_BYTES_MAX
from imud.model.errors import BadArgument
from imud.model.event import Event, EventKind
from imud.sim.hipnuc.boot_loader import APPLICATION, make_image
from tests.cli.conftest import Cli, Terminal
from tests.support.daemon_process import RunningDaemon, daemon_with_module

live = pytest.mark.live


def hex_file(path: Path, *parts: tuple[int, bytes]) -> Path:
    made = IntelHex()
    for address, data in parts:
        made.puts(address, data.decode("latin-1"))
    made.write_hex_file(str(path))
    return path


# --- files ------------------------------------------------------------------------------------------------------------


def test_gaps_contain_the_value_of_erased_flash(tmp_path: Path) -> None:
    """Written by hand: `:LLAAAATT…CC`, the sum of all bytes of a record is 0 modulo 256."""
    path = tmp_path / "new.hex"
    path.write_bytes(b":020000040801F1\r\n:0200000041427B\r\n:010004004FAC\r\n:00000001FF\r\n")
    image = read_image(path)
    assert (image.address, image.data) == (0x0801_0000, b"AB\xff\xffO")


def _damaged(text: str) -> str:
    return text.replace(":10000000", ":10000100", 1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.rsplit(":", 1)[0], "got a truncated or joined file"),
        (lambda text: text[: len(text) // 2], "got a truncated or joined file"),
        (lambda text: text + text, "got a truncated or joined file"),
        (lambda text: text.replace(":00000001FF", ":00000001FE"), "invalid checksum"),
        (_damaged, "invalid checksum"),
        (lambda text: text.replace("53494D", "53494", 1), "contains invalid record"),
        (lambda text: text.replace("53494D", "zzzzzz", 1), "contains invalid record"),
        (lambda text: text.split("\n", 2)[0] + "\n:00000001FF\n", "expected data, got a file without data"),
        (lambda text: "", "expected an Intel HEX file, got another file"),
        (lambda text: "\x7fELF" + text, "expected an Intel HEX file, got another file"),
        (lambda text: ":01000000AA55\n" + text, "expected addresses within 1048576 bytes, got 0x00000000 … 0x08010fff"),
        (
            lambda text: text.replace("\n", "\n" + "\n".join([":020000040801F1"] * 600_000) + "\n", 1),
            "got a longer file",
        ),
    ],
)
def test_damaged_and_foreign_files_are_refused(tmp_path: Path, change: Callable[[str], str], words: str) -> None:
    path = hex_file(tmp_path / "new.hex", (APPLICATION, make_image("HI14R3", 170)))
    path.write_text(change(path.read_text()))
    with pytest.raises(BadArgument, match=words):
        read_image(path)


def test_too_large_and_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        BadArgument, match=f"expected at most {IMAGE_BYTES_MAX} bytes of data, got {IMAGE_BYTES_MAX + 10}"
    ):
        read_image(hex_file(tmp_path / "new.hex", (0, bytes(IMAGE_BYTES_MAX + 10))))
    with pytest.raises(BadArgument, match=r"cannot read .*: No such file or directory"):
        read_image(tmp_path / "missing.hex")
    os.mkfifo(tmp_path / "fifo.hex")
    with pytest.raises(BadArgument, match="is a FIFO, expected a regular file"):
        read_image(tmp_path / "fifo.hex")


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    with daemon_with_module(tmp_path_factory.mktemp("firmware")) as daemon:
        yield daemon


@live
def test_device_of_a_running_daemon_is_updated(
    daemon: RunningDaemon, cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new = hex_file(tmp_path / "new.hex", (APPLICATION, make_image("HI14R3", 170, 6000)))
    words = ("firmware", "--socket", daemon.socket, "bow", new)
    cli.refuses("cannot ask for confirmation without a terminal; confirm with --yes", *words)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda _question: "")
    assert cli(*words, status=1).out.endswith("\nimud changed nothing\n")
    other = hex_file(tmp_path / "other.hex", (APPLICATION, make_image("CH020", 170)))
    cli.refuses("expected an image for HI14R3, got an image that names CH020", *words[:-1], other, "--yes")
    out = cli(*words, "--yes", "--version", "1.7.0").out
    assert out.startswith(f"{new}: 6000 bytes at 0x08010000 … 0x0801176f; it names HI14R3\nbow sends no samples")
    assert "\nfirmware update: erase, 0 of 6000 bytes\n" in out
    assert "\nverified: expected version 1.7.0, got 1.7.0\n  6000 bytes in " in out
    daemon.wait_for("bow", "running")
    assert daemon.statuses()["bow"].identity["firmware"] == "1.7.0"
    *events, result = map(json.loads, cli(*words, "--yes", "--json", status=1).out.splitlines())
    assert {event["kind"] for event in events} == {"firmware"}
    assert (result["verified"], result["after"]) == (False, "1.7.0")
    assert "reports version 1.7.0 before and after" in result["evidence"]


def test_progress_is_a_bar_on_a_terminal() -> None:
    half = Event(
        0, "bow", EventKind.FIRMWARE, "firmware update: write, 3 of 6 bytes", {"phase": "write", "progress": 0.5}
    )
    terminal = Terminal()
    for event in (half, Event(0, "bow", EventKind.UP, "up")):
        _show(event, terminal, as_json=False)
    bar = "#" * 15 + "." * 15
    assert terminal.getvalue() == f"\r\x1b[2K[{bar}]  50%  firmware update: write, 3 of 6 bytes"
