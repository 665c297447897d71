"""The daemon as a process: reconnected devices, reloads, exits with a reason. An unread log, signals and kills."""

import asyncio
import os
import pty
import re
import signal
import socket
import subprocess
import sys
import threading
import tty
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import monotonic_ns, sleep, time_ns
from typing import Any, cast
from unittest.mock import AsyncMock, Mock, PropertyMock

import msgspec
import pytest

from imud.client.ring import Ring
from imud.config import load
from imud.config.model import Config
from imud.contracts.publisher import Publisher
from imud.contracts.status import DeviceState
from imud.daemon import Daemon, Reloader
from imud.device.device import Device
from imud.host.clock import HostClock
from imud.host.scope import Scope
from imud.model.errors import CommandError, ConfigError, ServerError
from imud.model.event import Event, EventKind
from imud.model.units import NS_PER_S
from imud.publishers.shm import ShmOptions
from imud.utc.system_clock import KernelClock
from tests.support.daemon_process import LIMIT_S, RunningDaemon, running_daemon, wait_until, write_config
from tests.support.event_loops import in_loop
from tests.support.files import hi91
from tests.support.surroundings import pipe

MISSING = 250
RUN = (sys.executable, "-m", "imud", "run", "--config")
EMPTY = Config("info", "", {}, ())


class Cable:
    """A pty with a stable name for its slave, like an adapter below /dev/serial/by-id."""

    def __init__(self, name: Path) -> None:
        self.name = name
        self.ms = 0
        self.plug()

    def plug(self) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.name.symlink_to(os.ttyname(slave))
        self.slave: int | None = slave

    def hold_no_more(self) -> None:
        """Close the test's descriptor of the slave, so that only the daemon has it open."""
        if self.slave is not None:
            os.close(self.slave)
            self.slave = None

    def unplug(self) -> None:
        self.name.unlink()
        self.hold_no_more()
        os.close(self.master)

    def send(self, frames: int = 1) -> None:
        for _ in range(frames):
            self.ms += 10
            os.write(self.master, hi91(self.ms))


@contextmanager
def cable(folder: Path) -> Iterator[Cable]:
    one = Cable(folder / "port")
    try:
        yield one
    finally:
        one.unplug()


def device(path: Path, **more: Any) -> dict[str, Any]:
    return {"driver": "hipnuc-uart", "identify": False, "uart": {"port": str(path), "baud": 115200}, **more}


def samples(daemon: RunningDaemon, name: str = "bow") -> int:
    return daemon.statuses()[name].ledger["samples"]


@pytest.mark.live
def test_a_port_that_appears_is_taken_each_time(tmp_path: Path) -> None:
    with running_daemon(tmp_path, {"bow": device(tmp_path / "port")}) as daemon:
        assert daemon.wait_for("bow", "missing").connects == 0
        with cable(tmp_path) as port:
            daemon.wait_for("bow", "searching")
            port.send(5)
            wait_until(lambda: samples(daemon) == 5, "five samples")
            port.unplug()
            daemon.wait_for("bow", "missing")
            port.plug()
            wait_until(lambda: daemon.statuses()["bow"].connects == 2, "the port is open again")
            port.send(5)
            wait_until(lambda: samples(daemon) == 10, "five more samples")
            status = daemon.wait_for("bow", "running")
            assert (status.newest_seq, status.ledger["bytes_in"]) == (10, 10 * 82)
            assert status.ledger["bytes_in_good_frames"] == 10 * 82


@in_loop
async def test_the_thread_that_closes_is_there_from_the_beginning() -> None:
    """A new thread after an unplug would need memory and a process id, which may not be available."""
    daemon = Daemon(EMPTY)
    running = asyncio.create_task(daemon.run())
    await asyncio.sleep(0)
    threads = set(threading.enumerate())
    assert [thread.name for thread in threads if thread.name.startswith("imud close")]
    loop = asyncio.get_running_loop()
    await asyncio.gather(*(loop.run_in_executor(None, sleep, 0.02) for _ in range(4)))
    assert not set(threading.enumerate()) - threads
    daemon.stop()
    await running


def test_outputs_learn_whether_the_clock_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    for is_kept in (True, False):
        monkeypatch.setattr("imud.daemon.kernel_clock", lambda: KernelClock(is_kept, 50, 0))  # noqa: B023 - called here
        found = Daemon(EMPTY)._context.clock.utc_reference()
        assert (found is not None) == is_kept
        if found is not None:
            assert found.error_ns == 50_000
            assert abs(found.offset_ns - (time_ns() - monotonic_ns())) < NS_PER_S


def test_outputs_do_not_read_the_clocks_that_stamp_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread of an output that read them changed the steady time between two samples, and a replay differed."""
    monkeypatch.setattr("imud.daemon.kernel_clock", lambda: KernelClock(True, 50, 0))
    clock = Daemon(EMPTY)._context.clock
    monkeypatch.delattr(HostClock, "utc_offset_ns")
    assert abs(clock.utc_offset_ns() - (time_ns() - monotonic_ns())) < NS_PER_S
    assert clock.utc_reference() is not None


@in_loop
async def test_an_unknown_device_and_ticks_at_two_rates(monkeypatch: pytest.MonkeyPatch) -> None:
    alarm, daemon = Mock(due_s=1.0), Daemon(EMPTY)
    monkeypatch.setattr("imud.daemon.Alarm", lambda _owner: alarm)
    running = asyncio.create_task(daemon.run())
    await asyncio.sleep(0)
    with pytest.raises(CommandError, match=r"^nobody: no such device$"):
        daemon.control("nobody")
    daemon._devices["bow"] = device = Mock()
    daemon._scopes["bow"] = Scope("bow", Mock())
    daemon.tick_soon()
    daemon.tick_soon()  # the first request is enough
    monkeypatch.setattr("imud.publishers.outputs.Outputs.tick", lambda *_: daemon.tick_soon())
    alarm.due_s = None  # as during a tick
    daemon.on_alarm()
    assert [call.args for call in alarm.set.call_args_list] == [(0.5,), (0.1,), (0.1,)]
    daemon._is_soon, daemon._devices_due_ns = False, 1 << 62
    daemon.on_alarm()  # between two ticks of quiet devices
    assert device.tick.call_count == 1
    daemon.stop()
    await running


@in_loop
async def test_a_reload_without_any_usable_directory_keeps_the_daemon(tmp_path: Path) -> None:
    """Both the old and the new directory of shared memory are missing, and imud cannot create them."""
    old, new = tmp_path / "a" / "old", tmp_path / "b" / "new"
    old.mkdir(parents=True)
    daemon = Daemon(Config("info", "", {"shm": ShmOptions(directory=str(old))}, ()))
    running = asyncio.create_task(daemon.run())
    await asyncio.sleep(0)
    old.rmdir()
    old.parent.rmdir()
    await daemon.change_to(Config("info", "", {"shm": ShmOptions(directory=str(new))}, ()))
    assert daemon.config.publishers["shm"] == ShmOptions(directory=str(old))
    assert "not yet: shm" in daemon._summary()
    daemon._outputs.tick(monotonic_ns() + 100 * NS_PER_S)  # a later attempt
    assert not running.done()
    old.parent.mkdir()
    daemon._outputs.tick(monotonic_ns() + 1000 * NS_PER_S)
    assert "outputs: shm" in daemon._summary()
    daemon.stop()
    await running


class EndingOutput:
    """An output that raises an exception in some methods on request."""

    def __init__(self, *failing: str) -> None:
        self.failing = failing
        self.did: list[str] = []
        self.ends = False

    def __getattr__(self, name: str) -> Any:
        def do(*_: object) -> None:
            self.did.append(name)
            if self.ends and name in self.failing:
                raise RuntimeError(name)

        return do


@pytest.mark.parametrize("is_ticking", [True, False])
@in_loop
async def test_whatever_a_part_raises_at_the_end_all_others_are_closed(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, is_ticking: bool
) -> None:
    outputs = {"a": EndingOutput("tick", "close"), "b": EndingOutput("close"), "c": EndingOutput()}
    extra = cast("dict[str, Publisher]", outputs if is_ticking else {})
    daemon = Daemon(EMPTY, extra=extra)
    running = asyncio.create_task(daemon.run())
    await asyncio.sleep(0)
    for name in () if is_ticking else ("bow", "stern"):
        monkeypatch.setitem(daemon._devices, name, Mock(close=Mock(side_effect=RuntimeError(name))))
    for output in outputs.values():
        output.ends = True
    daemon.stop()
    with pytest.raises(RuntimeError, match="tick" if is_ticking else "bow"):  # the first exception is the reason
        await running
    assert f"{'b' if is_ticking else 'stern'}: the end failed" in caplog.text
    assert not is_ticking or [output.did[-2:] for output in outputs.values()] == [["tick", "close"]] * 3


@in_loop
async def test_a_reload_that_fails_ends_the_daemon_and_other_ends_do_not(caplog: pytest.LogCaptureFixture) -> None:
    daemon = Daemon(EMPTY)
    running = asyncio.create_task(daemon.run())
    for end, *result in (("set_result", None), ("cancel",), ("set_exception", KeyError("broken"))):
        for _ in range(9):
            await asyncio.sleep(0)
        assert not running.done()
        future = asyncio.get_running_loop().create_future()
        getattr(future, end)(*result)
        daemon._on_reloaded(cast("asyncio.Task[None]", future))
    with pytest.raises(KeyError, match="broken"):
        await running
    for error in (None, ServerError("it failed")):  # the caller prints the words of imud's own errors
        running = asyncio.create_task(Daemon(EMPTY).run())
        await asyncio.sleep(0)
        asyncio.get_running_loop().call_exception_handler({"message": "it failed", "exception": error})
        with pytest.raises(ServerError if error else RuntimeError, match=r"^it failed$"):
            await running
    assert [one.getMessage() for one in caplog.records if one.levelname == "ERROR"][-2:].count("it failed") == 1


@pytest.mark.parametrize("end", ["update", "second stop"])
@in_loop
async def test_stop_waits_for_a_firmware_update(
    end: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = Daemon(EMPTY)
    update_end = asyncio.Event()
    update = Mock(wait_for_end=lambda _limit_s: update_end.wait())
    type(update).is_interruptible = PropertyMock(side_effect=update_end.is_set)
    device = Mock(firmware=update)
    running = asyncio.create_task(daemon.run())
    await asyncio.sleep(0)
    monkeypatch.setitem(daemon._devices, "bow", device)

    daemon.stop()
    for _ in range(9):
        await asyncio.sleep(0)
    assert not running.done()
    device.close.assert_not_called()
    if end == "update":
        update_end.set()
    else:
        daemon.stop()
    await running
    device.close.assert_called_once()
    assert "imud stops after the firmware update of bow, at most 80 s" in caplog.text
    assert ("start imud and repeat the update" in caplog.text) == (end == "second stop")


def config_of(folder: Path, **devices: dict[str, Any]) -> Config:
    """Return a configuration without outputs for devices with missing ports and these keys."""
    found = load(write_config(folder, {name: device(folder / name, **keys) for name, keys in devices.items()}))
    return replace(EMPTY, devices=found.devices)


@in_loop
async def test_a_reload_starts_and_stops_devices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def past() -> list[str]:
        return [event.message for event in daemon._context.past_events.newest(0, 99).events]

    async def count_turns() -> None:
        while not running.done():
            turns.append(1)
            await asyncio.sleep(0)

    output, turns = EndingOutput(), list[int]()
    daemon = Daemon(config_of(tmp_path, bow={}, stern={}), extra={"a": cast(Publisher, output)})
    running = asyncio.create_task(daemon.run())
    for _ in range(9):
        await asyncio.sleep(0)
    statuses, counting = daemon.each_status(), asyncio.create_task(count_turns())
    assert [(status.name, status.state) for status in daemon.status()] == [("bow", "missing"), ("stern", "missing")]
    assert next(statuses).name == "bow"
    for name in ("bow", "stern"):
        daemon.send_event(Event(1, name, EventKind.MARK, name))
    await daemon.change_to(config_of(tmp_path, bow={"convention": "enu-flu"}, mast={}))
    assert len(turns) == 4  # one stopped, one stopped and started again, one started
    assert list(statuses) == []  # a reload removed the device in the meantime
    assert [one.name for one in daemon.configured_devices()] == [one.name for one in daemon.status()] == ["bow", "mast"]
    assert {"bow", "mast", "stern"} & {task.get_name() for task in asyncio.all_tasks()} == {"bow", "mast"}
    assert (set(past()) & {"bow", "stern"}, output.did.count("remove_device")) == ({"bow"}, 2)
    assert daemon._latencies.need("bow")
    with pytest.raises(KeyError):
        daemon._latencies.need("stern")
    daemon.refuse(ConfigError("f.yaml:3: wrong"))
    assert past()[-1] == "the new configuration is invalid: f.yaml:3: wrong"
    monkeypatch.setattr("imud.publishers.outputs.Outputs.add_device", Mock(side_effect=ServerError("it is full")))
    for keys in ({}, {"convention": "enu-flu"}):  # the second reload changes a device that is not running
        await daemon.change_to(config_of(tmp_path, stern=keys))
        assert past()[-1].endswith("; stern cannot be started: it is full")
    monkeypatch.undo()
    monkeypatch.setattr(Device, "run", AsyncMock(side_effect=KeyError("broken")))
    await daemon.change_to(config_of(tmp_path, stern={}))  # the next reload starts the device
    for _ in range(9):
        await asyncio.sleep(0)
    assert daemon.status()[0].problem == "internal error KeyError: 'broken'; imud starts this device again in 1 s"
    daemon.stop()
    await running
    await counting
    monkeypatch.setattr(Device, "run", AsyncMock())
    monkeypatch.setattr(Device, "state", DeviceState.FINISHED)
    await Daemon(config_of(tmp_path, bow={}), until_finished=True).run()


@in_loop
async def test_a_failed_device_of_imud_starts_again_after_a_pause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An internal error in one device ended the daemon with all devices."""
    run = AsyncMock(side_effect=SystemExit(0))
    monkeypatch.setattr(Device, "run", run)
    daemon = Daemon(config_of(tmp_path, bow={}))
    running = asyncio.create_task(daemon.run())
    for pause_s in (1, 2, 4):
        for _ in range(9):
            await asyncio.sleep(0)
        (status,) = daemon.status()
        assert (status.state, status.word) == ("failed", "missing")
        assert status.problem == f"internal error SystemExit: 0; imud starts this device again in {pause_s} s"
        due_ns = daemon._restarts["bow"].due_ns
        daemon._restart_devices(due_ns - 1)
        assert daemon.status()[0].state == "failed"
        daemon._restart_devices(due_ns)
        assert daemon.status()[0].state == "missing"
    assert run.call_count == 4
    assert "bow: internal error SystemExit: 0; imud continues without this device" in caplog.text
    daemon.stop()
    await running


@in_loop
async def test_a_status_that_fails_ends_only_its_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = Daemon(config_of(tmp_path, bow={}, stern={}))
    running = asyncio.create_task(daemon.run())
    for _ in range(9):
        await asyncio.sleep(0)
    device = daemon._devices["bow"]
    good = device.status
    monkeypatch.setattr(device, "status", Mock(side_effect=[KeyboardInterrupt(), good(), good()]))
    assert [status.name for status in daemon.status()] == ["bow", "stern"]
    assert [status.state for status in (good(), daemon.status()[1])] == ["failed", "missing"]
    daemon.stop()
    await running


@in_loop
async def test_a_block_and_a_growth_are_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    daemon = Daemon(config_of(tmp_path, bow={}))
    running = asyncio.create_task(daemon.run())
    for _ in range(9):
        await asyncio.sleep(0)
    bow = daemon._devices["bow"]
    daemon.on_blocked(daemon._scopes["bow"], 8 * NS_PER_S)
    blocked = "the driver hipnuc-uart of the device bow blocked imud for 8.0 s; all devices lost samples or time"
    assert daemon.status()[0].problem == blocked
    bow.tick(monotonic_ns() + 601 * NS_PER_S)
    assert daemon.status()[0].problem == ""
    daemon.on_blocked(None, 3 * NS_PER_S)
    monkeypatch.setattr(Device, "is_of_other_package", True)
    daemon.on_growth("imud uses 500 MiB of memory, 100 MiB after its start")
    leak = "imud uses 500 MiB of memory, 100 MiB after its start; the driver hipnuc-uart of another package may leak"
    assert daemon.status()[0].problem == leak
    messages = [event.message for event in daemon._context.past_events.newest(0, 99).events]
    assert {blocked, leak, "an unknown part blocked imud for 3.0 s"} <= set(messages)
    daemon.stop()
    await running


def reload(daemon: RunningDaemon, devices: dict[str, Any], **more: Any) -> None:
    """Write another configuration and reload the daemon."""
    write_config(daemon.folder, devices, **more)
    daemon.signal(signal.SIGHUP)


@pytest.mark.live
def test_reload_changes_what_differs_and_keeps_the_rest(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with (
        cable(tmp_path / "a") as bow,
        cable(tmp_path / "b") as stern,
        running_daemon(tmp_path, {"bow": device(bow.name)}) as daemon,
    ):
        daemon.wait_for("bow", "searching")
        bow.send(3)
        wait_until(lambda: samples(daemon) == 3, "three samples")
        both = {"bow": device(bow.name), "stern": device(stern.name)}
        reload(daemon, both)
        wait_until(lambda: "stern" in daemon.statuses(), "the new device is there")
        daemon.wait_for("stern", "searching")
        stern.send(2)
        wait_until(lambda: samples(daemon, "stern") == 2, "samples of the new device")
        assert Ring(tmp_path / "imud.stern").newest_seq == 2
        # a new output receives the samples in place of the old output
        for place, newest in (("first", 5), ("second", 7)):
            (tmp_path / place).mkdir(mode=0o755)
            ring = tmp_path / place / "imud.bow"
            reload(daemon, both, shm={"directory": str(tmp_path / place)})
            wait_until(ring.exists, "the new ring is there")
            bow.send(2)
            wait_until(lambda: samples(daemon) == newest, "two more samples")  # noqa: B023 - it is called here
            assert Ring(ring).newest_seq == newest
        assert daemon.statuses()["bow"].connects == 1
        reload(daemon, {"stern": device(stern.name)})
        wait_until(lambda: "bow" not in daemon.statuses(), "the old device is gone")
        assert not (tmp_path / "imud.bow").exists()
        assert samples(daemon, "stern") == 2


@pytest.mark.live
def test_a_reload_that_changes_little_or_cannot_be_used_is_an_event(tmp_path: Path) -> None:
    with cable(tmp_path) as port, running_daemon(tmp_path, {"bow": device(port.name)}) as daemon:
        daemon.wait_for("bow", "searching")
        with daemon.client() as client:
            found = client.events(timeout_s=LIMIT_S)
            events = (event for event in found if event.kind != "condition")
            reload(daemon, {"bow": device(port.name)}, state_dir=str(tmp_path / "other"))
            assert next(events).message == (
                "configuration read again: keys changed: state_dir; a new state_dir needs a restart of imud"
            )
            file = tmp_path / "imud.yaml"
            file.write_text("devices:\n  bow:\n    baudd: 9600\n")
            daemon.signal(signal.SIGHUP)
            event = next(events)
            assert event.kind == "configuration"
            assert "imud.yaml:3" in event.message
            assert "baudd" in event.message
            file.unlink()
            os.mkfifo(file)
            daemon.signal(signal.SIGHUP)
            assert "is a FIFO" in next(events).message
        port.send(2)
        wait_until(lambda: samples(daemon) == 2, "samples still flow")


@pytest.mark.live
def test_second_daemon_is_refused_with_the_reason(tmp_path: Path) -> None:
    with running_daemon(tmp_path, {}) as daemon:
        argv = [*RUN, str(tmp_path / "imud.yaml")]
        again = subprocess.run(argv, capture_output=True, text=True, timeout=LIMIT_S, check=False)
        assert again.returncode == 75
        assert re.search(r"CRITICAL .*imud\.sock", again.stderr)
        assert "Traceback" not in again.stderr
        assert daemon.statuses() == {}
        daemon.signal(signal.SIGINT)  # all other tests use SIGTERM
        assert daemon.process.wait(LIMIT_S) == 0


@pytest.mark.live
def test_port_in_use_is_told_and_taken_when_free(tmp_path: Path) -> None:
    with cable(tmp_path) as port, running_daemon(tmp_path, {"bow": device(port.name)}) as first:
        first.wait_for("bow", "searching")
        other = tmp_path / "other"
        other.mkdir()
        with running_daemon(other, {"bow": device(port.name)}) as second:
            status = second.wait_for("bow", "failed")
            assert str(port.name) in status.problem
            first.signal(signal.SIGTERM)
            second.wait_for("bow", "searching")
            port.send(3)
            second.wait_for("bow", "running")


@pytest.mark.live
def test_metrics_and_socket_and_shared_memory_show_the_same_ledger(tmp_path: Path) -> None:
    """The port of the metrics is taken at first; imud tries it again."""
    log = tmp_path / "log"
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as holder, cable(tmp_path) as port:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        number = holder.getsockname()[1]
        with running_daemon(tmp_path, {"bow": device(port.name)}, metrics={"port": number}) as daemon:
            wait_until(lambda: "has started" in log.read_text(), "the devices are searched for")
            assert f"port {number}: Address already in use" in log.read_text()
            assert "imud continues without this output and tries again" in log.read_text()
            assert "outputs: socket, shm (not yet: metrics)" in log.read_text()
            holder.close()
            wait_until(lambda: "metrics: started" in log.read_text(), "the port is taken")
            daemon.wait_for("bow", "searching")
            port.send(4)
            os.write(port.master, b"\x00garbage\xff" + hi91(1)[:50])
            wait_until(lambda: daemon.statuses()["bow"].ledger["bytes_in"] == 4 * 82 + 59, "all bytes are in")
            ledger = daemon.statuses()["bow"].ledger
            with Ring(tmp_path / "imud.bow") as ring:
                wait_until(lambda: (now := ring.ledger()) is not None and now.ledger == ledger, "the same in the ring")
            with urllib.request.urlopen(f"http://127.0.0.1:{number}/metrics", timeout=LIMIT_S) as answer:
                text = answer.read().decode()
    assert f'imud_bytes_in_total{{device="bow"}} {float(ledger["bytes_in"])}' in text
    assert f'imud_samples_total{{device="bow"}} {float(ledger["samples"])}' in text
    assert "imud has stopped" in log.read_text()


@pytest.mark.live
def test_found_device_is_remembered_over_a_restart(tmp_path: Path) -> None:
    auto = {"driver": "auto", "identify": False, "uart": {"port": str(tmp_path / "port"), "baud": "auto"}}
    with cable(tmp_path) as port:
        with running_daemon(tmp_path, {"bow": auto}) as daemon:
            daemon.wait_for("bow", "searching")

            def heard() -> bool:
                port.send(1)
                return daemon.statuses()["bow"].state == "running"

            wait_until(heard, "the device is found")
        remembered = msgspec.json.decode((tmp_path / "found.json").read_bytes())
        assert remembered["bow"]["driver"] == "hipnuc-uart"


def missing(folder: Path, count: int, **more: Any) -> dict[str, Any]:
    """Return devices with missing ports."""
    return {f"m{number}": device(folder / f"none{number}", **more) for number in range(count)}


@pytest.mark.live
def test_a_log_that_nobody_reads_costs_no_sample(tmp_path: Path) -> None:
    """Reports of noise and of reloads fill the log. Its pipe is full from the start."""
    file = write_config(tmp_path, {"bow": device(tmp_path / "port")})
    with (
        pipe(full=True) as (_, descriptor),
        cable(tmp_path) as port,
        subprocess.Popen([*RUN, str(file)], stderr=descriptor, stdin=subprocess.DEVNULL, text=True) as process,
    ):
        daemon = RunningDaemon(tmp_path, process)
        try:
            wait_until(daemon.socket.exists, "the daemon's socket")
            daemon.wait_for("bow", "searching")
            for sent in range(0, 1000, 100):
                os.write(port.master, b"\x5a\xa5garbage")
                daemon.signal(signal.SIGHUP)
                for _ in range(4):
                    port.send(25)
                wait_until(lambda: samples(daemon) == sent + 100, "every sample is there")  # noqa: B023 - called here
            assert daemon.statuses()["bow"].ledger["lost_queue"] == 0
        finally:
            process.terminate()
            assert process.wait(LIMIT_S) == 0


class Manager:
    """Socket of a service manager, and the received messages with their times."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self.states: list[str] = []
        self.status = ""
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while (data := self._socket.recv(4096)) != b"end":
            state, _, value = data.decode().partition("=")
            if state == "STATUS":
                self.status = value
            else:
                self.states.append(state)

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"end", str(self.path))
        self._thread.join(LIMIT_S)
        self._socket.close()


class SlowTarget(Daemon):
    """A daemon that applies a configuration when `go` is set."""

    def __init__(self) -> None:
        self.begun, self.go = asyncio.Event(), asyncio.Event()
        self.applied: list[str] = []

    async def change_to(self, new: Config) -> None:
        self.begun.set()
        await self.go.wait()
        self.applied.append(new.log_level)

    def refuse(self, error: ConfigError) -> None:
        self.applied.append(str(error))


@in_loop
async def test_requests_during_a_reload_are_one_reload_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told, slept_s = list[str](), list[float]()
    monkeypatch.setattr("imud.daemon.notify", told.append)
    monkeypatch.setattr("imud.daemon.time.sleep", slept_s.append)
    file, target, done = tmp_path / "imud.yaml", SlowTarget(), asyncio.Event()
    reloader = Reloader(file, cast(Daemon, target), HostClock(lambda: 5000))

    def request(level: str) -> None:
        file.write_text(f"log_level: {level}\ndevices: {{}}")
        reloader.request(lambda _task: done.set())

    request("debug")
    await target.begun.wait()
    for level in ("error", "info", "warning"):
        request(level)
    target.go.set()
    await done.wait()
    assert target.applied == ["debug", "warning"]
    done.clear()
    request("loud")
    await done.wait()
    assert target.applied[2].startswith(f"{file}:1:12: log_level: ")
    done.clear()
    monkeypatch.setattr("imud.daemon.configuration.load", lambda _file, pause: pause() or 1 // 0)
    request("info")
    await done.wait()
    assert target.applied[3].startswith(f"{file}: ZeroDivisionError: ")
    assert (told, slept_s[-1]) == (["RELOADING=1\nMONOTONIC_USEC=5", "READY=1"] * 4, 100e-6)
    await reloader.close()
    await reloader.close()


@in_loop
async def test_a_reload_ends_with_an_error_of_its_own_and_with_the_daemon(tmp_path: Path) -> None:
    file, target = tmp_path / "imud.yaml", SlowTarget()
    file.write_text("devices: {}")
    reloader = Reloader(file, cast(Daemon, target), HostClock())
    tasks: list[asyncio.Task[None]] = []
    reloader.request(tasks.append)
    await asyncio.sleep(0)
    await reloader.close()
    await asyncio.sleep(0)
    assert ([task.cancelled() for task in tasks], target.applied) == ([True], [])


@pytest.mark.live
def test_the_manager_knows_of_reloads_and_one_may_be_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manager = Manager(tmp_path / "manager")
    monkeypatch.setenv("NOTIFY_SOCKET", str(manager.path))
    quiet: dict[str, Any] = {"shm": {"enabled": False}}
    try:
        with running_daemon(tmp_path, {}, python=(), **quiet) as daemon:
            wait_until(lambda: manager.states == ["READY"], "it is ready")
            write_config(tmp_path, missing(tmp_path, MISSING), **quiet)
            for _ in range(20):
                daemon.signal(signal.SIGHUP)
            wait_until(lambda: len(daemon.statuses()) == MISSING, "all devices are there")
            problem = f"{MISSING} of {MISSING} devices have a problem: "
            wait_until(lambda: manager.status.startswith(problem), "the status line names the devices")
            write_config(tmp_path, {}, **quiet)
            daemon.signal(signal.SIGHUP)
            wait_until(lambda: not daemon.statuses(), "the newest file counts")
            wait_until(lambda: manager.states[-1] == "READY", "it is ready again")
            reloads = manager.states[1:]
            assert reloads == ["RELOADING", "READY"] * (len(reloads) // 2)
            write_config(tmp_path, missing(tmp_path, MISSING), **quiet)
            daemon.signal(signal.SIGHUP)
            wait_until(lambda: manager.states[-1] == "RELOADING" or daemon.statuses(), "the reload has begun")
    finally:
        manager.close()
    assert manager.states[-1] == "STOPPING"


@pytest.mark.live
def test_killed_at_any_moment_it_starts_again(tmp_path: Path) -> None:
    devices, log, state = missing(tmp_path, 20), tmp_path / "log", tmp_path / "imud.sock"
    file = write_config(tmp_path, devices)
    moments: list[Callable[[], object]] = [
        lambda: True, lambda: list(tmp_path.glob("imud.m*")), state.exists, lambda: "has started" in log.read_text()
    ]  # fmt: skip
    for moment in moments:
        for left in tmp_path.glob("imud.[ms]*"):
            left.unlink()
        with log.open("wb") as stream, subprocess.Popen([*RUN, str(file)], stderr=stream) as process:
            wait_until(moment, "the moment")
            process.kill()
            process.wait(LIMIT_S)
    with running_daemon(tmp_path, devices) as daemon:
        assert len(daemon.statuses()) == 20


@pytest.mark.live
def test_a_holder_of_the_port_with_a_name_that_is_no_text(tmp_path: Path) -> None:
    """The name of the process is in the problem of the device, in the log and in replies. Before, it ended the
    daemon."""
    name = b"\xff\n\x1b[31m"
    with cable(tmp_path) as port:
        holder = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(port.name), name.hex()], stdout=subprocess.PIPE, stdin=subprocess.PIPE
        )
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == b"held\n"
            with running_daemon(tmp_path, {"bow": device(port.name)}) as daemon:
                problem = daemon.wait_for("bow", "failed").problem
                assert str(holder.pid) in problem
                assert problem.isprintable()
            lines = (tmp_path / "log").read_text().splitlines()
            assert any("pid" in line for line in lines)
            assert all(line.isprintable() for line in lines)
        finally:
            holder.communicate(b"")


HOLD = """
import ctypes, fcntl, os, sys, termios
fd = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
fcntl.flock(fd, fcntl.LOCK_EX)
fcntl.ioctl(fd, termios.TIOCEXCL)
ctypes.CDLL(None).prctl(15, bytes.fromhex(sys.argv[2]), 0, 0, 0)
print("held", flush=True)
sys.stdin.read()
"""


@in_loop
async def test_a_second_signal_at_the_end_does_not_change_the_exit_status() -> None:
    """A fixture of all tests restores the handlers."""
    daemon = Daemon(EMPTY)
    daemon.install_signals()
    running = asyncio.create_task(daemon.run())
    await asyncio.sleep(0)
    signal.raise_signal(signal.SIGTERM)
    await running
    assert {signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)} == {signal.SIG_IGN}
