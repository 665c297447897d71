"""HI81 and HI83: imud and the decoders of the vendor's SDK in C and Python agree for frames with random damage.

The test needs a copy of the vendor's public SDK and a C compiler:

    IMUD_HIPNUC_SDK=…/products pytest -q -s -m thorough tests/drivers/hipnuc/uart/test_ins_vendor.py
"""

import importlib.util
import logging
import math
import os
import shutil
import struct
import subprocess
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from random import Random
from typing import Any, Final, NamedTuple

import pytest

from imud.attitude.rotation import quat_from_euler312
from imud.contracts.codec import BadFrame, BadReason
from imud.drivers.hipnuc.uart import ins
from imud.drivers.hipnuc.uart.codec import encode_frame
from imud.model.sample import Measurement, Position
from tests.drivers.hipnuc.uart.test_codec import make

FRAMES: Final = 10_000
SDK: Final = os.environ.get("IMUD_HIPNUC_SDK", "")
REASON: Final = "set IMUD_HIPNUC_SDK to a copy of github.com/hipnuc/products, and install gcc"
HARNESS: Final = """
#include <stdlib.h>
#include "hipnuc_dec.h"
int main(void)
{
    static struct { hipnuc_raw_t raw; uint8_t beyond[1024]; } room;
    uint16_t size;
    while (fread(&size, 2, 1, stdin) == 1) {
        int32_t found = 0;
        memset(&room, 0, sizeof room);
        for (int i = 0; i < size; i++)
            found += hipnuc_input(&room.raw, (uint8_t)getchar()) > 0;
        fwrite(&found, 4, 1, stdout);
        fwrite(&room.raw.hi81, sizeof room.raw.hi81, 1, stdout);
        fwrite(&room.raw.hi83, sizeof room.raw.hi83, 1, stdout);
    }
    return 0;
}
"""
RAW_81: Final = struct.Struct("<BHBHI2x3h3h3hhhb5BH2hH4h3i6BBhB3h3h3i2x")
RAW_83: Final = struct.Struct("<BHBI3f3f3f3f4fQ5BHBff3f3f3f3f3f3d4Bfff4B3d3f")
GIVEN: Final = (0x81, 0x83)


class Raw(NamedTuple):
    """Values of a sub-packet in SI units, computed from the fields of a decoder of the vendor; None: not sent."""

    accel_m_s2: Sequence[float] | None
    gyro_rad_s: Sequence[float] | None
    mag_t: Sequence[float] | None
    euler_rad: Sequence[float] | None
    quat_wxyz: Sequence[float] | None
    pressure_pa: float | None
    temperature_c: float | None
    velocity_enu_m_s: Sequence[float] | None
    heave_m: float | None
    place: Sequence[float] | None  # latitude, longitude, height
    counts: Sequence[int] | None  # quality, satellites
    utc: Sequence[int] | None
    status: int


def scaled(values: Sequence[float] | None, factor: float) -> list[float] | None:
    return None if values is None else [value * factor for value in values]


def of_81(v: Sequence[Any]) -> Raw:
    rad = math.pi / 180
    return Raw(
        scaled(v[8:11], 0.0048828), scaled(v[5:8], 0.001), scaled(v[11:14], 0.030517e-6),
        (v[23] * 0.01 * rad, v[24] * 0.01 * rad, -v[25] * 0.01 * rad), scaled(v[26:30], 1e-4), v[14] + 100_000.0,
        v[16], scaled(v[42:45], 0.01), None, (v[31] * 1e-7 * rad, v[30] * 1e-7 * rad, v[32] * 1e-3), v[35:37],
        v[17:23], v[1] | v[2] << 16,
    )  # fmt: skip


def of_83(v: Sequence[Any]) -> Raw:
    rad, bitmap = math.pi / 180, v[3]

    def at(bit: int, begin: int, end: int) -> Sequence[Any] | None:
        return v[begin:end] if bitmap >> bit & 1 else None

    def one(bit: int, begin: int) -> Any:
        return v[begin] if bitmap >> bit & 1 else None

    place = at(14, 45, 48)
    return Raw(
        at(0, 4, 7), at(1, 7, 10), scaled(at(2, 10, 13), 1e-6), scaled(at(3, 13, 16), rad), at(4, 16, 20), one(7, 28),
        one(8, 29), at(12, 39, 42), one(10, 33), None if place is None else (place[1] * rad, place[0] * rad, place[2]),
        at(15, 48, 50), at(6, 21, 27), v[1] | v[2] << 16,
    )  # fmt: skip


def of_python(packet: dict[str, Any]) -> Raw:
    """Return the values of the decoder in Python. Its texts of UTC have no digits to compare."""
    rad, get, is_81 = math.pi / 180, packet.get, packet["type"] == "HI81"
    euler = None if "roll" not in packet else [packet[name] * rad for name in ("roll", "pitch", "yaw")]
    if is_81 and euler is not None:
        euler[2] = -euler[2]
    where = get("ins_lon_lat_msl") or ([get("ins_lon"), get("ins_lat"), get("ins_msl")] if is_81 else None)
    pressure, hss = get("air_pressure"), get("hss")
    return Raw(
        get("acc"), scaled(get("gyr"), rad) if is_81 else get("gyr"), scaled(get("mag"), 1e-6), euler, get("quat"),
        None if pressure is None else pressure + 100_000.0 * is_81, get("temperature"), get("vel_enu"),
        None if hss is None else hss[0], None if where is None else (where[1] * rad, where[0] * rad, where[2]),
        (packet["solq_pos"], packet["nv_pos"]) if "solq_pos" in packet else None, None,
        packet["main_status"] | packet["ins_status"] << 16,
    )  # fmt: skip


LIMITS: Final = {"accel_m_s2": 40 * 9.80665, "gyro_rad_s": 4000 * math.pi / 180, "mag_t": 4000e-6,
                 "euler_rad": 360.001 * math.pi / 180, "velocity_enu_m_s": 1000.0}  # fmt: skip
FILLERS: Final = (0x7FFF, 0x7F7F, -0x8000, 0, -1)


def check_values(m: Measurement, raw: Raw, counts: Counter[str]) -> None:
    """Compare all values of a measurement. A value that imud removed must be impossible or a filler."""
    for name in ("accel_m_s2", "gyro_rad_s", "mag_t", "euler_rad", "velocity_enu_m_s", "quat_wxyz"):
        found, sent = getattr(m, name), getattr(raw, name)
        if sent is None:
            assert found is None, name
        elif found is None:
            counts["values removed"] += 1
            too_large = any(not abs(value) < LIMITS.get(name, 1.0) for value in sent)
            no_rotation = name == "quat_wxyz" and not 0.9604 < sum(value * value for value in sent) < 1.0404
            assert too_large or no_rotation or len({*sent[:2], sent[-1]}) == 1, (name, sent)
        else:
            counts["values equal"] += 1
            apart = [one - other for one, other in zip(found, sent, strict=True)]
            if name == "euler_rad":
                apart[2] = math.remainder(apart[2], 2 * math.pi)
            assert all(abs(one) <= 1e-6 * LIMITS.get(name, 1.0) * 1e-3 for one in apart), (name, found, sent)
    for name in ("pressure_pa", "temperature_c", "heave_m"):
        found, sent = getattr(m, name), getattr(raw, name)
        if found is None:
            counts["values removed"] += sent is not None
            in_range = {"pressure_pa": (1000, 120_000), "temperature_c": (-127, 126), "heave_m": (-100, 100)}[name]
            assert sent is None or not in_range[0] <= sent <= in_range[1] or sent in (0.0, 100_000.0), (name, sent)
        else:
            counts["values equal"] += 1
            assert found == pytest.approx(sent, rel=1e-12), name
    if m.position is not None:
        assert raw.place is not None
        place = (m.position.latitude_rad, m.position.longitude_rad, m.position.height_m)
        assert place == pytest.approx(tuple(raw.place), rel=1e-12)
        sent_counts = raw.counts or (255, 255)
        assert (m.position.quality, m.position.satellites) == tuple(None if n == 255 else n for n in sent_counts)
        counts["values equal"] += 1
    elif raw.place is not None:
        counts["values removed"] += 1
        latitude, longitude, height = raw.place
        is_possible = abs(latitude) <= math.pi / 2 and abs(longitude) <= math.pi and abs(height) < 1e5
        assert latitude == longitude == 0 or not is_possible, raw.place
    assert m.status == (None if raw.status & 0xE000 else raw.status)
    if m.gnss_utc_ns is not None and raw.utc is not None:
        assert ins.utc_fields(m.gnss_utc_ns // 10**6 * 10**6) == tuple(raw.utc) or raw.utc[5] >= 60_000
        counts["values equal"] += 1


def random_values(random: Random) -> Measurement:
    angles = (random.uniform(-3.1, 3.1), random.uniform(-1.5, 1.5), random.uniform(-3.1, 3.1))

    def vector(spread: float) -> tuple[float, float, float]:
        return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))

    return Measurement(
        0, 0, None, vector(9), vector(2), vector(5e-5), quat_from_euler312(angles), angles, random.uniform(-40, 85),
        random.uniform(80_000, 110_000), velocity_enu_m_s=vector(20), heave_m=random.gauss(0, 1),
        position=Position(random.uniform(-1.5, 1.5), random.uniform(-3.1, 3.1), random.uniform(-400, 9000),
                          random.randrange(6), random.randrange(60)),
        gnss_utc_ns=random.randrange(1_600_000_000_000, 1_900_000_000_000) * 10**6,
    )  # fmt: skip


def random_frame(random: Random) -> tuple[str, bytes]:
    """Return the kind of the damage and a frame."""
    values, status = random_values(random), random.getrandbits(13)
    if random.random() < 0.5:
        payload = ins.pack_hi81(values, main_status=status, ins_status=random.randrange(7), week=2400, tow_ms=5)
    else:
        bitmap = random.getrandbits(32) & ins.KNOWN_BITS
        payload = ins.pack_hi83(values, bitmap, main_status=status, ins_status=3, system_time_us=random.getrandbits(60))
    kind = random.choice(("none", "none", "bit flip", "cut", "noise in the payload", "length", "bitmap", "insertion"))
    frame = bytearray(encode_frame(payload))
    if kind == "bit flip":
        for _ in range(random.randrange(1, 4)):
            frame[random.randrange(len(frame))] ^= 1 << random.randrange(8)
    elif kind == "cut":
        del frame[random.randrange(1, len(frame)) :]
    elif kind == "insertion":
        frame.insert(random.randrange(len(frame)), random.randrange(256))
    elif kind == "noise in the payload":  # with a correct CRC: any value of a field
        body = bytearray(payload)
        for at in range(12 if payload[0] == ins.TAG_HI81 else 8, len(body)):
            body[at] = random.randrange(256)
        frame = bytearray(encode_frame(bytes(body)))
    elif kind == "length":  # with a correct CRC
        longer = payload + random.randbytes(random.randrange(1, 9))
        frame = bytearray(encode_frame(random.choice((longer, payload[: -random.randrange(1, 8)] or payload))))
    elif kind == "bitmap" and payload[0] == ins.TAG_HI83:  # with a correct CRC
        bitmap = int.from_bytes(payload[4:8], "little") ^ 1 << random.randrange(32)
        frame = bytearray(encode_frame(payload[:4] + bitmap.to_bytes(4, "little") + payload[8:]))
    return kind, bytes(frame)


def shown(path: str) -> bytes:
    return (Path(SDK) / path).read_bytes()


def decoded_in_c(frames: Sequence[bytes], folder: Path) -> list[tuple[int, bytes, bytes]]:
    """Return the number of good frames, and the structs of HI81 and HI83, for each frame."""
    for name in ("hipnuc_dec.c", "hipnuc_dec.h"):
        (folder / name).write_bytes(shown(f"drivers/{name}"))
    (folder / "harness.c").write_text(HARNESS)
    program = folder / "harness"
    sources = [str(folder / name) for name in ("harness.c", "hipnuc_dec.c")]
    subprocess.run(["gcc", "-O1", "-w", "-o", str(program), *sources], check=True)
    sent = b"".join(len(frame).to_bytes(2, "little") + frame for frame in frames)
    out = subprocess.run([str(program)], input=sent, check=True, capture_output=True).stdout
    size = 4 + RAW_81.size + RAW_83.size
    assert len(out) == size * len(frames)
    parts = (out[at : at + size] for at in range(0, len(out), size))
    return [(int.from_bytes(one[:4], "little"), one[4 : 4 + RAW_81.size], one[4 + RAW_81.size :]) for one in parts]


def parser_in_python(folder: Path) -> Any:
    path = folder / "vendor_parser.py"
    path.write_bytes(shown("examples/python/parsers/hipnuc_serial_parser.py"))
    spec = importlib.util.spec_from_file_location("vendor_parser", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.hipnuc_parser


@pytest.mark.thorough
@pytest.mark.skipif(not (SDK and shutil.which("gcc")), reason=REASON)
def test_the_decoders_of_the_vendor_agree(tmp_path: Path) -> None:
    random, counts = Random(81), Counter[str]()
    kinds, frames = zip(*(random_frame(random) for _ in range(FRAMES)), strict=True)
    in_c, parser = decoded_in_c(frames, tmp_path), parser_in_python(tmp_path)
    logging.disable(logging.CRITICAL)  # the parser logs each bad frame
    try:
        for kind, frame, (good, raw_81, raw_83) in zip(kinds, frames, in_c, strict=True):
            codec = make()
            events = [*codec.feed(frame), *codec.flush()]
            assert codec.ledger.closes()
            measured = [event for event in events if isinstance(event, Measurement)]
            reasons = {event.reason for event in events if isinstance(event, BadFrame)}
            try:
                packets = [one for one in parser().parse(frame) if one["type"] != "HI91"]
            except IndexError:
                counts["the decoder in Python fails"] += 1
                packets = []
            counts[f"damage: {kind}"] += 1
            sent = [raw for raw in (raw_81, raw_83) if raw[0] in GIVEN]
            if not measured:
                # the vendor does not compare the bitmap with the length, and reads bytes after the payload
                counts["rejected by imud"] += 1
                if good and sent:
                    counts["rejected by imud only, because of its length or its bits"] += 1
                    assert BadReason.CONTENT in reasons or codec.unknown, (kind, frame.hex())
                continue
            assert good == 1, (kind, frame.hex())
            counts["decoded by all"] += 1
            (m,) = measured
            check_values(m, of_python(packets[0]), counts)
            if codec.unknown:  # the decoder in C can overwrite the values with bytes after an unknown tag
                counts["decoded by all, with a rest that imud skips"] += 1
                continue
            raw = of_81(RAW_81.unpack(raw_81)) if raw_81[0] == ins.TAG_HI81 else of_83(RAW_83.unpack(raw_83))
            check_values(m, raw, counts)
    finally:
        logging.disable(logging.NOTSET)
    print()
    for name, count in sorted(counts.items()):
        print(f"{count:7} {name}")
    assert counts["decoded by all"] > FRAMES / 4
    assert counts["rejected by imud"] > FRAMES / 4
