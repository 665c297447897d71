"""`imud fleet collect --to -` with a real broker: lines, acknowledgements, ledger."""

import json
import signal
from contextlib import AbstractContextManager
from typing import Any

import pytest

from imud.fleet.accounts import GatewayState, StreamPosition
from tests.cli.conftest import Cli, ImudProcess, imud_process
from tests.fleet.fleet_gateway import SendingGateway, dropped_message, samples_message
from tests.fleet.mosquitto import Mosquitto

URL = "mqtt://127.0.0.1:{}"


def collecting(broker: Mosquitto) -> AbstractContextManager[ImudProcess]:
    return imud_process("fleet", "collect", URL.format(broker.port), "--to", "-")


def lines(process: ImudProcess, number: int) -> list[dict[str, Any]]:
    return [json.loads(process.out.readline()) for _ in range(number)]


@pytest.mark.live
def test_lines_come_and_the_ledger_is_printed_at_the_end(broker: Mosquitto) -> None:
    gateway = SendingGateway(broker.port)
    gateway.send_state(
        GatewayState(v=1, online=True, boot="1", positions=[StreamPosition("1", "bow", "samples", 1, 9)])
    )
    with collecting(broker) as process:
        while not any("SUBSCRIBE" in line or "imud-reader-collector 1 imud" in line for line in broker.log):
            assert process.process.poll() is None
        gateway.send(samples_message(1, 2), dropped_message(3, 5))
        first, second, third = lines(process, 3)
        ledger = process.end(signal.SIGTERM).err
    gateway.close()
    assert (first["site"], first["gateway"], first["boot"], first["device"]) == ("mill", "gw", "1", "bow")
    assert (first["stream"], first["kind"], first["seq"]) == ("samples", "sample", 1)
    assert first["accel_m_s2"] == [0.125, 0.0, 9.75]
    assert second["seq"] == 2
    assert (third["kind"], third["first"], third["last"], third["cause"]) == ("dropped", 3, 5, "space")
    assert ledger.splitlines()[-1].split() == ["gw", "1", "bow", "samples", "9", "2", "3", "space", "0", "4", "0"]


@pytest.mark.live
def test_what_was_not_acknowledged_by_a_killed_collector_comes_again(broker: Mosquitto) -> None:
    gateway = SendingGateway(broker.port)
    seen: set[int] = set()
    with collecting(broker) as process:
        gateway.send(samples_message(1, 1))
        while not any("imud-reader-collector 1 imud" in line for line in broker.log):
            assert process.process.poll() is None
        for round_ in range(20):
            gateway.send(samples_message(10 * round_ + 2, 10 * round_ + 11))
        seen.update(one["seq"] for one in lines(process, 30) if one["kind"] == "sample")
        process.process.kill()
        printed = [line for line in process.out if line.endswith("\n")]  # the acknowledged messages are among them
        seen.update(one["seq"] for one in map(json.loads, printed) if one["kind"] == "sample")
    gateway.send(samples_message(202, 211))
    with collecting(broker) as process:
        while 211 not in seen:
            seen.update(one["seq"] for one in lines(process, 1))
    gateway.close()
    assert seen >= set(range(2, 212))


def test_arguments_are_checked(cli: Cli) -> None:
    for words, problem in [
        (["mqtt://host", "--to", "elsewhere"], "--to: expected"),
        (["host", "--to", "-"], "expected a URL"),
        (["mqtt://host", "--to", "-", "--password-file", "f"], "add --user"),
        (["mqtt://host", "--to", "-", "--key-file", "f"], "add --cert-file"),
    ]:
        cli.refuses(problem, "fleet", "collect", *words)
