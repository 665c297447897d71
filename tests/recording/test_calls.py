"""Recorded calls: a fixed table of calls, with types and ranges of their arguments."""

from typing import Any

import pytest

from imud.formats import records
from imud.formats.records import CallRecord, Kind
from imud.model.errors import ImudError
from imud.recording.calls import HostState, repeat_call
from tests.support import states
from tests.support.states import path_of

BIG = 1 << 62


@pytest.mark.parametrize(
    ("target", "method"),
    [
        ("path", "__init__"), ("path", "__class__"), ("path", "_publish"), ("path", "on_data"), ("path", "clock"),
        ("clock", "settle"), ("clock", "__reduce__"), ("host", "now_ns"), ("ledger", "__setattr__"), ("", ""),
        ("os", "system"), ("path.clock", "restart"),
    ],
)  # fmt: skip
def test_calls_outside_the_table_are_errors(target: str, method: str) -> None:
    path = path_of("hipnuc-uart", 1)
    with pytest.raises(ImudError, match="does not know it; try a newer imud"):
        repeat_call(path, path_of("hipnuc-uart", 1).codec.ledger, CallRecord(target, method, []))  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("target", "method", "arguments", "keywords"),
    [
        ("path", "begin", ["now"], {}), ("path", "begin", [BIG], {}), ("path", "begin", [], {}),
        ("path", "begin", [1.5], {}),
        ("path", "begin", [1, 2], {}), ("path", "begin", [1], {"now_ns": 1}), ("path", "flush", [None], {}),
        ("path", "reset", [1], {}), ("path", "set_frame_time", [-1], {}), ("path", "set_frame_time", [BIG], {}),
        ("path", "skip", [-5], {}), ("path", "overruns", [[]], {}), ("ledger", "set", [{"samples": -1}], {}),
        ("ledger", "set", [{"samples": "many"}], {}), ("ledger", "set", [["samples"]], {}),
        ("clock", "link_changed", [], {}), ("clock", "link_changed", [], {"byte_ns": BIG, "hold_ns": 0}),
        ("clock", "link_changed", [], {"byte_ns": 1, "hold_ns": -1}), ("clock", "link_changed", [1, 2], {}),
        ("clock", "link_changed", [], {"byte_ns": 1, "hold_ns": 1, "self": 1}),
        ("clock", "set_own_status", ["x"], {}), ("clock", "set_own_status", [1 << 40], {}),
        ("clock", "set_utc_reference", [[1]], {}), ("clock", "set_utc_reference", [[1, -1]], {}),
        ("clock", "set_utc_reference", [[1 << 63, 1]], {}), ("aiding", "on_trigger_stamps", [[[1, 2]]], {}),
        ("aiding", "on_trigger_stamps", [[[1, 2, "x"]]], {}), ("aiding", "on_trigger_stamps", [[[1, 2, 3]] * 4097], {}),
    ],
)  # fmt: skip
def test_invalid_arguments_are_errors(target: str, method: str, arguments: list[Any], keywords: dict[str, Any]) -> None:
    path = path_of("hipnuc-uart", 1)
    with pytest.raises(ImudError, match=f"cannot replay a record with the call {target}.{method}"):
        repeat_call(path, path.codec.ledger, CallRecord(target, method, arguments, keywords))  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "arguments", [[], [b""], [b"", 1 << 63, 0], [b"", 0, -1], [b"", 0, 0, 0], [b"", None, 0], [7, 0, 0]]
)
def test_invalid_states_of_the_host_are_errors(arguments: list[Any]) -> None:
    with pytest.raises(ImudError, match=r"cannot replay a record with the call host\.restore"):
        HostState.of(CallRecord(*HostState.CALL, arguments))
    record = records.encode_object(Kind.CALL, records.NO_DEVICE, CallRecord(*HostState.CALL, arguments))
    with pytest.raises(ImudError):
        states.play([record])
