"""`imud export`: the output, read by csv, mcap and rosbags, is equal to the published samples."""

import csv
import json
import os
import sys
import threading
from collections.abc import Iterator
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from imud.attitude.conventions import FLU_LEVEL, RFU_ENU, Convention
from imud.attitude.published import as_sent
from imud.cli.export import ExportFile
from imud.cli.export_sources import recorded_facts
from imud.contracts.publisher import Batch
from imud.contracts.status import Deviations
from imud.formats.recording import BlockGatherer, RecordingReader
from imud.formats.records import (
    NO_DEVICE,
    CallRecord,
    ClocksRecord,
    Kind,
    SessionRecord,
    encode,
    encode_clocks,
    encode_object,
)
from imud.model.errors import BadArgument, ImudError
from imud.model.event import Event, EventKind
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.cli.captures import resting, write_capture
from tests.cli.conftest import Cli
from tests.cli.recorded_daemon import FRAMES, run_recorded, stamped_capture
from tests.support.files import hi91, imu61x_log

EVENTS = (
    Event(1 * NS_PER_S, "bow", EventKind.UP, "is there", {"rate_hz": 100.0}),
    Event(2 * NS_PER_S, "mast", cast("EventKind", "new-kind"), "of a newer imud"),
    Event(3 * NS_PER_S, "", EventKind.RECORDER, "the disk is full"),
)


class Recorded(NamedTuple):
    file: Path
    samples: list[Sample]

    def of(self, device: str) -> list[Sample]:
        """Return the samples of a device in the axes of REP-103."""
        mine = [sample for sample in self.samples if sample.device == device]
        frame = as_sent(RFU_ENU if device == "bow" else FLU_LEVEL)
        return list(Batch(device, 0, mine, frame).converted(Convention.ENU_FLU).samples)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    _, collector, (file,) = run_recorded(tmp_path_factory.mktemp("recorded"))
    return Recorded(copied(file, file, *(encode_object(Kind.EVENT, 0, event) for event in EVENTS)), collector.samples)


def copied(source: Path, target: Path, *more: bytes) -> Path:
    """Copy a recording. Add records before its end."""
    gatherer, data = BlockGatherer(), b""
    with source.open("rb") as stream:
        for record in RecordingReader(stream, source.name):
            for added in more if record.kind == Kind.END else ():
                data += gatherer.add(added)
            data += gatherer.add(encode(Kind(record.kind), record.device, record.body))
    target.write_bytes(data + gatherer.finish())
    return target


def rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(StringIO(text, newline="")))


# --- CSV --------------------------------------------------------------------------------------------------------------


def test_csv_has_every_sample_with_all_its_digits(recorded: Recorded, cli: Cli) -> None:
    printed = cli("export", "--to", "csv", recorded.file)
    found = rows(printed.out)
    assert len(found) == len(recorded.samples) > FRAMES
    for row, sample in zip(found, recorded.samples, strict=True):
        assert (row["device"], int(row["seq"]), int(row["t_ns"])) == (sample.device, sample.seq, sample.t_ns)
        assert (int(row["t_err_ns"]), row["sync"], int(row["utc_ns"])) == (sample.t_err_ns, sample.sync, sample.utc_ns)
        assert sample.accel_m_s2 is not None
        assert tuple(float(row[f"accel_{axis}_m_s2"]) for axis in "xyz") == sample.accel_m_s2
    assert {row["mag_x_t"] for row in found if row["device"] == "mast"} == {""}
    assert "equal to the live run" in printed.err
    assert f"{len(found)} samples to standard output" in printed.err


def test_csv_of_rfc_4180_chosen_fields_events_and_losses(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    cli("export", "-o", tmp_path / "a.csv", recorded.file)
    for words in (["-o", tmp_path / "a.txt"], []):
        problem = "expected --to, or an output file with the suffix .csv or .mcap, got "
        cli.refuses(problem, "export", recorded.file, *words)
    lines = (tmp_path / "a.csv").read_bytes().split(b"\r\n")
    assert lines[-1] == b""
    assert b"\n" not in b"".join(lines)
    assert len({line.count(b",") for line in lines[:-1]}) == 1
    words = ["export", "--to", "csv", "--device", "mast", "--fields", "gyro_rad_s,t_ns", str(recorded.file)]
    found = rows(cli(*words).out)
    assert list(found[0]) == ["gyro_x_rad_s", "gyro_y_rad_s", "gyro_z_rad_s", "t_ns"]
    assert len(found) == sum(sample.device == "mast" for sample in recorded.samples)
    events = rows(cli("export", "--to", "csv", "--table", "events", recorded.file).out)
    assert [(one["device"], one["kind"], one["t_ns"]) for one in events[-3:]] == [
        (event.device, event.kind, str(event.t_ns)) for event in EVENTS
    ]
    newest = recorded.samples[-1]
    for one in events[-3:]:
        offset_ns = int(one["utc_ns"]) - int(one["t_ns"])
        assert abs(offset_ns - (newest.utc_ns - newest.t_ns)) < NS_PER_MS
    losses = rows(cli("export", "--to", "csv", "--table", "losses", recorded.file).out)
    assert {(one["device"], one["lost_crc"]) for one in losses} == {("bow", "0"), ("mast", "0")}


# --- MCAP -------------------------------------------------------------------------------------------------------------


def messages(file: Path) -> Iterator[tuple[str, str, int, bytes]]:
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False):
            assert schema is not None
            yield channel.topic, schema.name, message.log_time, message.data


def test_mcap_with_json(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / "a.mcap"
    cli("export", "--to", "mcap", "-o", out, recorded.file)
    found: dict[str, list[Any]] = {}
    for topic, _, t_ns, data in messages(out):
        found.setdefault(topic, []).append((t_ns, json.loads(data)))
    assert set(found) == {
        "/bow/imu/data", "/bow/imu/mag", "/bow/temperature", "/bow/pressure", "/bow/attitude", "/bow/stamp",
        "/bow/losses", "/mast/imu/data", "/mast/temperature", "/mast/attitude", "/mast/stamp", "/mast/losses",
        "/events", "/diagnostics",
    }  # fmt: skip
    for device in ("bow", "mast"):
        samples = recorded.of(device)
        for (t_ns, imu), (_, stamp), sample in zip(
            found[f"/{device}/imu/data"], found[f"/{device}/stamp"], samples, strict=True
        ):
            assert t_ns == sample.utc_ns == imu["timestamp"]["sec"] * 10**9 + imu["timestamp"]["nsec"]
            assert tuple(imu["linear_acceleration"].values()) == sample.accel_m_s2
            assert tuple(imu["angular_velocity"].values()) == sample.gyro_rad_s
            assert (stamp["seq"], stamp["t_err_ns"], stamp["sync"]) == (sample.seq, sample.t_err_ns, sample.sync)
    frames = {one["child_frame_id"]: one["parent_frame_id"] for topic in ("bow", "mast")
              for _, one in found[f"/{topic}/attitude"]}  # fmt: skip
    assert frames == {"bow": "enu", "mast": "mast_level"}
    assert [one["message"] for _, one in found["/events"]][-3:] == [
        "up: is there", "new-kind: of a newer imud", "recorder: the disk is full"
    ]  # fmt: skip


def test_mcap_with_ros_2_is_a_bag_for_rosbags(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / "a.mcap"
    cli("export", "--to", "mcap", "--schema", "ros2", "-o", out, recorded.file)
    found: dict[str, list[Any]] = {}
    with AnyReader([out]) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        for connection, t_ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((t_ns, reader.deserialize(data, connection.msgtype)))
    assert (types["/bow/imu/data"], types["/bow/imu/mag"]) == ("sensor_msgs/msg/Imu", "sensor_msgs/msg/MagneticField")
    assert types["/bow/pressure"] == "sensor_msgs/msg/FluidPressure"
    assert (types["/tf"], types["/events"]) == ("tf2_msgs/msg/TFMessage", "rcl_interfaces/msg/Log")
    assert types["/diagnostics"] == "diagnostic_msgs/msg/DiagnosticArray"
    for device in ("bow", "mast"):
        for (t_ns, imu), (_, stamp), sample in zip(
            found[f"/{device}/imu/data"], found[f"/{device}/stamp"], recorded.of(device), strict=True
        ):
            header, force, turn = imu.header, imu.linear_acceleration, imu.orientation
            assert t_ns == sample.utc_ns == header.stamp.sec * 10**9 + header.stamp.nanosec
            assert (header.frame_id, (force.x, force.y, force.z)) == (device, sample.accel_m_s2)
            assert (turn.w, turn.x, turn.y, turn.z) == sample.quat_wxyz
            assert (stamp.seq, stamp.t_ns, stamp.t_err_ns) == (sample.seq, sample.t_ns, sample.t_err_ns)
    assert (len(found["/tf"]), found["/bow/losses"][0][1].lost_crc) == (len(recorded.samples), 0)


def test_diagnostics_have_losses_states_and_errors(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    """Errors come from a recording, losses come from a capture with 7 lost samples."""
    accel, gyro = resting(1500, 100.0)
    gap = write_capture(tmp_path / "gap.capture", accel, gyro, rate_hz=100.0, missing=range(700, 707))
    for file in (recorded.file, gap):
        out = tmp_path / f"{file.name}.mcap"
        cli("export", "--to", "mcap", "--schema", "ros2", "-o", out, file)
        with AnyReader([out]) as reader:
            found = [
                (t_ns, reader.deserialize(data, connection.msgtype))
                for connection, t_ns, data in reader.messages()
                if connection.topic == "/diagnostics"
            ]
        if file == gap:
            break
        by_device = {one.name: one for _, array in found for one in array.status}  # type: ignore[attr-defined]
        assert by_device.keys() == {"imud: bow", "imud: mast"}
        newest = {one.key: one.value for one in by_device["imud: bow"].values}
        sample = next(one for one in recorded.of("bow") if str(one.seq) == newest["samples"])
        assert (newest["t_err_ns"], newest["sync"]) == (str(sample.t_err_ns), sample.sync)
    arrays: list[Any] = [array for _, array in found]
    statuses = [array.status[0] for array in arrays]
    assert [one.level for one in statuses] == 7 * [statuses[0].OK] + 8 * [statuses[0].WARN]
    lost = [{one.key: one.value for one in status.values}["lost_gap_device"] for status in statuses]
    assert lost == 7 * ["0"] + 8 * ["7"]
    stamps_ns = [array.header.stamp.sec * 10**9 + array.header.stamp.nanosec for array in arrays]
    assert [t_ns for t_ns, _ in found] == [max(stamp_ns, 0) for stamp_ns in stamps_ns], "MCAP begins in 1970"


def test_covariances_come_from_the_configuration_and_from_reports(tmp_path: Path, cli: Cli) -> None:
    pytest.importorskip("scipy", reason="the analysis needs the extra imud[analysis]")
    accel, gyro = resting(12_000, 100.0)
    resting_file = write_capture(tmp_path / "rest.capture", accel, gyro, rate_hz=100.0)
    _, _, (file,) = run_recorded(tmp_path, more="noise: {gyro_rad_s: 0.5, attitude_rad: 0.25}")
    report = json.loads(cli("noise", "--json", resting_file).out)
    report["measurement"]["device"] = "mast"
    (tmp_path / "mast.json").write_text(json.dumps(report))
    sigma = sum(axis["spread"]["value"] ** 2 for axis in report["sensors"]["gyro"]["axes"].values()) / 3
    for words, variance in (([], 0.25), (["--noise", str(tmp_path / "mast.json")], sigma)):
        out = tmp_path / "a.mcap"
        cli("export", "--to", "mcap", "--schema", "ros2", "--force", *words, "-o", out, file)
        with AnyReader([out]) as reader:
            imu: dict[str, Any] = {
                connection.topic: reader.deserialize(data, connection.msgtype)
                for connection, _, data in reader.messages()
                if connection.topic.endswith("/imu/data")
            }
        mast = imu["/mast/imu/data"]
        assert list(mast.angular_velocity_covariance) == pytest.approx([variance, 0, 0, 0, variance, 0, 0, 0, variance])
        assert mast.orientation_covariance[8] == 0.0625
        assert not any(imu["/bow/imu/data"].angular_velocity_covariance)


def test_the_noise_of_a_device_that_is_described_after_samples_of_another_one(tmp_path: Path) -> None:
    """The daemon describes a device at its start. Another device can send samples before that."""
    _, _, (file,) = run_recorded(tmp_path, more="noise: {gyro_rad_s: 0.5}")
    with file.open("rb") as stream:
        records = list(RecordingReader(stream, file.name))
    late = next(one for one in records if b"gyro_rad_s" in bytes(one.body) and one.kind == Kind.DEVICE)
    gatherer, data = BlockGatherer(), b""
    for record in [*(one for one in records if one is not late and one.device != late.device), late]:
        data += gatherer.add(encode(Kind(record.kind), record.device, record.body))
    for number, target in enumerate(("host", "clock")):  # only the first is the state of the host's clocks
        call = CallRecord(target, "restore", [b"", 7_000_000_000 + number, 1 + number])
        data += gatherer.add(encode(Kind.CALL, NO_DEVICE, msgspec.msgpack.encode(call)))
    facts = recorded_facts(BytesIO(data + gatherer.finish()), "a")
    assert facts.noise == {"mast": Deviations(gyro_rad_s=0.5)}
    assert (facts.clock.utc_ns(5, 0), facts.clock.utc_ns(10**18, 0)) == (7_000_000_005, 10**18 + 7_000_000_000)


@pytest.mark.parametrize("way", ["step", "suspend", "joined"])
def test_rows_before_a_step_of_the_wall_clock(recorded: Recorded, tmp_path: Path, cli: Cli, way: str) -> None:
    """imud places all rows with the last offset of their run, and rows before a suspend with the last offset before
    it, because CLOCK_MONOTONIC stops during a suspend."""
    step_ns, newest = 1168 * 86_400 * NS_PER_S, recorded.samples[-1]
    last = ClocksRecord(newest.t_ns + 1, 1, 1, 1, newest.utc_ns - newest.t_ns + step_ns, way == "suspend")
    other = encode_object(Kind.SESSION, NO_DEVICE, SessionRecord(1, "", "", "", 7, 0, 0, 0))
    file = copied(recorded.file, tmp_path / "a.imudrec", *[other] * (way == "joined"), encode_clocks(last))
    shift_ns = step_ns if way == "step" else 0
    found = rows(cli("export", "--to", "csv", file).out)
    for row, sample in zip(found, recorded.samples, strict=True):
        assert abs(int(row["utc_ns"]) - sample.utc_ns - shift_ns) < NS_PER_MS
    begun, before = (json.loads(cli("info", "--json", one).out)["begun_utc_ns"] for one in (file, recorded.file))
    assert abs(begun - before - shift_ns) < NS_PER_MS
    cli("export", "--to", "mcap", "-o", tmp_path / "a.mcap", file)
    (first, *_), (*_, last_event) = (
        [t_ns for topic, _, t_ns, _ in messages(tmp_path / "a.mcap") if topic == wanted]
        for wanted in ("/bow/stamp", "/events")
    )
    assert abs(first - recorded.of("bow")[0].utc_ns - shift_ns) < NS_PER_MS
    assert abs(last_event - (newest.utc_ns - newest.t_ns + EVENTS[-1].t_ns) - shift_ns) < NS_PER_MS


def test_fields_choose_channels_and_ned_has_frames_of_its_own(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    out = tmp_path / "a.mcap"
    words = ("export", "--to", "mcap", "--device", "bow", "--force", "-o", out, recorded.file)
    cli(*words, "--fields", "mag_t,temperature_c")
    topics = {topic for topic, *_ in messages(out)}
    assert topics == {"/bow/imu/mag", "/bow/temperature", "/bow/losses", "/events", "/diagnostics"}
    cli(*words, "--convention", "ned-frd")
    found = [json.loads(data) for topic, _, _, data in messages(out) if topic in ("/bow/imu/data", "/bow/attitude")]
    assert {one.get("frame_id", one.get("child_frame_id")) for one in found} == {"bow_frd"}
    assert {one["linear_acceleration"]["z"] for one in found if "linear_acceleration" in one} == {-9.8}


# --- captures ---------------------------------------------------------------------------------------------------------


def test_raw_and_stamped_captures_and_a_log_of_candump_have_their_times(tmp_path: Path, cli: Cli) -> None:
    (tmp_path / "c.raw").write_bytes(b"".join(hi91(10 * i) for i in range(300)))
    printed = cli("export", "--to", "csv", tmp_path / "c.raw")
    found = rows(printed.out)
    assert len(found) == 300
    for name in ("t_ns", "t_err_ns", "sync", "t_rx_ns", "utc_ns"):
        assert {row[name] for row in found} == {""}
    assert [int(row["t_dev_ns"]) for row in found] == [10_000_000 * i for i in range(300)]
    words = " ".join(printed.err.split())
    assert "without the times of the reads" in words
    assert "Hz" not in words
    assert "live run" not in words
    (tmp_path / "c.raw").write_bytes(b"".join(hi91(10 * i) for i in range(30)))
    out = tmp_path / "c.mcap"
    cli("export", "--to", "mcap", "-o", out, tmp_path / "c.raw")
    stamps = [(t_ns, json.loads(data)) for topic, _, t_ns, data in messages(out) if topic == "/replay/stamp"]
    assert [t_ns for t_ns, _ in stamps] == [10_000_000 * i for i in range(30)]
    assert {one["t_err_ns"] for _, one in stamps} == {0xFFFF_FFFF}
    with out.open("rb") as stream:
        (metadata,) = [one.metadata for one in make_reader(stream).iter_metadata()]
    assert "without the times of the reads" in metadata["times"]
    printed = cli("export", "--to", "csv", stamped_capture(tmp_path / "c.capture"))
    found = rows(printed.out)
    assert len(found) == FRAMES
    assert abs(int(found[-1]["t_ns"]) - (1000 * 10**9 + 299 * 10**7)) < 10**7
    assert int(found[0]["utc_ns"]) < 10**7
    assert "and no time of day" in " ".join(printed.err.split())
    (tmp_path / "can.log").write_text(imu61x_log(range(200)))
    printed = cli("export", "--to", "csv", "--driver", "imu61x-can", tmp_path / "can.log")
    found = rows(printed.out)
    assert len(found) == 200
    assert abs(int(found[100]["utc_ns"]) - (1_763_717_507 * 10**9 + 100 * 10**7)) < 10**6
    assert "contains only the wall clock" in " ".join(printed.err.split())


# --- what goes wrong --------------------------------------------------------------------------------------------------


def test_damaged_recordings_and_refused_files_and_options(recorded: Recorded, tmp_path: Path, cli: Cli) -> None:
    data, damaged, out = recorded.file.read_bytes(), tmp_path / "damaged", tmp_path / "a.csv"
    damaged.write_bytes(data[:-40] + bytes(20) + data)
    printed = cli("export", "--to", "csv", "-o", out, damaged, status=1)
    assert "damaged" in printed.err + cli("replay", damaged, status=1).err
    assert len(rows(out.read_text())) >= len(recorded.samples)
    (tmp_path / "noise").write_bytes(b"\x00" * 500)
    cli("export", "--to", "csv", tmp_path / "noise", status=1)
    cli.refuses("expected a recording or a capture", "export", "--to", "csv", str(tmp_path / "none"))
    (tmp_path / "c.raw").write_bytes(hi91(0))
    words = ("export", "--to", "csv", "--driver", "hipnuc-modbus", tmp_path / "c.raw")
    cli.refuses("expected a driver of bytes or CAN frames", *words)
    words = ("export", "--to", "csv", "--device", "bow", tmp_path / "c.raw")
    cli.refuses("--device applies to recordings only; a capture contains one device", *words)
    for options, expected in [
        (["--to", "csv", "--schema", "ros2"], "--schema applies to --to mcap only"),
        (["--to", "csv", "--noise", "a.json"], "--noise applies to --to mcap only"),
        (["--to", "mcap", "--table", "events"], "--table applies to --to csv only"),
        (["--to", "csv", "--fields", "acel_m_s2"], "acel_m_s2"),
        (["--to", "csv", "--table", "events", "--fields", "t_ns"], "--fields applies to --table samples only"),
        (["--to", "csv", "--driver", "hipnuc-uart"], "--driver applies to captures only"),
        (["--to", "csv", "--device", "stern"], "expected a device of the recording: bow, mast"),
    ]:
        cli.refuses(expected, "export", *options, recorded.file)


def test_a_full_disk_and_a_missing_library(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch, cli: Cli, tmp_path: Path
) -> None:
    for to in ("csv", "mcap"):
        cli.refuses("/dev/full: No space left on device", "export", "--to", to, "-o", "/dev/full", recorded.file)
    monkeypatch.setitem(sys.modules, "mcap.records", None)
    monkeypatch.delitem(sys.modules, "imud.bridges.mcap", raising=False)
    cli.refuses(" install 'imud[export]'", "export", "--to", "mcap", "-o", str(tmp_path / "a"), str(recorded.file))
    assert list(tmp_path.iterdir()) == []
    for name in [name for name in sys.modules if name.partition(".")[0] == "mcap"]:
        monkeypatch.setitem(sys.modules, name, None)
    cli("export", "--to", "csv", recorded.file)


def output(path: Path | None, folder: Path, *, force: bool = False, binary: bool = False) -> ExportFile:
    source = folder / "source"
    source.touch()
    return ExportFile(path, source=source, force=force, binary=binary)


def interrupted(out: ExportFile) -> None:
    try:
        with out:
            out.write(b"new")
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        pass


def test_the_file_is_there_when_it_is_whole_and_an_old_one_is_kept_without_force(tmp_path: Path) -> None:
    file = tmp_path / "a"
    with output(file, tmp_path) as out:
        out.write(b"one")
        assert not file.exists()
        out.write(b"two")
    assert (file.read_bytes(), out.written_bytes) == (b"onetwo", 6)
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a", "source"]
    interrupted(output(tmp_path / "b", tmp_path))
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a", "source"]
    file.write_bytes(b"old")
    with pytest.raises(BadArgument, match="replace it with --force"):
        output(file, tmp_path)
    interrupted(output(file, tmp_path, force=True))
    assert file.read_bytes() == b"old"
    with output(file, tmp_path, force=True) as out:
        out.write(b"new")
    assert file.read_bytes() == b"new"


def test_outputs_that_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "source").write_bytes(b"a recording")
    (tmp_path / "link").symlink_to(tmp_path / "source")
    for name in ("source", "link"):
        with pytest.raises(BadArgument, match="name another file"):
            output(tmp_path / name, tmp_path, force=True)
    assert (tmp_path / "source").read_bytes() == b"a recording"
    with pytest.raises(ImudError, match="none/a: No such file or directory"):
        output(tmp_path / "none" / "a", tmp_path)
    out = output(Path("/dev/full"), tmp_path)
    with pytest.raises(ImudError, match="/dev/full: No space left on device"), out:
        out.write(b"x")
    assert Path("/dev/full").is_char_device()
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    with pytest.raises(BadArgument, match="cannot write MCAP to a terminal"):
        output(None, tmp_path, binary=True)
    with output(None, tmp_path):
        pass


def test_a_fifo_is_written_in_place(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    got: list[bytes] = []
    reader = threading.Thread(target=lambda: got.append(fifo.read_bytes()))
    reader.start()
    with output(fifo, tmp_path) as out:
        out.write(b"through")
    reader.join(10)
    assert got == [b"through"]
    assert fifo.is_fifo()


def test_part_of_killed_export_is_removed(tmp_path: Path) -> None:
    """The part of a running export has a lock. Files with other names belong to other programs."""
    killed, other = tmp_path / ".a.4194305.part", tmp_path / ".a.x.part"
    for file in (killed, other):
        file.write_bytes(b"incomplete")
    with output(tmp_path / "a", tmp_path) as running:
        running.write(b"first")
        (part,) = set(tmp_path.glob(".a.*.part")) - {other}
        assert part.read_bytes() == b"first"
        part.rename(tmp_path / ".a.4194306.part")
        with output(tmp_path / "a", tmp_path) as second:
            second.write(b"second")
        assert (tmp_path / ".a.4194306.part").exists(), "the first export runs"
        (tmp_path / ".a.4194306.part").rename(part)
    assert (tmp_path / "a").read_bytes() == b"first"
    assert sorted(file.name for file in tmp_path.iterdir()) == [".a.x.part", "a", "source"]
