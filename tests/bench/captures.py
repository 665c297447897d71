"""Captures of simulated devices in motion, and a daemon that replays and records a capture."""

from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, Final, NamedTuple

from imud import config
from imud.daemon import Daemon
from imud.host import event_loop
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.sim.hipnuc.uart import HipnucModule
from imud.sim.hipnuc.uart_settings import HipnucHardware, ModuleSettings, Output
from imud.sim.sensor import StreamModule
from tests.support.files import CaptureWriter

BEGIN_NS: Final = 86_400 * NS_PER_S  # a device that runs for a day
BAUD: Final = 921_600


class Source(NamedTuple):
    driver: str
    rate_hz: int
    make: Callable[[], StreamModule]


def hi91_module(rate_hz: int) -> HipnucModule:
    return HipnucModule(BEGIN_NS, ModuleSettings(baud=BAUD, hi91=Output(period_ms=1000 // rate_hz)), HipnucHardware())


def write_capture(source: Source, seconds: int, path: Path) -> None:
    """Write a capture of the simulated device. The simulated port delivers each burst up to 0.25 ms late."""
    random, module = Random(1), source.make()
    with path.open("wb") as out:
        writer = CaptureWriter(out, driver=source.driver, baud=BAUD)
        for second in range(seconds):
            for burst in module.advance(BEGIN_NS + (second + 1) * NS_PER_S):
                if burst.data:
                    writer.write(burst.data, burst.due_ns + random.randrange(NS_PER_MS // 4))


def record(source: Source, seconds: int, folder: Path, **more: Any) -> Path:
    """Record a simulated device with a daemon for `seconds` of device time. Return the path of the recording.

    `more` contains further arguments of the daemon.
    """
    capture, recordings = folder / "capture", folder / f"{source.driver}-recordings"
    write_capture(source, seconds, capture)
    text = f"""
recorder: {{enabled: true, directory: {recordings}, file_mb: 1000}}
socket: {{enabled: false}}
shm: {{enabled: false}}
metrics: {{enabled: false}}
devices:
  bow: {{driver: {source.driver}, replay: {{path: {capture}, speed: maximum}}}}
"""
    # speed `maximum`: the daemon reads the capture without pauses
    event_loop.run(Daemon(config.parse(text, "imud.yaml"), until_finished=True, **more).run())
    capture.unlink()
    (made,) = recordings.glob("*.imudrec")
    return made
