"""Files of tests: files of the repository, shared recordings, captures and logs of frames."""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import BinaryIO, Final
from urllib.parse import quote

import pytest

from imud.drivers.hipnuc.uart.codec import encode_hi91
from imud.drivers.imu61x.can import encode_set
from imud.formats.can import DATA_BYTES_MAX, EXTENDED_ID_MAX, FD_LENGTHS, STANDARD_ID_MAX, CanFrame
from imud.formats.capture import MAGIC, RECORD, RECORD_BYTES_MAX, VERSION
from imud.model.units import NS_PER_S, NS_PER_US

ROOT: Final = Path(__file__).parents[2]
SHARED: Final = Path(os.environ.get("IMUD_SHARED") or ROOT.parent / "shared")
UPLOT_MISSING: Final = (
    "" if (ROOT / "imud/web/static/uplot").is_dir() else "no uPlot: install npm, then run python hatch_build.py"
)
needs_uplot: Final = pytest.mark.skipif(bool(UPLOT_MISSING), reason=UPLOT_MISSING)
"""Mark of a test that needs plots in `imud web`."""


FOLDER: Final = SHARED / "data"


def shared(name: str) -> Path:
    """Return the path of a shared file. Skip the test if the file does not exist."""
    path = FOLDER / name
    if not path.is_file():
        pytest.skip(f"{path} is not there: set IMUD_SHARED to the folder with {name}")
    return path


class CaptureWriter:
    """Writes a capture with time stamps. The caller flushes and closes the file."""

    def __init__(
        self, file: BinaryIO, *, driver: str = "", baud: int = 0, details: Mapping[str, str | int] | None = None
    ) -> None:
        """Write the first line without empty values and zeros."""
        self._file = file
        self._newest_ns = -(1 << 63)
        values: dict[str, str | int] = {"driver": driver, "baud": baud, **(details or {})}
        pairs = [f"{key}={quote(str(value), safe='')}" for key, value in values.items() if value not in ("", 0)]
        file.write(MAGIC + " ".join([VERSION, *pairs]).encode("ascii") + b"\n")

    def write(self, data: bytes, t_ns: int) -> None:
        """Append one read. A time that runs backwards is replaced by the previous time."""
        if data:
            self._newest_ns = max(self._newest_ns, t_ns)
        for start in range(0, len(data), RECORD_BYTES_MAX):
            piece = data[start : start + RECORD_BYTES_MAX]
            self._file.write(RECORD.pack(self._newest_ns, len(piece)) + piece)


def candump_line(frame: CanFrame, bus: str = "can0") -> str:
    """Return a frame as a log line with the wall-clock time `t_rx_ns`. Raises ValueError for an invalid frame."""
    most = EXTENDED_ID_MAX if frame.extended else STANDARD_ID_MAX
    if not 0 <= frame.can_id <= most or len(frame.data) not in FD_LENGTHS or frame.t_rx_ns < 0:
        raise ValueError(f"invalid CAN frame: {frame}")
    seconds, ns = divmod(frame.t_rx_ns, NS_PER_S)
    digits = 8 if frame.extended else 3
    flags = "#5" if len(frame.data) > DATA_BYTES_MAX else ""  # BRS and FDF
    data = flags + frame.data.hex().upper()
    return f"({seconds:010d}.{ns // NS_PER_US:06d}) {bus} {frame.can_id:0{digits}X}#{data}\n"


BEGIN_NS = 1_763_717_507_000_000_000
PERIOD_NS = 10_000_000  # 100 samples per second
FRAME_NS = 250_000  # time between two frames of a sample


def imu61x_log(indices: Iterable[int]) -> str:
    """Return samples of an IMU61x at rest, 100 per second according to their index."""
    lines = []
    for index in indices:
        frames = encode_set(
            index=index, accel_m_s2=(0, 0, 9.80665), gyro_rad_s=(0, 0, 0), euler_rad=(0.1, 0.2, 0.3), temperature_c=25.5
        )
        t_ns = BEGIN_NS + index * PERIOD_NS
        for place, (can_id, data) in enumerate(frames):
            lines.append(candump_line(CanFrame(can_id, False, data, t_ns + place * FRAME_NS)))
    return "".join(lines)


def hi91(ms: int, accel_z_m_s2: float = 9.8) -> bytes:
    return encode_hi91(
        system_time_ms=ms, accel_m_s2=(0.0, 0.0, accel_z_m_s2), gyro_rad_s=(0.0, 0.0, 0.0), mag_t=(2e-5, 0.0, -4e-5),
        euler_rad=(0.0, 0.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0), temperature_c=20.0, pressure_pa=1e5,
    )  # fmt: skip
