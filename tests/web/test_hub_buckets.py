"""Buckets of samples: boundaries, peaks, and missing or infinite values."""

from math import inf, nan

import msgspec

from imud.model.sample import Sample
from imud.web.hub import Bucketing, bucket_of, raw_of
from tests.support.socket_rig import sample

MS = 1_000_000


def at(ms: float, seq: int = 1, z: float = 9.75) -> Sample:
    made = sample("bow", seq)
    t_ns = 80_000_000_000_000 + round(ms * MS)
    return msgspec.structs.replace(made, t_ns=t_ns, t_rx_ns=t_ns + 300_000, accel_m_s2=(0.5, -0.5, z))


def test_buckets() -> None:
    bucketing = Bucketing(20)
    early = [at(ms, seq) for seq, ms in enumerate((0, 10, 49.999), start=1)]
    assert bucketing.add(early, early[-1].t_ns) == []
    (bucket,) = bucketing.add([at(50, 4)], at(50).t_ns)
    assert (bucket.count, bucket.seq, bucket.first_s, bucket.last_s) == (3, 3, 80000.0, 80000.049999)
    (second,) = bucketing.add([], at(200).t_ns)
    assert (second.count, second.seq) == (1, 4), "it ends two periods after its interval without another sample"
    assert bucketing.add([], at(500).t_ns) == []
    samples = [at(ms, ms + 1) for ms in range(1000)]
    bucketing = Bucketing(50)
    buckets = bucketing.add(samples, samples[-1].t_ns) + bucketing.add([], samples[-1].t_ns + 60 * MS)
    assert [bucket.count for bucket in buckets] == [20] * 50
    assert [bucket.seq for bucket in buckets] == [*range(20, 1001, 20)]
    samples = [at(0, 1, 9.0), at(1, 2, 60.0), at(2, 3, -40.0), at(3, 4, 9.5)]
    bucket = bucket_of(samples)
    assert bucket.accel_m_s2 == ((0.5, -0.5, -40.0), (0.5, -0.5, 60.0))
    assert (bucket.t_err_s, bucket.latency_s) == (12e-6, 300e-6)
    bucket = bucket_of([at(0, 1, nan), at(1, 2, 9.0), at(2, 3, inf)])
    assert bucket.accel_m_s2 == ((0.5, -0.5, 9.0), (0.5, -0.5, 9.0))
    assert bucket_of([at(0, 1, nan)]).accel_m_s2 is None
    assert bucket.mag_t is None
    assert bucket.quat_wxyz is None
    assert "mag_t" not in msgspec.to_builtins(bucket)
    good = msgspec.structs.replace(at(0), quat_wxyz=(0.5, 0.5, 0.5, 0.5))
    bad = msgspec.structs.replace(at(1, 2), quat_wxyz=(nan, 0.0, 0.0, 0.0))
    assert bucket_of([good, bad, at(2, 3)]).quat_wxyz == (0.5, 0.5, 0.5, 0.5)


def test_raw_values_keep_their_sequence_numbers() -> None:
    raw = raw_of("bow", "accel_m_s2", [at(0, 1, 1.0), at(1, 2, nan), at(2, 5, 3.0)])
    assert raw is not None
    assert (raw.seq, raw.t_s) == ((1, 5), (80000.0, 80000.002))
    assert raw.axes == ((0.5, 0.5), (-0.5, -0.5), (1.0, 3.0))
    assert raw_of("bow", "mag_t", [at(0)]) is None
