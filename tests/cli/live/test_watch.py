"""`imud watch`: formats, rates and fields, the end of its reader, and a daemon that is restarted."""

import csv
import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import Event, Thread

import pytest

from imud.cli import main
from imud.contracts.publisher import Batch
from imud.publishers.socket.publisher import SocketServer
from tests.support.socket_rig import Daemon, batch, daemon

PERIOD_NS = 10_000_000


def publishing(sent: Batch, server: SocketServer) -> None:
    server.publish(sent)


@contextmanager
def samples_of(served: Daemon, devices: Sequence[str] = ("imu0",)) -> Iterator[None]:
    """Samples of devices again and again, as at 100 Hz by their stamps."""
    ended = Event()

    def publish() -> None:
        seq = 0
        while not ended.wait(0.002):
            seq += 1
            for device in devices:
                sent = batch(device, seq, period_ns=PERIOD_NS)
                served.do(partial(publishing, sent))

    sender = Thread(target=publish)
    sender.start()
    try:
        yield
    finally:
        ended.set()
        sender.join()


def watched(tmp_path: Path, *options: str) -> None:
    """Run the command on a daemon whose devices send, until it ends by itself."""
    with daemon(tmp_path) as served, samples_of(served, ("imu0", "imu1")):
        assert main(["watch", "--socket", str(served.path), *options]) == 0


@pytest.mark.parametrize("option", ["--json", "--format=json"])
def test_json_has_every_sample(tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str) -> None:
    watched(tmp_path, "--count", "5", option, "imu0")
    seqs = [json.loads(line)["seq"] for line in capsys.readouterr().out.splitlines()]
    assert seqs == list(range(seqs[0], seqs[0] + 5))


def test_json_of_chosen_fields(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    watched(tmp_path, "--count", "2", "--json", "--fields", "temperature_c,accel_m_s2,mag_t", "imu0")
    assert capsys.readouterr().out == '{"temperature_c":31.5,"accel_m_s2":[0.125,-0.5,9.75]}\n' * 2


def test_the_table_has_ten_samples_a_second(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    watched(tmp_path, "--count", "3", "--fields", "device,seq,accel_m_s2", "imu0")
    _labels, head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["DEVICE", "SEQ", "X", "Y", "Z"]
    seqs = [int(row.split()[1]) for row in rows]
    assert seqs == [seqs[0], seqs[0] + 10, seqs[0] + 20]
    assert rows[0].endswith("  0.12  -0.50   9.75")


@pytest.mark.parametrize(("rate", "step"), [("0", 1), ("20", 5)])
def test_the_rate_of_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str], rate: str, step: int) -> None:
    watched(tmp_path, "--count", "3", "--rate", rate, "--fields", "seq", "imu0")
    seqs = [int(row) for row in capsys.readouterr().out.splitlines()[1:]]
    assert seqs == [seqs[0], seqs[0] + step, seqs[0] + 2 * step]


def test_several_devices_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    watched(tmp_path, "--count", "8")
    _labels, head, *rows = capsys.readouterr().out.splitlines()
    assert head.split()[:2] == ["DEVICE", "TIME"]
    assert {row.split()[0] for row in rows} == {"imu0", "imu1"}


def test_the_convention_turns_the_values(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    watched(tmp_path, "--count", "1", "--convention", "ned-frd", "--fields", "accel_m_s2", "imu0")
    assert capsys.readouterr().out.splitlines()[-1].split() == ["-0.50", "0.12", "-9.75"]


def test_csv_has_a_header_and_every_sample(tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    watched(tmp_path, "--count", "3", "--format", "csv", "imu0")
    text = capfdbinary.readouterr().out.decode()
    assert text.count("\r\n") == text.count("\n") == 4
    head, *rows = csv.reader(text.splitlines(keepends=True), strict=True)
    found = [dict(zip(head, row, strict=True)) for row in rows]
    seqs = [int(one["seq"]) for one in found]
    assert seqs == [seqs[0], seqs[0] + 1, seqs[0] + 2]
    assert (found[0]["accel_z_m_s2"], found[0]["mag_x_t"], found[0]["sync"]) == ("9.75", "", "regression")


def test_an_unknown_field_is_an_error_before_the_daemon_is_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["watch", "--socket", str(tmp_path / "none"), "--fields", "seq,gyro"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        'imud watch: --fields: expected a field that imud knows, got "gyro"; did you mean gyro_rad_s?'
    )
    assert error.count("\n") == 1


def test_a_format_and_json_exclude_each_other(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["watch", "--json", "--format", "csv"])
    assert "not allowed with argument" in capsys.readouterr().err


def program(path: str | Path, *options: str) -> list[str]:
    """The command as a process of its own."""
    return [sys.executable, "-m", "imud", "watch", "--socket", str(path), *options]


@pytest.mark.parametrize("form", ["table", "json", "csv"])
def test_a_reader_that_ends_is_no_error(tmp_path: Path, form: str) -> None:
    with (
        daemon(tmp_path) as served,
        samples_of(served),
        subprocess.Popen(
            program(served.path, "--format", form), stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process,
    ):
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(20) == 0


def test_an_interrupt_ends_it_quietly(tmp_path: Path) -> None:
    with (
        daemon(tmp_path) as served,
        samples_of(served),
        subprocess.Popen(program(served.path), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process,
    ):
        assert process.stdout is not None
        assert process.stdout.readline()
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
    assert (process.returncode, error) == (130, b"")


def test_without_follow_the_end_of_the_daemon_is_an_error(tmp_path: Path) -> None:
    with daemon(tmp_path) as served, samples_of(served):
        process = subprocess.Popen(
            program(served.path, "--json"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        assert process.stdout.readline()
    with process:
        _, error = process.communicate(timeout=20)
    assert process.returncode == 2
    assert error.count("\n") == 1
    assert "the daemon closed the connection" in error


def test_follow_begins_before_the_daemon_and_goes_on_after_its_restart(tmp_path: Path) -> None:
    options = ["--follow", "--format", "csv", "--fields", "device,seq"]
    with subprocess.Popen(
        program(tmp_path / "imud.sock", *options), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert "is imud running?" in process.stderr.readline()
        with daemon(tmp_path) as served, samples_of(served, ["imu0"]):
            assert process.stdout.readline() == "device,seq\n"
            assert process.stdout.readline().startswith("imu0,")
            assert process.stderr.readline() == "imud watch: connected again\n"
        assert process.stderr.readline().endswith("; waiting for the daemon\n")
        with daemon(tmp_path) as served, samples_of(served, ["imu1"]):
            line = next(line for line in process.stdout if not line.startswith("imu0,"))
            assert line.startswith("imu1,")  # and no second header
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 130
