"""`imud fleet top` as a process: tables with a real broker, on a terminal, and what it refuses."""

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from imud.formats.fleet.state import GatewayState
from tests.cli.conftest import Cli
from tests.fleet.demo import GATEWAYS
from tests.fleet.demo import main as demonstrate
from tests.fleet.fleet_gateway import LIMIT_S, SendingGateway, samples_message
from tests.publishers.mqtt.mosquitto import NO_MOSQUITTO, Mosquitto

URL = "mqtt://127.0.0.1:{}"
TOP = (sys.executable, "-m", "imud", "fleet", "top")


@pytest.fixture
def gateway(broker: Mosquitto) -> Iterator[tuple[Mosquitto, SendingGateway]]:
    made = SendingGateway(broker.port)
    made.send_state(GatewayState(v=1, online=True, boot="1", devices=["bow"]))
    yield broker, made
    made.close()


def test_tables_come_until_it_is_told_to_end(gateway: tuple[Mosquitto, SendingGateway]) -> None:
    broker, sender = gateway
    words = [*TOP, URL.format(broker.port), "--plain", "--interval", "0.2"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = 1
        for line in process.stdout:
            if line.startswith("mill/gw ") and line.split()[1:3] == ["online", "1"] and line.split()[3] != "0.0":
                break
            sender.send(samples_message(first, first + 4))
            first += 5
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, said) == (0, "")


def test_on_a_terminal_the_picture_is_redrawn(gateway: tuple[Mosquitto, SendingGateway]) -> None:
    broker, _ = gateway
    master, slave = pty.openpty()
    words = [*TOP, URL.format(broker.port), "--interval", "0.2"]
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100", "LINES": "30"}
    with subprocess.Popen(words, stdin=slave, stdout=slave, stderr=subprocess.PIPE, env=environment) as process:
        os.close(slave)
        shown = b""
        while b"mill/gw" not in shown or b"\x1b[?1049h" not in shown:  # the alternate screen
            shown += os.read(master, 4096)
        process.send_signal(signal.SIGINT)
        while b"\x1b[?1049l" not in shown:
            shown += os.read(master, 4096)
        assert process.wait(LIMIT_S) == 0
    os.close(master)


def test_no_gateway_is_an_answer_of_no_and_the_reason_is_told(cli: Cli) -> None:
    printed = cli("fleet", "top", "mqtt://127.0.0.1:1", "--plain", "--interval", "0.2", "--duration", "1s", status=1)
    assert "no gateway yet; " in printed.out
    assert "nothing comes at the end: mqtt://127.0.0.1:1" in printed.err


@pytest.mark.skipif(bool(NO_MOSQUITTO), reason=NO_MOSQUITTO)
@pytest.mark.timeout(120)
def test_every_gateway_of_the_demonstration_is_online_and_sends(capfd: pytest.CaptureFixture[str]) -> None:
    assert demonstrate(["--plain", "--interval", "1", "--duration", "25s"]) == 0
    pictures = capfd.readouterr().out.split("GATEWAY")
    rows = {line.split()[0]: line.split() for line in pictures[-1].splitlines() if line.startswith("demo/")}
    assert rows.keys() == {f"demo/{name}" for name in GATEWAYS}
    for row in rows.values():
        assert row[1:3] == ["online", "1"]
        assert float(row[3]) > 20
        assert row[4:6] == ["0", "0"]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["http://host"], "expected a URL"),
        (["mqtt://host", "--interval", "0"], "--interval: expected 0.1 to 3600"),
        (["mqtt://host", "--gateway", "a/b"], "gateway: expected 1 to 64 letters"),
    ],
)
def test_arguments_are_checked(words: list[str], problem: str, cli: Cli) -> None:
    cli.refuses(problem, "fleet", "top", "--plain", *words)
