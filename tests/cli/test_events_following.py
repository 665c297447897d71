"""Reconnection after a restart of the daemon, and the notes on standard error."""

import os
import sys
from pathlib import Path

import pytest

from imud.cli.events import RETRY_S, DeviceNotes, keep_connected
from imud.client.connection import Client
from imud.formats.jsonrpc import RpcError
from imud.model.errors import LinkMissing, ServerError
from tests.support.socket_rig import daemon
from tests.support.surroundings import pipe


def test_without_follow_a_missing_daemon_is_an_error_and_a_refusal_always_is(tmp_path: Path) -> None:
    def work(_client: Client) -> None:
        raise AssertionError

    with pytest.raises(LinkMissing, match="is imud running"):
        keep_connected("imud watch", str(tmp_path / "none"), work, follow=False)
    with daemon(tmp_path) as served, pytest.raises(RpcError, match="imu7"):
        keep_connected("imud watch", str(served.path), lambda c: print(c.watch(["imu7"])), follow=True)


def test_follow_waits_for_the_daemon_and_says_so_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "imud.sock"
    waits: list[float] = []
    versions: list[str] = []

    def attempt() -> None:
        keep_connected("imud watch", str(path), lambda c: versions.append(c.hello.version), follow=True, wait=wait)

    def wait(seconds: float) -> None:
        waits.append(seconds)
        if len(waits) == 3:
            with daemon(tmp_path):
                attempt()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        attempt()
    assert waits == [RETRY_S] * 3
    assert len(versions) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"imud watch: no daemon at {path}: is imud running?")
    assert lines[0].endswith("; waiting for the daemon")


def test_follow_goes_on_after_the_connection_is_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    epochs: list[int] = []

    def work(client: Client) -> None:
        epochs.append(client.hello.epoch)
        if len(epochs) == 1:
            raise LinkMissing("the daemon closed the connection")

    with daemon(tmp_path) as served:
        keep_connected("imud events", str(served.path), work, follow=True, wait=lambda _s: None)
    assert len(epochs) == 2
    assert capsys.readouterr().err.splitlines() == [
        "imud events: the daemon closed the connection; waiting for the daemon",
        "imud events: connected again",
    ]


def test_a_daemon_that_does_not_answer(tmp_path: Path) -> None:
    tries: list[Client] = []

    def work(client: Client) -> None:
        tries.append(client)
        if len(tries) < 3:
            raise TimeoutError("waited in vain for devices")

    with daemon(tmp_path) as served:
        with pytest.raises(ServerError, match="in vain"):
            keep_connected("imud watch", str(served.path), work, follow=False)
        keep_connected("imud watch", str(served.path), work, follow=True, wait=lambda _s: None)
    assert len(tries) == 3


def test_waiting_ends_when_nobody_reads_the_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pipe() as (reader, writer), open(writer, "w", closefd=False) as output:
        monkeypatch.setattr(sys, "stdout", output)
        waits: list[float] = []

        def wait(seconds: float) -> None:
            waits.append(seconds)
            if len(waits) == 2:
                os.close(reader)

        with pytest.raises(BrokenPipeError):
            keep_connected("imud watch", str(tmp_path / "none"), lambda _c: None, follow=True, wait=wait)
    assert len(waits) == 2


class Answers:
    def __init__(self) -> None:
        self.found = [{"name": "bow", "state": "running", "problem": ""}]

    def devices(self) -> list[dict[str, str]]:
        return self.found


def test_a_device_that_is_gone_is_reported_once_and_when_it_is_back(capsys: pytest.CaptureFixture[str]) -> None:
    client = Answers()
    notes = DeviceNotes(client, ["bow"])
    notes.look(0.0)
    assert capsys.readouterr().err == ""
    client.found = [{"name": "bow", "state": "missing", "problem": "/dev/x is not there"}]
    notes.look(1.0)
    assert capsys.readouterr().err == ""
    for now_s in (2.0, 4.0):
        notes.look(now_s)
    assert capsys.readouterr().err == "imud watch: bow is missing: /dev/x is not there\n"
    client.found = []
    notes.look(6.0)
    client.found = [{"name": "bow", "state": "running", "problem": ""}]
    notes.look(8.0)
    assert capsys.readouterr().err == "imud watch: bow is no longer in the configuration\nimud watch: bow is running\n"


def test_dropped_samples_are_reported_together(capsys: pytest.CaptureFixture[str]) -> None:
    notes = DeviceNotes(Answers(), [])
    notes.look(0.0)
    for count in (5, 7):
        notes.add_dropped("bow", count)
    notes.look(1.0)
    assert capsys.readouterr().err == ""
    notes.look(2.0)
    notes.look(4.0)
    assert (
        capsys.readouterr().err == "imud watch: the daemon dropped 12 samples of bow because imud watch was too slow\n"
    )
