"""A daemon that replays captures and records them. The published samples are stored for a comparison."""

from collections.abc import Sequence
from pathlib import Path
from random import Random

import pytest

from imud import config
from imud.contracts.publisher import Batch
from imud.daemon import Daemon
from imud.host import event_loop
from imud.model.event import Event
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.support.files import CaptureWriter, hi91, imu61x_log

FRAMES = 300
BEGIN_NS = 1000 * NS_PER_S


class Collector:
    def __init__(self) -> None:
        self.samples: list[Sample] = []
        self.events: list[Event] = []

    def publish(self, batch: Batch) -> None:
        self.samples += batch.samples

    def event(self, event: Event) -> None:
        self.events.append(event)

    def start(self) -> None: ...
    def add_device(self, name: str, device_id: int) -> None: ...
    def remove_device(self, name: str) -> None: ...
    def tick(self, now_ns: int) -> None: ...
    def close(self) -> None: ...


def stamped_capture(file: Path, seed: int = 1) -> Path:
    """Return a capture of a device at 100 Hz behind an adapter that delays bytes."""
    random = Random(seed)
    with file.open("wb") as out:
        writer = CaptureWriter(out, driver="hipnuc-uart", baud=115200)
        for number in range(FRAMES):
            late_ns = random.randrange(8 * NS_PER_MS)
            writer.write(hi91(10 * number), BEGIN_NS + number * 10 * NS_PER_MS + late_ns)
    return file


def run_recorded(
    folder: Path, *, more: str = "", recorder: str = "enabled: true", speed: str = "maximum", can_frames: int = 200
) -> tuple[Daemon, Collector, Sequence[Path]]:
    """Run a daemon with a serial device and a CAN device to the end of their captures.

    Return the daemon, the published samples, and the recorded files.
    """
    stamped_capture(folder / "serial.capture")
    (folder / "can.log").write_text(imu61x_log(range(can_frames)))
    text = f"""
recorder: {{directory: {folder / "recordings"}, {recorder}}}
socket: {{enabled: false}}
shm: {{enabled: false}}
metrics: {{enabled: false}}
devices:
  bow:
    driver: hipnuc-uart
    replay: {{path: {folder / "serial.capture"}, speed: {speed}}}
  mast:
    driver: imu61x-can
    replay: {{path: {folder / "can.log"}, speed: {speed}}}
    {more}
"""
    collector = Collector()
    daemon = Daemon(config.parse(text, "imud.yaml"), extra={"test": collector}, until_finished=True)
    with pytest.MonkeyPatch.context() as patch:
        # on a busy host, the recorder would start the second device at the next tick, in the middle of its replay
        patch.setattr("imud.publishers.recorder.writer.BEGIN_NS", NS_PER_S)
        event_loop.run(daemon.run())
    return daemon, collector, sorted((folder / "recordings").glob("*.imudrec"))
