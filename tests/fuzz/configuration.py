"""The configuration: for any bytes, the result is a configuration or one ConfigError with a printable text."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import msgspec

from imud.config.model import differences
from imud.config.reading import PROBLEMS_SHOWN, parse
from imud.model.errors import ConfigError
from tests.fuzz.target import Target, check_printable
from tests.support.files import ROOT

FILENAME: Final = "imud.yaml"
MESSAGE_BYTES_MAX: Final = 64 * 1024
"""Maximum length of an error message, bytes: a user must be able to read it."""


_CONTROL: Final = re.compile(r"\\x[0189][0-9a-f]|\\x7f|\\[nrt]|\\u202[89]")
"""Control characters as `repr` writes them."""


def names() -> Sequence[str]:
    return ["yaml"]


def make(_name: str) -> Target:
    return Target(run, seeds, words=words, bytes_max=16384)


def run(data: bytes) -> None:
    try:
        config = parse(data, FILENAME)
    except ConfigError as error:
        _check_message(str(error))
        return
    assert not _CONTROL.search(str(msgspec.to_builtins(config, enc_hook=str)).replace("\\\\", ""))
    assert len({device.name for device in config.devices}) == len(config.devices)
    same = differences(config, parse(data, FILENAME))
    assert not any(getattr(same, name) for name in same.__dataclass_fields__)


def _check_message(message: str) -> None:
    lines = message.split("\n")
    assert 1 <= len(lines) <= PROBLEMS_SHOWN + 1
    for line in lines:
        check_printable(line)
    assert len(message.encode()) <= MESSAGE_BYTES_MAX


def seeds() -> list[bytes]:
    shipped = (ROOT / "etc/imud.yaml").read_text()
    plain = "\n".join(line for line in re.sub(r" +#.*", "", shipped).split("\n") if line.strip())
    settings = re.sub(r"^( *)#(?=[a-z_0-9]+:)", r"\1", shipped, flags=re.MULTILINE)
    examples = [block for path in sorted((ROOT / "docs").glob("*.md")) for block in _yaml_blocks(path)]
    odd = ["devices: {}\n", "", "a: &x 1\nb: *x\n", "[[[[[[[[", "devices: {a: {uart: {port: 1:20}}}\n", "? [a]\n: 1\n"]
    odd += ['devices: {a: {uart: {port: "/dev/tty\\0"}}}', 'state_dir: "/var/\\n/\\x9b"\ndevices: {}']
    return [text.encode() for text in (shipped, plain, settings, *examples, *odd)]


def words() -> list[bytes]:
    text = re.sub(r"^ *# .*", "", (ROOT / "etc/imud.yaml").read_text(), flags=re.MULTILINE)
    return sorted({word.encode() for word in re.findall(r"[a-z_0-9/.-]{2,24}:?", text)})


def _yaml_blocks(path: Path) -> list[str]:
    return re.findall(r"```yaml\n(.*?)```", path.read_text(), flags=re.DOTALL)
