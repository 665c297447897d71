"""Settings of the collector in a YAML file."""

from pathlib import Path

import pytest

from imud.config import load_options
from imud.fleet.database.settings import CollectorSettings
from imud.model.errors import ConfigError


def read(tmp_path: Path, text: str) -> CollectorSettings:
    path = tmp_path / "collector.yaml"
    path.write_text(text)
    return load_options(path, CollectorSettings)


def test_the_file_sets_keys_and_the_other_keys_have_defaults(tmp_path: Path) -> None:
    found = read(tmp_path, "shares: 4\nsamples_days: 30\ncompress_after_days: null\nmetrics: 127.0.0.1:9000\n")
    assert found == CollectorSettings(
        shares=4, samples_days=30.0, compress_after_days=None, metrics="127.0.0.1:9000", keep_boots=10
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("share: 4", 'collector.yaml:1:1: share: expected a key that imud knows, got "share"; did you mean shares?'),
        ("shares: 65", "collector.yaml:1:9: shares: expected a whole number from 1 to 64, got 65"),
        ("\nkeep_boots: many", 'collector.yaml:2:13: keep_boots: expected a whole number from 1 to 1000, got "many"'),
        ("samples_days: 0", "samples_days: expected a number from 0.01 to 36500, or null, got 0"),
        ("partition_hours: 24\npartition_hours: 24", "collector.yaml:2"),
        ("- 1", "expected keys and values, got a list"),
        ("", "collector.yaml:1:1: expected keys and values, got an empty file"),
        ("a: [", "collector.yaml:2:1: expected YAML, but"),
    ],
)
def test_invalid_files_are_reported_with_their_line(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(ConfigError) as error:
        read(tmp_path, text)
    assert problem in str(error.value)


def test_all_problems_and_a_missing_file_are_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as error:
        read(tmp_path, "shares: 0\nsilent_s: x\nfoo: 1")
    assert len(str(error.value).splitlines()) == 3
    with pytest.raises(ConfigError, match=r"cannot read /nowhere: No such file or directory; is the path right\?"):
        load_options("/nowhere", CollectorSettings)
