"""Recordings of each driver with a state in the middle of a run, and the objects below a path with their tables."""

from collections.abc import Iterator, Mapping, Sequence
from random import Random
from typing import Any, Final

import msgspec

from imud.contracts.driver import CanDriver, Driver, PolledDriver, StreamDriver
from imud.drivers import DRIVERS
from imud.drivers.imu61x.uart.codec import encode_ahrs
from imud.formats import records
from imud.formats.records import CallRecord, DeviceRecord, Kind, PathRecord, Record, records_of
from imud.formats.state import CodecState, Field, New, StateTable
from imud.host.clock import SteadyTime
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US
from imud.recording.player import PlayedDevice, Player
from imud.sampling.path import SamplePath
from imud.sampling.state import PATHS, save_path, save_steady
from tests.support.files import hi91

START_NS: Final = 1000 * NS_PER_S
PERIOD_NS: Final = 10 * NS_PER_MS
LINES: Final = {"data_ready": {"chip": "/dev/gpiochip0", "line": 4}}


def device_record(driver: str, *, attitude: bool = False) -> bytes:
    """Return the description of a device with a data-ready line if imud polls the device."""
    configuration: dict[str, Any] = {"lines": LINES} if isinstance(DRIVERS[driver], PolledDriver) else {}
    if attitude:
        configuration["attitude"] = "host"
    made = DeviceRecord("bow", driver, "uart", "/dev/ttyUSB0", configuration, {}, {})
    return records.encode_object(Kind.DEVICE, 0, made)


def path_record(driver: str, state: bytes) -> bytes:
    """Return the start of a path with a state."""
    made = PathRecord(driver, {}, PERIOD_NS, Ledger().snapshot(), state)
    return records.encode_object(Kind.PATH, 0, made)


def inputs(driver: str, first: int, count: int, *, aided: bool = False) -> Iterator[bytes]:
    """Yield the input of samples `first` … of a device, with jitter; `aided`: with edges, triggers and UTC."""
    row, random = DRIVERS[driver], Random(driver)
    for number in range(first, first + count):
        t_ns = START_NS + number * PERIOD_NS + random.randrange(100 * NS_PER_US)
        if aided:
            yield from _aiding(number, t_ns)
        yield _sample(row, number, t_ns, random)


def _aiding(number: int, t_ns: int) -> Iterator[bytes]:
    pulse_ns = START_NS + number * PERIOD_NS - NS_PER_MS
    if number == 0:
        yield records.encode_object(Kind.CALL, 0, CallRecord("clock", "set_utc_reference", [[10**18, 1000]]))
    for line in ("sout", "sout_div"):
        yield records.encode_edges(0, line, [(pulse_ns, True, 2 * number), (pulse_ns + 80_000, False, 2 * number + 1)])
    if number % 100 == 0:
        yield records.encode_edges(0, "pps", [(pulse_ns, True, number // 100)])
    trigger = CallRecord("aiding", "on_trigger_stamps", [[[t_ns - 2 * NS_PER_MS, 1000, number + 1]]])
    yield records.encode_object(Kind.CALL, 0, trigger)


def _sample(row: Driver, number: int, t_ns: int, random: Random) -> bytes:
    if isinstance(row, StreamDriver):
        return records.encode_data(0, stream_frame(row.name, number), t_ns, -1)
    if isinstance(row, CanDriver):
        return records.encode_frames(0, [frame._replace(t_rx_ns=t_ns) for frame in row.example_frames(random)])
    assert isinstance(row, PolledDriver)
    reading = records.ReadingRecord(0, t_ns, t_ns + NS_PER_MS, 0, row.example_reading(random))
    edge = records.encode_edges(0, "data_ready", [(t_ns - NS_PER_MS, True, number)])
    return edge + records.encode_readings(0, [reading])


def stream_frame(driver: str, number: int) -> bytes:
    """Return frame `number` of a device at 100 Hz."""
    if driver == "hipnuc-uart":
        return hi91(10 * number)
    zero = (0.0, 0.0, 0.0)
    return encode_ahrs(
        timer_us=10_000 * number, accel_m_s2=(0.0, 0.0, 9.8), gyro_rad_s=zero, euler_rad=zero, temperature_c=20.0
    )


def play(data: Sequence[bytes]) -> tuple[Player, PlayedDevice, list[Any]]:
    """Replay records of one device. Return the player, the device and the samples."""
    samples: list[Any] = []
    player = Player(lambda batch: samples.extend(batch.samples))
    player.play(record for one in data for record in records_of(one))
    return player, player.devices[0], samples


def path_of(driver: str, count: int = 150, *, aided: bool = False, attitude: bool = False) -> SamplePath:
    """Return the path of a device after `count` samples."""
    data = [device_record(driver, attitude=attitude), path_record(driver, b"")]
    _, device, _ = play([*data, *inputs(driver, 0, count, aided=aided)])
    assert device.path is not None
    return device.path


def state_of(driver: str, count: int = 150, *, aided: bool = False, attitude: bool = False) -> bytes:
    """Return the state of a path after `count` samples."""
    return save_path(path_of(driver, count, aided=aided, attitude=attitude))


def steady_state(count: int = 50) -> bytes:
    """Return the state of a host clock that an NTP client slews."""
    steady = SteadyTime()
    for second in range(count):
        steady.add_pair(second * 1_000_000_500, second * NS_PER_S)
    return save_steady(steady)


def host_record(state: bytes) -> bytes:
    """Return the call that restores the host clocks."""
    return records.encode_object(Kind.CALL, records.NO_DEVICE, CallRecord("host", "restore", [state, 0, 0]))


def objects_of(path: SamplePath) -> Iterator[tuple[StateTable, Any]]:
    """Yield each object below a path with its table."""
    yield from _objects(PATHS[type(path)], path)


def _objects(table: StateTable, value: Any) -> Iterator[tuple[StateTable, Any]]:
    yield table, value
    for field in table.fields:
        yield from _inside(field.type, getattr(value, field.name))


def _inside(kind: Any, value: Any) -> Iterator[tuple[StateTable, Any]]:
    if value is None:
        return
    if isinstance(kind, StateTable):
        yield from _objects(kind, value)
    elif isinstance(kind, New):
        yield from _objects(kind.state, value)
    elif isinstance(kind, CodecState):
        yield from _objects(type(value).STATE, value)
    elif hasattr(kind, "type"):  # a container or an optional value
        items = value.values() if isinstance(value, Mapping) else value
        for item in items if hasattr(kind, "count_max") or isinstance(value, list) else [value]:
            yield from _inside(kind.type, item)


def fields_of(table: StateTable) -> Iterator[Field]:
    """Yield the fields of a table and of all tables inside it."""
    for field in table.fields:
        yield field
        kind: Any = field.type
        while hasattr(kind, "type"):
            kind = kind.type
        if isinstance(kind, New):
            yield from fields_of(kind.state)
        elif isinstance(kind, StateTable):
            yield from fields_of(kind)


Leaf = tuple[int | str, ...]


def leaves(tree: Any, path: Leaf = ()) -> Iterator[Leaf]:
    """Yield the place of each value in a decoded state, containers included."""
    yield path
    pairs = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list | tuple) else ()
    for key, item in pairs:
        yield from leaves(item, (*path, key))


def replaced(tree: Any, path: Leaf, value: Any) -> Any:
    """Return a decoded state with another value at a place."""
    if not path:
        return value
    key, *rest = path
    if isinstance(tree, dict):
        return {**tree, key: replaced(tree[key], tuple(rest), value)}
    return [replaced(item, tuple(rest), value) if index == key else item for index, item in enumerate(tree)]


BAD_VALUES: Final[tuple[Any, ...]] = (
    None, True, -1, 0, 1, 2, 1 << 20, 1 << 53, (1 << 63) - 1, -(1 << 63), (1 << 64) - 1, 0.0, -0.0, 1e-320, 1e-3, -1.5,
    1e18, -1e18, 1e308, float("nan"), float("inf"), float("-inf"), "", "os:system", "x" * 1000, b"", b"\0" * 5000, [],
    {}, [None], [0] * 5000, [[[[[0]]]]], {"__class__": 1}, {1: 2}, ["f", "os:system"],
)  # fmt: skip


def decoded(state: bytes) -> Any:
    """Return the tree of a state."""
    return msgspec.msgpack.decode(state, strict=False)


def record_of(data: bytes) -> Record:
    """Return the only record of the bytes."""
    (record,) = records_of(data)
    return record
