"""Status of a device as rows of name and text."""

import pytest
from msgspec.structs import replace

from imud.attitude.conventions import Heading
from imud.bridges.status import axes, declared, driven, parts, rows, utc, watched
from imud.contracts.setting import OnDifference, SettingDifference, SettingsState, SettingsStatus
from imud.contracts.status import FrameStatus, LinesStatus, UtcStatus
from imud.model.sample import Position
from tests.support.metrics import LINES, UTC, device, equipped

STATUS = replace(
    equipped("bow"), settings={"mode": "6-axis"}, status_bits=4, status_words=("gyroscope-saturated",),
    status_bit_names={"2": "gyroscope-saturated"}, hold_ns=5_000_000, hold_by="shared memory",
    declared=SettingsStatus(
        SettingsState.DIFFER, OnDifference.REPORT, differences={"mode": SettingDifference("9-axis", "6-axis")},
        unverified=("baud",),
    ),
)  # fmt: skip
"""A status with all optional parts."""
WORDS = {
    "clock": ("edge, skew -40.00 ppm, residual 30.0 µs, error 0.004 ms, 2 resets",),
    "polling": ("1000 reads, 20 late, 3 missed", "vanished 6 times"),
    "line": ("11 requests without a reply",),
    "sout": ("5000 edges, 7 lost",),
    "alarm": ("ACTIVE, raised 3 times; 2 edges, 0 lost (/dev/gpiochip0 is not there)",),
    "pulses": ("4998, 9 without a sample, 21 triggers without a frame; 17 samples without a pulse",),
    "settings": ('mode is "6-axis", declared "9-axis"', "not reported by the device: baud"),
    "status": ("gyroscope-saturated",),
    "present": ("mode 6-axis",),
    "latency": ("batching 5 ms", "shared memory"),
}


def test_rows_contain_each_counter_of_the_status() -> None:
    full = dict(rows(STATUS))
    for name, words in WORDS.items():
        for one in words:
            assert one in full[name], name
    assert list(parts(device("bow"))) == []
    frame = FrameStatus("body: x forward", "ned-frd", "ZYX", "NED", Heading.TRUE, -3.5, {}, "its z axis points down")
    assert axes(frame) == "ned-frd, body: x forward; heading true with a declination of -3.5°"
    ignored = replace(frame, heading=Heading.RELATIVE)
    assert axes(ignored) == "ned-frd, body: x forward; heading relative to power-on; declination_deg is ignored"
    own = replace(frame, frame="sensor: x right", convention="device", declination_deg=None, problem="")
    assert axes(own) == "sensor: x right; heading true"


def test_lines_utc_settings_and_status_bits() -> None:
    lines = LinesStatus({"sin": "GPIO4 is in use by another program"}, {}, {}, sin=True)
    for alarm, words in ((True, "ACTIVE"), (False, "inactive"), (None, "level unknown")):
        assert watched(replace(LINES, alarm=alarm), "alarm", 2).startswith(f"{words}, raised")
    assert driven(lines).endswith("(GPIO4 is in use by another program)")
    assert [name for name, _ in parts(device("bow", lines=LinesStatus({}, {}, {}, sin=True)))] == ["sin"]
    unsaved = SettingsStatus(SettingsState.UNDECLARED, OnDifference.REPORT, unsaved=True)
    assert dict(parts(device("bow", declared=unsaved)))["unsaved"].endswith("run `imud command bow save`")
    unseen = SettingsStatus(SettingsState.DIFFER, OnDifference.REPORT, "no reply", {}, ("mode", "baud"))
    assert declared(unseen) == "differ; not reported by the device: mode, baud (no reply)"
    lines = LinesStatus({"reset": "GPIO5 is in use by another program"}, {}, {})
    assert list(parts(device("bow", lines=lines))) == [("reset", "GPIO5 is in use by another program")]
    assert utc(UtcStatus("", "")) == "no pulse and no sentence yet"
    assert utc(UtcStatus("", "", pulses=3)) == "3 pulses, 0 ignored"
    assert utc(replace(UTC, refused={}, pulses=0, pulses_ignored=0, chrony_refused=0, chrony_sent=0,
                                       problem="")) == "gpsd at 127.0.0.1:2947: 100 sentences, 90 sent"  # fmt: skip
    shown = replace(
        device("bow"), settings={"mode": "6-axis", "output.hi91": "100 Hz"}, status_bits=1 << 5,
        status_words=("accelerometer over range",), status_bit_names={"5": "accelerometer over range"},
    )  # fmt: skip
    assert dict(parts(shown)) == {"status": "accelerometer over range", "present": "mode 6-axis, output.hi91 100 Hz"}
    assert dict(parts(replace(shown, status_bits=0, status_words=())))["status"] == "no known bit is set"


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (Position(0.5, -1.25), "28.6478898°, -71.6197244°"),
        (Position(0.5, -1.25, 42.5, 0, 17), "28.6478898°, -71.6197244°, 42.50 m, quality 0, satellites 17"),
    ],
)
def test_position(place: Position, words: str) -> None:
    assert dict(parts(device("bow", position=place))) == {"position": words}
