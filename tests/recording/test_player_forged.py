"""Forged recordings: they supply values only, and they can only cause an error."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud import __version__
from imud.cli import main
from imud.drivers import DRIVERS
from imud.formats import records
from imud.formats.recording import BlockGatherer
from imud.formats.records import CallRecord, DeviceRecord, Kind, PathRecord, SessionRecord, records_of
from imud.model.errors import ImudError
from imud.model.ledger import LEDGER_FIELDS, Ledger
from imud.model.units import NS_PER_S
from imud.recording.player import DEVICES_MAX, NOTES_MAX, OFFSETS_MAX, Player, RecordedClock
from tests.support import states
from tests.support.states import device_record, host_record, inputs, path_record, play, state_of, steady_state

DRIVER = "hipnuc-uart"


def session(epoch: int = 1, version: str = __version__) -> bytes:
    made = SessionRecord(records.VERSION, version, "3.13", "host", epoch, 0, NS_PER_S, NS_PER_S)
    return records.encode_object(Kind.SESSION, records.NO_DEVICE, made)


def file_of(data: Sequence[bytes]) -> bytes:
    gatherer = BlockGatherer()
    return b"".join(gatherer.add(record) for record in data) + gatherer.finish()


def objects_by_name(command: bytes) -> bytes:
    """Return a state with names of classes and functions, as before the tables. A call of the clock runs a command."""
    registry = "imud.contracts.registry:Registry"
    rows = [4, "dict", [["bad", "os:system"], ["measure", "os:getpid"]]]
    plugins = [14, "tuple", [[15, "dict", []], [16, "dict", []]]]
    parts = {"rows": rows, "kind": "x", "_group": None, "_modules": [5, "dict", []], "_plugins": plugins}
    decoder_parts = {"stale": 0, "_ledger": ["x", "ledger"], "_size_bytes": len(command), "_last": b""}
    decoder = [6, "object", "imud.drivers.polled_frames:PolledFrameDecoder", decoder_parts]
    imports = [3, "object", registry, parts]
    restart = [7, "partial", ["b", decoder, "decode"], [8, "tuple", [command]], imports]
    clock = [9, "object", registry, {"rows": [10, "dict", []], "kind": "x", "_group": None, "restart": restart}]
    return msgspec.msgpack.encode({"path": (0, {"clock": clock})})


@pytest.mark.parametrize("arguments", [["replay"], ["export", "-o", "out.csv"], ["noise"], ["spectrum"], ["info"]])
def test_a_recording_runs_no_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> None:
    monkeypatch.chdir(tmp_path)
    state = objects_by_name(f"touch {tmp_path}/proof".encode())
    restart = records.encode_object(Kind.CALL, 0, CallRecord("clock", "restart"))
    data = [session(), device_record(DRIVER), path_record(DRIVER, state), restart, *inputs(DRIVER, 0, 20)]
    (tmp_path / "forged.imurec").write_bytes(file_of(data))
    main([arguments[0], "forged.imurec", *arguments[1:]])
    assert not (tmp_path / "proof").exists()


@pytest.mark.parametrize(
    "state", [objects_by_name(b"true"), b"\x92\x01\x81\x01\x07", b"junk", b"\xdd\xff\xff\xff\xff" * 9]
)
def test_an_invalid_state_starts_a_new_clock(state: bytes) -> None:
    _, device, samples = play([device_record(DRIVER), path_record(DRIVER, state), *inputs(DRIVER, 0, 20)])
    assert len(samples) == 20
    (reason,) = device.fresh_starts
    assert reason.startswith("cannot restore the state: ")


@pytest.mark.parametrize("driver", ["os:system", "imud.drivers.hipnuc.uart.driver:DRIVER", "", "__class__", "auto"])
def test_the_driver_is_a_row_of_the_registry(driver: str) -> None:
    """The name in a recording never imports a module."""
    modules = set(sys.modules)
    device = records.encode_object(Kind.DEVICE, 0, DeviceRecord("bow", driver, "uart", "", {}, {}, {}))
    with pytest.raises(ImudError, match="no driver named"):
        play([device, path_record(driver, b"")])
    assert set(sys.modules) == modules
    assert isinstance(DRIVERS.rows, type(type.__dict__))


def test_fresh_ignores_the_state_of_the_host() -> None:
    data = [
        session(), host_record(steady_state()), device_record(DRIVER), path_record(DRIVER, state_of(DRIVER)),
        *inputs(DRIVER, 150, 9),
    ]  # fmt: skip
    steered = []
    for is_fresh in (False, True):
        player = Player(lambda _batch: None, fresh=is_fresh)
        player.play(record for one in data for record in records_of(one))
        path = player.devices[0].path
        assert path is not None
        steered.append(path.clock.status().steering_ppm)
        assert player.devices[0].fresh_starts == ["a new clock was requested"] * is_fresh
    assert steered[0] == pytest.approx(0.5, rel=1e-3)
    assert steered[1] == 0


@pytest.mark.parametrize(
    "state", [b"", b"junk", steady_state()[:-1], msgspec.msgpack.encode([1, {2: [2, 1], 3: [0, 0]}])]
)
def test_an_invalid_state_of_the_host_starts_new_clocks(state: bytes) -> None:
    """The state of a device refers to the clocks of the host."""
    path = path_record(DRIVER, state_of(DRIVER))
    data = [session(), host_record(state), device_record(DRIVER), path, *inputs(DRIVER, 150, 9)]
    _, device, samples = play(data)
    assert len(samples) == 9
    assert [reason.partition(":")[0] for reason in device.fresh_starts] == ["cannot restore the clocks of the host"]
    _, device, _ = play([*data, host_record(steady_state()), path, *inputs(DRIVER, 200, 9)])
    assert len(device.fresh_starts) == 1


def test_the_version_in_a_recording_is_printable() -> None:
    _, device, _ = play([session(version="0.1\x1b[2J"), device_record(DRIVER), path_record(DRIVER, b"")])
    assert device.fresh_starts[0].isprintable()


# --- memory -------------------------------------------------------------------------------------------------------


def test_stored_differences_are_limited() -> None:
    """Each check record of 100 bytes causes a sentence of 1 kB."""
    ledger = dict.fromkeys(LEDGER_FIELDS, 1)
    check = records.encode_object(Kind.CHECK, 0, records.CheckRecord(1, 5, 5, 5, ledger))
    path = path_record(DRIVER, b"")
    _, device, _ = play([device_record(DRIVER), *[path] * 100, *[check] * 1000])
    assert (device.checks, device.different_checks) == (1000, 1000)
    assert (len(device.differences), len(device.fresh_starts)) == (NOTES_MAX, NOTES_MAX)


def test_the_number_of_devices_is_limited() -> None:
    device = device_record(DRIVER)
    ids = [records.encode(Kind.DEVICE, number, next(records_of(device)).body) for number in range(DEVICES_MAX + 1)]
    with pytest.raises(ImudError, match="expected at most 1024 devices"):
        Player(lambda _batch: None).play(record for one in ids for record in records_of(one))
    runs = [part for epoch in range(DEVICES_MAX + 1) for part in (session(epoch), device)]
    player = Player(lambda _batch: None)
    with pytest.raises(ImudError, match="expected at most 1024 devices"):
        player.play(record for one in runs for record in records_of(one))
    assert len(player.all_devices) == DEVICES_MAX


def test_devices_of_earlier_runs_have_no_path() -> None:
    run = [device_record(DRIVER), path_record(DRIVER, b""), *inputs(DRIVER, 0, 50)]
    player = Player(lambda _batch: None)
    player.play(record for one in [session(1), *run, session(2), *run] for record in records_of(one))
    (earlier,), newest = player.earlier, player.devices[0].path
    assert newest is not None
    assert (earlier.path, earlier.newest) == (None, newest.newest)
    assert earlier.rate_hz == newest.clock.expected_rate_hz > 0


def test_the_number_of_clock_offsets_is_limited() -> None:
    adders: tuple[Callable[[RecordedClock, int], None], ...] = (
        lambda clock, number: clock.add(number, 0, number), lambda clock, number: clock.begin(number),
    )  # fmt: skip
    for add in adders:
        clock = RecordedClock()
        for number in range(OFFSETS_MAX - 1):
            add(clock, number + 1)
        with pytest.raises(ImudError, match="expected at most 65536 runs and suspends"):
            add(clock, OFFSETS_MAX)


# --- times --------------------------------------------------------------------------------------------------------

FAR = (1 << 61) + 1


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    "encode",
    [
        lambda t_ns: records.encode_data(0, b"", t_ns, -1), lambda t_ns: records.encode_data(0, b"", 1, t_ns),
        lambda t_ns: records.encode_edges(0, "sout", [(t_ns, True, 1)]),
        lambda t_ns: records.encode_clocks(records.ClocksRecord(t_ns, 1, 1, 1, 1, 1)),
        lambda t_ns: records.encode_clocks(records.ClocksRecord(1, t_ns, 1, 1, 1, 1)),
        lambda t_ns: records.encode_clocks(records.ClocksRecord(1, 1, t_ns, 1, 1, 1)),
        lambda t_ns: records.encode_clocks(records.ClocksRecord(1, 1, 1, abs(t_ns), 1, 1)),
        lambda t_ns: records.encode_clocks(records.ClocksRecord(1, 1, 1, -1, t_ns, 1)),
        lambda t_ns: records.encode_clocks(records.ClocksRecord(1, 1, 1, 1, 2 * t_ns, 1)),
    ],
)  # fmt: skip
def test_times_far_away_are_errors(encode: Any, sign: int) -> None:
    """Differences of valid times have 64 bits, as in the C code."""
    with pytest.raises(ImudError, match="cannot read"):
        play([device_record(DRIVER), path_record(DRIVER, b""), encode(sign * FAR)])


@pytest.mark.parametrize("driver", sorted(DRIVERS.rows))
def test_a_jump_of_all_times_ends_in_time(driver: str) -> None:
    """The times jump by up to 73 years in both directions. The test counts calls, not time: it must end."""
    data = [device_record(driver), path_record(driver, b""), *inputs(driver, 0, 100)]
    for offset_ns in (1 << 60, -(1 << 60), 10**18, 0):
        data.append(records.encode_clocks(records.ClocksRecord(offset_ns, -offset_ns, 0, 0, offset_ns, 0)))
        data += [moved(one, offset_ns) for one in inputs(driver, 100, 100)]
    try:
        _, device, _ = play(data)
    except ImudError:
        return
    assert device.ledger.samples > 100


def moved(data: bytes, offset_ns: int) -> bytes:
    """Return the records with other times."""
    found = b""
    for record in records_of(data):
        if record.kind == Kind.DATA:
            t_ns, waited_ns, body = records.decode_data(record.body)
            found += records.encode_data(0, body, t_ns + offset_ns, waited_ns)
        elif record.kind == Kind.FRAMES:
            frames = [one._replace(t_rx_ns=one.t_rx_ns + offset_ns) for one in records.decode_frames(record.body)]
            found += records.encode_frames(0, frames)
        elif record.kind == Kind.READINGS:
            readings = [
                one._replace(start_ns=one.start_ns + offset_ns, end_ns=one.end_ns + offset_ns)
                for one in records.decode_readings(record.body)
            ]
            found += records.encode_readings(0, readings)
        else:
            line, edges = records.decode_edges(record.body)
            found += records.encode_edges(0, line, [one._replace(t_ns=one.t_ns + offset_ns) for one in edges])
    return found


def test_large_objects_are_errors() -> None:
    """Each byte of an empty list needs 64 bytes of memory."""
    large = records.encode(Kind.PATH, 0, b"\xdd" + (4 << 20).to_bytes(4, "big") + b"\x90" * (3 << 20))
    with pytest.raises(ImudError, match="expected at most 1310720 bytes"):
        play([device_record(DRIVER), large])


@pytest.mark.parametrize(
    "changes",
    [{"period_ns": -1}, {"period_ns": 1 << 60}, {"ledger": {"samples": -1}}, {"ledger": {"samples": 1 << 60}}],
)
def test_paths_outside_their_range_are_errors(changes: dict[str, Any]) -> None:
    made = msgspec.to_builtins(PathRecord(DRIVER, {}, 0, Ledger().snapshot(), b"")) | {"state": b""} | changes
    with pytest.raises(ImudError, match="cannot read a record of kind 3"):
        play([device_record(DRIVER), records.encode_object(Kind.PATH, 0, made)])


def test_states_of_this_module_are_valid() -> None:
    _, device, _ = play([device_record(DRIVER), path_record(DRIVER, state_of(DRIVER)), *inputs(DRIVER, 150, 9)])
    assert not device.fresh_starts
    assert device.path is not None
    assert len(list(states.objects_of(device.path))) > 10
