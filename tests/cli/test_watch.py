"""`imud watch`: formats, rates, fields, a closed pipe, and a restart of the daemon."""

import csv
import json
import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from operator import methodcaller
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from imud.cli import main
from imud.client.connection import Client
from tests.cli.conftest import Cli, imud_process
from tests.support.socket_rig import Daemon, batch, daemon

pytestmark = pytest.mark.live
Words = tuple[object, ...]


@contextmanager
def samples_of(served: Daemon, devices: Sequence[str] = ("imu0",)) -> Iterator[None]:
    ended = Event()

    def publish() -> None:
        seq = 0
        while not ended.wait(0.002):
            seq += 1
            for device in devices:
                served.do(methodcaller("publish", batch(device, seq, period_ns=10_000_000)))

    sender = Thread(target=publish)
    sender.start()
    try:
        yield
    finally:
        ended.set()
        sender.join()


@pytest.fixture(scope="module")
def words(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Words]:
    with daemon(tmp_path_factory.mktemp("watch")) as served, samples_of(served, ("imu0", "imu1")):
        yield "watch", "--socket", served.path


@pytest.mark.parametrize("option", ["--json", "--format=json"])
def test_json_has_every_sample(words: Words, cli: Cli, option: str) -> None:
    seqs = [json.loads(line)["seq"] for line in cli(*words, "--count", 5, option, "imu0").out.splitlines()]
    assert seqs == list(range(seqs[0], seqs[0] + 5))
    fields = ("--fields", "temperature_c,accel_m_s2,mag_t")
    text = cli(*words, "--count", 2, option, *fields, "imu0").out
    assert text == '{"temperature_c":31.5,"accel_m_s2":[0.125,-0.5,9.75]}\n' * 2


def test_the_rate_devices_and_convention_of_the_table(words: Words, cli: Cli) -> None:
    for rate, step in [((), 10), (("--rate", "0"), 1), (("--rate", "20"), 5)]:
        more = ("--count", 3, *rate, "--fields", "device,seq,accel_m_s2", "imu0")
        _labels, head, *rows = cli(*words, *more).out.splitlines()
        assert head.split() == ["DEVICE", "SEQ", "X", "Y", "Z"]
        assert rows[0].endswith("  0.12  -0.50   9.75")
        seqs = [int(row.split()[1]) for row in rows]
        assert seqs == [seqs[0], seqs[0] + step, seqs[0] + 2 * step], rate
    _labels, head, *rows = cli(*words, "--count", 8).out.splitlines()
    assert (head.split()[:2], {row.split()[0] for row in rows}) == (["DEVICE", "TIME"], {"imu0", "imu1"})
    turned = cli(*words, "--count", 1, "--convention", "ned-frd", "--fields", "accel_m_s2", "imu0").out
    assert turned.splitlines()[-1].split() == ["-0.50", "0.12", "-9.75"]


def test_csv_has_a_header_and_all_samples(words: Words, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    assert main([*map(str, words), "--count", "3", "--format", "csv", "imu0"]) == 0
    text = capfdbinary.readouterr().out.decode()
    assert text.count("\r\n") == text.count("\n") == 4
    head, *rows = csv.reader(text.splitlines(keepends=True), strict=True)
    found = [dict(zip(head, row, strict=True)) for row in rows]
    seqs = [int(one["seq"]) for one in found]
    assert seqs == [seqs[0], seqs[0] + 1, seqs[0] + 2]
    assert (found[0]["accel_z_m_s2"], found[0]["mag_x_t"], found[0]["sync"]) == ("9.75", "", "regression")


def test_options_are_sent_to_the_daemon(words: Words, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []

    def watch(_client: Client, names: list[str] | None, **options: Any) -> None:
        asked.append((names, options["rate_hz"], options["convention"], options["latency_ms"]))
        raise KeyboardInterrupt

    monkeypatch.setattr(Client, "watch", watch)
    cli(*words, status=130)
    cli(*words, "--json", "imu1", "imu0", status=130)
    cli(*words, "--rate", 5, "--latency", 12.5, "--convention", "enu-flu", status=130)
    assert asked == [
        (None, 10.0, None, None), (["imu1", "imu0"], None, None, None), (None, 5.0, "enu-flu", 12.5),
    ]  # fmt: skip


def test_mistakes_are_found_before_the_daemon_is_asked(tmp_path: Path, cli: Cli) -> None:
    error = cli("watch", "--socket", tmp_path / "none", "--fields", "seq,gyro", status=2).err
    assert error.startswith(
        'imud watch: --fields: expected a field that imud knows, got "gyro"; did you mean gyro_rad_s?'
    )
    assert error.count("\n") == 1
    cli.refuses("not allowed with argument", "watch", "--json", "--format", "csv")


def test_a_reader_that_ends_is_no_error_and_an_interrupt_ends_it_quietly(words: Words) -> None:
    for form in ("table", "json", "csv"):
        with imud_process(*words, "--format", form) as watch:
            assert watch.out.readline()
            watch.out.close()
            assert watch.end() == ("", ""), form
    with imud_process(*words) as watch:
        assert watch.out.readline()
        assert watch.end(signal.SIGINT, status=130).err == ""


def test_without_follow_the_end_of_the_daemon_is_an_error(tmp_path: Path) -> None:
    with ExitStack() as stack:
        with daemon(tmp_path) as served, samples_of(served):
            watch = stack.enter_context(imud_process("watch", "--socket", served.path, "--json"))
            assert watch.out.readline()
        error = watch.end(status=2).err
    assert error.count("\n") == 1
    assert "the daemon closed the connection" in error


def test_follow_begins_before_the_daemon_and_goes_on_after_its_restart(tmp_path: Path) -> None:
    options = ("--follow", "--format", "csv", "--fields", "device,seq")
    with imud_process("watch", "--socket", tmp_path / "imud.sock", *options) as watch:
        assert "is imud running?" in watch.err.readline()
        with daemon(tmp_path) as served, samples_of(served, ["imu0"]):
            assert watch.out.readline() == "device,seq\n"
            assert watch.out.readline().startswith("imu0,")
            assert watch.err.readline() == "imud watch: connected again\n"
        assert watch.err.readline().endswith("; waiting for the daemon\n")
        with daemon(tmp_path) as served, samples_of(served, ["imu1"]):
            line = next(line for line in watch.out if not line.startswith("imu0,"))
            assert line.startswith("imu1,")  # without a second header
        watch.end(signal.SIGINT, status=130)
