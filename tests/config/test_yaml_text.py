"""imud, and a reader of YAML 1.1, read written settings with the same values."""

from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from imud.config.yaml import no_pause, read_yaml, yaml_block, yaml_comment, yaml_flow

TEXTS = [
    "6-axis", "yes", "on", "1e5", "0x10", "12:30", "1_000", "~", "", "a: b # c", "- x", "é\u2028\x7f\U0001f600", "\\",
]  # fmt: skip
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=8) | st.sampled_from(TEXTS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(min_size=1, max_size=5), inner, max_size=3),
    max_leaves=8,
)  # fmt: skip


def read_back(text: str) -> Any:
    tree = read_yaml(text.encode(), no_pause)
    assert not tree.problems, (text, tree.problems)
    return tree.data


def test_blocks_outside_and_flow_inside() -> None:
    values = {"settings": {"mode": "6-axis", "output": {"hi91": 100}, "matrix": [1, 0.5]}, "time": "now", "none": {}}
    assert yaml_block(values) == (
        'settings:\n  mode: "6-axis"\n  output: {hi91: 100}\n  matrix: [1, 0.5]\ntime: "now"\nnone: {}'
    )
    assert yaml_comment("a\n\nb") == "# a\n#\n# b"


@pytest.mark.parametrize("text", TEXTS)
def test_texts_stay_texts(text: str) -> None:
    assert read_back(f"a: {yaml_flow(text)}") == {"a": text}
    assert yaml.safe_load(f"a: {yaml_flow(text)}") == {"a": text}


@pytest.mark.parametrize("key", ["mode", "yes", "ON", "null", "y", "a-b", "1", "", "a b", ":"])
def test_keys_stay_texts(key: str) -> None:
    for read in (read_back, yaml.safe_load):
        assert read(yaml_block({key: 1})) == {key: 1}


@given(st.dictionaries(st.text(min_size=1, max_size=5).filter(lambda key: key != "<<"), VALUES, min_size=1, max_size=3))
def test_everything_is_read_back(values: dict[str, Any]) -> None:
    text = yaml_block(values)
    if "<<" not in text:
        assert read_back(text) == values
