"""Firmware update of one device: check the product, write the image with the driver, verify the version.

    identity ──▶ product? ──▶ driver: boot loader ──▶ addresses? ──▶ erase ──▶ write ──▶ start ──▶ identity ──▶ version?

imud changes nothing before `erase`. If the boot loader refuses the erase, imud starts the old application again. After
an interruption, the device stays in its boot loader, and a further update succeeds. imud stores an interrupted update
in the state directory until the device sends samples or an update succeeds. Only a request on the socket starts an
update: no key of the configuration and no MQTT command does.
"""

import asyncio
import logging
from contextlib import suppress
from typing import Final

from imud.contracts.driver import Identity
from imud.contracts.firmware import (
    ERASE,
    TOTAL_S,
    EraseRefused,
    FirmwareImage,
    FirmwareResult,
    check_product,
)
from imud.contracts.status import DeviceState
from imud.device.pending_updates import PendingUpdates
from imud.device.settings import DeviceSettings
from imud.device.transport import DeviceContext, Transport
from imud.model.errors import BadArgument, CommandError, ImudError
from imud.model.event import EventKind
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

REPORT_NS: Final = NS_PER_S // 2  # minimum time between two events of one phase
VERIFY_NS: Final = 20 * NS_PER_S  # maximum time until the new firmware reports its version
ASK_AGAIN_S: Final = 0.5  # pause between two queries of the identity
STOP_LIMIT_S: Final = 80.0
"""Maximum time that a stop of imud waits for an update, s. systemd stops a service after 90 s (TimeoutStopSec)."""
CLOSED: Final = (DeviceState.MISSING, DeviceState.FAILED, DeviceState.FINISHED)


def version_of(identity: Identity) -> str:
    """Return the version of the firmware that a device reports; empty if it does not report one."""
    return identity.firmware or (identity.details or {}).get("revision", "")


def normal_version(version: str) -> str:
    """Return one form of the versions that HiPNUC devices and users write: `170` for 1.7.0, v1.7.0, 170, 0x000000AA."""
    text = version.strip().lower().removeprefix("v")
    if text.startswith("0x"):
        with suppress(ValueError):
            return str(int(text, 16))
    digits = text.split(".")
    if all(len(digit) == 1 and digit.isdecimal() for digit in digits):
        return "".join(digits).lstrip("0") or "0"
    return text


class FirmwareUpdate:
    """Update of one device. Synchronization: the loop's thread only."""

    def __init__(
        self, context: DeviceContext, transport: Transport, settings: DeviceSettings, pending: PendingUpdates
    ) -> None:
        """Name the update of this device that an earlier run of imud did not end, until a sample arrives."""
        self._device = context.config.name
        self._transport = transport
        self._settings = settings
        self._events = context.events
        self._health = context.health
        self._host = context.host
        self._pending = pending
        self._phase = ""  # present phase; empty without an update
        self._end = asyncio.Event()  # set while no update can be interrupted
        self._end.set()
        self._reported_ns = 0  # CLOCK_MONOTONIC of the newest event
        if start := pending.start_of(self._device):
            transport.in_boot_loader(
                f"the firmware update of {start} did not end before imud stopped, so the device can be in its boot "
                f"loader; {self._next_step()}"
            )

    def refuse_other_work(self) -> None:
        """Raise CommandError while an update runs."""
        work = self._settings.lock.work
        if self._phase and work is not None:
            raise CommandError(f"{self._device}: {work.words(self._host.now_ns())}; try again later")

    def on_samples(self) -> None:
        """Note that the application of the device runs: no update is incomplete."""
        if not self._phase:
            self._pending.remove(self._device)

    @property
    def is_interruptible(self) -> bool:
        """Whether a stop of imud does not interrupt an update."""
        return self._end.is_set()

    async def wait_for_end(self, limit_s: float) -> None:
        """Wait until no update runs, at most `limit_s`."""
        if self.is_interruptible:
            return
        log.warning("%s: the stop of the device waits for the firmware update, at most %g s", self._device, limit_s)
        with suppress(TimeoutError):
            await asyncio.wait_for(self._end.wait(), limit_s)

    async def update(self, image: FirmwareImage, product: str, version: str) -> FirmwareResult:
        """Write an image and verify the version. Raises ImudError; the message contains the next step."""
        settings, health, name = self._settings, self._health, self._device
        driver = self._transport.driver
        if driver is not None and driver.firmware is None:
            raise BadArgument(f"{name}: expected a driver with a firmware update, got {driver.name}")
        if health.state in CLOSED:
            raise CommandError(f"{name} is {health.state}: {health.problem}")
        async with settings.lock.hold("the firmware update"):
            begun_ns = self._host.now_ns()
            await self._identify()
            identity = settings.identity
            check_product(image, identity.product, product)
            before = version_of(identity)
            log.warning("%s: firmware update: %d bytes at %#x", name, len(image.data), image.address)
            try:
                self._end.clear()
                await self._write(image)
                settings.identity = Identity(identity.product, identity.serial_number)  # the old version ends here
                after, verified, evidence = await self._verify(before, version)
                self._transport.in_boot_loader("" if after else f"{evidence}; {self._next_step()}")
                if after:
                    self._pending.remove(name)
            finally:
                self._phase = ""
                self._end.set()
                settings.forget()
            duration_s = (self._host.now_ns() - begun_ns) / NS_PER_S
            self._report("end", len(image.data), len(image.data), evidence, verified=verified)
            await settings.read_again(identity=False)
            return FirmwareResult(identity.product, before, after, len(image.data), verified, evidence, duration_s)

    async def _identify(self) -> None:
        """Query the identity. A device in its boot loader does not reply: its last identity stays."""
        if self._transport.accepts_scripts:
            try:
                await self._transport.read_identity()
            except CommandError as error:
                log.info("%s: identity not read before the update: %s", self._device, error)

    async def _write(self, image: FirmwareImage) -> None:
        """Run the script of the driver. Report an interruption with the next step."""
        is_complete = was_changed = False

        def on_progress(phase: str, done: int, total: int) -> None:
            nonlocal was_changed
            begins, now_ns = phase != self._phase, self._host.now_ns()
            self._phase = phase
            if phase == ERASE and not was_changed:  # a new try starts with another phase
                was_changed = True
                self._pending.add(self._device)
            if begins or now_ns - self._reported_ns >= REPORT_NS:
                self._reported_ns = now_ns
                self._report(phase, done, total, f"{phase}, {done} of {total} bytes")

        self._health.down(self._host.now_ns(), DeviceState.SILENT, "a firmware update is running")
        try:
            async with asyncio.timeout(TOTAL_S):
                await self._transport.run_firmware(image, on_progress)
            is_complete = True
        except (ImudError, TimeoutError) as error:
            words = str(error) or f"the update did not end within {TOTAL_S:g} s"
            if isinstance(error, EraseRefused):
                present_version = await self._read_version()
                was_changed = not present_version
                if present_version:
                    words += f"; imud changed nothing, and the device runs version {present_version} again"
            self._report("end", 0, len(image.data), words, verified=False)
            if not was_changed:
                self._pending.remove(self._device)
                if isinstance(error, ImudError) and not isinstance(error, EraseRefused):
                    raise
                next_step = "compare the file with the model of the device" if present_version else "try again"
                raise CommandError(f"{self._device}: {words}; {next_step}") from None
            raise CommandError(
                f"{self._device}: {words}. The update is not complete: the device stays in its boot loader, also after "
                f"power-off. {self._next_step()}"
            ) from None
        finally:  # also if imud stops
            if was_changed and not is_complete:
                self._transport.in_boot_loader(
                    f"the device is in its boot loader after an interrupted firmware update; {self._next_step()}"
                )

    def _next_step(self) -> str:
        return f"Connect the device and run `imud firmware {self._device} FILE` again"

    async def _verify(self, before: str, expected: str) -> tuple[str, bool, str]:
        """Return the version of the device, whether it is the expected version, and the evidence."""
        version = await self._read_version()
        if version:
            return version, *_compared(before, version, expected)

        version, advice = await self._find_application()
        if version:
            verified, evidence = _compared(before, version, expected)
            return version, verified, f"{evidence}; {advice}" if advice else evidence
        seconds = VERIFY_NS // NS_PER_S
        return (
            "",
            False,
            f"the image was written, but the device reported no version within {seconds} s; switch it off and on, and "
            f"compare the version in `imud status {self._device}`",
        )

    async def _find_application(self) -> tuple[str, str]:
        """Search for the new firmware at other baud rates. Return its version, and the necessary change of the
        configuration; empty if the device does not reply or the link has no baud rate."""
        driver = self._transport.driver
        find = driver.firmware.find if driver is not None and driver.firmware is not None else None
        if find is None:
            return "", ""
        try:
            advice: str = await self._transport.run_script(find)
            await self._transport.read_identity()
        except ImudError as error:
            log.info("%s: the device does not reply at any baud rate: %s", self._device, error)
            return "", ""
        return version_of(self._settings.identity), advice

    async def _read_version(self) -> str:
        """Return the version that the device reports within VERIFY_NS; empty if it does not reply."""
        end_ns = self._host.now_ns() + VERIFY_NS
        while self._host.now_ns() < end_ns:
            await asyncio.sleep(ASK_AGAIN_S)
            try:
                await self._transport.read_identity()
            except ImudError as error:
                log.info("%s: version not read yet: %s", self._device, error)
                continue
            if version := version_of(self._settings.identity):
                return version
        return ""

    def _report(self, phase: str, done: int, total: int, words: str, **detail: bool) -> None:
        progress = done / total if total else 0.0
        self._events.raise_event(
            self._host.now_ns(),
            EventKind.FIRMWARE,
            f"firmware update: {words}",
            phase=phase,
            progress=progress,
            **detail,
        )


def _compared(before: str, after: str, expected: str) -> tuple[bool, str]:
    """Return whether the version shows the update, and the evidence."""
    if expected:
        return normal_version(after) == normal_version(expected), f"expected version {expected}, got {after}"
    if not before:
        return False, f"the device reports version {after}, and its version before is unknown; state it with --version"
    if normal_version(before) == normal_version(after):
        return (
            False,
            f"the device reports version {after} before and after; state the version of the file with --version",
        )
    return True, f"the device reports version {after}, was {before}"
