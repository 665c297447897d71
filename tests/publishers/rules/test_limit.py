"""Limits on packed slots: golden values, hold and hysteresis, the band filter against scipy, kernel against Python."""

from collections.abc import Sequence
from math import inf, nan, pi, radians, sin, sqrt
from random import Random
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from imud.formats import kernel
from imud.formats.slot import encode_slots
from imud.model.options import wrong_values
from imud.model.sample import Sample, Sync
from imud.publishers.rules.limit import Change, Limit, band_pass
from imud.publishers.rules.publisher import state_of
from imud.publishers.rules.settings import RuleOptions

MS, S = 1_000_000, 1_000_000_000
IMPLEMENTATIONS = ["kernel", "python"]


@pytest.fixture(params=IMPLEMENTATIONS)
def implementation(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    use(request.param, monkeypatch)
    return str(request.param)


def use(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "python":
        monkeypatch.setattr(kernel, "present", kernel.Kernel(None))
    elif kernel.present.module is None:
        pytest.skip(kernel.present.problem)


def packed(samples: Sequence[dict[str, Any]], step_ns: int = 10 * MS) -> bytes:
    """Return slots at intervals of `step_ns`, with values by field; `t_ns` replaces the time stamp."""
    made = [
        msgspec.structs.replace(Sample("imu", n, n * step_ns, 0, Sync.ARRIVAL, 0, 0), **values)
        for n, values in enumerate(samples)
    ]
    return b"".join(encode_slots(made, 0))


class MadeLimit(Limit):
    def __init__(self, rule: RuleOptions) -> None:
        super().__init__(state_of(rule))
        self.band_hz = rule.band_hz or (0, 0)


def run(limit: MadeLimit, slots: bytes, sizes: Sequence[int] = (10**6,)) -> list[tuple[int, Change]]:
    """Evaluate slots in batches of these sizes. Return the index of the slot and the change of each change."""
    found, begin, turn, count = [], 0, 0, len(slots) // 320
    while begin < count:
        size = min(sizes[turn % len(sizes)], count - begin)
        batch, offset = slots[begin * 320 : (begin + size) * 320], 0
        while (offset := limit.evaluate(batch, offset)) >= 0:
            state = limit.load()
            found.append((begin + offset // 320 - 1, Change(state.change)))
            if state.change == Change.PERIOD:
                state.design(*limit.band_hz)
                limit.store()
        begin, turn = begin + size, turn + 1
    return found


def made(**keys: Any) -> MadeLimit:
    return MadeLimit(msgspec.convert({"hold_s": 0, **keys}, RuleOptions))


ACCEL = {"accel_m_s2": (3.0, -4.0, 12.0)}
ANGLES = {"euler_rad": (radians(-20), radians(30), 1.0)}
GOLDEN = [
    # measure, axis, samples, value by hand
    ("tilt_deg", "roll", [ANGLES], -20.0),
    ("tilt_deg", "pitch", [ANGLES], 30.0),
    ("tilt_deg", None, [{"euler_rad": (radians(60), radians(60), 3.0)}], 75.52248781407008),  # acos(0.25)
    ("tilt_deg", "y", [{"incli_rad": (1.0, radians(5))}], 5.0),
    ("peak_accel_m_s2", None, [ACCEL], 13.0),
    ("peak_accel_m_s2", "y", [ACCEL, {"accel_m_s2": (0.0, 1.0, 0.0)}], 4.0),
    # window of 1 s with ±2 around 9: the mean does not count
    ("rms_accel_m_s2", "z", [{"accel_m_s2": (0.0, 0.0, 9.0 + 2 * (-1) ** n)} for n in range(101)], 2.0),
    ("rms_accel_m_s2", None, [{"accel_m_s2": ((-1.0) ** n, 2 * (-1.0) ** n, 5.0)} for n in range(101)], sqrt(5)),
    ("angular_rate_deg_s", None, [{"gyro_rad_s": (pi * 3 / 180, 0.0, pi * 4 / 180)}], 5.0),
    ("angular_rate_deg_s", "x", [{"gyro_rad_s": (-pi, 0.0, 0.0)}], 180.0),
    ("temperature_c", None, [{"temperature_c": -12.5}], -12.5),
    ("t_err_ms", None, [{"t_err_ns": 2_500_000}], 2.5),
]


@pytest.mark.parametrize(("measure", "axis", "samples", "value"), GOLDEN)
def test_values_by_hand(implementation: str, measure: str, axis: str | None, samples: Any, value: float) -> None:
    over, under = (made(measure=measure, axis=axis, above=value - d, below=-1e6) for d in (1e-6, -1e-6))
    assert run(over, packed(samples))[-1:] in ([(0, Change.BEGIN)], [(len(samples) - 1, Change.BEGIN)])
    assert run(under, packed(samples)) == []
    assert over.load().value == pytest.approx(value, abs=1e-9)


def temperatures(*values: float, step_ns: int = 100 * MS) -> bytes:
    return packed([{"temperature_c": value} for value in values], step_ns)


def test_hold_hysteresis_gaps_and_absent_values(implementation: str) -> None:
    keys: dict[str, Any] = {"measure": "temperature_c", "above": 50, "below": 0, "hysteresis": 5}
    begin_at_3 = run(made(**keys, hold_s=0.3), temperatures(51, 51, 51, 51, 51))
    assert begin_at_3 == [(3, Change.BEGIN)], "0.3 s after the first value beyond the limit"
    assert run(made(**keys, hold_s=0.3), temperatures(51, 51, 50, 51, 51, 51)) == [], "the hold starts again"
    ended = run(made(**keys, hold_s=0), temperatures(-1, *[4] * 20, *[5] * 11))
    assert ended == [(0, Change.BEGIN), (31, Change.END)], "inside 5 … 45 for at least 1 s"
    assert run(made(**keys), temperatures(51, *[46] * 20, *[45] * 11)) == [(0, Change.BEGIN), (31, Change.END)]
    gap = [{"temperature_c": 60.0, "t_ns": t * S} for t in (0, 100, 200)]
    limit = made(**keys, hold_s=2)
    assert run(limit, packed(gap)) == [(2, Change.BEGIN)], "a gap counts as 1 s"
    limit = made(**keys, hold_s=0)
    assert run(limit, packed([{}, {"temperature_c": nan}, {"temperature_c": inf}, {"t_ns": 1 << 61}, {"temperature_c": 60.0}])) == [(4, 1)]  # fmt: skip  # noqa: E501
    state = limit.load()
    assert (state.absent, state.not_finite, state.used) == (2, 2, 1)
    backwards = [{"temperature_c": 60.0, "t_ns": t * MS} for t in (5000, 5900, 100, 900, 1100)]
    assert run(made(**keys, hold_s=1), packed(backwards)) == [(4, Change.BEGIN)], (
        "another recording starts the hold again"
    )


@given(
    st.lists(st.floats(-10, 10), max_size=60),
    st.floats(0, 3),
    st.sampled_from([0.0, 0.25, 1.5]),
    st.lists(st.integers(1, 7), min_size=1),
)
def test_events_never_chatter(values: list[float], hysteresis: float, hold_s: float, sizes: list[int]) -> None:
    keys: dict[str, Any] = {"measure": "temperature_c", "above": 4, "hysteresis": hysteresis, "hold_s": hold_s}
    slots = temperatures(*values)
    with pytest.MonkeyPatch.context() as patch:
        use("python", patch)
        found = run(made(**keys), slots)
    assert run(made(**keys), slots, sizes) == found, "batches and the kernel do not matter"
    assert [change for _, change in found] == [Change.BEGIN, Change.END] * (len(found) // 2) + [1] * (len(found) % 2)
    before = -1
    for at, change in found:
        hold = round(hold_s * 10 + 0.499) if change == Change.BEGIN else max(10, round(hold_s * 10 + 0.499))
        assert at - before > hold
        newest = values[at - hold : at + 1]
        assert all(v > 4 for v in newest) if change == Change.BEGIN else all(v <= 4 - hysteresis for v in newest)
        before = at


def vibration(count: int, rate_hz: float, hz: float, amplitude: float, seed: int = 1) -> list[dict[str, Any]]:
    random = Random(seed)
    return [
        {"accel_m_s2": (amplitude * sin(2 * pi * hz * n / rate_hz) + random.gauss(0, 0.05), random.gauss(0, 1), 9.8)}
        for n in range(count)
    ]


@pytest.mark.parametrize(("low", "high", "rate"), [(10, 100, 1000), (0.5, 5, 100), (1, 49.9, 100), (5, 6, 500)])
def test_the_filter_is_the_filter_of_scipy(implementation: str, low: float, high: float, rate: int) -> None:
    sections = signal.butter(4, [low, high], "bandpass", output="sos", fs=rate)
    mine = np.array([[one.gain, 0, -one.gain, 1, one.a1, one.a2] for one in band_pass(low, high, rate)])
    hz = np.linspace(0.001 * rate, 0.499 * rate, 300)
    (_, theirs), (_, here) = (signal.sosfreqz(sos, hz, fs=rate) for sos in (sections, mine))
    assert np.max(np.abs(theirs - here)) < 1e-9
    limit = made(measure="peak_accel_m_s2", axis="y", above=1e6, band_hz=[low, high], window_s=0.01)
    samples = vibration(6 * rate, rate, low, 1.0)
    assert run(limit, packed(samples, S // rate)) == [(rate, Change.PERIOD)]
    values = np.array([one["accel_m_s2"][1] for one in samples[rate + 1 :]])
    expected, _ = signal.sosfilt(sections, values, zi=signal.sosfilt_zi(sections) * values[0])
    window = max(rate // 100, 1)  # the peak covers one or two windows
    state = limit.load()
    assert state.is_filtering
    assert np.isclose(abs(expected[-2 * window :]), state.value, rtol=1e-6, atol=1e-9).any()


def test_band_rms_settling_gaps_and_changes_of_the_rate(implementation: str) -> None:
    keys = {"measure": "rms_accel_m_s2", "axis": "x", "above": 1.0, "band_hz": [20, 80], "window_s": 0.5}
    loud = made(**keys)
    slots = packed(vibration(3000, 500, 40, 2.0), 2 * MS)
    # 1 s of measurement, settling of 2 / 20 s, window of 0.5 s
    assert run(loud, slots) == [(500, Change.PERIOD), (801, Change.BEGIN)]
    assert loud.load().value == pytest.approx(sqrt(2), rel=0.01)
    assert run(made(**keys), packed(vibration(3000, 500, 5, 2.0), 2 * MS)) == [(500, Change.PERIOD)], "below the band"
    lossy = [one | {"t_ns": 2 * MS * (n + n // 250)} for n, one in enumerate(vibration(2000, 500, 40, 2.0))]
    cut = made(**keys)
    assert Change.BEGIN not in [change for _, change in run(cut, packed(lossy))], "no complete window between gaps"
    assert cut.load().restarts == 6
    slower = [one | {"t_ns": MS * (2 * n if n < 1000 else 2000 + 10 * (n - 1000))} for n, one in enumerate(vibration(1400, 500, 1, 0.0))]  # fmt: skip  # noqa: E501
    limit = made(**keys)
    assert [change for _, change in run(limit, packed(slower))] == [Change.PERIOD, Change.PERIOD]
    state = limit.load()
    assert (state.period_ns, state.designed) == (10 * MS, 0), "80 Hz is not below 50 Hz"
    assert state.design(20, 80).startswith("expected band_hz below half the sample rate (50 Hz), got 80 Hz")


RULES: list[dict[str, Any]] = [
    {"measure": "peak_accel_m_s2", "above": 12, "band_hz": [3, 40]}, {"measure": "rms_accel_m_s2", "above": 2},
    {"measure": "rms_accel_m_s2", "axis": "y", "above": 0.5, "band_hz": [3, 40], "window_s": 0.3},
    {"measure": "peak_accel_m_s2", "above": 12, "window_s": 0.1}, {"measure": "t_err_ms", "above": 1e-3},
    {"measure": "tilt_deg", "above": 40, "hysteresis": 3, "hold_s": 0.05},
    {"measure": "angular_rate_deg_s", "above": 90},
]  # fmt: skip


@pytest.mark.skipif(kernel.present.module is None, reason=kernel.present.problem)
@given(st.integers(0, 2**32), st.sampled_from(RULES), st.lists(st.integers(1, 40), min_size=1, max_size=5))
def test_the_kernel_and_python_agree_in_every_bit(seed: int, rule: dict[str, Any], sizes: list[int]) -> None:
    random, t_ns, samples = Random(seed), 0, []
    step_ns = random.choice([5 * MS, 10 * MS])
    for _ in range(400):
        odd = random.random()
        t_ns += step_ns * 30 if odd < 0.003 else -S if odd < 0.004 else 1 << 61 if odd < 0.005 else step_ns
        t_ns = t_ns if abs(t_ns) < 1 << 62 else 0
        vector = tuple(
            random.gauss(0, 6) if random.random() > 0.003 else random.choice([nan, inf, 1e200]) for _ in "xyz"
        )
        named = {"accel_m_s2": vector, "gyro_rad_s": vector, "euler_rad": vector} if random.random() > 0.01 else {}
        samples.append({"t_ns": t_ns, "t_err_ns": random.getrandbits(32) >> random.randrange(32), **named})
    slots, found = packed(samples), []
    for name in IMPLEMENTATIONS:
        with pytest.MonkeyPatch.context() as patch:
            use(name, patch)
            limit = made(**rule)
            changes = run(limit, slots, sizes if name == "kernel" else (10**6,))
            state = limit.load()
            found.append((changes, [str(getattr(state, slot)) for slot in state.__slots__ if slot != "change"]))
    assert found[0] == found[1]


def test_the_kernel_rejects_a_wrong_state() -> None:
    if kernel.present.module is None:
        pytest.skip(kernel.present.problem)
    for arguments in ((bytearray(8), b"", 0), (bytearray(560), b"", -1), (bytearray(b"\xff" * 560), b"", 0)):
        with pytest.raises(ValueError, match="expected 560 bytes"):
            kernel.present.module.evaluate(*arguments)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({}, "expected the key above or below, got none"),
        ({"above": 3, "below": 2, "hysteresis": 0.5}, "expected more than below plus twice the hysteresis (3), got 3"),
        ({"above": 1, "axis": "roll"}, "axis: expected for peak_accel_m_s2: x, y, z; got roll"),
        ({"above": 1, "band_hz": [5, 5]}, "band_hz: expected an acceleration and two rising edges"),
        ({"above": 1, "measure": "tilt_deg", "band_hz": [1, 5]}, "got [1.0,5.0] for tilt_deg"),
        ({"above": 1, "measure": "silence_s", "window_s": 2}, "window_s: expected no window for silence_s, got 2"),
        ({"above": 1, "command": ["ls", "-l"]}, 'command: expected a program with an absolute path first, got "ls"'),
        ({"above": 1, "end_command": ["/bin/"]}, 'end_command: expected a program with an absolute path first, got'),
    ],
)  # fmt: skip
def test_invalid_rules_are_rejected(keys: dict[str, Any], words: str) -> None:
    assert words in str(wrong_values(RuleOptions, {"measure": "peak_accel_m_s2", **keys})[0])
