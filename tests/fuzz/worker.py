"""Fuzzes one target in this process: `python -m tests.fuzz.worker ENGINE TARGET SECONDS SEED FOLDER GROWN INPUT...`.

`tests.fuzz.__main__` starts this process for each target, because atheris instruments a module at its import and ends
the process at a finding. The last printed lines are a summary in the format of libFuzzer, for both engines.
"""

import importlib
import logging
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from hashlib import sha1
from pathlib import Path
from random import Random
from typing import Final, Protocol, cast

from tests.fuzz.target import Target, load

INPUT_S_MAX: Final = 120
"""Maximum time for one input, s. An input needs milliseconds, but a busy host gives a nice process little time."""
MEMORY_MB_MAX: Final = 1024  # libFuzzer ends a target with more memory
MEND_SHARE: Final = 0.5  # share of inputs with corrected checksums


class Atheris(Protocol):
    def instrument_imports(self, include: Sequence[str]) -> AbstractContextManager[None]:
        """Count the coverage of the packages that the context imports."""
        ...

    def Setup(
        self, args: Sequence[str], run: Callable[[bytes], None],
        custom_mutator: Callable[[bytes, int, int], bytes],
    ) -> object:  # fmt: skip
        ...

    def Fuzz(self) -> None: ...

    def Mutate(self, data: bytes, size: int) -> bytes: ...


def fuzz_with_atheris(name: str, seconds: float, seed: int, folder: Path, grown: Path, inputs: Sequence[str]) -> None:
    """Fuzz with atheris, guided by the coverage of the package `imud`."""
    atheris = cast(Atheris, importlib.import_module("atheris"))
    with atheris.instrument_imports(include=["imud", "prometheus_client", "paho"]):
        target = load(name)

    def mutated(data: bytes, size: int, seed: int) -> bytes:
        found, random = atheris.Mutate(data, len(data)), Random(seed)
        return target.mend(found, random)[:size] if random.random() < MEND_SHARE else found

    options = [
        f"-max_len={target.bytes_max}", f"-timeout={INPUT_S_MAX}", f"-rss_limit_mb={MEMORY_MB_MAX}", "-len_control=0",
        *libfuzzer_options(seconds, seed, folder, inputs), *_dictionary(target, folder), str(grown),
    ]  # fmt: skip
    atheris.Setup([sys.argv[0], *options], target.run, custom_mutator=mutated)
    atheris.Fuzz()


def libfuzzer_options(seconds: float, seed: int, folder: Path, inputs: Sequence[str]) -> list[str]:
    """Return the common options of the fuzzers of Python and C. A seed of 0 means the clock.

    For a reproducible run, the options name the inputs in order, because the order of a folder is random. They switch
    off reloading of the corpus and the weight of rare features, because some features are not reproducible.
    """
    options = [f"-max_total_time={max(int(seconds), 1)}", f"-artifact_prefix={folder}/", "-print_final_stats=1"]
    if seed:
        options += [f"-seed={seed}", "-reload=0", "-entropic=0"]
    if inputs:
        file = folder / "inputs"
        file.write_text(",".join(inputs))
        options.append(f"-seed_inputs=@{file}")
    return options


def _dictionary(target: Target, folder: Path) -> list[str]:
    """Return the option for a dictionary file with the words of the target; empty for a target without words."""
    words = target.words()
    file = folder / "words.dict"
    file.write_text("".join(f'"{escaped(word)}"\n' for word in words))
    return [f"-dict={file}"] if words else []


def fuzz_with_hypothesis(name: str, seconds: float, seed: int, folder: Path, paths: Sequence[Path]) -> int:
    """Fuzz with mutations of the corpus, without coverage. Return the exit status of the process."""
    from hypothesis import HealthCheck, find, settings
    from hypothesis import strategies as st
    from hypothesis.errors import NoSuchExample

    target = load(name)
    known = [path.read_bytes() for path in paths] or [b""]
    inputs = st.one_of(
        st.binary(max_size=256),
        st.builds(
            lambda data, at, cut, put, seed: _changed(target, data, at, cut, put, seed),
            st.sampled_from(known), st.integers(0, 1 << 16), st.integers(0, 64), st.binary(max_size=64),
            st.integers(0, 1 << 32),
        ),
    )  # fmt: skip
    end_s, runs = time.monotonic() + seconds, 0
    failure: list[Exception] = []

    def fails(data: bytes) -> bool:
        nonlocal runs
        runs += 1
        try:
            target.run(data)
        except Exception as error:  # noqa: BLE001  # whatever is raised is a finding
            failure[:] = [error]
            return True
        return False

    quick = settings(max_examples=200, database=None, deadline=None, suppress_health_check=list(HealthCheck))
    random = Random(seed)
    while time.monotonic() < end_s:
        try:
            found = find(inputs, fails, settings=quick, random=Random(random.getrandbits(64)))
        except NoSuchExample:
            continue
        path = folder / f"crash-{sha1(found, usedforsecurity=False).hexdigest()}"
        path.write_bytes(found)
        fails(found)
        print(f"{type(failure[0]).__name__}: {failure[0]}\nartifact: {path}\nstat::number_of_executed_units: {runs}")
        return 1
    print(f"stat::number_of_executed_units: {runs}")
    return 0


def _changed(target: Target, data: bytes, at: int, cut: int, put: bytes, seed: int) -> bytes:
    at %= len(data) + 1
    data = data[:at] + put + data[at + cut :]
    return (target.mend(data, Random(seed)) if seed % 2 else data)[: target.bytes_max]


def escaped(word: bytes) -> str:
    """Format a word in ASCII for a dictionary of libFuzzer."""
    return "".join(chr(byte) if bytes([byte]).isalnum() else f"\\x{byte:02X}" for byte in word)


def main() -> int:
    logging.disable()  # targets report invalid input thousands of times per second
    engine, name, seconds, seed, folder, grown, *inputs = sys.argv[1:]
    if engine == "atheris":
        fuzz_with_atheris(name, float(seconds), int(seed), Path(folder), Path(grown), inputs)
        return 0
    paths = [*map(Path, inputs), *sorted(Path(grown).iterdir())]
    return fuzz_with_hypothesis(name, float(seconds), int(seed), Path(folder), paths)


if __name__ == "__main__":
    sys.exit(main())
