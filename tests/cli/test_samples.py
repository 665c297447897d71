"""`imud watch` prints samples as text and as JSON; `imud schema` says what their fields mean."""

import json
from pathlib import Path
from threading import Event, Thread

import msgspec
import pytest

from imud.cli import main
from imud.cli.samples import DeviceNotes, as_json, as_text
from imud.sample import Sample, Sync
from tests.support.socket_rig import Daemon, batch, daemon

ONE = Sample("bow", 7, 12_345_678_900, 250_000, Sync.EDGE, 12_350_000_000, 0)


def test_a_line_for_people_has_people_s_units() -> None:
    whole = msgspec.structs.replace(
        ONE, euler_rad=(0.1, -0.2, 3.0), gyro_rad_s=(1.0, 0.0, -1.0), accel_m_s2=(0.0, 0.5, 9.8)
    )
    assert as_text(whole) == (
        "bow             12.345679 s ± 0.250 ms edge        rpy    5.73  -11.46  171.89 °\n"
        "    gyro    57.30     0.00   -57.30 °/s  accel   0.000   0.500   9.800 m/s²"
    )


def test_the_longest_lines_have_80_columns() -> None:
    longest = Sample(
        "n" * 31 + "m", 1, 9_999_999_000_000_000, 5_000_000_000, Sync.REGRESSION, 0, 0, euler_rad=(-3.14,) * 3,
        gyro_rad_s=(-40.0,) * 3, accel_m_s2=(-156.9,) * 3,
    )  # fmt: skip
    first, second = as_text(longest).splitlines()
    assert (len(first), len(second)) == (80, 78)
    assert first.startswith("nnnnn…nnnm 9999999.000000 s ±  5000 ms regression  rpy")


def test_absent_fields_are_left_out() -> None:
    assert as_text(ONE).endswith(" ms edge")
    assert json.loads(as_json(ONE)) == {
        "device": "bow", "seq": 7, "t_ns": 12_345_678_900, "t_err_ns": 250_000, "sync": "edge",
        "t_rx_ns": 12_350_000_000, "utc_ns": 0,
    }  # fmt: skip


def send(served: Daemon, seq: int) -> None:
    served.do(lambda server: server.publish(batch("imu0", seq)))


@pytest.mark.parametrize("form", [[], ["--json"], ["--convention", "ned-frd"]])
def test_watch_ends_after_count_samples(tmp_path: Path, capsys: pytest.CaptureFixture[str], form: list[str]) -> None:
    with daemon(tmp_path) as served:
        ended = Event()

        def publish() -> None:
            seq = 0
            while not ended.wait(0.01):
                seq += 1
                send(served, seq)

        sender = Thread(target=publish)
        sender.start()
        try:
            assert main(["watch", "--socket", str(served.path), "--count", "3", *form, "imu0"]) == 0
        finally:
            ended.set()
            sender.join()
    printed = capsys.readouterr().out.splitlines()
    lines = printed if "--json" in form else [" ".join(pair) for pair in zip(printed[::2], printed[1::2], strict=True)]
    assert len(lines) == 3
    assert all("imu0" in line for line in lines)
    turned = "--convention" in form
    values = "-0.500   0.125  -9.750" if turned else " 0.125  -0.500   9.750"
    assert "--json" in form or all(line.endswith(f"accel  {values} m/s²") for line in lines), lines
    if "--json" in form:
        seqs = [json.loads(line)["seq"] for line in lines]
        assert seqs == [seqs[0], seqs[0] + 1, seqs[0] + 2]


def test_schema_names_the_status_bits_of_each_driver(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "magnetic disturbance" in line)
    assert row.split()[:2] == ["hipnuc-uart", "4"]
    assert main(["schema", "--json"]) == 0
    assert '"status_bits":{"3":"gyroscope bias not converged",' in capsys.readouterr().out


def test_schema_names_every_field_with_its_unit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema"]) == 0
    text = capsys.readouterr().out
    for word in ("accel_m_s2", "m/s²", "gyro_rad_s", "rad/s", "hipnuc-uart", "ENU"):
        assert word in text


def test_a_device_that_is_gone_is_told_once_and_when_it_is_back(capsys: pytest.CaptureFixture[str]) -> None:
    class Answers:
        """A client whose daemon's devices are these."""

        def __init__(self) -> None:
            self.found = [{"name": "bow", "state": "running", "problem": ""}]

        def devices(self) -> list[dict[str, str]]:
            return self.found

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
    assert (
        capsys.readouterr().err == "imud watch: bow is not in the configuration any more\nimud watch: bow is running\n"
    )
