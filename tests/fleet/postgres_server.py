"""A real PostgreSQL of the tests, Debian's, on a UNIX socket in a folder of its own.

`initdb` refuses to run as root: there it runs as the package's user `postgres`.
"""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Final

LIMIT_S: Final = 40
_FOLDERS: Final = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda one: float(one.parent.name))
BIN: Final = _FOLDERS[-1] if _FOLDERS else None
NO_POSTGRES: Final = (
    "PostgreSQL is not installed (make fleet-deps)"
    if BIN is None
    else "" if find_spec("psycopg") else "psycopg is not installed (pip install 'imud[fleet]')"
)  # fmt: skip


@contextmanager
def running_postgres() -> Iterator[str]:
    """A server that runs; its URL."""
    assert BIN is not None
    folder = Path(tempfile.mkdtemp(prefix="imud-pg-", dir="/tmp"))  # tmp_path is closed to other users
    root = os.geteuid() == 0
    before = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"] if root else []
    if root:
        shutil.chown(folder, "postgres", "postgres")
    data = str(folder / "data")

    def call(program: str, *words: str) -> None:
        done = subprocess.run(
            [*before, str(BIN / program), "-D", data, *words], cwd=folder, capture_output=True, text=True,
            timeout=LIMIT_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr

    try:
        call("initdb", "-U", "imud", "--auth=trust", "--no-sync", "-E", "UTF8", "--locale=C")
        options = f"-k {folder} -c listen_addresses='' -c fsync=off"
        call("pg_ctl", "-l", str(folder / "log"), "-w", "-t", str(LIMIT_S), "-o", options, "start")
        try:
            yield f"postgresql:///postgres?host={folder}&user=imud"
        finally:
            call("pg_ctl", "-m", "immediate", "-w", "stop")
    finally:
        shutil.rmtree(folder)
