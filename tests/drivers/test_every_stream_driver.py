"""Every stream driver, from its row in DRIVERS: the requirements of `imud.testing`, lines of text, kinds of damage."""

from dataclasses import replace
from random import Random

import pytest

from imud import drivers as devices
from imud.contracts.codec import BadFrame, BadReason
from imud.contracts.driver import StreamDriver, of_kind
from imud.contracts.script import TextLine
from imud.drivers.imu61x.uart.codec import DEVICE_SYNC, RAW_FRAME, encode_frame
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions
from imud.drivers.imu61x.uart.raw import RawFrame
from imud.testing import driver_tests
from imud.testing.invariants import feed_stream as feed_checked
from imud.testing.stream import IDLE, make

DRIVERS = {driver.name: driver for driver in of_kind(devices.DRIVERS.values(), StreamDriver)}
LAYOUT = RawFrame(type="i16", accel_at=6, gyro_at=0, accel_g_per_lsb=0.001, gyro_deg_s_per_lsb=0.1, timer_at=14)


class RawOptions(Imu61xUartOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    raw_frame: RawFrame | None = LAYOUT


def raw_frame(random: Random) -> bytes:
    """Return a raw frame or an ignored AHRS frame."""
    if random.random() < 0.2:
        return DRIVERS["imu61x-uart"].example_frame(random)
    payload = random.randbytes(LAYOUT.size_bytes + random.choice((0, 0, 3)))
    return encode_frame(DEVICE_SYNC, RAW_FRAME, payload)


DRIVERS["imu61x-uart, raw frames"] = replace(DRIVERS["imu61x-uart"], settings=RawOptions, example_frame=raw_frame)
every_driver = pytest.mark.parametrize("name", list(DRIVERS))

test_stream_drivers = driver_tests(*DRIVERS.values())


def test_text_interrupted_by_frames_is_one_line() -> None:
    driver, random = DRIVERS["hipnuc-uart"], Random(1)
    codec = make(driver)
    frame = driver.example_frame(random)
    events = feed_checked(codec, [b"APP_VER", frame, b"=15", frame + frame + b"6", b"\r", frame, b"\nOK\n"])
    assert [event.text for event in events if isinstance(event, TextLine)] == ["APP_VER=156", "OK"]
    assert codec.ledger.frames_good == 4 + 2
    assert codec.ledger.bytes_pending == codec.ledger.bytes_skipped == 0


@every_driver
def test_damage_is_counted_by_its_kind(name: str) -> None:
    """A wrong bit in the payload is a CRC error, a length without a frame type is a length error."""
    driver = DRIVERS[name]
    frame = driver.example_frame(Random(1))
    length_at = 2 if name == "hipnuc-uart" else 4
    wrong_length = frame[:length_at] + b"\xff\xff" + frame[length_at + 2 :]
    for data, reason in ((frame[:-1] + bytes([frame[-1] ^ 1]), BadReason.CRC), (wrong_length, BadReason.LENGTH)):
        codec = make(driver)
        bad = [event for event in feed_checked(codec, [data + bytes(IDLE)]) if isinstance(event, BadFrame)]
        assert [event.reason for event in bad] == [reason]
        counts = codec.ledger.frames_bad_crc, codec.ledger.frames_bad_length, codec.ledger.frames_good
        assert counts == ((1, 0, 0) if reason is BadReason.CRC else (0, 1, 0))
