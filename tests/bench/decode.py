"""Cost of decoding HI91 and AHRS frames to SI values, against the floor: check value and `struct.unpack_from` alone.

Figures are ns per frame, best of many short runs taken in turns, so that all see the same machine. The codec reads the
streams in blocks of 4096 bytes (a busy port or a replay) and frame by frame (a quiet port at 1 kHz); `noisy` has one
damaged frame in ten, and garbage, cut frames and text between others.
"""

import binascii
import struct
import zlib
from collections.abc import Callable
from functools import partial
from random import Random
from time import perf_counter_ns

from imud.contracts.codec import CodecEvent, StreamCodec
from imud.devices.hipnuc.uart.codec import HipnucCodec, HipnucSettings, encode_hi91
from imud.devices.imu61x.uart.codec import Imu61xCodec, encode_ahrs
from imud.ledger import Ledger
from imud.sample import Measurement
from tests.bench.rows import Row, at_most

FRAMES = 250  # a run of 0.2 ms fits between the interruptions of a busy machine
ROUNDS = 400
READ_BYTES = 4096
HI91_FRAME_BYTES = 82
AHRS_FRAME_BYTES = 54
REACH_RATIO = 1.6
AHRS_REACH_RATIO = 3.0
"""The quaternion, which HI91 has in the message, is computed from the angles."""
AHRS_SINGLE_RATIO = 4.0


def _vector(random: Random, spread: float) -> tuple[float, float, float]:
    return (random.gauss(0, spread), random.gauss(0, spread), random.gauss(0, spread))


def _frames(random: Random) -> list[bytes]:
    vector = partial(_vector, random)
    return [
        encode_hi91(
            system_time_ms=1_000_000 + index, accel_m_s2=vector(5), gyro_rad_s=vector(1), mag_t=vector(3e-5),
            euler_rad=vector(0.5), quat_wxyz=(1.0, *vector(0.1)), temperature_c=31, pressure_pa=101_325,
        )
        for index in range(FRAMES)
    ]  # fmt: skip


def _ahrs_frames(random: Random) -> list[bytes]:
    vector = partial(_vector, random)
    return [
        encode_ahrs(
            timer_us=2500 * index, accel_m_s2=vector(5), gyro_rad_s=vector(1), euler_rad=vector(0.5), temperature_c=31
        )
        for index in range(FRAMES)
    ]


def _noisy(frames: list[bytes], random: Random) -> bytes:
    parts: list[bytes] = []
    for index, frame in enumerate(frames):
        parts.append(frame)
        if index % 10 == 3:
            damaged = bytearray(frame)
            damaged[random.randrange(len(frame))] ^= 1 << random.randrange(8)
            parts[-1] = bytes(damaged)
        elif index % 10 == 7:
            parts.append(random.choice((random.randbytes(20), frame[: random.randrange(82)], b"APP_VER=156\r\n")))
    return b"".join(parts)


def _floor(stream: bytes) -> None:
    crc, unpack = binascii.crc_hqx, struct.Struct("<BHbfI16f").unpack_from
    for at in range(0, len(stream), HI91_FRAME_BYTES):
        crc(stream[at + 6 : at + HI91_FRAME_BYTES], crc(stream[at : at + 4], 0))
        unpack(stream, at + 6)


def _ahrs_floor(stream: bytes) -> None:
    crc, unpack = zlib.crc32, struct.Struct("<I10fI").unpack_from
    for at in range(0, len(stream), AHRS_FRAME_BYTES):
        crc(stream[at : at + 50], 0xFFFFFFFE)
        unpack(stream, at + 6)


def _decoder(reads: list[bytes], codec: StreamCodec | None = None) -> Callable[[], None]:
    codec = codec or HipnucCodec(Ledger(), HipnucSettings())

    def run() -> None:
        feed = codec.feed
        for read in reads:
            feed(read)
        codec.reset()

    return run


def _split(stream: bytes, size: int) -> list[bytes]:
    return [stream[at : at + size] for at in range(0, len(stream), size)]


def _best_ns(rounds: int, runs: dict[str, Callable[[], object]]) -> dict[str, float]:
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(rounds):
        for name, run in runs.items():
            begin = perf_counter_ns()
            run()
            best[name] = min(best[name], perf_counter_ns() - begin)
    return {name: ns / FRAMES for name, ns in best.items()}


def _good(events: list[CodecEvent]) -> int:
    return sum(type(event) is Measurement for event in events)


def rows(*, quick: bool = False) -> list[Row]:
    random = Random(1)
    frames = _frames(random)
    clean, noisy = b"".join(frames), _noisy(frames, random)
    ahrs = _ahrs_frames(random)
    assert _good(list(Imu61xCodec(Ledger()).feed(b"".join(ahrs)))) == FRAMES
    assert _good(list(HipnucCodec(Ledger(), HipnucSettings()).feed(clean))) == FRAMES
    best = _best_ns(
        ROUNDS // 4 if quick else ROUNDS,
        {
            "floor": lambda: _floor(clean),
            "clean": _decoder(_split(clean, READ_BYTES)),
            "single": _decoder(frames),
            "noisy": _decoder(_split(noisy, READ_BYTES)),
            "ahrs floor": lambda: _ahrs_floor(b"".join(ahrs)),
            "ahrs clean": _decoder(_split(b"".join(ahrs), READ_BYTES), Imu61xCodec(Ledger())),
            "ahrs single": _decoder(ahrs, Imu61xCodec(Ledger())),
        },
    )
    return [
        Row("decode floor (crc_hqx + unpack_from)", best["floor"], "ns/frame"),
        Row("decode clean, reads of 4096 bytes", best["clean"], "ns/frame"),
        Row("decode clean, one frame per read", best["single"], "ns/frame"),
        Row("decode noisy, reads of 4096 bytes", best["noisy"], "ns/frame"),
        at_most("decode clean / floor", best["clean"] / best["floor"], "x", REACH_RATIO),
        Row("decode noisy / floor", best["noisy"] / best["floor"], "x"),
        Row("decode AHRS floor (crc32 + unpack_from)", best["ahrs floor"], "ns/frame"),
        Row("decode AHRS, reads of 4096 bytes", best["ahrs clean"], "ns/frame"),
        Row("decode AHRS, one frame per read", best["ahrs single"], "ns/frame"),
        at_most("decode AHRS / floor", best["ahrs clean"] / best["ahrs floor"], "x", AHRS_REACH_RATIO),
        at_most(
            "decode AHRS, one frame per read / floor", best["ahrs single"] / best["ahrs floor"], "x", AHRS_SINGLE_RATIO
        ),
    ]
