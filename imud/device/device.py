"""One device with any link: open the link, receive samples, detect silence and a missing link, and recover.

MISSING ──port appears──▶ SEARCHING ──samples──▶ RUNNING ──none for a while──▶ SILENT
   ▲                        │    ▲                  │                            │
   └──────── unplugged ─────┴────┼──────────────────┴────────────────────────────┤
                                 └── bytes without frames, or long silence ──────┘

A device has a transport, which owns the link and the sample path, and attachments such as GPIO lines.
"""

import asyncio
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from imud.config.model import DeviceConfig
from imud.config.reading import owner_of
from imud.contracts.command import (
    CalibrationResult,
    Calibrations,
    Kept,
    LastCalibration,
    Verbs,
)
from imud.contracts.condition import Condition
from imud.contracts.driver import status_bits_of, status_words
from imud.contracts.lines import LineFactory
from imud.contracts.link import Link
from imud.contracts.publisher import PutRecord
from imud.contracts.status import ClockStatus, DeviceState, DeviceStatus
from imud.device.attachments import Attachments
from imud.device.calibration import CalibrationRun
from imud.device.condition import ConditionJudge, Known
from imud.device.firmware import FirmwareUpdate
from imud.device.flash import SettingsFiles
from imud.device.health import NO_SAMPLE, RUNNING, STREAMING, DeviceEvents, Health
from imud.device.latency import Need
from imud.device.settings import DeviceSettings, identity_words
from imud.device.settings_plan import setting_instead
from imud.device.transport import UNHEARD_NS, DeviceContext, DeviceOwner, Transport
from imud.device.verbs import VerbRun
from imud.device.watches import AttitudeWatch, StatusWatch
from imud.drivers import DRIVERS
from imud.host.clock import HostClock
from imud.host.log import printable, shown
from imud.host.scope import words_of
from imud.links import LINKS
from imud.model.errors import BadArgument, LinkBusy, LinkError, LinkMissing
from imud.model.event import EventKind
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.recording.observer import PathObserver
from imud.sampling.meters import LatencyMeter
from imud.sampling.path import SamplePath

log = logging.getLogger(__name__)

RETRY_S = 0.5  # pause before imud opens a failed port again, s. A device thus returns within 1 s.
GONE_S = 0.02
"""Pause after a port became missing, s. imud waits for the port without polling. The pause limits the number of tries
if the device node exists but imud cannot open it."""
IDLE_FLUSH_NS = 50 * NS_PER_MS
"""Idle time of the link after which the codec discards a pending frame, ns. Latency timers take up to 16 ms."""
SILENCE_NS = 1 * NS_PER_S  # minimum time without a sample that makes a device silent, ns
BLOCKED_SHOWN_NS: Final = 600 * NS_PER_S  # time for which the status shows that a driver blocked imud, ns
WATCHED: Final = (DeviceState.SEARCHING, DeviceState.SILENT)  # states that end with the first sample
SILENCE_PERIODS = 5  # minimum number of sample periods without a sample that makes a device silent

MakeTransport = Callable[[DeviceContext], Transport]


@dataclass(frozen=True, slots=True)
class SharedParts:
    """Parts that all devices of a daemon share."""

    owner: DeviceOwner
    host: HostClock
    lines: LineFactory
    files: SettingsFiles


class Device:
    """A configured device. Synchronization: the loop's thread only."""

    def __init__(
        self, config: DeviceConfig, device_id: int, shared: SharedParts, make_transport: MakeTransport
    ) -> None:
        self.config = config
        self.device_id = device_id
        self.ledger = Ledger()
        self._shared = shared
        self._host = host = shared.host
        self._suspends = host.suspends
        self._events = DeviceEvents(config.name, self.ledger, shared.owner.send_event)
        self._health = Health(self._events)
        self.observer = PathObserver(config, device_id, self.ledger, host)
        context = DeviceContext(
            config, device_id, shared.owner, host, shared.lines, self.ledger, self._events, self._health, self.observer
        )
        self._transport = transport = make_transport(context)
        self._attachments = Attachments(config, shared.lines, transport, self._events, host)
        self.settings = DeviceSettings(config, transport, self._events, self.observer, host, shared.files)
        transport.serve(self._attachments, self.settings)
        self._calibration = CalibrationRun(transport, self._events)
        self._attachments.add(self._calibration)
        self._attachments.add(self.settings)
        self._attachments.add(transport.samples)
        self._verb_run = VerbRun(self.settings, transport)
        self.firmware = FirmwareUpdate(context, transport, self.settings, shared.files.updates)
        self._attitude = AttitudeWatch(config, self._events)
        self._status = StatusWatch(self._events, config.attitude)
        self._judge = ConditionJudge(config, transport.link.title, self.ledger, self._events, host.now_ns())
        self._is_slow = True  # whether the sample period is longer than IDLE_FLUSH_NS, or not known
        self._is_quick = False  # whether a tick can end immediately while samples arrive and no command runs
        self._connects = 0
        self._shown_problem = ""  # problem of `_show_problem`
        self._shown_until_ns = 0  # CLOCK_MONOTONIC of its end
        self._has_failed = False  # whether an internal error has ended the device
        self._need = Need(0, "")
        self._ended: asyncio.Future[LinkError | None] | None = None

    @property
    def state(self) -> DeviceState:
        return self._health.state

    @property
    def driver_name(self) -> str:
        """Name of the driver; the configured name before imud has found the device."""
        driver = self._transport.driver
        return driver.name if driver else self.config.driver

    @property
    def link(self) -> Link:
        return self._transport.link

    def set_need(self, need: Need) -> None:
        """Set the maximum hold of samples. With GPIO lines there is no hold, because edges belong to samples."""
        self._need = need if self._attachments.drain_edges is None else Need(0, "its lines")
        self._transport.set_latency(self._need.latency_ns)

    async def run(self) -> None:
        """Run the device until cancelled, or until the end of a replay."""
        try:
            self._attachments.tick(self._host.now_ns(), None)
            await self._serve_until_finished()
            self._health.finished("" if self.ledger.samples else self._transport.unknown_words())
            self._judge_condition(self._host.now_ns())
        finally:
            self._attachments.close()
            self._transport.close()

    def tick(self, now_ns: int) -> None:
        """Update the state, detect an idle link, and send collected events. Called once per second, and ten times per
        second while `_needs_ticks`. While samples arrive, the work is due once per second."""
        transport, health, judge, path = self._transport, self._health, self._judge, self._transport.path
        if self._has_failed:
            if now_ns >= judge.due_ns:
                self._judge_condition(now_ns)
            return
        if self._shown_problem and now_ns >= self._shown_until_ns:
            health.clear_link_problem(self._shown_problem)
            self._shown_problem = ""
        has_news = path is None or now_ns - path.last_sample_ns > IDLE_FLUSH_NS or health.state is not RUNNING
        is_due = now_ns >= judge.due_ns
        is_quick = self._is_quick and not (has_news or transport.busy or self.settings.lock.work is not None)
        if is_quick and not is_due:
            return
        needs_ticks = not is_quick and self._needs_ticks(now_ns)
        if needs_ticks:
            self._shared.owner.tick_soon()
            self._attachments.tick(now_ns, path.newest if path is not None else None)
        elif is_due:  # the other attachments wait for a command, or have a line and need ticks
            self.settings.tick(now_ns, None)
        if not is_quick:  # the transport has no work while samples arrive
            transport.tick(now_ns)
        if path is not None and (has_news or self._suspends != self._host.suspends):
            self._tick_flow(path, now_ns)
        if path is not None and (needs_ticks or is_due):
            self._status.tick(now_ns, transport.driver, path)
            self._events.tick(now_ns, path.quality[0])
            self._attitude.tick(now_ns, path)
        if is_due or health.state is not judge.state:
            self._judge_condition(now_ns)

    def _judge_condition(self, now_ns: int) -> None:
        """Update the condition from the facts that it depends on."""
        transport, settings, health, path = self._transport, self.settings, self._health, self._transport.path
        rate_hz, attachments, ledger = transport.expected_rate_hz, self._attachments, self.ledger
        self._is_slow = rate_hz * IDLE_FLUSH_NS < NS_PER_S
        has_lines, lines, utc_problem = attachments.needs_ticks, None, ""
        if has_lines:
            lines, utc_problem = transport.add_lines(attachments.lines_status()), attachments.utc_problem()
        self._is_quick = not (self._is_slow or has_lines or transport.has_ticks)
        has_settings = bool(settings.declared or settings.is_unsaved or settings.comparison.problem)
        axes, axes_problem = self._attitude.problem(transport.driver, settings, transport.axes_problem)
        t_err_ns, last_ns = 0, path.last_sample_ns if path is not None else 0
        newest_ns = path.clock.t_ns if path is not None and path.last_sample_ns else 0
        if path is not None and self.config.condition.t_err_ms is not None:
            t_err_ns = path.quality[1]
        self._judge.judge(now_ns, rate_hz, t_err_ns, last_ns, Known(
            health.state, health.problem, settings.resets - settings.resets_requested, transport.is_polled,
            settings.status() if has_settings else None, axes, axes_problem, lines,
            path is not None and path.clock.has_scattered_time, utc_problem, ledger.bytes_open(), ledger.frames_open(),
            transport.is_in_boot_loader,
        ), newest_ns)  # fmt: skip

    def _tick_flow(self, path: SamplePath, now_ns: int) -> None:
        """Flush an idle link, and detect silence and the first sample. Not necessary while recent samples arrive."""
        transport = self._transport
        if self._suspends != self._host.suspends:
            self._suspends = self._host.suspends
            if path.fresh:  # CLOCK_MONOTONIC does not count the suspend, during which samples were lost
                self.ledger.add_unknown_gap()
        if now_ns - path.last_data_ns > IDLE_FLUSH_NS + transport.hold_ns:
            path.flush(now_ns)
        if transport.receiving:
            self._watch_flow(path, now_ns)

    @property
    def condition(self) -> Condition:
        return self._judge.watch.level

    def _needs_ticks(self, now_ns: int) -> bool:
        """Return whether the device needs ten ticks per second."""
        state, path = self._health.state, self._transport.path
        # `flush` must complete the samples of a slow device
        if self._is_slow if state is RUNNING else state in WATCHED:
            return True
        if state is RUNNING and path is not None and now_ns - path.last_sample_ns > SILENCE_NS // 2:
            return True  # it can become silent before the next tick of quiet devices
        return self._attachments.needs_ticks or self._transport.busy or self.settings.lock.work is not None

    def close(self) -> None:
        """Release the link. A second call does nothing."""
        self._transport.close()

    @property
    def is_of_other_package(self) -> bool:
        """Whether the driver is part of another package."""
        driver = self._transport.driver or DRIVERS.get(self.config.driver)
        return driver is not None and driver.interface != 0

    def report_blocked(self, duration_ns: int) -> None:
        """Report that the code of the device blocked imud. The problem stays in the status for BLOCKED_SHOWN_NS."""
        now_ns = self._host.now_ns()
        who = f"the driver {self.driver_name} of the device {self.config.name}"
        words = f"{who} blocked imud for {duration_ns / NS_PER_S:.1f} s"
        self._show_problem(now_ns, f"{words}; all devices lost samples or time")

    def report_memory(self, words: str) -> None:
        """Report that the process grows. The driver of another package can be the cause."""
        self._show_problem(self._host.now_ns(), f"{words}; the driver {self.driver_name} of another package may leak")

    def _show_problem(self, now_ns: int, problem: str) -> None:
        self._health.on_link_news(now_ns, problem, problem)
        self._shown_problem = problem
        self._shown_until_ns = now_ns + BLOCKED_SHOWN_NS

    def fail(self, problem: str) -> None:
        """End the device after an internal error. Its status shows `problem`. imud does not call its driver again."""
        now_ns = self._host.now_ns()
        was_streaming = self._health.streaming
        self._has_failed = True
        for step in (self._attachments.close, self._transport.close):
            try:
                step()
            except BaseException as error:  # noqa: BLE001 - the parts of a failed device can fail again
                log.error("%s: its end failed: %s", self.config.name, words_of(error))
        self._transport.forget_driver()
        self._health.down(now_ns, DeviceState.FAILED, problem)
        if not was_streaming:
            self._events.raise_event(now_ns, EventKind.DOWN, problem, state=str(DeviceState.FAILED))
        self._judge_condition(now_ns)

    # --- the link ----------------------------------------------------------------------------------------------------

    async def _serve_until_finished(self) -> None:
        """Serve the link while it exists; return at the end of a replay."""
        while True:
            try:
                await self._transport.wait_present()
                await self._serve()
                return
            except LinkMissing as error:
                self._down(DeviceState.MISSING, error)
                await asyncio.sleep(GONE_S)
            except LinkError as error:
                self._down(DeviceState.FAILED, self._with_owner(error))
                await asyncio.sleep(RETRY_S)

    async def _serve(self) -> None:
        """Open and serve the link until it ends; return at the end of a replay. Raises LinkError."""
        transport = self._transport
        transport.link.open()
        self._connects += 1
        self._health.link_opened()
        self._shared.owner.tick_soon()
        ended = self._ended = asyncio.get_running_loop().create_future()
        tasks: list[asyncio.Task[None]] = []
        try:
            transport.start(self._on_end)
            tasks = [
                asyncio.create_task(transport.work(), name=f"{self.config.name} work"),
                asyncio.create_task(self.settings.comparison.run(), name=f"{self.config.name} settings"),
            ]
            await asyncio.wait({*tasks, ended}, return_when=asyncio.FIRST_COMPLETED)
            if not ended.done():
                for task in tasks:
                    if task.done():
                        await task  # a task that ends before the link has an error
            elif error := ended.result():
                raise error
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            transport.stop()
            self._attachments.stop()
            if transport.path is not None:
                transport.path.reset()

    def _on_end(self, error: LinkError | None) -> None:
        if self._ended is not None and not self._ended.done():
            self._ended.set_result(error)

    def _with_owner(self, error: LinkError) -> LinkError:
        """Return the error with the name of the other configured device that uses the port."""
        if not isinstance(error, LinkBusy):
            return error
        owner = owner_of(self.config, self._shared.owner.configured_devices(), LINKS)
        if not owner:
            return error
        return LinkBusy(f"{self._transport.link.title} is in use by {owner}, another device of this configuration")

    def _down(self, state: DeviceState, error: LinkError) -> None:
        self._health.down(self._host.now_ns(), state, str(error))

    # --- recording ---------------------------------------------------------------------------------------------------

    def record(self, put: PutRecord) -> None:
        """Start a recording: write the description of the device, then its data. `observer.end` stops the recording."""
        self.observer.begin(put, self._transport.where, identity_words(self.settings.identity), self.settings.shown)

    # --- verbs -----------------------------------------------------------------------------------------------------

    @property
    def verbs(self) -> Verbs:
        """Verbs by name. Before imud has found the device: only the verbs of its GPIO lines."""
        driver = self._transport.driver
        return {**(driver.verbs if driver is not None else {}), **self._attachments.verbs}

    async def act(self, name: str, arguments: Mapping[str, Any]) -> object:
        """Run a verb and return its result. Raises CommandError, TransferError, DeviceRefused, LinkError."""
        log.info("%s: run %s%s", self.config.name, printable(name), f" {shown(arguments)}" if arguments else "")
        verb = self.verbs.get(name)
        if verb is None:
            if instead := setting_instead(self.config.name, name, self._transport.driver, arguments):
                raise instead
            raise BadArgument(f"{self.config.name}: unknown command {name[:64]!r}; expected: {self._known_verbs()}")
        if name in self._attachments.verbs:
            self.firmware.refuse_other_work()
            return await self._verb_run.run_line(name, arguments, self._attachments)
        self._transport.require_replies()
        return await self._verb_run.run(name, verb, arguments)

    @property
    def calibrations(self) -> Calibrations:
        """Calibrations by kind; empty before imud has found the device."""
        driver = self._transport.driver
        return driver.calibrations if driver is not None else {}

    @property
    def last_calibrations(self) -> Mapping[str, LastCalibration]:
        """Result of the last calibration of each kind."""
        return self._shared.files.flash.record(self.settings.module).calibrations

    async def calibrate(self, kind: str, *, save: bool) -> CalibrationResult:
        """Guide a calibration. Raises CommandError, TransferError, DeviceRefused, LinkError."""
        calibration = self.calibrations.get(kind)
        if calibration is None:
            known = ", ".join(self.calibrations) or "none"
            raise BadArgument(f"{self.config.name}: unknown calibration {kind[:64]!r}; expected: {known}")
        log.info("%s: calibrate %s%s", self.config.name, kind, ", save" if save else "")
        self._transport.require_replies()
        stop = f"stop it with imud calibrate {self.config.name} --stop"
        async with self.settings.lock.hold(f"the calibration {kind}", stop):
            if save:
                self.settings.spend_flash()
            result = None
            try:
                self._calibration.tick(self._host.now_ns(), None)  # no tick in a quiet state
                result = await self._calibration.run(kind, calibration, save=save)
                self._shared.files.flash.keep_calibration(self.settings.module, result)
            finally:
                if result is not None and result.saved:  # the save writes all settings
                    self.settings.flash_is_current(changed=False)
                is_unsaved = result is None or (result.kept is Kept.BY_SAVE and not result.saved)
                if self._calibration.is_sent:  # a refused calibration has changed nothing
                    self.settings.changed(unsaved=is_unsaved)
            await self.settings.read_again(identity=False)  # a calibration changes reports, for example an offset
            return result

    def stop_calibration(self) -> bool:
        """Stop the running calibration; return whether one was running."""
        return self._calibration.cancel()

    def _known_verbs(self) -> str:
        return ", ".join(self.verbs) or "none" + " while no device is found" * (self._transport.driver is None)

    # --- the samples -------------------------------------------------------------------------------------------------

    def _watch_flow(self, path: SamplePath, now_ns: int) -> None:
        state, quiet_ns = self._health.state, now_ns - max(path.last_sample_ns, path.begun_ns)
        if state in STREAMING and (problem := self._transport.loader_words(path)):
            if state is DeviceState.RUNNING or problem != self._health.problem:
                self._health.down(now_ns, DeviceState.SILENT, problem)
            return
        if (state is DeviceState.SEARCHING and path.fresh) or (
            state is DeviceState.SILENT and now_ns - path.last_sample_ns < SILENCE_NS
        ):
            if state is DeviceState.SILENT:
                self.settings.after_silence()
            self._up(now_ns)
        elif state is DeviceState.RUNNING and quiet_ns > SILENCE_NS and quiet_ns > SILENCE_PERIODS * path.period_ns:
            seconds = f"{quiet_ns / NS_PER_S:.1f} s"
            words = f"{NO_SAMPLE} {seconds}, but the link is open; check the power supply of the device and its output"
            self._health.down(now_ns, DeviceState.SILENT, words)
        elif quiet_ns > UNHEARD_NS:
            self._transport.on_no_samples(path, now_ns)

    def _up(self, now_ns: int) -> None:
        transport = self._transport
        self._attachments.device_found()
        self.firmware.on_samples()
        driver = transport.driver.name if transport.driver is not None else ""
        self._health.up(now_ns, driver, transport.where, transport.bit_rate)

    # --- state -------------------------------------------------------------------------------------------------------

    def status(self) -> DeviceStatus:
        """Return the status of the device."""
        transport, health, path = self._transport, self._health, self._transport.path
        driver, newest = transport.driver, path.newest if path is not None else None
        latency = path.latency if path is not None else LatencyMeter()
        last_sample_ns = path.last_sample_ns if path is not None else 0
        self._judge.add_new_losses(self._host.now_ns(), last_sample_ns)
        frame = self._attitude.status(driver, path, self.settings)
        bits = status_bits_of(driver, self.config.attitude) if driver else {}
        status = DeviceStatus(
            name=self.config.name,
            device_id=self.device_id,
            driver=self.driver_name,
            euler_convention=frame.euler_convention if frame else "",
            navigation_frame=frame.navigation_frame if frame else "",
            frame=frame,
            link=transport.where,
            state=health.state,
            problem=health.problem,
            identity=identity_words(self.settings.identity),
            settings=dict(self.settings.shown),
            rate_hz=self._judge.counts.rate_hz(),
            expected_rate_hz=transport.expected_rate_hz,
            newest_seq=newest.seq if newest else 0,
            clock=path.clock.status() if path else ClockStatus(),
            ledger=self.ledger.snapshot(),
            kernel=transport.link.kernel_counters(),
            latency_buckets=tuple(latency.buckets),
            latency_sum_ns=latency.sum_ns,
            hold_ns=transport.hold_ns,
            hold_wanted_ns=self._need.latency_ns,
            hold_by=self._need.who,
            temperature_c=newest.temperature_c if newest else None,
            status_bits=newest.status if newest else None,
            position=newest.position if newest else None,
            status_words=status_words(bits, newest.status) if newest else (),
            status_bit_names={str(number): bit.name for number, bit in bits.items()},
            connects=self._connects,
            lines=transport.add_lines(self._attachments.lines_status()),
            utc=self._attachments.utc_status(),
            declared=self.settings.status(),
            noise=self.config.noise,
            resets_requested=self.settings.resets_requested,
            condition=self._judge.watch.condition,
            recent=self._judge.counts.status(last_sample_ns),
            history=self._judge.watch.history,
            calibration=self._calibration.status,
            work=self.settings.lock.work,
        )
        return transport.add_status(status)
