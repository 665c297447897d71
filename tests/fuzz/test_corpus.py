"""Run every input of the corpus once through its target, without a fuzzing engine."""

from pathlib import Path
from random import Random

import pytest

from imud.contracts.driver import CanDriver, PolledDriver, StreamDriver
from imud.drivers import DRIVERS
from tests.fuzz import c_header
from tests.fuzz.target import CORPUS, all_names, folder_of, inputs_of, load

NAMES = all_names()
CORPUS_BYTES_MAX = 2_000_000  # the repository must stay small


@pytest.mark.parametrize("name", NAMES)
def test_corpus(name: str) -> None:
    target = load(name)
    inputs = inputs_of(name)
    assert inputs, f"expected inputs of {name}, got none; try make fuzz ARGS=--corpus"
    for data in {*(path.read_bytes() for path in inputs), *target.seeds()}:  # also the present seeds of the encoders
        target.run(data)
        target.run(target.mend(data, Random(1)))


def test_every_driver_has_a_target() -> None:
    kinds = {StreamDriver: "stream", CanDriver: "can", PolledDriver: "polled"}
    for name, driver in DRIVERS.items():
        assert f"{kinds[type(driver)]}/{name}" in NAMES


def test_no_folder_without_a_target_and_small_in_all() -> None:
    assert {folder.name for folder in CORPUS.iterdir()} == {folder_of(name).name for name in NAMES}
    assert sum(path.stat().st_size for path in CORPUS.rglob("*")) <= CORPUS_BYTES_MAX


def test_corpus_of_rings_through_the_c_header(tmp_path: Path) -> None:
    if problem := c_header.build(tmp_path):
        pytest.skip(problem)
    done = c_header.run_once(tmp_path, inputs_of(c_header.TARGET))
    assert done.returncode == 0, done.stderr
