"""The daemon: one event loop with all configured devices and outputs.

Device ──Batch──▶ Publisher ×n              (publish: a plain loop)
tick, 2 Hz, 10 Hz ──▶ devices, outputs        SIGHUP ──▶ reload        SIGTERM, SIGINT ──▶ stop
"""

import asyncio
import gc
import logging
import queue
import secrets
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from time import thread_time_ns
from typing import Any, Final, NamedTuple

from imud import __version__
from imud import config as configuration
from imud.config.model import Config, DeviceConfig
from imud.contracts.condition import summary
from imud.contracts.firmware import TOTAL_S
from imud.contracts.lines import LineFactory
from imud.contracts.publisher import (
    DeviceControl,
    DeviceLedger,
    OutputFacts,
    Publisher,
    PublisherClock,
    PublisherContext,
)
from imud.contracts.status import DeviceState, DeviceStatus
from imud.device.device import Device
from imud.device.factory import DeviceFactory
from imud.device.firmware import STOP_LIMIT_S
from imud.device.latency import LatencyBudget
from imud.device.recordable import RecordableDevices
from imud.host.clock import HostClock
from imud.host.event_loop import Alarm
from imud.host.log import printable
from imud.host.process_watch import ProcessWatch
from imud.host.scope import Scope, ThreadScopes, words_of
from imud.host.service_manager import ServiceManager, notify
from imud.lines.driven_line import driving
from imud.lines.gpio import GPIO_LINES
from imud.lines.watched_line import watching
from imud.model.errors import CommandError, ConfigError, ImudError
from imud.model.event import Event, EventKind, EventLog
from imud.model.ledger import NOTHING_LOST
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.outputs import FORGOTTEN_NS, RETRY_FIRST_NS, RETRY_MOST_NS, Outputs
from imud.utc.system_clock import kernel_clock, system_reference

log = logging.getLogger(__name__)

PAUSE_S: Final = 100e-6
"""Pause of the thread that reads the configuration, s. The kernel needs about 10 us to wake the loop's thread."""


class Reloader:
    """Reader of the configuration file for reloads. Synchronization: the loop's thread only."""

    def __init__(self, file: Path, daemon: "Daemon", host: HostClock) -> None:
        self._file = file
        self._daemon = daemon
        self._host = host
        self._jobs: queue.SimpleQueue[asyncio.Future[Config] | None] = queue.SimpleQueue()
        self._again = False
        self._task: asyncio.Task[None] | None = None
        threading.Thread(target=self._serve, name="configuration", daemon=True).start()

    def request(self, done: Callable[[asyncio.Task[None]], None]) -> None:
        """Reload now, or again after the running reload. Call `done` with the task at its end."""
        if self._task is not None and not self._task.done():
            self._again = True
            return
        self._task = asyncio.create_task(self._reload(), name="reload")
        self._task.add_done_callback(done)

    async def close(self) -> None:
        """Stop the thread and the running reload. A second call does nothing."""
        self._jobs.put(None)
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _reload(self) -> None:
        again = True
        while again:
            self._again = False
            notify(f"RELOADING=1\nMONOTONIC_USEC={self._host.now_ns() // 1000}")
            try:
                new = await self._read()
            except ConfigError as error:
                self._daemon.refuse(error)
            else:
                await self._daemon.change_to(new)
            notify("READY=1")
            again = self._again

    async def _read(self) -> Config:
        """Read the file in the thread. Raises ConfigError."""
        answer: asyncio.Future[Config] = asyncio.get_running_loop().create_future()
        self._jobs.put(answer)
        return await answer

    def _serve(self) -> None:
        """Read the file for each future in the queue. Runs in the thread."""
        while (answer := self._jobs.get()) is not None:
            config, error = self._load()
            with suppress(RuntimeError):  # the loop has ended
                answer.get_loop().call_soon_threadsafe(_give, answer, config, error)

    def _load(self) -> tuple[Config | None, ConfigError | None]:
        try:
            return configuration.load(self._file, pause=lambda: time.sleep(PAUSE_S)), None
        except ConfigError as error:
            return None, error
        except Exception as error:  # an internal error must not stop the running devices
            log.exception("the configuration cannot be read because of an internal error")
            return None, ConfigError(f"{self._file}: {type(error).__name__}: {printable(str(error))}")


def _give(answer: "asyncio.Future[Config]", config: Config | None, error: ConfigError | None) -> None:
    if answer.done():  # cancelled
        return
    if config is not None:
        answer.set_result(config)
    else:
        answer.set_exception(error or ConfigError("not read"))


def _log_ignored(config: Config) -> None:
    for problem in config.ignored:
        log.error("%s", problem)


TICK_S: Final = 0.1  # interval of ticks while a part needs them (`tick_soon`), s
QUIET_TICK_S: Final = 0.5  # interval of ticks in a quiet state, s; half of the maximum age of a heartbeat
CONDITION: Final = attrgetter("condition")
DEVICES_NS: Final = 950 * NS_PER_MS  # minimum time between two ticks of quiet devices, ns: each second tick


class DeviceRestart(NamedTuple):
    """Next start of a device that failed because of an internal error."""

    due_ns: int  # CLOCK_MONOTONIC
    pause_ns: int

    @classmethod
    def after(cls, previous: "DeviceRestart | None", now_ns: int) -> "DeviceRestart":
        """Return the next start after a failure. The pause doubles with each failure, as for outputs."""
        if previous is None or now_ns - previous.due_ns > FORGOTTEN_NS:
            pause_ns = RETRY_FIRST_NS
        else:
            pause_ns = min(2 * previous.pause_ns, RETRY_MOST_NS)
        return cls(now_ns + pause_ns, pause_ns)


class Daemon:
    """Devices and outputs of one configuration. Synchronization: the loop's thread only.

    A reload reads `file`. `state_dir` contains the state files (None: no files). `extra` contains outputs in addition
    to the configured outputs. With `until_finished`, `run` ends with the last replay. `lines` opens the GPIO lines.
    """

    def __init__(
        self,
        config: Config,
        *,
        file: Path | None = None,
        state_dir: Path | None = None,
        extra: Mapping[str, Publisher] | None = None,
        until_finished: bool = False,
        lines: LineFactory = GPIO_LINES,
    ) -> None:
        self.config = config
        self._file = file
        self._reloader: Reloader | None = None
        host = HostClock()
        self._host = host
        self._factory = DeviceFactory(self, host, state_dir=state_dir, lines=lines)
        self._devices: dict[str, Device] = {}
        self._latencies = LatencyBudget()
        self.recording = RecordableDevices(self._devices, host)
        host.utc_offset_ns()
        # Threads of outputs use the offset of the last reading, which is at most 1 s old. A reading by a thread
        # would change the steady time between two samples, and a recording would contain it at the wrong place.
        clock = PublisherClock(
            host.now_ns,
            host.kept_utc_offset_ns,
            lambda: system_reference(kernel_clock(), host.kept_utc_offset_ns()),
            thread_time_ns,
        )
        self._context = PublisherContext(
            epoch=secrets.randbits(63) | 1,
            clock=clock,
            devices=self,
            outputs=OutputFacts(),
            latencies=self._latencies,
            watch_line=watching(lines, host),
            drive_line=driving(lines, host),
            owner=self,
            configuration="" if file is None else str(file.absolute()),
            state_dir=state_dir,
            past_events=EventLog(host.now_ns()),
        )
        self._threads = ThreadScopes()
        self._outputs = Outputs(self._context, extra or {}, self._threads)
        # a direct reference: a method of this class would cost one more call per batch
        self.publish: Final = self._outputs.publish
        self._until_finished = until_finished
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._scopes: dict[str, Scope] = {}  # by the name of the device
        self._restarts: dict[str, DeviceRestart] = {}  # failed devices that imud starts again
        self._ids: dict[str, int] = {}
        self._stop = asyncio.Event()
        self._alarm: Alarm | None = None
        self._is_soon = False  # whether the next tick follows after TICK_S
        self._devices_due_ns = 0  # CLOCK_MONOTONIC of the next tick of quiet devices
        self._failure: BaseException | None = None
        self._manager = ServiceManager()
        self._conditions: list[str] | None = None  # names and conditions of the devices at the last status line
        self._summary_line = ""
        self._watch = ProcessWatch(host.now_ns, self)
        self._signals: list[int] = []  # signals with a handler of this daemon

    # --- life ------------------------------------------------------------------------------------------------------

    async def run(self, on_stopping: Callable[[BaseException | None], None] = lambda _error: None) -> None:
        """Run until `stop`. Call `on_stopping` with the error, or None, before imud closes the devices and outputs.

        Raises ServerError if a required output cannot start, and the error that ended the task of a device.
        """
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._on_loop_error)
        loop.set_default_executor(_one_thread())
        self._threads.install(loop)
        self._watch.start(loop)
        if self._file is not None:
            self._reloader = Reloader(self._file, self, self._host)
        try:
            _log_ignored(self.config)
            self._outputs.start(self.config.publishers)
            for device in self.config.devices:
                self._start_device(device)
            gc.collect()
            gc.freeze()  # later collections skip the present objects, which live until the end
            self._manager.ready()
            log.info("imud %s has started: %s", __version__, self._summary())
            await self._tick_until_stopped()
        finally:
            self._manager.stopping()
            on_stopping(self._failure)
            await self._close()
            self._threads.remove()
            self._watch.close()
            self._ignore_signals()
            log.info("imud has stopped")
        if self._failure is not None:
            raise self._failure

    def stop(self) -> None:
        """Close all devices and outputs, then end `run`."""
        self._stop.set()

    def install_signals(self) -> None:
        """Install signal handlers: SIGTERM and SIGINT stop, SIGHUP reloads. Needs a running loop in the main thread."""
        loop = asyncio.get_running_loop()
        for number, action in ((signal.SIGTERM, self.stop), (signal.SIGINT, self.stop), (signal.SIGHUP, self.reload)):
            loop.add_signal_handler(number, action)
            self._signals.append(number)

    def _ignore_signals(self) -> None:
        """Ignore further signals: the default action would replace the exit status of a regular end."""
        for number in self._signals:
            asyncio.get_running_loop().remove_signal_handler(number)
            signal.signal(number, signal.SIG_IGN)

    @property
    def finished(self) -> bool:
        """Whether each device is a finished replay."""
        return all(device.state is DeviceState.FINISHED for device in self._devices.values())

    # --- reload ----------------------------------------------------------------------------------------------------

    def reload(self) -> None:
        """Start a reload: read the configuration file again and apply the changes. An invalid file changes nothing."""
        if self._reloader is not None:
            self._reloader.request(self._on_reloaded)

    def refuse(self, error: ConfigError) -> None:
        """Report the errors of a new configuration."""
        for problem in str(error).splitlines():
            log.error("the old configuration stays active: %s", problem)
        self.send_event(
            Event(self._host.now_ns(), "", EventKind.CONFIGURATION, f"the new configuration is invalid: {error}")
        )

    async def change_to(self, new: Config) -> None:
        """Stop, restart and start the changed devices and outputs. Run the event loop after each change."""
        change = configuration.differences(self.config, new)
        self.config = new
        logging.getLogger().setLevel(new.log_level.upper())
        _log_ignored(new)
        for name in (*change.devices_removed, *change.devices_changed):
            if name in self._devices:
                await self._devices[name].firmware.wait_for_end(TOTAL_S)
            self._stop_device(name)
            await asyncio.sleep(0)
        problems = ["a new state_dir needs a restart of imud"] if "state_dir" in change.keys_changed else []
        for name in change.publishers_changed:
            problems.append(self._outputs.change_to(name, new.publishers[name]))
            await asyncio.sleep(0)
        self.config = replace(new, publishers=self._outputs.options)
        for device in new.devices:
            if device.name not in self._devices:
                problems.append(self._try_device(device))
                await asyncio.sleep(0)
        words = "; ".join([f"configuration read again: {change}", *filter(None, problems)])
        log.info("%s", words)
        self.send_event(Event(self._host.now_ns(), "", EventKind.CONFIGURATION, words))

    def _try_device(self, device: DeviceConfig) -> str:
        try:
            self._start_device(device)
        except Exception as error:
            is_expected = isinstance(error, ImudError)
            words = str(error) if is_expected else words_of(error)
            log.error("%s cannot be started: %s", device.name, words, exc_info=None if is_expected else error)
            return f"{device.name} cannot be started: {words}"
        return ""

    # --- devices and outputs ----------------------------------------------------------------------------------------

    def control(self, name: str) -> DeviceControl:
        """Return the device of this name. Raises CommandError if the device does not exist."""
        device = self._devices.get(name)
        if device is None:
            raise CommandError(f"{name}: no such device")
        return device

    def status(self) -> list[DeviceStatus]:
        """Return the status of all devices."""
        return list(self.each_status())

    def each_status(self) -> Iterator[DeviceStatus]:
        """Yield the status of each device. Skip a device that a reload removes in the meantime."""
        for name in list(self._devices):
            device = self._devices.get(name)
            if device is not None:
                yield self._status_of(name, device)

    def _status_of(self, name: str, device: Device) -> DeviceStatus:
        """Return the status of a device. Its driver takes part in it: a failure ends the device first."""
        try:
            return device.status()
        except BaseException as error:  # noqa: BLE001 - foreign code can raise any exception
            self._scopes[name].fail(error)
            return device.status()

    def ledgers(self) -> list[DeviceLedger]:
        """Return the ledgers of all devices."""
        return [(name, device.driver_name, device.ledger.values()) for name, device in self._devices.items()]

    def losses(self, name: str) -> tuple[int, ...]:
        """Return the counters of losses of a device (`Ledger.losses`); zeros if the device does not exist."""
        device = self._devices.get(name)
        return NOTHING_LOST if device is None else device.ledger.losses()

    def configured_devices(self) -> Sequence[DeviceConfig]:
        """Return all devices of the present configuration."""
        return self.config.devices

    def _summary(self) -> str:
        """Return file, devices and outputs for the log."""
        file = f"configuration {self._file}; " if self._file is not None else ""
        devices = f"{len(self._devices)} device{'s' * (len(self._devices) != 1)}"
        return f"{file}{devices}; outputs: {self._outputs.summary()}"

    def _start_device(self, config: DeviceConfig) -> None:
        device_id = self._ids.setdefault(config.name, len(self._ids))
        self._outputs.add_device(config.name, device_id)
        name = config.name
        scope = Scope(name, partial(self._on_device_failure, name))
        device = scope.run(self._factory.make, config, device_id)
        self._devices[name] = device
        self._scopes[name] = scope
        self._latencies.add_device(name, lambda need: scope.call(device.set_need, need))
        task = scope.task(device.run(), name)
        task.add_done_callback(self._on_done)
        self._tasks[name] = task
        self.tick_soon()

    def _stop_device(self, name: str) -> None:
        self._restarts.pop(name, None)
        if name in self._devices:  # False if imud could not start the device
            self._tasks.pop(name).cancel()
            self._scopes.pop(name).close()
            self._end_part(name, self._devices.pop(name).close)
        self._latencies.remove_device(name)
        if all(device.name != name for device in self.config.devices):
            self._context.past_events.remove(name)
        self._outputs.remove_device(name)

    def _on_done(self, _task: asyncio.Task[None]) -> None:
        """Stop at the end of the last replay."""
        if self._until_finished and self.finished:
            self._stop.set()

    def _on_device_failure(self, name: str, error: BaseException) -> None:
        """End a device after an internal error. All other devices and the outputs continue.

        imud starts a device with a driver of imud again after a pause. The driver of another package would fail again:
        its device ends until the next start of imud, or until a reload changes the device.
        """
        if self._until_finished:  # a replay: the calling program reports the error
            self.end_with(error)
            return
        device = self._devices[name]
        self._tasks[name].cancel()
        words = str(error) if isinstance(error, ImudError) else words_of(error)
        if device.is_of_other_package:
            advice = "imud uses this device again after its next start, or after a change of its configuration"
        else:
            restart = DeviceRestart.after(self._restarts.get(name), self._host.now_ns())
            self._restarts[name] = restart
            advice = f"imud starts this device again in {restart.pause_ns // NS_PER_S} s"
        log.error("%s: %s; imud continues without this device", name, words, exc_info=error)
        device.fail(f"{words}; {advice}")
        if self._alarm is not None:
            self.tick_soon()

    def _restart_devices(self, now_ns: int) -> None:
        """Start the failed devices after their pauses."""
        for name, restart in list(self._restarts.items()):
            config = next((device for device in self.config.devices if device.name == name), None)
            has_failed = name in self._scopes and self._scopes[name].is_closed
            if config is not None and has_failed and now_ns >= restart.due_ns:
                self._stop_device(name)
                self._restarts[name] = restart  # a further failure has a longer pause
                self._try_device(config)

    def _on_reloaded(self, task: asyncio.Task[None]) -> None:
        """Stop after an internal error in a reload."""
        if not task.cancelled() and task.exception() is not None:
            self._failure = task.exception()
            self._stop.set()

    def _on_loop_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, object]) -> None:
        """Stop after an internal error that belongs to no device and no output."""
        error = context.get("exception")
        if not isinstance(error, ImudError):  # the caller prints the words of an ImudError
            log.error("%s", context.get("message"), exc_info=error if isinstance(error, BaseException) else None)
        self.end_with(error if isinstance(error, BaseException) else RuntimeError(str(context.get("message"))))

    def end_with(self, error: BaseException) -> None:
        """Stop, and raise an error at the end of `run`. The first error is the reason."""
        self._failure = self._failure or error
        self._stop.set()

    def send_event(self, event: Event) -> None:
        """Store an event, and pass it to the outputs."""
        self._context.past_events.add(event)
        self._outputs.send_event(event)

    # --- time -------------------------------------------------------------------------------------------------------

    async def _tick_until_stopped(self) -> None:
        self._alarm = Alarm(self)
        self.on_alarm()
        try:
            await self._stop.wait()
            await self._wait_for_updates()
        finally:
            self._alarm.cancel()

    async def _wait_for_updates(self) -> None:
        """Wait for the end of running firmware updates: an interrupted update leaves a device in its boot loader."""
        updates = {name: device.firmware for name, device in self._devices.items()}
        names = [name for name, update in updates.items() if not update.is_interruptible]
        if not names:
            return
        self._stop.clear()
        log.warning(
            "imud stops after the firmware update of %s, at most %g s; a second stop interrupts the update",
            ", ".join(names),
            STOP_LIMIT_S,
        )

        second_stop: asyncio.Future[Any] = asyncio.ensure_future(self._stop.wait())
        waits = [updates[name].wait_for_end(STOP_LIMIT_S) for name in names]
        ends: asyncio.Future[Any] = asyncio.gather(*waits)
        await asyncio.wait({second_stop, ends}, return_when=asyncio.FIRST_COMPLETED)
        second_stop.cancel()
        ends.cancel()

        for name in names:
            if not updates[name].is_interruptible:
                log.error("%s: imud stops during the firmware update; start imud and repeat the update", name)

    def tick_soon(self) -> None:
        """Tick within TICK_S. A part that needs ten ticks per second calls this method in each tick."""
        if not self._is_soon:
            self._is_soon = True
            if self._alarm is not None and self._alarm.due_s is not None:
                self._alarm.set(TICK_S)

    def on_alarm(self) -> None:
        """Call `tick` of all outputs. Call `tick` of all devices once per second, and after `tick_soon`."""
        assert self._alarm is not None
        now_ns = self._host.now_ns()
        self._watch.tick(now_ns)
        if self._is_soon or now_ns >= self._devices_due_ns:
            self._is_soon, self._devices_due_ns = False, now_ns + DEVICES_NS
            self._host.utc_offset_ns()  # without samples too: the rate of the clock is a mean between two reads
            for name, device in list(self._devices.items()):
                self._scopes[name].call(device.tick, now_ns)
            if self._restarts:
                self._restart_devices(now_ns)
        self._outputs.tick(now_ns)
        self._manager.tick(now_ns, self._status_line)
        self._alarm.set(TICK_S if self._is_soon else QUIET_TICK_S)

    def on_blocked(self, scope: Scope | None, duration_ns: int) -> None:
        """Report code that blocked the event loop: log, event and status of its device."""
        name = scope.owner if scope is not None else "an unknown part"
        if scope is not None and self._scopes.get(name) is scope:
            scope.call(self._devices[name].report_blocked, duration_ns)
            return
        words = f"{name} blocked imud for {duration_ns / NS_PER_S:.1f} s"
        log.error("%s", words)
        self.send_event(Event(self._host.now_ns(), "", EventKind.OUTPUT, words))

    def on_growth(self, text: str) -> None:
        """Report the growth of the process. The devices of other packages show it in their status."""
        log.warning("%s", text)
        self.send_event(Event(self._host.now_ns(), "", EventKind.CONFIGURATION, text))
        for name, device in list(self._devices.items()):
            if device.is_of_other_package:
                self._scopes[name].call(device.report_memory, text)

    def _status_line(self) -> str:
        conditions = [*self._devices, *map(CONDITION, self._devices.values())]
        if conditions != self._conditions:
            self._conditions = conditions
            self._summary_line = summary({name: device.condition for name, device in self._devices.items()})
        return self._summary_line

    async def _close(self) -> None:
        if self._reloader is not None:
            await self._reloader.close()
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        for scope in self._scopes.values():
            scope.close()
        await asyncio.gather(*tasks, return_exceptions=True)
        for name, device in self._devices.items():
            self._end_part(name, device.close)
        self._end_part("devices", self._factory.close)
        failure = self._outputs.close()
        self._failure = self._failure or failure

    def _end_part(self, name: str, step: Callable[[], None]) -> None:
        """Close a part. Log an error and continue; the first error is the result of `run`."""
        try:
            step()
        except BaseException as error:
            log.exception("%s: the end failed", name)
            self._failure = self._failure or error


def _one_thread() -> ThreadPoolExecutor:
    """Return an executor with one running thread, so that a missing device does not start a thread."""
    executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="imud close")
    executor.submit(int)
    return executor
