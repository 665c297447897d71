"""Evidence in the samples of one device: a restart, and the arrival of a sample."""

import asyncio
from abc import ABC
from typing import Final

from imud.contracts.command import Proof
from imud.contracts.driver import SAMPLE_COUNTER, Driver
from imud.model.sample import Sample
from imud.model.units import NS_PER_MS
from imud.sampling.clock import SampleClock
from imud.sampling.path import SamplePath

STEP_S: Final = 0.1  # time between two looks at the newest sample, s
STEPS: Final = 30  # maximum number of looks: 3 s
PAUSE_NS: Final = 300 * NS_PER_MS  # minimum pause of the samples that shows a restart, ns
PAUSE_PERIODS: Final = 3  # minimum number of sample periods of this pause


class SampleSource(ABC):
    """Transport of a device, as its evidence uses it. `imud.device.transport` imports this module."""

    driver: Driver | None  # driver of the device; None before imud has found the device
    path: SamplePath | None  # sample path of the device; None before imud has found the device


class SampleWatch:
    """Watch of the samples during a command; an attachment. Synchronization: the loop's thread only."""

    def __init__(self, source: SampleSource) -> None:
        self._source = source
        self._seen: Sample | None = None  # newest sample at the last tick
        self._pause_ns = 0  # longest time between two samples since `mark`, ns
        self._before: Sample | None = None  # newest sample at `mark`
        self._resets = 0  # resets of the device counter at `mark`

    # --- the attachment ----------------------------------------------------------------------------------------------

    def start(self, clock: SampleClock) -> None:
        """Do nothing: `mark` starts the watch."""

    def tick(self, now_ns: int, newest: Sample | None) -> None:
        """Measure the pause of the samples."""
        if newest is not None:
            since_ns = self._seen.t_rx_ns if self._seen is not None else newest.t_rx_ns
            self._pause_ns = max(self._pause_ns, newest.t_rx_ns - since_ns)
            self._seen = newest

    def stop(self) -> None:
        """Do nothing: the command ends with the link."""

    def close(self) -> None:
        """Do nothing."""

    # --- evidence ----------------------------------------------------------------------------------------------------

    def mark(self) -> None:
        """Start the watch, before the command."""
        self._pause_ns, self._before, self._resets = 0, self.newest, self.counter_resets
        self._seen = self._before  # the last tick can be one second old

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
        await asyncio.sleep(3 * STEP_S)
        return self.newest is before

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
        if proof is Proof.ONE_SAMPLE and not is_quiet:
            return False, "the device sends other samples too"
        if await self.arrived():
            return True, "a sample arrived"
        return False, "no sample arrived; check the output of the device"

    async def restarted(self) -> tuple[bool | None, str]:
        """Return whether the device has restarted since `mark`, None: unknown, and the observation.

        The device counter shows a restart. Without a counter, a pause of the samples is the evidence.
        """
        source, before = self._source, self._before
        path, driver = source.path, source.driver
        if not await self.arrived() or path is None or driver is None:
            return None, "the device sends no samples that show a restart"
        if before is None:
            return True, "a sample arrived, and none arrived before"
        has_counter = driver.tick_ns != SAMPLE_COUNTER and before.t_dev_ns is not None
        pause_ns = max(PAUSE_NS, PAUSE_PERIODS * path.period_ns)
        for _ in range(STEPS // 2):
            if has_counter and self.counter_resets != self._resets:
                return True, "the device counter restarted"
            if not has_counter and self._pause_ns >= pause_ns:
                return True, f"the samples paused for {self._pause_ns / NS_PER_MS:.0f} ms"
            await asyncio.sleep(STEP_S)
        if has_counter:
            return False, "the device counter continued, so the device has ignored the command"
        return None, "the samples did not pause"
