"""Load a configuration file: read and check the whole file, then make a `Config`."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from imud.config.devices import DeviceReader
from imud.config.model import Config
from imud.config.schema import TABLES, General, Keys, Tables
from imud.config.yaml import FILE_BYTES_MAX, Problem, no_pause, path_text, read_yaml
from imud.host.files import read_regular
from imud.model.errors import ConfigError

PROBLEMS_SHOWN: Final = 20


def load(
    path: Path | str,
    tables: Tables = TABLES,
    pause: Callable[[], None] = no_pause,
    missing: str = "is the path right?",
) -> Config:
    """Read a configuration file. Raises ConfigError with all problems, one per line.

    imud calls `pause` after each piece of work of less than a millisecond. `missing` is the hint if the file does not
    exist.
    """
    try:
        content = read_regular(path, FILE_BYTES_MAX + 1)
    except OSError as error:
        hint = "check its owner and mode" if isinstance(error, PermissionError) else missing
        raise ConfigError(f"cannot read {path}: {error.strerror}; {hint}") from None
    return parse(content, str(path), tables, pause)


def parse(text: str | bytes, filename: str, tables: Tables = TABLES, pause: Callable[[], None] = no_pause) -> Config:
    """Read a configuration from text. `filename` is for messages, `pause` as in `load`. Raises ConfigError."""
    tree = read_yaml(text.encode() if isinstance(text, str) else text, pause)
    keys = Keys(tree)
    config = _config(keys, tables, pause) if tree.complete else None
    problems = [*tree.problems, *keys.problems_besides(tree.problems)]
    if problems or config is None:
        raise ConfigError(_report(problems, filename))
    return config


def _config(keys: Keys, tables: Tables, pause: Callable[[], None]) -> Config | None:
    """Make the configuration; None if it has problems."""
    top = keys.mapping((), keys.tree.data)
    if top is None:
        return None
    known = [*General.__struct_fields__, *tables.publishers, "devices"]
    keys.unknown_keys((), top, known)
    general = keys.settings(General, (), {key: top[key] for key in General.__struct_fields__ if key in top})
    publishers = {name: keys.row(tables.publishers, name, top.get(name)) for name in tables.publishers}
    for name, options in publishers.items():
        for path, message in tables.publishers[name].check(options, tables.drivers).items() if options else ():
            keys.problem((name, *path), message)
    outputs = {name: tables.publishers[name].claims(one) for name, one in publishers.items() if one is not None}
    devices = DeviceReader(keys, tables, pause, outputs).devices(top)
    if general is None or devices is None or keys.problems:
        return None
    used = tuple(device for device, enabled in devices if enabled)
    return Config(
        log_level=general.log_level,
        state_dir=general.state_dir,
        publishers={name: settings for name, settings in publishers.items() if settings is not None},
        devices=used,
        disabled=tuple(device.name for device, enabled in devices if not enabled),
    )


def _report(problems: Sequence[Problem], filename: str) -> str:
    lines = []
    for problem in sorted(problems)[:PROBLEMS_SHOWN]:
        place = f"{filename}:{problem.mark.line}:{problem.mark.column}: "
        lines.append(place + (f"{path_text(problem.path)}: " if problem.path else "") + problem.message)
    if len(problems) > PROBLEMS_SHOWN:
        lines.append(f"… and {len(problems) - PROBLEMS_SHOWN} more problems")
    return "\n".join(lines)
