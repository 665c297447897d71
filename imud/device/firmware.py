"""Firmware update of one device: check the product, write the image with the driver, verify the version.

    identity ──▶ product? ──▶ driver: boot loader ──▶ addresses? ──▶ erase ──▶ write ──▶ start ──▶ identity ──▶ version?

imud changes nothing before `erase`. After an interruption, the device stays in its boot loader, and a further update
succeeds. Only a request on the socket starts an update: no key of the configuration and no MQTT command does.
"""

import asyncio
import logging
from typing import Final

from imud.contracts.driver import Identity
from imud.contracts.firmware import (
    ERASE,
    TOTAL_S,
    FirmwareImage,
    FirmwareResult,
    check_product,
)
from imud.contracts.status import DeviceState
from imud.device.health import DeviceEvents, Health
from imud.device.settings import DeviceSettings
from imud.device.transport import Transport
from imud.host.clock import HostClock
from imud.model.errors import BadArgument, CommandError, ImudError
from imud.model.event import EventKind
from imud.model.units import NS_PER_S

log = logging.getLogger(__name__)

REPORT_NS: Final = NS_PER_S // 2  # minimum time between two events of one phase
VERIFY_NS: Final = 20 * NS_PER_S  # maximum time until the new firmware reports its version
ASK_AGAIN_S: Final = 0.5  # pause between two queries of the identity
CLOSED: Final = (DeviceState.MISSING, DeviceState.FAILED, DeviceState.FINISHED)


def version_of(identity: Identity) -> str:
    """Return the version of the firmware that a device reports; empty if it does not report one."""
    return identity.firmware or (identity.details or {}).get("revision", "")


class FirmwareUpdate:
    """Update of one device. Synchronization: the loop's thread only."""

    def __init__(
        self, device: str, transport: Transport, settings: DeviceSettings, events: DeviceEvents, health: Health,
        host: HostClock,
    ) -> None:  # fmt: skip
        self._device = device
        self._transport = transport
        self._settings = settings
        self._events = events
        self._health = health
        self._host = host
        self._phase = ""  # present phase; empty without an update
        self._reported_ns = 0  # CLOCK_MONOTONIC of the newest event

    def refuse_other_work(self) -> None:
        """Raise CommandError while an update runs."""
        work = self._settings.lock.work
        if self._phase and work is not None:
            raise CommandError(f"{self._device}: {work.words(self._host.now_ns())}; try again later")

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
                await self._write(image)
                settings.identity = Identity(identity.product, identity.serial_number)  # the old version ends here
                after, verified, evidence = await self._verify(before, version)
                self._transport.in_boot_loader("" if after else f"the update did not start; {self._next_step()}")
            finally:
                self._phase = ""
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
            self._phase, was_changed = phase, was_changed or phase == ERASE  # a new try starts with another phase
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
            self._report("end", 0, len(image.data), words, verified=False)
            if not was_changed:
                if isinstance(error, ImudError):
                    raise
                raise CommandError(f"{self._device}: {words}; imud erased nothing; try again") from None
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
        end_ns = self._host.now_ns() + VERIFY_NS
        while self._host.now_ns() < end_ns:
            await asyncio.sleep(ASK_AGAIN_S)
            try:
                await self._transport.read_identity()
            except ImudError as error:
                log.info("%s: version not read yet: %s", self._device, error)
                continue
            after = version_of(self._settings.identity)
            if after:
                return after, *_compared(before, after, expected)
        return (
            "",
            False,
            (
                f"the device reported no version within {VERIFY_NS // NS_PER_S} s; switch it off and on, and compare "
                f"the version in `imud status {self._device}`"
            ),
        )

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
        return after == expected, f"expected version {expected}, got {after}"
    if not before:
        return False, f"the device reports version {after}, and its version before is unknown; state it with --version"
    if before == after:
        return (
            False,
            f"the device reports version {after} before and after; state the version of the file with --version",
        )
    return True, f"the device reports version {after}, was {before}"
