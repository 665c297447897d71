"""The installation of imud: how to add a library to it, and the folder of its documents."""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from imud.model.errors import BadArgument, ImudError

# Folders that contain `docs/`: of a checkout, of the Debian package
DOCUMENTS: Final = (Path(__file__).parents[2], Path("/usr/share/doc/imud-daemon"))


def documents() -> str:
    """Return the place of the folder `docs`, to which messages of imud refer."""
    found = (folder / "docs" for folder in DOCUMENTS if (folder / "docs/index.md").exists())
    return str(next(found, "docs in the source of imud"))


def install_command(requirement: str) -> str:
    """Return the shell command that installs a requirement of pip into the environment of this process."""
    sudo = "" if os.access(sys.prefix, os.W_OK) else "sudo "
    if find_spec("pip") is not None:
        return f"{sudo}{sys.executable} -m pip install '{requirement}'"
    # The Debian package and uv make environments without pip. The pip of the system installs into them.
    apt = "" if shutil.which("pip3") else f"{'' if os.geteuid() == 0 else 'sudo '}apt install python3-pip && "
    return f"{apt}{sudo}python3 -m pip --python {sys.executable} install '{requirement}'"


@contextmanager
def needs_extra(extra: str, failure: type[ImudError] = BadArgument) -> Iterator[None]:
    """Raise `failure` with the command that installs the extra if an import fails in the `with` block.

    A missing module of imud is a defect: its ImportError passes, also every ImportError without an extra.
    """
    try:
        yield
    except ImportError as error:
        library = (error.name or "a library").partition(".")[0]
        if not extra or library == "imud":
            raise
        command = install_command(f"imud[{extra}]")
        raise failure(f"cannot import {library}; install the extra {extra}: {command}") from error
