"""The complete path with real processes: bytes into a pty, samples from the socket and from shared memory."""

import csv
import os
import pty
import struct
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from math import radians
from pathlib import Path

import pytest

from imud.attitude import rotation
from imud.client.ring import Ring
from imud.drivers.hipnuc.uart.codec import encode_hi91
from imud.model.sample import Sample
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware
from imud.sim.physics import FIELD_ENU_T, Still
from tests.support.daemon_process import LIMIT_S, running_daemon, wait_until
from tests.support.files import SHARED

RECORDING = SHARED / "data" / "hi91-static-100hz.csv"
G = 9.8


@contextmanager
def raw_ports(count: int) -> Iterator[list[tuple[int, str]]]:
    """Yield the masters of raw ptys and the paths of their slaves. The slaves stay open."""
    pairs = [pty.openpty() for _ in range(count)]
    for _, slave in pairs:
        tty.setraw(slave)
    yield [(master, os.ttyname(slave)) for master, slave in pairs]
    for descriptor in chain(*pairs):
        os.close(descriptor)


def device(path: str, **more: object) -> dict[str, object]:
    return {"driver": "hipnuc-uart", "identify": False, "uart": {"port": path, "baud": 921600}, **more}


def f32(value: float) -> float:
    """Return the nearest 32-bit float, as in a frame."""
    result: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return result


Row = dict[str, str]


def frame(row: Row) -> bytes:
    """Return the frame of a row of the recording."""
    acc, gyr, mag = ([float(row[f"{name}_{axis}"]) for axis in "xyz"] for name in ("acc", "gyr", "mag"))
    return encode_hi91(
        system_time_ms=int(row["sys_time"]), accel_m_s2=(acc[0] * G, acc[1] * G, acc[2] * G),
        gyro_rad_s=(radians(gyr[0]), radians(gyr[1]), radians(gyr[2])),
        mag_t=(mag[0] * 1e-6, mag[1] * 1e-6, mag[2] * 1e-6),
        euler_rad=(radians(float(row["roll"])), radians(float(row["pitch"])), radians(float(row["yaw"]))),
        quat_wxyz=(float(row["quat_w"]), float(row["quat_x"]), float(row["quat_y"]), float(row["quat_z"])),
        temperature_c=float(row["temperature"]), pressure_pa=float(row["pressure"]),
        word_1_2=round(float(row["pps_sync_stamp"]) * 1000),
    )  # fmt: skip


def check(sample: Sample, row: Row) -> None:
    """Check that the sample is equal to the row, with the precision of 32-bit floats."""
    assert sample.t_dev_ns == int(row["sys_time"]) * 1_000_000
    expected = {
        "accel_m_s2": [f32(float(row[f"acc_{axis}"])) * G for axis in "xyz"],
        "gyro_rad_s": [radians(f32(float(row[f"gyr_{axis}"]))) for axis in "xyz"],
        "mag_t": [f32(float(row[f"mag_{axis}"])) * 1e-6 for axis in "xyz"],
        "euler_rad": [radians(f32(float(row[name]))) for name in ("roll", "pitch", "yaw")],
        "quat_wxyz": [f32(float(row[f"quat_{axis}"])) for axis in "wxyz"],
    }
    for name, values in expected.items():
        assert getattr(sample, name) == pytest.approx(values, rel=2e-7, abs=1e-12), name
    assert sample.temperature_c == float(row["temperature"])
    assert sample.pressure_pa == pytest.approx(f32(float(row["pressure"])), rel=1e-7)
    assert sample.pps_age_ms == round(float(row["pps_sync_stamp"]) * 1000)


@pytest.mark.live
@pytest.mark.skipif(not RECORDING.exists(), reason=f"the recording {RECORDING} is not on this machine")
def test_every_row_of_a_real_recording_arrives_on_both_ways(tmp_path: Path) -> None:
    with RECORDING.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1000
    with (
        raw_ports(1) as [(master, path)],
        running_daemon(tmp_path, {"bow": device(path)}) as daemon,
        daemon.client() as client,
    ):
        daemon.wait_for("bow", "searching")
        with Ring(tmp_path / "imud.bow") as ring:
            watch = client.watch(timeout_s=LIMIT_S)
            for row in rows:
                os.write(master, frame(row))
            by_socket = [next(watch) for _ in rows]
            wait_until(lambda: ring.newest_seq == 1000, "the ring holds 1000 samples")
            by_shm = ring.read()
        ledger = daemon.wait_for("bow", "running").ledger
    assert (by_shm.missed, by_shm.samples) == (0, by_socket)
    assert [sample.seq for sample in by_socket] == list(range(1, 1001))
    for sample, row in zip(by_socket, rows, strict=True):
        check(sample, row)
        assert sample.t_ns <= sample.t_rx_ns
    times = [sample.t_ns for sample in by_socket]
    assert times == sorted(set(times))
    assert ledger["bytes_in"] == ledger["bytes_in_good_frames"] == 1000 * 82
    assert ledger["frames_good"] == ledger["frames_in_samples"] == ledger["samples"] == 1000
    assert sum(ledger[name] for name in ledger if name.startswith("lost_")) == 0


# --- a device with a known attitude in a body -------------------------------------------------------------------------

BODY = (radians(5.0), radians(-10.0), radians(30.0))
"""Roll, pitch, yaw of the body in enu-flu: left side up by 5°, nose up by 10°, its front 30° to the left of east."""
IN_NED = (radians(5.0), radians(10.0), radians(60.0))
"""Attitude of BODY in ned-frd, computed by hand: right side down by 5°, nose up by 10°, 60° clockwise from north."""
MOUNTINGS: dict[str, tuple[dict[str, object], rotation.Matrix3]] = {
    # lines of the configuration; rows: the axis of the sensor that points forward, left, up
    "side": ({"axes": {"x": "y", "y": "z", "z": "x"}}, ((0, 1, 0), (0, 0, 1), (1, 0, 0))),
    "upside_down": ({"quat_wxyz": [0, 1, 0, 0]}, ((1, 0, 0), (0, -1, 0), (0, 0, -1))),
    "turned_left": ({"euler": {"yaw_deg": 90}}, ((0, -1, 0), (1, 0, 0), (0, 0, 1))),
}


@pytest.mark.live
def test_simulated_modules_in_bodies_of_known_attitude(tmp_path: Path) -> None:
    """The ring and a normal client receive enu-flu; a binary client and `poll` request ned-frd."""
    body = rotation.matrix_from_quat(rotation.quat_from_euler_zyx(BODY))
    up_m_s2 = (body[2][0] * G, body[2][1] * G, body[2][2] * G)
    field_t = rotation.matrix_times(rotation.transposed(body), FIELD_ENU_T)
    with raw_ports(len(MOUNTINGS)) as ports:
        named = zip(MOUNTINGS.items(), ports, strict=True)
        devices = {name: device(path, frame=keys) for (name, (keys, _)), (_, path) in named}
        with running_daemon(tmp_path, devices) as daemon, daemon.client() as plain, daemon.client() as other:
            for (name, (_, mounting)), (master, _) in zip(MOUNTINGS.items(), ports, strict=True):
                daemon.wait_for(name, "searching")
                sensor = rotation.quat_from_matrix(rotation.matrix_product(body, mounting))
                hardware = HipnucHardware(motion=Still(*rotation.euler312_from_quat(sensor)), skew_ppm=0)
                module = HipnucModule(0, None, hardware)
                as_configured = plain.watch([name], timeout_s=LIMIT_S, encoding="json")
                asked = other.watch([name], timeout_s=LIMIT_S, convention="ned-frd")
                os.write(master, b"".join(burst.data for burst in module.advance(int(1.5e9))))
                first, down = next(as_configured), next(asked)
                with Ring(tmp_path / f"imud.{name}") as ring:
                    wait_until(lambda: ring.newest_seq >= 90, "the ring has what was sent")
                    by_shm = ring.latest()
                    assert by_shm is not None
                (polled,) = other.poll([name], convention="ned-frd")
                schema = plain.schema()["devices"][name]
                status = daemon.statuses()[name]
                for one in (first, by_shm):
                    assert one.euler_rad == pytest.approx(BODY, abs=1e-5)
                    assert one.accel_m_s2 == pytest.approx(up_m_s2, abs=1e-4)
                    assert one.mag_t == pytest.approx(field_t, abs=1e-10)
                for one in (down, polled):
                    assert one.euler_rad == pytest.approx(IN_NED, abs=1e-5)
                    assert one.accel_m_s2 == pytest.approx((up_m_s2[0], -up_m_s2[1], -up_m_s2[2]), abs=1e-4)
                    assert one.mag_t == pytest.approx((field_t[0], -field_t[1], -field_t[2]), abs=1e-10)
                assert (schema["convention"], schema["navigation_frame"]) == ("enu-flu", "ENU")
                assert schema["frame"] == "body: x forward, y left, z up (FLU)"
                assert status.frame is not None
                assert (status.frame.problem, status.euler_convention) == ("", schema["euler_convention"])
