"""`make fleet-demo`: a broker, three gateways with a simulated sensor each, and `imud fleet top`.

    simulator ──pty──▶ imud run ──MQTT──▶ mosquitto ──▶ imud fleet top

The arguments are the arguments of `imud fleet top`: `make fleet-demo ARGS="--plain --duration 20s"`. All processes end
with it.
"""

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from tests.fleet.mosquitto import NO_MOSQUITTO, running_broker

GATEWAYS: Final = ("crane-1", "crane-2", "boat-1")
LIMIT_S: Final = 60.0


@contextmanager
def ended_with(words: Sequence[str], log: Path) -> Iterator[None]:
    with (
        log.open("w") as out,
        # the simulator ends when its standard input closes
        subprocess.Popen(words, stdin=subprocess.PIPE, stdout=out, stderr=out) as process,
    ):
        try:
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()


def configuration(folder: Path, gateway: str, port: int) -> Path:
    tree = {
        "state_dir": str(folder), "socket": {"path": str(folder / "imud.sock")}, "shm": {"enabled": False},
        "metrics": {"enabled": False},
        "mqtt": {
            "enabled": True, "brokers": [f"mqtt://127.0.0.1:{port}"], "site": "demo", "gateway": gateway,
            "spool_directory": str(folder / "spool"), "status_s": 2,
            "devices": {"*": {"rate_hz": 10, "whole": "slots"}},
        },
        "devices": {"bow": {"driver": "hipnuc-uart", "uart": {"port": str(folder / "port"), "baud": 115200}}},
    }  # fmt: skip
    file = folder / "imud.yaml"
    file.write_text(json.dumps(tree))
    return file


def main(arguments: Sequence[str]) -> int:
    """Run until `imud fleet top` ends. Return its exit status."""
    if NO_MOSQUITTO:
        print(f"fleet-demo: {NO_MOSQUITTO}", file=sys.stderr)
        return 2
    imud = [sys.executable, "-m", "imud"]
    with tempfile.TemporaryDirectory(prefix="imud-fleet-") as name, ExitStack() as stack:
        folder = Path(name)
        broker = stack.enter_context(running_broker(folder / "broker"))
        for gateway in GATEWAYS:
            own = folder / gateway
            own.mkdir()
            simulator = [sys.executable, "-m", "imud.sim", "--path", str(own / "port"), "--baud", "115200"]
            stack.enter_context(ended_with(simulator, own / "simulator.log"))
            daemon = [*imud, "run", "--config", str(configuration(own, gateway, broker.port))]
            stack.enter_context(ended_with(daemon, own / "log"))
        try:
            return subprocess.call([*imud, "fleet", "top", f"mqtt://127.0.0.1:{broker.port}", *arguments])
        except KeyboardInterrupt:
            return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
