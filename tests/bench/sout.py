"""CPU time that SOUT on a GPIO line adds to the path of a sample. Runs with and without SOUT alternate."""

from collections.abc import Iterator
from dataclasses import replace

from tests.bench.rig import Load, run
from tests.bench.rows import Row, at_most

ROUNDS = 3
RISE_LIMIT = 1 + 1 / 3  # maximum CPU ratio: SOUT may add one third


def rows(*, quick: bool = False) -> Iterator[Row]:
    """Yield the CPU time per sample at 1 kHz, best round of each: other programs on the host only increase the time."""
    load = Load(seconds=2.0 if quick else 6.0)
    pairs = [(run(load), run(replace(load, sout=True))) for _ in range(1 if quick else ROUNDS)]
    plain = min((a for a, _ in pairs), key=lambda outcome: outcome.cpu_us_per_sample)
    sout = min((b for _, b in pairs), key=lambda outcome: outcome.cpu_us_per_sample)
    (status,) = sout.statuses
    yield Row("1 kHz: CPU per sample without lines", plain.cpu_us_per_sample, "us")
    yield Row("1 kHz: CPU per sample with SOUT", sout.cpu_us_per_sample, "us")
    yield at_most("1 kHz: CPU with SOUT / without", sout.cpu_us_per_sample / plain.cpu_us_per_sample, "x", RISE_LIMIT)
    yield Row("1 kHz: edges without a sample", float(status.clock.edges_unpaired), "edges")
    yield Row("1 kHz: samples without an edge", float(status.clock.samples_unpaired), "samples")
    yield at_most("1 kHz with SOUT: samples lost", float(sout.lost), "samples", 0)
