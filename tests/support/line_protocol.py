"""Independent parser of line protocol, a fake HTTP server, and a real InfluxDB 1.6 of Debian."""

import json
import os
import re
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlencode
from urllib.request import urlopen

from tests.support.daemon_process import wait_until
from tests.support.surroundings import free_port

NO_INFLUX = "" if shutil.which("influxd") else "influxd is not installed (make influx-deps)"
# Grammar of the reference: escapes in names, strings with escapes only for quotes and backslashes
_NAME = r"(?:[^,= \n\\]|\\[,= ])+"
_FIELD = rf'({_NAME})=(-?\d+i|true|false|-?\d+(?:\.\d+)?(?:e[+-]?\d+)?|"(?:[^"\\\n]|\\["\\])*")'
_LINE = re.compile(rf"({_NAME})((?:,{_NAME}={_NAME})*) ({_FIELD}(?:,{_FIELD})*) (-?\d+)\n")


class Parsed(NamedTuple):
    measurement: str
    tags: dict[str, str]
    fields: dict[str, Any]
    time_ns: int


def parse_line(text: str) -> Parsed:
    found = _LINE.fullmatch(text)
    assert found, f"not a line: {text!r}"
    tags = re.findall(rf",({_NAME})=({_NAME})", found[2])
    fields = {_plain(name): _value(value) for name, value in re.findall(_FIELD, found[3])}
    return Parsed(_plain(found[1]), {_plain(name): _plain(value) for name, value in tags}, fields, int(found[8]))


def _plain(name: str) -> str:
    return re.sub(r"\\([,= ])", r"\1", name)


def _value(text: str) -> Any:
    if text.startswith('"'):
        return re.sub(r'\\(["\\])', r"\1", text[1:-1])
    if text in ("true", "false"):
        return text == "true"
    return int(text[:-1]) if text.endswith("i") else float(text)


class FakeDatabase:
    """HTTP server that keeps the bodies of accepted requests, and replies with `replies`, then with 204."""

    def __init__(self) -> None:
        self.replies: list[tuple[int, str]] = []
        self.bodies: list[bytes] = []
        self.connections: list[socket.socket] = []
        self.requests: list[tuple[str, dict[str, str]]] = []
        fake = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def setup(self) -> None:
                super().setup()
                fake.connections.append(self.connection)

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                fake.requests.append((self.path, dict(self.headers)))
                status, text = fake.replies.pop(0) if fake.replies else (204, "")
                if status == 0:  # the server accepts the body, and the connection breaks before the reply
                    fake.bodies.append(body)
                    self.close_connection = True
                    return
                if status < 300:
                    fake.bodies.append(body)
                self.send_response(status)
                self.send_header("Content-Length", str(len(text)))
                self.end_headers()
                self.wfile.write(text.encode())

            def log_message(self, *_: object) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = False  # `close` waits for the threads, which end with their connections
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/write?db=imud"
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
        self._thread.start()

    @property
    def lines(self) -> list[Parsed]:
        return [parse_line(one) for body in self.bodies for one in body.decode().splitlines(keepends=True)]

    def close(self) -> None:
        self._server.shutdown()
        for one in self.connections:
            with suppress(OSError):  # the client closed it
                one.shutdown(socket.SHUT_RDWR)
        self._server.server_close()


@contextmanager
def fake_database() -> Iterator[FakeDatabase]:
    made = FakeDatabase()
    try:
        yield made
    finally:
        made.close()


class InfluxServer:
    """InfluxDB 1.6 with HTTP and UDP. A restart keeps the data."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.port, self.udp_port, rpc = free_port(), free_port(), free_port()
        self.url = f"http://127.0.0.1:{self.port}/write?db=imud"
        (folder / "influxdb.conf").write_text(
            f'reporting-disabled = true\nbind-address = "127.0.0.1:{rpc}"\n[meta]\ndir = "{folder}/meta"\n'
            f'[data]\ndir = "{folder}/data"\nwal-dir = "{folder}/wal"\n[http]\n'
            f'bind-address = "127.0.0.1:{self.port}"\nlog-enabled = false\n'
            f'[[udp]]\nenabled = true\nbind-address = "127.0.0.1:{self.udp_port}"\ndatabase = "imud"\n'
            'batch-size = 100\nbatch-timeout = "100ms"\n'
        )
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with (self._folder / "log").open("ab") as log:
            words = ["influxd", "-config", str(self._folder / "influxdb.conf")]
            self._process = subprocess.Popen(words, stdout=log, stderr=log, env={**os.environ, "HOME": "/nonexistent"})
        wait_until(self._replies, "influxd replies")
        self.query("CREATE DATABASE imud")

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def query(self, text: str) -> list[dict[str, Any]]:
        """Return the rows of a query, by column name."""
        words = urlencode({"db": "imud", "epoch": "ns", "q": text})
        method = "POST" if text.startswith("CREATE") else "GET"
        from urllib.request import Request

        with urlopen(Request(f"http://127.0.0.1:{self.port}/query?{words}", method=method), timeout=60) as reply:
            (result,) = json.load(reply)["results"]
        series = result.get("series", [])
        return [dict(zip(one["columns"], row, strict=True)) for one in series for row in one["values"]]

    def count(self, measurement: str) -> int:
        found = self.query(f"SELECT count(t_ns) FROM {measurement}")
        return found[0]["count"] if found else 0

    def _replies(self) -> bool:
        try:
            with urlopen(f"http://127.0.0.1:{self.port}/ping", timeout=60):
                return True
        except OSError:
            return False


@contextmanager
def influx_server(folder: Path) -> Iterator[InfluxServer]:
    made = InfluxServer(folder)
    made.start()
    try:
        yield made
    finally:
        made.kill()
