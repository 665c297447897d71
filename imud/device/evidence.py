"""Evidence in the samples of one device: a restart, and the arrival of a sample."""

import asyncio
from abc import ABC
from typing import Final

from imud.contracts.command import Proof
from imud.contracts.driver import SAMPLE_COUNTER, Driver
from imud.model.sample import Sample
from imud.sampling.clock import SampleClock
from imud.sampling.path import SamplePath

STEP_S: Final = 0.1  # time between two looks at the newest sample, s
STEPS: Final = 30  # maximum number of looks: 3 s
# Maximum number of looks for a sample of a device that sends none: 1.5 s. Devices send each message at least once per
# second (sections 2.2.5, 5.1 and 6.2.2 of the HiPNUC manual, table 12 of the IMU61x manual).
QUIET_STEPS: Final = 15


class SampleSource(ABC):
    """Transport of a device, as its evidence uses it. `imud.device.transport` imports this module."""

    driver: Driver | None  # driver of the device; None before imud has found the device
    path: SamplePath | None  # sample path of the device; None before imud has found the device


class SampleWatch:
    """Watch of the samples during a command; an attachment. Synchronization: the loop's thread only."""

    def __init__(self, source: SampleSource) -> None:
        self._source = source
        self._before: Sample | None = None  # newest sample at `mark`
        self._resets = 0  # resets of the device counter at `mark`

    # --- the attachment ----------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """Do nothing: `mark` starts the watch."""

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Do nothing: the evidence reads the newest sample of the path."""

    def stop(self) -> None:
        """Do nothing: the command ends with the link."""

    def close(self) -> None:
        """Do nothing."""

    # --- evidence ----------------------------------------------------------------------------------------------------

    def mark(self) -> None:
        """Start the watch, before the command."""
        self._before = self.newest
        self._resets = self.counter_resets

    @property
    def newest(self) -> Sample | None:
        """Newest sample of the device."""
        return self._source.path.newest if self._source.path is not None else None

    @property
    def counter_resets(self) -> int:
        """Number of resets of the device counter."""
        return self._source.path.clock.resets if self._source.path is not None else 0

    async def next(self, after: Sample | None) -> Sample | None:
        """Return a sample other than `after`; None if no sample arrives."""
        for _ in range(STEPS):
            if (newest := self.newest) is not None and newest is not after:
                return newest
            await asyncio.sleep(STEP_S)
        return None

    async def is_quiet(self) -> bool:
        """Return whether no sample arrives while imud sends nothing."""
        before = self.newest
        for _ in range(QUIET_STEPS):
            await asyncio.sleep(STEP_S)
            if self.newest is not before:
                return False
        return True

    async def arrived(self) -> bool:
        """Return whether a sample has arrived since `mark`."""
        return await self.next(self._before) is not None

    async def has_restarted(self) -> bool:
        """Return whether the next sample shows a restart of the device counter since `mark`."""
        await self.next(self.newest)
        return self.counter_resets != self._resets

    async def evidence(self, proof: Proof, is_quiet: bool) -> tuple[bool | None, str]:
        """Return whether the samples show the effect of a verb since `mark`, None: unknown, and the observation.

        `is_quiet`: whether no sample arrived before the verb.
        """
        if proof is Proof.RESTART:
            return await self.restarted()
        if not is_quiet:
            return None, "the device also sent samples before the command"
        if await self.arrived():
            return True, "a sample arrived, and none arrived before the command"
        return False, "no sample arrived; check the output of the device"

    async def restarted(self) -> tuple[bool | None, str]:
        """Return whether the device has restarted since `mark`, None: unknown, and the observation.

        Only the device counter shows a restart. A pause of the samples does not: a device or a busy link can pause them
        without a restart.
        """
        path, driver = self._source.path, self._source.driver
        if not await self.arrived() or path is None or driver is None:
            return None, "the device sends no samples that show a restart"
        if self._before is None or driver.tick_ns == SAMPLE_COUNTER or self._before.t_dev_ns is None:
            return None, "the device has no counter that shows a restart"
        for _ in range(STEPS // 2):
            if self.counter_resets != self._resets:
                return True, "the device counter restarted"
            await asyncio.sleep(STEP_S)
        return False, "the device counter continued, so the device has ignored the command"
