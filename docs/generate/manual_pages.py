"""Creates manual pages in roff: `python -m docs.generate.manual_pages FOLDER`.

imud(1) and one page per command, imud-COMMAND(1), come from the parsers that print `--help`. imud.yaml(5) comes from
the option classes, like docs/configuration.md. The Debian package installs the pages.
"""

import argparse
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

import msgspec

from docs.generate import references
from docs.generate.settings_parts import docs_of, settings_parts
from imud import __version__
from imud.cli import COMMANDS, build_parser
from imud.formats.jsonrpc import DEFAULT_PATH
from imud.model.options import expected

EXIT_STATUS: Final = (
    ("0", "Done."),
    ("1", "The command ran, and its result is negative."),
    ("2", "The command could not run; the reason is on standard error."),
)
OWN_STATUS: Final = {
    "run": (
        ("0", "Stopped by SIGTERM or SIGINT."),
        ("1", "An internal error; the log has a traceback."),
        ("2", "Invalid command line."),
        ("75", "A required output cannot start."),
        ("78", "The configuration is invalid; the log contains file, line and column."),
    ),
    "doctor": (
        ("0", "The possible checks found no problem."),
        ("1", "A warning: a device or an output works, but not as well as possible."),
        ("2", "An error: a device or an output does not work. Also: invalid command line."),
    ),
    "setup": (
        ("0", "All configured devices send samples, or the plan was printed, or no change is left to undo."),
        ("1", "No sensor was found, a device sends no samples, or a change was not made or not undone."),
        ("2", "The command could not run, or a change failed; the reason is on standard error."),
    ),
}
ENVIRONMENT: Final = (
    ("IMUD_SOCKET", f"The daemon's socket, instead of {DEFAULT_PATH}."),
    ("IMUD_SHM", "The folder of the rings of shared memory."),
    ("IMUD_PLUGINS", "off: imud ignores drivers and outputs of other packages."),
)
FILES: Final = (
    ("/etc/imud.yaml", "The configuration, imud.yaml(5)."),
    (DEFAULT_PATH, "The socket: requests, samples and events."),
    ("/run/imud/shm", "The rings of shared memory."),
    ("/var/lib/imud", "The stored state of the daemon."),
    ("/usr/share/doc/imud-daemon/docs", "The documents, with index.md as the first page."),
)

RAGGED: Final = ".ad l"
"""Request for left-aligned lines: some words of a synopsis are longer than half a line."""
EVEN: Final = ".ad b"
"""Request for lines with both margins aligned."""

# --- roff -------------------------------------------------------------------------------------------------------------


def inside(text: str) -> str:
    """Return text within a line for roff. Hyphens are escaped, so that users can copy them."""
    return text.replace("\\", "\\e").replace("-", "\\-").replace("^", "\\(ha").replace("~", "\\(ti")


def escaped(text: str) -> str:
    return "\n".join("\\&" + line if line[:1] in (".", "'") else line for line in inside(text).splitlines())


def bold(text: str) -> str:
    return f"\\fB{inside(text)}\\fR"


def italic(text: str) -> str:
    return f"\\fI{inside(text)}\\fR"


def marked(text: str) -> str:
    """Return text of a document with its `code` in bold."""
    parts = text.split("`")
    return "".join(bold(part) if number % 2 else inside(part) for number, part in enumerate(parts))


def header(name: str, section: int, summary: str) -> Iterator[str]:
    yield f'.TH "{escaped(name.upper())}" "{section}" "" "imud {escaped(__version__)}" "imud"'
    yield from (".SH NAME", f"{escaped(name)} \\- {escaped(summary)}")


def breakable(text: str) -> str:
    return re.sub(r",(?=\S)", ", ", text)


def listed(rows: Iterable[tuple[str, str]]) -> Iterator[str]:
    for term, meaning in rows:
        yield from (".TP", bold(term), escaped(meaning))


def see_also(pages: Iterable[tuple[str, int]]) -> Iterator[str]:
    yield ".SH SEE ALSO"
    yield ",\n".join(f"{bold(name)}({section})" for name, section in pages)


# --- the command line -------------------------------------------------------------------------------------------------


def sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("." if text and not text.endswith((".", "?")) else "")


def values_of(action: argparse.Action) -> str:
    if action.nargs == 0:
        return ""
    word = action.metavar
    if isinstance(word, tuple):
        return " ".join(italic(one) for one in word)
    if word is None and action.choices is not None:
        word = "{" + ",".join(map(str, action.choices)) + "}"
    one = italic(word or (action.dest.upper() if action.option_strings else action.dest))
    return {"*": f"[{one} ...]", "+": f"{one} [{one} ...]", "?": f"[{one}]"}.get(str(action.nargs), one)


def help_of(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    """Return the help text with values for its %(…)s, like `--help`."""
    words = {**vars(action), "prog": parser.prog}
    if action.choices is not None:
        words["choices"] = ", ".join(map(str, action.choices))
    text = (action.help or "") % words
    return sentence(text)


def arguments_of(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return the arguments in the output of `--help`, without the subcommands."""
    return [
        action
        for action in parser._actions
        if action.help != argparse.SUPPRESS and not isinstance(action, argparse._SubParsersAction)
    ]


def helps_of(parser: argparse.ArgumentParser) -> Mapping[str, str]:
    return {
        one.dest: one.help or ""
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
        for one in action._choices_actions
    }


def commands_of(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    found: dict[str, argparse.ArgumentParser] = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found |= action.choices
    return found


def synopsis(parser: argparse.ArgumentParser) -> str:
    """Return the synopsis of a command as in `--help`, with bars between alternatives."""
    words = " ".join(parser.format_usage().split()).removeprefix("usage: ").removeprefix(parser.prog)
    return bold(parser.prog) + inside(words)


def options(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in sorted(arguments_of(parser), key=lambda one: bool(one.option_strings)):
        values = values_of(action)
        names = ", ".join(f"{bold(one)} {values}".rstrip() for one in action.option_strings)
        yield from (".TP", names or values, escaped(help_of(action, parser)) or "\\&")


def main_page(parser: argparse.ArgumentParser) -> Iterator[str]:
    yield from header("imud", 1, "daemon that reads inertial sensors and sends their samples to programs")
    yield from (".SH SYNOPSIS", RAGGED, synopsis(parser), EVEN, ".SH DESCRIPTION")
    yield escaped(
        "imud reads inertial sensors on serial ports, RS-485, CAN, I2C and SPI. It time-stamps each sample with the "
        "time of its measurement, and sends it to any number of programs over a UNIX socket and shared memory. The "
        "service is imud.service. The commands find sensors, check a configuration, and send requests to the daemon."
    )
    yield ".SH COMMANDS"
    for name, command in COMMANDS.items():
        yield from (".TP", f"{bold(f'imud-{name}')}(1)", escaped(sentence(command.help)))
    yield from (".SH OPTIONS", *options(parser))
    yield from (".SH EXIT STATUS", *listed(EXIT_STATUS), ".SH ENVIRONMENT", *listed(ENVIRONMENT))
    yield from (".SH FILES", *listed(FILES))
    yield from see_also([*((f"imud-{name}", 1) for name in COMMANDS), ("imud.yaml", 5)])


def command_page(name: str, parser: argparse.ArgumentParser) -> Iterator[str]:
    yield from header(f"imud-{name}", 1, COMMANDS[name].help)
    yield from (".SH SYNOPSIS", RAGGED)
    below = commands_of(parser)
    for number, one in enumerate(below.values() if below else [parser]):
        yield from (*([".br"] if number else []), synopsis(one))
    yield from (EVEN, ".SH DESCRIPTION", escaped(parser.description or COMMANDS[name].help))
    yield from (".SH OPTIONS", *options(parser))
    for word, one in below.items():
        yield from (f".SS {escaped(one.prog)}", escaped(sentence(helps_of(parser)[word])), *options(one))
    yield from (".SH EXIT STATUS", *listed(OWN_STATUS.get(name, EXIT_STATUS)))
    yield from see_also([("imud", 1), ("imud.yaml", 5)])


# --- the configuration ------------------------------------------------------------------------------------------------


def configuration_page() -> Iterator[str]:
    yield from header("imud.yaml", 5, "configuration of imud")
    yield from (".SH SYNOPSIS", escaped("/etc/imud.yaml"), ".SH DESCRIPTION")
    yield marked(
        "A YAML file. All keys have defaults except the keys marked as needed. `imud check` checks a file and prints "
        "its errors. `systemctl reload imud` makes the daemon read the file again. The smallest useful file:"
    )
    yield from (".PP", ".EX", "devices:", "  front:", "    uart: {port: /dev/ttyUSB0}", ".EE")
    for title, path, schema in settings_parts():
        fields = msgspec.structs.fields(schema)
        if not fields:
            continue
        docs = docs_of(schema)
        yield f".SH {escaped(re.sub('`', '', title).upper())}"
        for field in fields:
            default = references.default_of(field).strip("`")
            value = "needed" if default == "needed" else f"default {default}"
            yield from (".TP", bold(path + field.name), marked(f"{docs[field.name]} Expected: {expected(field.type)};"))
            yield escaped(breakable(f"{value}."))
    yield from see_also([("imud", 1), ("imud-check", 1), ("imud-run", 1)])


def pages() -> dict[str, str]:
    parser = build_parser()
    found = {"imud.1": main_page(parser)}
    for name, command in commands_of(parser).items():
        found[f"imud-{name}.1"] = command_page(name, command)
    found["imud.yaml.5"] = configuration_page()
    return {name: "\n".join(lines) + "\n" for name, lines in found.items()}


if __name__ == "__main__":
    os.environ["IMUD_PLUGINS"] = "off"  # the result must not depend on installed drivers and outputs
    os.environ.pop("IMUD_SOCKET", None)  # the default must not depend on the environment of the build
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in pages().items():
        (folder / file).write_text(text)
