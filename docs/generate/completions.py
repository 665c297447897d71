"""Creates shell completions from the parsers with shtab: `python -m docs.generate.completions FOLDER`.

FOLDER contains one file per shell, with the name that the shell expects: `bash/imud`, `zsh/_imud`, `fish/imud.fish`.
"""

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from imud.cli import build_parser

FILES: Final = {"bash": "bash/imud", "zsh": "zsh/_imud", "fish": "fish/imud.fish"}
PATHS: Final = ("FILE", "PATH", "PORT", "CAPTURE")
"""Names of arguments in the help with file names as completions. A port is a node below /dev."""


def every_parser(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for one in action.choices.values():
                yield from every_parser(one)


def completions() -> dict[str, str]:
    import shtab

    parser = build_parser()
    for one in every_parser(parser):
        for action in one._actions:
            if action.metavar in PATHS:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    return {file: shtab.complete(parser, shell=shell) for shell, file in FILES.items()}


if __name__ == "__main__":
    os.environ.pop("IMUD_SOCKET", None)
    os.environ["IMUD_PLUGINS"] = "off"  # the result must not depend on installed drivers and outputs
    for file, text in completions().items():
        path = Path(sys.argv[1]) / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
