"""Real PostgreSQL server of Debian, on a UNIX socket in its own folder.

`initdb` refuses to run as root. Then it runs as the user `postgres`.
"""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

LIMIT_S: Final = 120
_FOLDERS: Final = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda one: float(one.parent.name))
BIN: Final = _FOLDERS[-1] if _FOLDERS else None
NO_POSTGRES: Final = (
    "PostgreSQL is not installed (make fleet-deps)"
    if BIN is None
    else "" if find_spec("psycopg") else "psycopg is not installed (pip install 'imud[fleet]')"
)  # fmt: skip

_CONTROL: Final = "extension/timescaledb.control"  # below the folder of shared files


def _has_timescale() -> bool:
    if BIN is None:
        return False
    done = subprocess.run([BIN / "pg_config", "--sharedir"], capture_output=True, text=True, check=False)
    return (Path(done.stdout.strip()) / _CONTROL).exists()


NO_TIMESCALE: Final = NO_POSTGRES or ("" if _has_timescale() else "TimescaleDB is not installed")


class PostgresServer:
    """Server process with its own data folder. Synchronization: one thread."""

    def __init__(self, folder: Path, libraries: str = "", options: str = "") -> None:
        """Create the data folder. `libraries` is the value of `shared_preload_libraries`. `options` are further options
        of the command `postgres`."""
        self.url = f"postgresql:///postgres?host={folder}&user=imud"
        self.folder = folder
        self._libraries, self._options = libraries, options
        self._runs = False
        root = os.geteuid() == 0
        self._before = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"] if root else []
        if root:
            shutil.chown(folder, "postgres", "postgres")
        self._call("initdb", "-U", "imud", "--auth=trust", "--no-sync", "-E", "UTF8", "--locale=C")

    @property
    def pid(self) -> int:
        """Return the process that starts all other processes of the server."""
        return int((self.folder / "data/postmaster.pid").read_text().split()[0])

    def start(self) -> None:
        """Start the server and wait for a reply. After `kill`, it recovers from its log."""
        options = (
            f"-k {self.folder} -c listen_addresses='' -c fsync=off -c shared_preload_libraries='{self._libraries}' "
            # a job of TimescaleDB runs only if a test runs it
            f"-c timescaledb.max_background_workers=0 {self._options}"
        )
        self._call("pg_ctl", "-l", str(self.folder / "log"), "-w", "-t", str(LIMIT_S), "-o", options, "start")
        self._runs = True

    def kill(self) -> None:
        """Kill all processes of the server. Do nothing if it does not run."""
        if self._runs:
            self._runs = False
            self._call("pg_ctl", "-m", "immediate", "-w", "stop")

    def _call(self, program: str, *words: str) -> None:
        assert BIN is not None
        done = subprocess.run(
            [*self._before, str(BIN / program), "-D", str(self.folder / "data"), *words], cwd=self.folder,
            capture_output=True, text=True, timeout=LIMIT_S, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr


@contextmanager
def running_server(libraries: str = "", options: str = "") -> Iterator[PostgresServer]:
    folder = Path(tempfile.mkdtemp(prefix="imud-pg-", dir="/tmp"))  # other users cannot read tmp_path
    try:
        server = PostgresServer(folder, libraries, options)
        server.start()
        try:
            yield server
        finally:
            server.kill()
    finally:
        shutil.rmtree(folder)


@contextmanager
def running_postgres() -> Iterator[str]:
    """Run a server during the block. Yield its URL."""
    with running_server() as server:
        yield server.url


def query(url: str, text: str, values: Mapping[str, object] | Sequence[object] | None = None) -> list[Any]:
    """Run a statement. Without `values`, `text` can contain several statements."""
    import psycopg

    with psycopg.connect(url) as connection:
        cursor = connection.execute(text.encode(), values)
        return cursor.fetchall() if cursor.description else []
