"""States of paths: each attribute has a row, a replay continues bit for bit, a forged state supplies values only."""

import sys
from random import Random
from typing import Any

import msgspec
import pytest

from imud.contracts.driver import StreamDriver
from imud.drivers import DRIVERS
from imud.formats.state import New, StateError, StateTable, attribute_names, encode_state
from imud.host.clock import SteadyTime
from imud.model.errors import ImudError
from imud.sampling import attitude
from imud.sampling.state import (
    ATTITUDE,
    FILTER_PERIOD_MAX_NS,
    INTERVALS_MAX,
    PATHS,
    REVISION,
    load_path,
    load_steady,
    save_path,
    save_steady,
)
from tests.support import states
from tests.support.states import BAD_VALUES, decoded, leaves, path_of, replaced, state_of

ALL_DRIVERS = sorted(DRIVERS.rows)
AIDED = [(name, aided) for name in ALL_DRIVERS for aided in (False, True) if not aided or name.endswith("uart")]


@pytest.mark.parametrize(("driver", "aided"), AIDED)
def test_each_attribute_is_state_or_not(driver: str, aided: bool) -> None:
    """A new attribute of a class fails this test until its table names the attribute."""
    path = path_of(driver, aided=aided)
    objects = list(states.objects_of(path))
    assert len(objects) > 10
    for table, value in objects:
        names = attribute_names(value)
        if type(value) in PATHS:  # an attribute of the class if imud does not compute the attitude
            names |= {"attitude"}
        assert names == table.names, type(value).__name__
        assert all(reason for reason in table.other.values())


def test_each_object_has_a_complete_table() -> None:
    """Objects that the runs above do not contain, for example the holdover after a jump."""
    fields = [field for table in PATHS.values() for field in states.fields_of(table)]
    made = 0
    for field in fields:
        kind: Any = field.type
        while hasattr(kind, "type"):
            kind = kind.type
        if isinstance(kind, New) and field.name not in ("_aiding", "sout", "sin"):
            assert attribute_names(kind.make(None)) == kind.state.names
            made += 1
    assert made > 10
    host_attitude = path_of("imu61x-spi", attitude=True).attitude
    assert attribute_names(host_attitude) == ATTITUDE.names


def test_limits_of_the_attitude_are_equal() -> None:
    assert (attitude.PERIOD_MAX_NS, attitude.BLOCK - 1) == (FILTER_PERIOD_MAX_NS, INTERVALS_MAX)


def test_numbers_of_fields_are_unique() -> None:
    tables = {id(table): table for driver in ALL_DRIVERS for table, _ in states.objects_of(path_of(driver))}
    for table in tables.values():
        numbers = [field.number for field in table.fields]
        assert len(set(numbers)) == len(numbers)
        names = [field.name for field in table.fields]
        assert not set(names) & table.other.keys()


@pytest.mark.parametrize(("driver", "aided"), AIDED)
@pytest.mark.parametrize("count", [1, 9, 150])
def test_replay_continues_bit_for_bit(driver: str, aided: bool, count: int) -> None:
    start = [states.device_record(driver), states.path_record(driver, b"")]
    rest = list(states.inputs(driver, count, 150, aided=aided))
    _, live, _ = states.play([*start, *states.inputs(driver, 0, count, aided=aided)])
    assert live.path is not None
    state = save_path(live.path)
    _, played, samples = states.play([start[0], states.path_record(driver, state), *rest])
    _, _, expected = states.play([*start, *states.inputs(driver, 0, count, aided=aided), *rest])
    assert not played.fresh_starts
    assert samples
    assert samples == expected[-len(samples) :]
    assert played.path is not None
    assert save_path(played.path) != state


@pytest.mark.parametrize("driver", ALL_DRIVERS)
def test_state_of_a_loaded_path_is_equal(driver: str) -> None:
    state = state_of(driver)
    path = path_of(driver, 1)
    load_path(path, state)
    assert save_path(path) == state


def nasty_states(driver: str, count: int, *, aided: bool = False, attitude: bool = False) -> list[bytes]:
    """Return states with one bad value each."""
    random, tree = Random(driver), decoded(state_of(driver, aided=aided, attitude=attitude))
    places = list(leaves(tree))
    return [
        msgspec.msgpack.encode(replaced(tree, random.choice(places), random.choice(BAD_VALUES))) for _ in range(count)
    ]


@pytest.mark.parametrize(("driver", "aided"), AIDED)
def test_forged_states_change_values_only(driver: str, aided: bool) -> None:
    """No module is imported, no attribute outside the tables changes, and the replay ends, at worst with ImudError."""
    rest = list(states.inputs(driver, 150, 20, aided=aided))
    start = states.device_record(driver)
    path_of(driver, 2, aided=aided)  # imports the modules of the driver
    accepted, modules = 0, set(sys.modules)
    for state in nasty_states(driver, 150, aided=aided):
        path = path_of(driver, 0)
        others = others_of(path)
        try:
            load_path(path, state)
            accepted += 1
        except StateError:
            pass
        assert all(others[key] is value for key, value in others_of(path).items() if key in others)
        for table, value in states.objects_of(path):
            assert attribute_names(value) <= table.names | {"attitude"}
        try:
            states.play([start, states.path_record(driver, state), *rest])
        except ImudError:
            continue
    assert set(sys.modules) == modules
    assert 0 < accepted < 150


def others_of(path: Any) -> dict[tuple[int, str], Any]:
    """Return the attributes of all objects below a path that are not state and that no table computes."""
    return {
        (id(value), name): getattr(value, name, None)
        for table, value in states.objects_of(path)
        for name, reason in table.other.items()
        if reason in ("set by the constructor", "part of the daemon", "from the options of the driver")
    }


@pytest.mark.parametrize("number", [1, 2, 3, 10, 20])
@pytest.mark.parametrize("value", BAD_VALUES, ids=repr)
def test_wrong_types_of_parts_are_rejected(number: int, value: object) -> None:
    """Numbers of Python that look like booleans, strings and containers are no substitute for a value."""
    tree = decoded(state_of("imu61x-uart", 20))
    part = tree[1][number]
    if type(value) in (dict, type(part), type(None)):
        return
    with pytest.raises(StateError):
        load_path(path_of("imu61x-uart", 1), msgspec.msgpack.encode(replaced(tree, (1, number), value)))


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ((1, 1, 5, 19), float("nan")), ((1, 1, 5, 19), float("inf")), ((1, 1, 5, 19), 0.0), ((1, 1, 5, 19), 1e300),
        ((1, 1, 5, 2), []), ((1, 1, 5, 2), [{}] * 65), ((1, 1, 23, 12, 21), 1e-300), ((1, 1, 23, 12, 21), -1.0),
        ((1, 1, 23, 12, 3), float("inf")), ((1, 1, 23, 12, 16), 12), ((1, 1, 23, 12, 18), [0] * 65),
        ((1, 1, 22), 1 << 62), ((1, 1, 21), (1 << 61) + 1), ((1, 1, 16), -1), ((1, 1, 20), 1 << 32),
        ((1, 4, 3), 9), ((1, 4, 3), "regression"), ((1, 2, 2, 1), b"\0" * 5000), ((1, 2, 1), [["a", 1]]),
        ((1, 20), [1] * 5000), ((0,), REVISION + 1),
    ],
    ids=repr,
)  # fmt: skip
def test_values_outside_their_range_are_rejected(place: tuple[int, ...], value: object) -> None:
    tree = decoded(state_of("imu61x-uart"))
    assert decoded(msgspec.msgpack.encode(replaced(tree, place, value))) != tree
    with pytest.raises(StateError):
        load_path(path_of("imu61x-uart", 1), msgspec.msgpack.encode(replaced(tree, place, value)))


@pytest.mark.parametrize(
    ("number", "value"),
    [(1, 0), (1, 1 << 40), (4, [1] * 32), (6, [0.0, 0.0]), (6, [0.0, float("nan"), 0.0]), (7, float("inf")), (9, {})],
)
def test_forged_attitude_is_rejected(number: int, value: object) -> None:
    tree = decoded(state_of("imu61x-spi", attitude=True))
    with pytest.raises(StateError):
        load_path(
            path_of("imu61x-spi", 1, attitude=True),
            msgspec.msgpack.encode(replaced(tree, (1, 10, number), value)),
        )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gyrQuat", [1.0]), ("gyrQuat", [float("nan")] * 4), ("gyrQuat", [None] * 4), ("bias", 0.0), ("delta", "0"),
        ("restDetected", 1), ("biasP", [float("inf")] * 9), ("accLpState", [1e300] * 6), ("other", 1.0),
    ],
)  # fmt: skip
def test_forged_filter_of_the_attitude_is_rejected(name: str, value: object) -> None:
    tree = decoded(state_of("imu61x-spi", attitude=True))
    tree[1][10][9][name] = value
    with pytest.raises(StateError):
        load_path(path_of("imu61x-spi", 1, attitude=True), msgspec.msgpack.encode(tree))


def test_unknown_and_missing_fields() -> None:
    """A newer imud can add fields. A field that an older imud did not write keeps the value of a new object."""
    tree = decoded(state_of("hipnuc-uart"))
    tree[1][99] = {"any": ["value"]}
    del tree[1][6]
    path = path_of("hipnuc-uart", 0)
    load_path(path, encode_state(REVISION, tree[1]))
    assert path.last_data_ns == 0
    assert path.clock.t_ns > 0


def test_a_state_needs_valid_bytes() -> None:
    path = path_of("hipnuc-uart", 1)
    for data in (b"", b"\xc1", b"\x91" * 10_000, b"\x92\x01\x80\x00", bytes(2 << 20), msgspec.msgpack.encode([1, [2]])):
        with pytest.raises(StateError):
            load_path(path, data)


def test_edge_sources_keep_their_order() -> None:
    tree = decoded(state_of("hipnuc-uart", aided=True))
    aiding = (1, 1, 1)
    for place, value in (((*aiding, 3), [0, 0]), ((*aiding, 3), [0]), ((*aiding, 3), [0, 2]), ((*aiding, 4), 7)):
        with pytest.raises(StateError):
            load_path(path_of("hipnuc-uart", 1), msgspec.msgpack.encode(replaced(tree, place, value)))


@pytest.mark.parametrize("count", [0, 1, 50, 5000])
def test_host_clock_continues(count: int) -> None:
    steady, new = SteadyTime(), SteadyTime()
    for second in range(count):
        steady.add_pair(second * 1_000_000_500, second * 1_000_000_000)
    load_steady(new, save_steady(steady))
    for name in attribute_names(steady):
        assert getattr(new, name) == getattr(steady, name)


@pytest.mark.parametrize(
    ("number", "value"),
    [
        (2, [1, 1]), (2, [2, 1]), (2, [1]), (3, [0, -1]), (3, [1 << 62, 0]), (4, 2), (4, -1), (1, 1.0), (2, [1] * 4097),
        (2, ["a", "b"]), (1, None),
    ],
)  # fmt: skip
def test_forged_host_clocks_are_rejected(number: int, value: object) -> None:
    """The conversion between two readings divides by their distance."""
    state = {1: 0, 2: [1, 2], 3: [0, 0], 4: 0, number: value}
    with pytest.raises(StateError):
        load_steady(SteadyTime(), encode_state(REVISION, state))


def test_codecs_without_a_table_are_named() -> None:
    path = path_of("hipnuc-uart", 1)
    state = save_path(path)

    class Codec:
        unknown = None

    path.codec = Codec()  # type: ignore[attr-defined]  # a codec of another package
    with pytest.raises(StateError, match="no table of the state of its codec Codec"):
        save_path(path)
    with pytest.raises(StateError, match="no table of the state of its codec Codec"):
        load_path(path, state)


@pytest.mark.parametrize("driver", ALL_DRIVERS)
def test_every_codec_has_a_table(driver: str) -> None:
    row: Any = DRIVERS[driver]
    codec = path_of(driver, 0).codec  # type: ignore[attr-defined]  # each path of a driver has one
    assert isinstance(type(codec).STATE, StateTable)
    assert row.name == driver
    assert isinstance(row, StreamDriver) == (driver.endswith("uart"))
