"""Saved states: all attributes of codecs and clocks are restored, and a forged state is rejected."""

from collections import deque
from functools import partial
from typing import Any

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from imud.contracts.lines import Edge
from imud.host.clock import SteadyTime
from imud.model.ledger import Ledger
from imud.model.sample import Sync
from imud.recording.state import StateError, StateReader, StateWriter, attributes
from imud.sampling.clock import SampleClock
from imud.sampling.device_time import JumpDetector
from imud.sampling.meters import LossMeter


class Holder:
    def __init__(self, **parts: Any) -> None:
        self.__dict__.update(parts)


def there_and_back(value: object, external: dict[str, object] | None = None) -> Any:
    root = Holder(value=value)
    state = StateWriter(external or {}).write({"root": root})
    new = Holder(value=None)
    StateReader(state, external or {}).restore("root", new)
    return new.__dict__["value"]


@pytest.mark.parametrize(
    "value",
    [
        None, True, 1 << 60, -0.0, float("inf"), "é", b"\0\xff", Sync.EDGE, [1, [2]], (1, (2,)), {1: "a", "b": [2]},
        {1, 2}, frozenset({3}), deque([1, 2], maxlen=5), Edge(1, True, 2), bytearray(b"ab"), SampleClock,
    ],
)  # fmt: skip
def test_values_are_restored(value: object) -> None:
    assert there_and_back(value) == value
    assert type(there_and_back(value)) is type(value)


class Slotted:
    __slots__ = ("set", "unset")
    set: int
    unset: int


def test_objects_are_restored_with_objects_of_the_daemon() -> None:
    slotted = Slotted()
    slotted.set = 1
    assert attributes(slotted) == {"set": 1}
    assert there_and_back(deque([1], maxlen=7)).maxlen == 7
    shared = [1]
    first, second = there_and_back([shared, shared])
    assert first is second
    ledger = Ledger()
    meter = there_and_back(LossMeter(ledger), {"ledger": ledger})
    meter.missed(2, 0)
    assert ledger.lost_gap_device == 2
    there_and_back(ledger.add_unknown_gap, {"ledger": ledger})()
    assert ledger.lost_unknown == 1
    assert type(there_and_back(partial(JumpDetector))()) is JumpDetector
    steady, new = SteadyTime(), SteadyTime()
    for second in range(50):
        steady.add_pair(second * 1_000_000_500, second * 1_000_000_000)
    StateReader(StateWriter({}).write({"steady": steady}), {}).restore("steady", new)
    for at in range(0, 50 * 10**9, 10**8):
        assert new.monotonic_ns(at) == steady.monotonic_ns(at)


@pytest.mark.parametrize("value", [print, lambda: 0, Holder(), open, msgspec.json.Decoder()])
def test_an_object_that_is_not_part_of_a_codec_cannot_be_written(value: object) -> None:
    with pytest.raises(StateError):
        StateWriter({}).write({"root": Holder(value=value)})


@pytest.mark.parametrize(
    "written",
    [
        ["f", "os:system"], ["f", "imud.host.files:replace_file"], ["f", "imud.sampling.clock:__builtins__"],
        ["f", "imud.sampling.clock:SampleClock.__init__"], ["f", "imud.sampling.clock:Callable"],
        [0, "object", "subprocess:Popen", {}], [0, "object", "imud.sampling.none:None", {}],
        [0, "object", "imud.model.errors:ImudError", {}], [0, "object", "imud.model.ledger:Ledger", {"__class__": 1}],
        [0, "object", "imud.formats.jsonrpc:RpcError", {}], [0, "object", "imud.sampling.driver_clock:make_clock", {}],
        [0, "object", "imud.contracts.link:CanUse", {"__doc__": "x"}], [0, "nothing", []],
        ["b", ["x", "ledger"], "__class__"],
        ["r", 9], ["x", "nothing"], ["e", "imud.model.sample:Sync", "NONE"], ["what"], [],
        [5, "set", [[0, "list", []]]], [0, "partial", ["f", "os:system"], [1, "tuple", []], [2, "dict", []]],
    ],
)  # fmt: skip
def test_a_forged_state_is_an_error(written: Any) -> None:
    state = msgspec.msgpack.encode({"root": (0, {"value": written})})
    with pytest.raises(StateError):
        StateReader(state, {"ledger": Ledger()}).restore("root", Holder(value=None))


def nested(levels: int) -> list[Any]:
    return [nested(levels - 1)] if levels > 1 else []


def test_the_depth_of_objects_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    assert there_and_back(nested(101)) == nested(101)  # 100 objects inside the first object
    with pytest.raises(StateError, match=r"cannot write the state: root\.value is deeper than 100 objects"):
        there_and_back(nested(102))
    monkeypatch.setattr("imud.recording.state.DEPTH_MAX", 1000)
    state = StateWriter({}).write({"root": Holder(value=nested(102))})
    monkeypatch.undo()
    with pytest.raises(StateError, match="cannot restore the state: it is deeper than 100 objects"):
        StateReader(state, {}).restore("root", Holder(value=None))


def test_an_attribute_that_this_version_does_not_have_is_an_error() -> None:
    state = msgspec.msgpack.encode({"root": (0, {"value": 1, "more": 2})})
    with pytest.raises(StateError, match=r"no attribute root\.more"):
        StateReader(state, {}).restore("root", Holder(value=None))
    with pytest.raises(StateError, match="does not contain other"):
        StateReader(state, {}).restore("other", Holder(value=None))


@example(b"\x81\xa5\x00\x00\x00\x00\x80")
@given(st.binary(max_size=60))
def test_any_bytes_raise_state_error(data: bytes) -> None:
    try:
        StateReader(data, {}).restore("root", Holder(value=None))
    except StateError:
        return
    raise AssertionError(data)
