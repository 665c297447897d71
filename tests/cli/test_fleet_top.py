"""`imud fleet top` with a real broker: plain tables, a terminal, invalid arguments."""

import os
import pty
import signal
from collections.abc import Iterator

import pytest

from imud.fleet.accounts import GatewayState
from tests.cli.conftest import Cli, imud_process
from tests.fleet.fleet_gateway import SendingGateway, samples_message
from tests.fleet.mosquitto import Mosquitto

URL = "mqtt://127.0.0.1:{}"
TOP = ("fleet", "top")


@pytest.fixture
def gateway(broker: Mosquitto) -> Iterator[tuple[Mosquitto, SendingGateway]]:
    made = SendingGateway(broker.port)
    made.send_state(GatewayState(v=1, online=True, boot="1", devices=["bow"]))
    yield broker, made
    made.close()


@pytest.mark.live
def test_tables_come_until_it_is_told_to_end(gateway: tuple[Mosquitto, SendingGateway]) -> None:
    broker, sender = gateway
    with imud_process(*TOP, URL.format(broker.port), "--plain", "--interval", "0.2") as process:
        first = 1
        for line in process.out:
            if line.startswith("mill/gw ") and line.split()[1:3] == ["online", "1"] and line.split()[3] != "0.0":
                break
            sender.send(samples_message(first, first + 4))
            first += 5
        assert process.end(signal.SIGTERM).err == ""


@pytest.mark.live
def test_on_a_terminal_the_picture_is_redrawn(gateway: tuple[Mosquitto, SendingGateway]) -> None:
    broker, _ = gateway
    master, slave = pty.openpty()
    words = (*TOP, URL.format(broker.port), "--interval", "0.2")
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "100", "LINES": "30"}
    with imud_process(*words, stdin=slave, stdout=slave, env=environment) as process:
        os.close(slave)
        shown = b""
        while b"mill/gw" not in shown or b"\x1b[?1049h" not in shown:  # switches to the alternate screen
            shown += os.read(master, 4096)
        process.process.send_signal(signal.SIGINT)
        while b"\x1b[?1049l" not in shown:
            shown += os.read(master, 4096)
        process.end()
    os.close(master)


@pytest.mark.live
def test_no_gateway_is_an_answer_of_no_and_the_reason_is_told(cli: Cli) -> None:
    printed = cli("fleet", "top", "mqtt://127.0.0.1:1", "--plain", "--interval", "0.2", "--duration", "1s", status=1)
    assert "no gateway yet; " in printed.out
    assert "the broker connection failed at the end: mqtt://127.0.0.1:1" in printed.err


def test_arguments_are_checked(cli: Cli) -> None:
    for words, problem in [
        (["http://host"], "expected a URL"),
        (["mqtt://host", "--interval", "0"], "--interval: expected 0.1 to 3600"),
        (["mqtt://host", "--gateway", "a/b"], "gateway: expected 1 to 64 letters"),
    ]:
        cli.refuses(problem, "fleet", "top", "--plain", *words)
