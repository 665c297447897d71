"""Time per sample of the Python and C readers of shared memory. `make bench-instructions` measures the writer."""

import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from imud.client.ring import Ring
from imud.contracts.publisher import Batch
from imud.model.sample import Sample, Sync
from imud.publishers.shm import ShmOptions, ShmPublisher
from tests.bench.rows import Row
from tests.support.publisher_context import publisher_context

INCLUDE = Path(__file__).parents[2] / "imud" / "include"
ROUNDS = 5
SAMPLES = 4096
READER_C = """
#include "imud.h"
int main(int argc, char **argv)
{
    imud_ring ring;
    imud_slot slot;
    long count = 0;
    int64_t start_ns, end_ns;
    if (argc != 2 || imud_open(&ring, argv[1]))
        return 1;
    start_ns = imud_now_ns();
    for (int round = 0; round < 100; round++)
        for (ring.next_seq = 1; imud_next(&ring, &slot, NULL) == 1; count++)
            ;
    end_ns = imud_now_ns();
    printf("%f\\n", (double)(end_ns - start_ns) / (double)count);
    return 0;
}
"""


def samples() -> Iterator[Sample]:
    for seq in range(1, SAMPLES + 1):
        t_ns = seq * 1_000_000
        yield Sample(
            "bench", seq, t_ns, 150_000, Sync.REGRESSION, t_ns + 400_000, 10**18 + t_ns, t_ns,
            (0.1, 0.2, 9.8), (0.01, 0.02, 0.03), (2e-5, 1e-6, -4e-5), (1.0, 0.0, 0.0, 0.0), (0.1, 0.2, 0.3),
            30.0, 101325.0,
        )  # fmt: skip


def rows(quick: bool = False) -> Iterable[Row]:
    """Yield the best of ROUNDS: other programs on the host only increase the time."""
    rounds = 2 if quick else ROUNDS
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="imud-bench-") as folder:
        context = publisher_context(list, 1, time.monotonic_ns)
        publisher = ShmPublisher(ShmOptions(directory=folder, slots=SAMPLES, group=""), context)
        publisher.add_device("bench", 0)
        given = list(samples())
        read = min(_read_ns(publisher, folder, given) for _ in range(rounds))
        yield Row("shm: Python reader, Ring.read()", read, "ns/sample")
        if shutil.which("cc") is not None:
            yield Row("shm: C reader, imud_next()", _c_reader_ns(Path(folder)), "ns/sample")
        publisher.close()


def _read_ns(publisher: ShmPublisher, folder: str, given: list[Sample]) -> float:
    publisher.add_device("bench", 0)  # replace the ring by an empty ring
    with Ring("bench", directory=folder) as ring:
        publisher.publish(Batch("bench", 0, given))
        start = time.perf_counter_ns()
        found = ring.read()
        return (time.perf_counter_ns() - start) / len(found.samples)


def _c_reader_ns(folder: Path) -> float:
    source, program = folder / "reader.c", folder / "reader"
    source.write_text(READER_C)
    subprocess.run(["cc", "-O2", f"-I{INCLUDE}", str(source), "-o", str(program)], check=True)
    done = subprocess.run([str(program), str(folder / "imud.bench")], capture_output=True, text=True, check=True)
    return float(done.stdout)
