"""Captures through codecs and clocks: the samples and times of `imud replay`."""

from io import BytesIO
from pathlib import Path

import pytest

from imud.contracts.publisher import Batch
from imud.drivers import DRIVERS
from imud.formats.can import CandumpReader, CanFrame
from imud.formats.capture import CaptureReader
from imud.model.errors import BadArgument
from imud.model.sample import T_ERR_MOST, Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.recording.capture_player import CapturePlayer, KnownTimes
from tests.support.fake_drivers import FAKE_DRIVER, fake_frame
from tests.support.files import BEGIN_NS as LOG_NS
from tests.support.files import CaptureWriter, candump_line, hi91, imu61x_log

BEGIN_NS = 5000 * NS_PER_S


class Played:
    def __init__(self, driver: str) -> None:
        self.samples: list[Sample] = []
        self.batches: list[int] = []  # number of samples in each batch
        row = DRIVERS[driver]
        self.player = CapturePlayer(self.publish, row, row.settings(), "file")

    def publish(self, batch: Batch) -> None:
        self.samples += batch.samples
        self.batches.append(len(batch.samples))

    @property
    def counted(self) -> dict[str, int]:
        return {name: count for name, count in self.player.device.ledger.snapshot().items() if count}


def stamped(count: int = 300, details: dict[str, str | int] | None = None) -> BytesIO:
    out = BytesIO()
    writer = CaptureWriter(out, driver="hipnuc-uart", baud=115200, details=details)
    for number in range(count):
        writer.write(hi91(10 * number), BEGIN_NS + number * 10 * NS_PER_MS + 8 * NS_PER_MS)
    writer.write(hi91(0)[:30], BEGIN_NS + count * 10 * NS_PER_MS)  # a frame that the end of the capture cuts
    out.seek(0)
    return out


def test_a_stamped_capture_has_the_times_of_its_reads_and_utc_if_it_says_when_it_began() -> None:
    played = Played("hipnuc-uart")
    played.player.play_bytes(CaptureReader(stamped()), 0)
    assert played.player.times is KnownTimes.MONOTONIC
    assert [sample.seq for sample in played.samples] == list(range(1, 301))
    last = played.samples[-1]
    read_ns = BEGIN_NS + 299 * 10 * NS_PER_MS + 8 * NS_PER_MS
    assert last.t_rx_ns == read_ns
    assert 0 < read_ns - last.t_ns < 8 * NS_PER_MS  # 82 bytes at 115200 baud are 7.1 ms
    assert last.utc_ns - last.t_ns == -(BEGIN_NS + 8 * NS_PER_MS)
    assert played.player.device.ledger.closes()
    assert played.counted == {
        "bytes_in": 24630, "bytes_in_good_frames": 24600, "bytes_skipped": 30, "frames_good": 300,
        "frames_in_samples": 300, "samples": 300,
    }  # fmt: skip
    played = Played("hipnuc-uart")
    played.player.play_bytes(CaptureReader(stamped(details={"start_utc_ns": 1_763_717_507 * NS_PER_S})), 0)
    assert played.player.times is KnownTimes.HOST
    sample = played.samples[50]
    assert sample.utc_ns - sample.t_ns == 1_763_717_507 * NS_PER_S - (BEGIN_NS + 8 * NS_PER_MS)


def test_a_raw_capture_has_the_time_of_the_device_or_of_the_bytes_on_the_wire() -> None:
    played = Played("hipnuc-uart")
    played.player.play_bytes(CaptureReader(BytesIO(b"".join(hi91(10 * i + 70) for i in range(50)))), 115200)
    assert played.player.times is KnownTimes.NONE
    assert not played.player.times.has_host_times
    for number, sample in enumerate(played.samples):
        t_ns = (10 * number + 70) * NS_PER_MS
        assert (sample.t_ns, sample.utc_ns, sample.t_rx_ns, sample.t_dev_ns) == (t_ns, t_ns, t_ns, t_ns)
        assert sample.t_err_ns == T_ERR_MOST
    assert len(played.samples) == 50
    played = Played("hipnuc-uart")
    played.player.play_bytes(CaptureReader(BytesIO()), 115200)
    assert played.samples == []
    assert played.player.device.path is None
    samples: list[Sample] = []
    player = CapturePlayer(lambda batch: samples.extend(batch.samples), FAKE_DRIVER, FAKE_DRIVER.settings(), "file")
    frame = fake_frame(bytes(94))
    player.play_bytes(CaptureReader(BytesIO(frame * 200)), 100_000)  # 10 ms per frame
    assert len(samples) == 200
    assert samples[-1].t_ns == pytest.approx(2 * NS_PER_S, abs=20 * NS_PER_MS)
    assert samples[100].t_ns == pytest.approx(samples[0].t_ns + NS_PER_S, rel=0.05)


def test_a_log_of_a_can_bus_has_the_wall_clock_and_frames_of_others_are_left_out() -> None:
    lines = imu61x_log(range(600)).splitlines(keepends=True)
    other = candump_line(CanFrame(0x7AA, False, b"\1\2\3", LOG_NS))
    played = Played("imu61x-can")
    played.player.play_frames(CandumpReader(BytesIO("".join([other, *lines]).encode())))
    assert played.player.times is KnownTimes.WALL_CLOCK
    assert (len(played.samples), played.samples[-1].utc_ns) == (600, played.samples[-1].t_ns)
    assert abs(played.samples[-1].t_ns - (LOG_NS + 599 * 10 * NS_PER_MS)) < NS_PER_MS
    assert played.counted == {
        "bytes_in": 24000, "bytes_in_good_frames": 24000, "frames_good": 3000, "frames_in_samples": 3000,
        "samples": 600,
    }  # fmt: skip
    assert played.batches == [51, 51, 51, 51, 52] * 2 + [51, 37]
    # a frame of another device after a step of the clock, within a sample
    before = candump_line(CanFrame(0x7AA, False, b"\1", LOG_NS + 9 * NS_PER_S))
    stepped = Played("imu61x-can")
    stepped.player.play_frames(CandumpReader(BytesIO("".join([*lines[:2], before, *lines[2:]]).encode())))
    assert len(stepped.samples) == 599


def test_a_polled_device_cannot_be_captured(tmp_path: Path) -> None:
    with pytest.raises(BadArgument, match="polls its devices"):
        Played("hipnuc-modbus")
