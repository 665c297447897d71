"""What `imud setup` says and asks: text in 80 columns on standard output, questions on the terminal."""

import sys
import textwrap
from collections.abc import Sequence
from typing import Final

from imud.cli.output import COLUMNS, paragraph, shortened, table
from imud.cli.setup.attached import Attached
from imud.errors import BadArgument
from imud.log import MESSAGE_CHARACTERS_MAX, printable

FOUND_HEAD: Final = ("PORT", "DRIVER", "RATE", "ADAPTER", "CONFIGURED")
TITLE_WIDTH: Final = 16
CONFIGURED_WIDTH: Final = 10
ANSWERS_MAX: Final = 10
"""Wrong answers to one question after which it is given up."""


class Conversation:
    """Standard output and the terminal. Synchronization: one thread."""

    def __init__(self, *, ask: bool, silent: bool = False) -> None:
        """Without `ask` every question has its default answer."""
        self.asks = ask
        self._silent = silent

    def say(self, text: str = "", indent: str = "") -> None:
        """Print a paragraph."""
        if not self._silent:
            words = printable(text, MESSAGE_CHARACTERS_MAX)
            print(
                textwrap.fill(words, COLUMNS, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
            )

    def show(self, lines: Sequence[str]) -> None:
        """Print lines as they are: tables, lines of files."""
        for line in lines if not self._silent else ():
            print(printable(line, MESSAGE_CHARACTERS_MAX))

    def agreed(self, question: str, *, default: bool) -> bool:
        """Ask for yes or no. Raises BadArgument where there is no terminal to ask on."""
        if not self.asks:
            return default
        word = self.answer(f"{question} [{'Y/n' if default else 'y/N'}]", "y" if default else "n")
        return word.lower() in ("y", "yes")

    def answer(self, question: str, default: str) -> str:
        """Ask for a word; an empty answer is the default. Raises BadArgument where there is no terminal to ask on."""
        if not self.asks:
            return default
        if not sys.stdin.isatty():
            raise BadArgument("expected a terminal to ask on, or --yes")
        try:
            return input(f"{question} ").strip() or default
        except KeyboardInterrupt:
            self.show(["", "Nothing more was changed."])
            raise
        except EOFError:
            self.show([""])
            raise BadArgument("expected an answer, got the end of the input: nothing more was changed") from None


def attached_table(found: Sequence[Attached]) -> list[str]:
    """Format what is attached, and below it why nothing was found on a port."""
    rows = [
        (
            one.node,
            f"{one.driver} {one.device}".strip() or "-",
            one.baud or "-",
            shortened(one.title, TITLE_WIDTH) or "-",
            shortened(one.configured, CONFIGURED_WIDTH) or "-",
        )
        for one in found
    ]
    lines = table(FOUND_HEAD, rows).splitlines()
    for one in found:
        if one.problem:
            lines += paragraph("  ", f"{one.node}: {one.problem}")
    return lines
