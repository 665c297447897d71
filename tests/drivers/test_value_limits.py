"""No driver lets an impossible value pass, and no output raises."""

import struct
from collections.abc import Iterable
from io import BytesIO
from itertools import count
from math import inf, isnan, nan, nextafter, radians, tau
from random import Random
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.attitude.conventions import Convention, Heading
from imud.attitude.published import as_sent
from imud.bridges import csv
from imud.bridges.channel import MessageFrames
from imud.bridges.json import JsonDialect
from imud.bridges.mcap import McapFile
from imud.bridges.ros2 import Ros2Dialect
from imud.contracts.driver import CanDriver, PolledDriver, StreamDriver
from imud.contracts.publisher import Batch
from imud.drivers import DRIVERS, value_limits
from imud.drivers.hipnuc.uart.codec import HI91, HI92, TAG_HI91, TAG_HI92
from imud.drivers.hipnuc.uart.codec import encode_frame as hipnuc_frame
from imud.drivers.imu61x import spi
from imud.drivers.imu61x.common import crc32
from imud.drivers.imu61x.uart import codec as imu61x
from imud.fleet.messages import FleetMessage, MessageKind, encode_message
from imud.fleet.statistics import summed_up
from imud.formats.can import CanFrame
from imud.formats.modbus import framed
from imud.formats.slot import decode_slots
from imud.model.ledger import Ledger
from imud.model.sample import SAMPLE_FIELDS, Measurement, Sample, Sync
from imud.publishers.metrics.rings import motion_of
from imud.publishers.nmea0183 import Formatter, make
from imud.publishers.socket.history import History, buckets
from imud.publishers.socket.outbox import BinaryEncoding, JsonEncoding
from imud.publishers.vessel import HeadingReference
from imud.web.hub import bucket_of, raw_of
from tests.support.publisher_context import publisher_context


def test_limits_of_values_and_temperatures() -> None:
    assert value_limits.scaled((0.0, 39.5, -39.5), 2.0, 40.0) == (0.0, 79.0, -79.0)
    for value in (40.0, 3e38, inf, nan):
        assert value_limits.scaled((0.0, -value, 0.0), 2.0, 40.0) is None
    assert value_limits.possible_angles((-tau, 0.0, tau)) == (-tau, 0.0, tau)
    assert value_limits.possible_angles((0.0, tau * 1.00001)) is None
    found = [value_limits.possible_quaternion(0.0, 0.0, 0.0, w) is not None for w in (0.979, 0.981, 1.019, 1.021)]
    assert found == [False, True, True, False]
    for impossible in (-128.0, nextafter(150.0, 151.0)):
        assert value_limits.possible_temperature_c(impossible) is None
        inside = nextafter(impossible, 0.0)
        assert value_limits.possible_temperature_c(inside) == inside


FLOATS = (nan, inf, -inf, 3e38, -3e38, 1e-45, 1e5, -4001.0, 2500.0, 400.0, -361.0, 151.0, 41.0, -35.0, 1.0, 0.0)
COUNTS = (0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF, 0x7FFF_8000, 0x8000_7FFF, 0x7FFE_FFFD, 0)
PREFIX = bytes([spi.PIPELINE_BYTES]) * spi.PIPELINE_BYTES
MOST = {"accel_m_s2": 40 * 9.80665, "gyro_rad_s": radians(4000), "mag_t": 4000e-6, "euler_rad": 6.2832,
        "incli_rad": 6.2832, "quat_wxyz": 1.02, "pressure_pa": 120_000, "temperature_c": 150}  # fmt: skip


def extreme(random: Random, size: int) -> bytes:
    """Return adjacent floats and integers, most of them extreme."""
    words = [
        random.choice(
            (struct.pack("<f", random.choice(FLOATS)), random.choice(COUNTS).to_bytes(4, "little"), random.randbytes(4))
        )
        for _ in range(size // 4 + 1)
    ]
    return b"".join(words)[:size]


def spi_burst(kind: str, random: Random) -> bytes:
    if kind == "registers":
        return PREFIX + extreme(random, 2 * spi.REGISTER_WORDS)
    if kind == "extended":
        memory = extreme(random, spi.CRC_OFFSET)
        return PREFIX + spi.little_endian(memory + crc32(memory).to_bytes(4, "little"))
    words = struct.unpack(">12H", extreme(random, 24))
    return PREFIX + spi.STANDARD.pack(*words, sum(words) & 0xFFFF, sum(words) >> 16)


def decoded(name: str, random: Random) -> Iterable[object]:
    """Return the events of 20 valid frames with extreme values."""
    driver = DRIVERS[name]
    if isinstance(driver, StreamDriver):
        codec = driver.make_codec(Ledger(), driver.settings())
        frames = {
            "hipnuc-uart": lambda: hipnuc_frame(
                random.choice((bytes([TAG_HI91]) + extreme(random, HI91.size - 1),
                               bytes([TAG_HI92]) + extreme(random, HI92.size - 1)))
            ),
            "imu61x-uart": lambda: imu61x.encode_frame(
                imu61x.DEVICE_SYNC, imu61x.AHRS_FRAME, extreme(random, imu61x.AHRS.size)
            ),
        }  # fmt: skip
        yield from codec.feed(b"".join(frames[name]() for _ in range(10)))
        for _ in range(10):
            yield from codec.feed(frames[name]())
    elif isinstance(driver, CanDriver):
        can = driver.make_codec(Ledger(), driver.settings())
        for number in range(20):
            tpdo7 = [CanFrame(0x788, False, bytes(8), 0)] if name == "hipnuc-canopen" else []
            for place, frame in enumerate([*driver.example_frames(random), *tpdo7]):
                head = 8 if name == "hipnuc-canfd" else 0  # bitmap and time: other bits make the frame bad
                data = frame.data[:head] + extreme(random, len(frame.data) - head)
                yield from can.feed_frame(frame.can_id, frame.extended, data, number * 10_000_000 + place * 250_000)
    elif isinstance(driver, PolledDriver):
        burst = random.choice(("standard", "extended", "registers")) if name == "imu61x-spi" else ""
        polled = driver.make_codec(Ledger(), msgspec.convert({"burst": burst} if burst else {}, driver.settings))
        for _ in range(20):
            data = driver.example_reading(random)
            if burst:
                data = spi_burst(burst, random)
            elif name == "hipnuc-modbus":
                data = framed(data[0], data[1:3] + extreme(random, len(data) - 5))
            else:
                data = (body := extreme(random, 28)) + crc32(body).to_bytes(4, "little")
            yield from polled.decode(0, data)


def impossible(sample: Sample) -> list[str]:
    """Return the fields with an impossible value. NaN is an absent part of an angle or angular rate."""
    found = []
    for field, most in MOST.items():
        value: Any = getattr(sample, field)
        parts = value if isinstance(value, tuple) else () if value is None else (value,)
        partial = field in ("euler_rad", "gyro_rad_s", "incli_rad")
        found += [field for part in parts if abs(part) > most or (isnan(part) and not partial)]
    return found


@pytest.mark.parametrize("name", list(DRIVERS))
@given(seed=st.integers(0, 2**32))
def test_no_output_raises_or_contains_an_impossible_value(name: str, seed: int) -> None:
    numbers = count(1)
    samples = [
        Sample("bow", n := next(numbers), n * 10**9, 1000, Sync.ARRIVAL, n * 10**9, n * 10**9,
               **{field: getattr(m, field) for field in SAMPLE_FIELDS if field in Measurement.__struct_fields__})
        for m in decoded(name, Random(seed)) if isinstance(m, Measurement)
    ]  # fmt: skip
    assert samples
    rotation = as_sent(DRIVERS[name].axes).rotation_to(Convention.NED_FRD)
    turned = samples if rotation is None else [rotation.sample(sample) for sample in samples]
    for sample in (*samples, *turned):
        assert not impossible(sample), sample
    slots = Batch("bow", 1, samples).packed
    assert repr(decode_slots(slots, "bow")) == repr(samples)
    batch, motion = Batch("bow", 1, samples), motion_of(slots, 0)
    assert motion is not None
    assert inf not in (motion.accel_norm_m_s2, *(motion.vibration_rms_m_s2 or ()), *(motion.vibration_peak_m_s2 or ()))
    assert len(BinaryEncoding(Convention.NED_FRD).encode(batch.converted(Convention.ENU_FLU))) == len(samples)
    history = History(publisher_context().devices)
    history.add(batch)
    text = msgspec.json.encode(list(buckets(history.seconds("bow"), 0, 10**15, 1, rotation)))
    text += b"".join(JsonEncoding(None, framed=True, texts=True, convention=Convention.NED_FRD).encode(batch))
    text += msgspec.json.encode(samples) + csv.csv_text(map(csv.sample_row(SAMPLE_FIELDS), samples))
    message = FleetMessage(
        v=1, gateway="g", boot="0" * 16, device="bow", kind=MessageKind.SAMPLES, begin=1, first=1, last=len(samples),
        count=len(samples), utc_ns=1, samples=samples,
    )  # fmt: skip
    text += encode_message(message) + msgspec.json.encode((summed_up(samples), bucket_of(samples)))
    text += msgspec.json.encode([raw_of("bow", vector, samples) for vector in ("accel_m_s2", "euler_rad")])
    file = McapFile(BytesIO(), "", "", {})
    for dialect in (JsonDialect(), Ros2Dialect()):
        for channel in dialect.samples(MessageFrames("bow")):
            made = [channel.encode(sample) for sample in samples]
            file.add_channel(channel).add_run([sample.utc_ns for sample in samples], [one or b"" for one in made])
            text += b"".join(one or b"" for one in made) if channel.message_encoding == "json" else b""
    file.finish()
    for kind in Formatter:
        text += b"".join(make(kind, one, HeadingReference(Heading.TRUE, 1.0)) or b"" for one in turned)
    assert b"Infinity" not in text
    assert b"e38" not in text
