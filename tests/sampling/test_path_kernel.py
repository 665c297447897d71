"""The kernel and the Python code make the same samples of the same bytes: slots, ledger, latencies, losses, state."""

import contextlib
import math
import os
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any, Literal, NamedTuple
from unittest.mock import Mock

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from imud.attitude.conventions import Convention
from imud.attitude.published import published_frame
from imud.contracts.publisher import AS_SENT, Batch
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.uart.codec import HipnucCodec, HipnucOptions, encode_frame, encode_hi92
from imud.drivers.imu61x.uart import codec as imu61x
from imud.formats import kernel
from imud.formats.slot import SLOT_BYTES
from imud.host.clock import HostClock
from imud.model.ledger import Ledger
from imud.model.sample import Sync
from imud.model.units import NS_PER_MS, NS_PER_US
from imud.sampling.clock import SampleClock
from imud.sampling.driver_clock import make_clock
from imud.sampling.path import PathContext, StreamPath
from imud.sampling.stamp_time import StampTime
from imud.sampling.state import save_path
from tests.support.event_loops import UTC_AHEAD_NS
from tests.support.files import hi91

Word = Literal["pps", "status"]
BYTE_NS = 10_851
SETTLE = 400  # frames of 1 ms until imud uses the fit and does not watch the counter
BEGIN_NS = 1000 * 10**9

if kernel.present.module is None:
    pytest.skip(f"no kernel: {kernel.present.problem}", allow_module_level=True)


class Step(NamedTuple):
    """One read. Without changes it contains `frames` usual frames that arrive evenly."""

    frames: int
    cut: int = 0  # bytes at the end that arrive with the next read
    damage: int | None = None  # position of an inverted byte
    kind: str = "usual"
    jump_ms: int = 0  # change of the device counter
    late_us: int = 0
    waited_ms: int = -1  # -1: read on arrival; otherwise the hold
    publish: bool = True
    slew_ns: int = 0  # change of CLOCK_MONOTONIC against the steady time
    own_status: int | None = None
    step_ms: int = 1
    expect: bool = False  # whether imud expects another rate
    left_us: int = 0  # correction of the time stamps


STEPS = st.builds(
    Step, st.integers(0, 12), st.sampled_from([0, 0, 0, 1, 2, 5, 40, 81]),
    st.none() | st.none() | st.integers(0, 900),
    st.sampled_from(["usual"] * 4 + ["extreme"] * 2 + ["nan", "text", "other", "zeros", "word", "hot", "pressure",
                                                       "reset", "long"]),
    st.sampled_from([0, 0, 0, 1, 7, -3, 10**6, 2**31]), st.sampled_from([0, 0, 30, 900, 20_000, 700_000]),
    st.sampled_from([-1, -1, 0, 5, 30]), st.booleans(), st.sampled_from([0, 0, 0, 400, 20_000, -90_000]),
    st.sampled_from([None, None, 0, 1 << 31]), st.sampled_from([1, 1, 1, 3]), st.booleans(),
    st.sampled_from([0, 0, 0, 300, -900, 3, -5]),
)  # fmt: skip
EXTREME = [math.nan, math.inf, 3e38, 1e-45, 40, 31.9, -2047, 360, 360.0005, 361, -128, 150, 151, 0.98, 0, -0.0]
COUNTS = ((0x7FFF, 0x7FFF), (-0x8000, -0x8000), (-1, -1), (0x7F7F, 0x7F7F), (9800, 1))
WORDS = [*(struct.pack("<f", value) for value in EXTREME), *(struct.pack("<2h", *pair) for pair in COUNTS)]


def values(ms: int) -> dict[str, Any]:
    euler_rad = (0.01 * (ms % 300), -0.7, ms % 6)
    return {"accel_m_s2": (1, -2, ms % 9), "gyro_rad_s": (0.1, -2, ms % 7), "euler_rad": euler_rad, "temperature_c": -3}


def hi92(ms: int) -> bytes:
    mag_t, quat, pressure_pa = (2e-5, 0, -4e-5), (1, 0, 0, 0), 101_000 + ms % 7
    return encode_hi92(pps_stamp_ms=ms % 8192, mag_t=mag_t, quat_wxyz=quat, pressure_pa=pressure_pa, **values(ms))


def ahrs(ms: int) -> bytes:
    return imu61x.encode_ahrs(timer_us=1000 * ms, **values(ms))


class Format(NamedTuple):
    driver: str
    frame: Callable[[int], bytes]  # returns the frame of a device time, ms
    other: bytes  # a frame that the kernel does not decode
    data_at: slice  # values in the payload that a frame of random words changes
    changes: Mapping[str, Sequence[tuple[int, bytes]]]  # changed bytes of the payload by kind of a step

    def changed(self, frame: bytes, changes: Sequence[tuple[int, bytes]]) -> bytes:
        is_ahrs = self.frame is ahrs
        payload = bytearray(frame[6:-4] if is_ahrs else frame[6:])
        for at, data in changes:
            payload[at : at + len(data)] = data
        ahrs_frame = imu61x.DEVICE_SYNC, imu61x.AHRS_FRAME, bytes(payload)
        return imu61x.encode_frame(*ahrs_frame) if is_ahrs else encode_frame(bytes(payload))

    def of_kind(self, kind: str, ms: int) -> bytes:
        frame = self.frame(ms)
        if kind == "text":
            return b"OK\r\n" + frame
        if kind == "other":
            return frame + self.other
        if kind == "extreme":  # at most three extreme values: the others show whether each value is at its place
            random, words = Random(ms), range(self.data_at.start, self.data_at.stop, 4)
            return self.changed(
                frame, [(random.choice(words), random.choice(WORDS)) for _ in range(random.randint(1, 3))]
            )
        return self.changed(frame, self.changes.get(kind, ()))


def floats(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


FORMATS = {
    "HI91": Format("hipnuc-uart", hi91, hi92(3), slice(12, 76), {
        "nan": [(12, floats(math.nan))], "zeros": [(36, bytes(12)), (60, bytes(16))],
        "long": [(60, floats(3.28, 0, 0, 0))], "word": [(1, b"\xff\xff\x80")], "hot": [(24, floats(140_000.0))],
        "pressure": [(4, floats(12.5))],
    }),
    "HI92": Format("hipnuc-uart", hi92, hi91(3), slice(8, 48), {
        "nan": [(28, b"\xff\xff\xff\x7f")], "zeros": [(22, bytes(6)), (40, bytes(8))], "long": [(40, b"\xff\x7f")],
        "word": [(1, b"\xff\xff"), (4, b"\xff\xff")], "hot": [(3, b"\x80")], "pressure": [(6, b"\xff\x7f")],
    }),
    "AHRS": Format("imu61x-uart", ahrs, imu61x.encode_acknowledgement(3), slice(4, 44), {
        "nan": [(16, floats(math.nan))], "zeros": [(4, bytes(40))], "long": [(4, floats(360.0, -360.0, 360.0005))],
        "word": [(4, floats(-0.0, -0.0))], "hot": [(40, floats(151.0))], "pressure": [(28, floats(-4001.0))],
    }),
}  # fmt: skip


class Run:
    """A path that processes steps, with or without the kernel."""

    def __init__(self, of: Format, word: Word, turned: bool, first_ms: int, modulus_ms: int) -> None:
        self.of = of
        self.slots = b""
        self.now_ns, self.slewed_ns, self.ms, self.number = BEGIN_NS, 0, first_ms, 0
        self.modulus_ms = modulus_ms
        self.kernel_batches, self.held = 0, list[bool]()
        self.late_bytes = b""
        self.ledger = Ledger()
        self.seen = Mock()
        host = HostClock(lambda: self.now_ns, lambda: self.now_ns + UTC_AHEAD_NS, lambda: self.now_ns - self.slewed_ns)
        self.steady = host.steady
        frame = published_frame(None, Convention.NED_FRD, None, AS_SENT.device) if turned else AS_SENT
        context = PathContext(
            "bow", 3, self.ledger, self.publish, self.seen.message, self.seen.bad_frame, lambda: 0, host, frame
        )
        clock: SampleClock = make_clock(
            "bow", None, DRIVERS[of.driver], None, host=host.steady, byte_ns=BYTE_NS,
            on_unknown_gap=self.ledger.add_unknown_gap,
        )  # fmt: skip
        is_ahrs = of.driver == "imu61x-uart"
        codec = imu61x.Imu61xCodec(self.ledger) if is_ahrs else HipnucCodec(self.ledger, HipnucOptions(hi91_word=word))
        self.path = StreamPath(codec, clock, context)
        self.path.watch_status(0xFFFF_FFFF)
        self.path.observe(self.seen.observer)

    def publish(self, batch: Batch) -> None:
        self.kernel_batches += batch.is_packed
        self.slots += batch.packed

    def do(self, step: Step) -> None:
        path = self.path
        if step.kind == "reset":
            path.clock.restart()
        self.slewed_ns += step.slew_ns
        if step.expect:
            path.clock.expect_rate()
        path.clock.set_own_status(step.own_status)
        path.clock._slew.add(step.left_us * NS_PER_US)
        self.ms += step.jump_ms
        stream = self.late_bytes
        for number in range(step.frames):
            self.ms += step.step_ms
            self.now_ns += step.step_ms * (NS_PER_MS + 40)
            stream += self.of.of_kind(step.kind if number == step.frames // 2 else "usual", self.ms % self.modulus_ms)
        self.number += 1
        self.now_ns += self.number * 7919 % 97 * 1000
        data = bytearray(stream[: len(stream) - step.cut])
        self.late_bytes = stream[len(data) :]
        if step.damage is not None and step.damage < len(data):
            data[step.damage] ^= 0xFF
        t_rx_ns = self.now_ns + step.late_us * NS_PER_US
        if step.waited_ms < 0:
            path.publish_gathered()
            path.on_data(bytes(data), t_rx_ns)
        else:
            path.gather(bytes(data), t_rx_ns, step.waited_ms * NS_PER_MS)
            self.held.append(path.held_by_fit)
            if step.publish:
                path.publish_gathered()

    def result(self) -> tuple[Any, ...]:
        path = self.path
        path.publish_gathered()
        newest, taken = (path.quality, path.clock.t_ns, path.clock.t_rx_ns(), path.newest), path.take_status()
        state = save_path(path)
        return (
            self.slots, self.ledger.snapshot(), path.latency.buckets, path.latency.sum_ns, newest, taken,
            self.seen.mock_calls, path.clock.status(), state, self.held,
        )  # fmt: skip


def play(
    steps: Sequence[Step], of: Format, found: kernel.Kernel, word: Word = "pps", turned: bool = False,
    first_ms: int = 0, modulus_ms: int = 2**32,
) -> Run:  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel, "present", found)
        run = Run(of, word, turned, first_ms, modulus_ms)
        for _ in range(SETTLE // 4):
            run.do(Step(4))
        for step in steps:
            run.do(step)
    return run


@pytest.mark.parametrize("name", FORMATS)
@given(steps=st.lists(STEPS, max_size=30), word=st.sampled_from(["pps", "status"]), turned=st.booleans())
@example(steps=[Step(4, expect=True), *[Step(4, step_ms=3)] * 9, *[Step(4)] * 9], word="pps", turned=False)
@example(steps=[Step(1), Step(2, waited_ms=0, publish=False), Step(1, waited_ms=5)], word="pps", turned=False)
@example(steps=[Step(4, left_us=us) for us in (300, -900, 0)], word="pps", turned=False)
@example(steps=[Step(1, step_ms=10_001), Step(300), *[Step(4, left_us=us) for us in (3, -5)]], word="pps", turned=False)
@example(steps=[Step(2, cut=5, damage=0), Step(10, slew_ns=20_000)], word="pps", turned=False)
def test_kernel_and_python_are_equal(name: str, steps: list[Step], word: Word, turned: bool) -> None:
    results = [play(steps, FORMATS[name], one, word, turned).result() for one in (kernel.present, kernel.Kernel(None))]
    for one, other in zip(*results, strict=True):
        assert one == other


DAY_MS = 86_400_000


@pytest.mark.parametrize("lost", [0, 5])
def test_samples_continue_over_the_end_of_a_day(lost: int) -> None:
    """Newer firmware counts modulo 24 h. 25 reads of 4 frames begin 50 ms before the wrap, inside the 13th read."""
    steps = [*[Step(4)] * 12, Step(4, jump_ms=lost), *[Step(4)] * 12]
    runs = [
        play(steps, FORMATS["HI91"], one, first_ms=DAY_MS - SETTLE - 50, modulus_ms=DAY_MS)
        for one in (kernel.present, kernel.Kernel(None))
    ]
    for run in runs:
        status, newest = run.path.clock.status(), run.path.newest
        assert newest is not None
        assert (newest.t_dev_ns, newest.sync) == ((DAY_MS + 50 + lost) * NS_PER_MS, Sync.REGRESSION)
        assert (status.resets, run.ledger.losses(), run.ledger.samples) == (0, (lost, 0, 0, 0, 0), SETTLE + 100)
    assert runs[0].kernel_batches > 10 > runs[1].kernel_batches == 0
    for one, other in zip(*(run.result() for run in runs), strict=True):
        assert one == other


EXTREMES: list[Any] = [
    0, -1, 1, 2**31, 2**32 - 1, 2**60, -(2**60), 2**62, 2**63 - 1, -(2**63), 2**64, 0.0, -1.0, 1e18, -1e300, math.inf,
    math.nan,
]  # fmt: skip


# The kernel is compiled with headers that count. CPython restores the count of None if it reaches 0 (none_dealloc).
@pytest.mark.skipif(sys.version_info >= (3, 12), reason="None is immortal since Python 3.12, its count may change")
def test_none_keeps_its_references() -> None:
    """Python 3.11 counts them, also if the headers of a later Python compiled the kernel."""
    module, before = kernel.present.module, sys.getrefcount(None)
    assert module is not None
    state = (1, -1, 1, 1, 1, 1, 0, 0), (0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0), (0,) * 9, StampTime.NO_STATE
    for _ in range(1000):
        assert module.start(-1, "HI91", *state) is None  # a device number out of range
    assert abs(sys.getrefcount(None) - before) < 100


@pytest.mark.parametrize("name", FORMATS)
def test_the_kernel_accepts_any_bytes_and_numbers(tmp_path: Path, name: str) -> None:
    module, file = kernel.present.module, os.open(tmp_path / "ring", os.O_RDWR | os.O_CREAT)
    assert module is not None
    os.ftruncate(file, 4096 + 8 * SLOT_BYTES)
    calls = Mock(wraps=module)
    of = FORMATS[name]
    run = play([Step(10)] * 10, of, kernel.Kernel(calls))
    values, t_rx_ns = calls.start.call_args.args, run.path.clock.t_rx_ns()
    tick = 1 if name != "AHRS" else 1000
    data = b"".join(of.frame(values[3][0] // tick + number) for number in range(1, 11))
    random, made_slots = Random(25), 0
    for _ in range(3000):
        stream = bytearray(data[: random.choice([len(data), random.randrange(len(data) + 1)])])
        if stream and random.random() < 0.3:
            stream[random.randrange(len(stream))] ^= random.randrange(1, 256)
        groups = [[values[0]], *map(list, values[2:]), [1, t_rx_ns + 10 * NS_PER_MS, UTC_AHEAD_NS, 0, 0, 0]]
        for _ in range(random.randrange(4)):
            group = random.choice(groups)
            group[random.randrange(len(group))] = random.choice(EXTREMES)
        (device_id,), *state, arguments = groups
        with contextlib.suppress(OverflowError, TypeError):  # 2⁶⁴, and a float in place of an integer
            made = module.start(device_id, name, *map(tuple, state))
            for _ in range(2):
                slots = b"" if made is None else made.stamp(bytes(stream), *arguments)
                assert len(slots) <= len(stream) // len(of.frame(0)) * SLOT_BYTES
                assert len(module.frame_slots(slots)) == len(slots) + 4 * (len(slots) // SLOT_BYTES)
                with contextlib.suppress(ValueError):  # a memory that is too small for the ring
                    memory = bytearray(random.choice([4096 + SLOT_BYTES, 4096 + 8 * SLOT_BYTES]))
                    mask, newest = random.choice([0, 7, *EXTREMES]), random.choice(EXTREMES)
                    ring = module.open_ring(memory, mask, newest, file)
                    assert ring.write(slots)
                    assert ring.beat(t_rx_ns)
                    assert ring.show(name * 9, tuple(random.choices([0, 2**64 - 1], k=random.randrange(60))))
                assert made is None or len(made.state()) == 10
                made_slots += bool(slots)
    os.close(file)
    assert made_slots > 300
    with pytest.raises(ValueError, match=f"expected a format of the kernel, got x{name}"):
        module.start(values[0], f"x{name}", *values[2:])
    for frames, controls in ((65, 65), (2, 1)):
        with pytest.raises(ValueError, match="expected buffers for at most 64 frames"):
            module.receive(-1, bytearray(72 * frames), bytearray(64 * controls))


@pytest.mark.parametrize("cut", [0, 40])
@pytest.mark.parametrize("name", FORMATS)
def test_the_kernel_makes_the_samples_of_usual_reads(name: str, cut: int) -> None:
    run = play([Step(10, cut)] * 50, FORMATS[name], kernel.present)
    assert run.kernel_batches > 75  # Python makes complete batches only until the fit is in use
    assert run.ledger.closes()
