"""Shared memory: one ring of slots per device, `/run/imud/shm/imud.<device>`, for readers that want no system call.

Readers are `imud.client.ring` and `imud/include/imud.h`; the layout is `imud.formats.ring`. A reader may be as slow
as it likes: the ring never waits for it. A ring that cannot be made, or that is removed or cut, is made anew as soon as
that is possible; the daemon and its other outputs go on meanwhile.
"""

import grp
import logging
import os
import sys
from dataclasses import dataclass
from typing import Annotated, Final

import msgspec

from imud.contracts.publisher import Batch, PublisherContext, PublisherType
from imud.contracts.settings import Settings
from imud.errors import ServerError
from imud.event import Event
from imud.formats.ring import DIRECTORY, STATE_LIVE, RingHeader, ring_path
from imud.publishers.shm.directory import RingDirectory, open_directory
from imud.publishers.shm.ring import ShmRing
from imud.units import NS_PER_MS

log = logging.getLogger(__name__)

ASKER: Final = "shared memory"
"""Who asks for the latency of its settings."""
RETRY_NS: Final = 1_000_000_000
"""A ring that cannot be made is tried again once a second: a full memory is not filled any faster."""
OTHERS_WRITE: Final = 0o022
SLOTS_MIN, SLOTS_MAX = 64, 1 << 20
"""64 slots are one 16 kB ring; 2²⁰ are 256 MB, more than a gateway should give to one device."""


class ShmSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shared memory."""

    enabled: bool = True
    """Whether there are rings at all."""
    directory: str = DIRECTORY
    """Where the files are; $XDG_RUNTIME_DIR/imud/shm instead of the default for a daemon that may not use that. Readers
    look into both; another directory is named by their environment variable IMUD_SHM."""
    slots: Annotated[int, msgspec.Meta(ge=SLOTS_MIN, le=SLOTS_MAX)] = 4096
    """Samples a ring holds, a power of two, 256 bytes each: 4096 are four seconds at 1 kHz and 1 MB per device."""
    latency_ms: Annotated[float, msgspec.Meta(ge=0, le=50)] = 5.0
    """Samples may be written so much later than they could be, several at once, which costs less CPU; 0: each at once.
    Where a client of the socket asks for less, it is less for all."""
    group: str = "imud"
    """Group that may read, if it exists and imud may give files to it."""
    mode: Annotated[int, msgspec.Meta(ge=0, le=0o777)] = 0o640
    """File mode: what the owner, the group and all others may do; only the owner may write."""

    def __post_init__(self) -> None:
        """Raise ValueError, which the configuration reports with its line, for what no type can say."""
        if self.slots & (self.slots - 1):
            below = 1 << self.slots.bit_length() - 1
            raise ValueError(f"slots: expected a power of two, found {self.slots}; near it are {below} and {2 * below}")
        if not self.directory.startswith("/"):
            raise ValueError(f"directory: expected an absolute path, found {self.directory!r}")
        if self.mode & OTHERS_WRITE:
            raise ValueError(f"mode: expected none that lets group or others write the rings, found {self.mode:#o}")


@dataclass(slots=True)
class _Place:
    """A device of the configuration, and why it has no ring."""

    device_id: int
    newest: int = 0
    """Sequence number of its newest sample while it had no ring."""
    problem: str = ""
    retry_ns: int = 0


class ShmPublisher:
    """Writes every device's samples into its ring. Synchronization: the event loop's thread only."""

    def __init__(self, settings: ShmSettings, context: PublisherContext) -> None:
        self._settings = settings
        self._context = context
        self._directory: RingDirectory | None = None
        self._places: dict[str, _Place] = {}
        self._rings: dict[str, ShmRing] = {}
        self._group_id: int | None = None
        self._started = False
        self._directory_problem = ""

    def start(self) -> None:
        """Open the directory and find the group. Raises ServerError when files cannot be made in the directory."""
        if sys.byteorder != "little":
            raise ServerError("shared memory is little-endian and this machine is not: set `shm: {enabled: false}`")
        self._opened_directory()
        self._group_id = self._find_group()
        self._started = True
        self._context.latencies.ask(ASKER, round(self._settings.latency_ms * NS_PER_MS))

    def add_device(self, name: str, device_id: int) -> None:
        """Make the device's ring; where that fails, log why and go on trying.

        Raises ServerError when another daemon writes it, or when the directory cannot be used.
        """
        self.remove_device(name)
        try:
            directory = self._opened_directory()
            directory.refuse_second_writer(ring_path(directory.path, name).name)
        except ServerError:
            if not self._started:  # it will not be: leave nothing open
                self.close()
            raise
        self._places[name] = _Place(device_id)
        self._make(name, directory, self._context.now_ns())

    def remove_device(self, name: str) -> None:
        """Close the device's ring and remove its file; no-op if absent."""
        self._places.pop(name, None)
        ring = self._rings.pop(name, None)
        self._context.rings.pop(name, None)
        self._context.without_ring.discard(name)
        if ring is not None:
            ring.close()

    def publish(self, batch: Batch) -> None:
        """Write the samples; the oldest of the ring give way."""
        ring = self._rings.get(batch.device)
        if ring is not None:
            ring.write(batch.samples, batch.slots())
        elif batch.device in self._places:
            self._places[batch.device].newest = batch.samples[-1].seq

    def event(self, event: Event) -> None:
        """Nothing: shared memory carries samples only."""

    def tick(self, now_ns: int) -> None:
        """Make rings anew that were removed or cut; refresh ledgers and heartbeats."""
        directory = self._current_directory()
        for name, place in self._places.items():
            ring = self._rings.get(name)
            if (ring is None or not ring.is_intact(directory)) and now_ns >= place.retry_ns:
                self._make_anew(name, directory, now_ns)
        self._show(now_ns)

    def close(self) -> None:
        """Show the final ledgers, then close every ring; may be called twice."""
        self._context.latencies.release(ASKER)
        if self._rings:
            self._show(self._context.now_ns())
        for name in list(self._places):
            self.remove_device(name)
        if self._directory is not None:
            self._directory.close()
            self._directory = None

    def _show(self, now_ns: int) -> None:
        for name, driver, ledger in self._context.ledgers():
            ring = self._rings.get(name)
            if ring is not None:
                ring.set_ledger(driver, ledger)
        for ring in self._rings.values():
            ring.beat(now_ns)

    def _opened_directory(self) -> RingDirectory:
        if self._directory is None:
            self._directory = open_directory(self._settings.directory, os.environ)
        return self._directory

    def _current_directory(self) -> RingDirectory:
        """The directory that is at its path now; where none is there that can be used, the one that was."""
        directory = self._opened_directory()
        if directory.current:
            return directory
        try:
            self._directory = open_directory(self._settings.directory, os.environ)
        except ServerError as error:
            if str(error) != self._directory_problem:
                log.error("shm: %s; trying again", error)
            self._directory_problem = str(error)
            return directory
        self._directory_problem = ""
        directory.close()
        return self._directory

    def _make_anew(self, name: str, directory: RingDirectory, now_ns: int) -> None:
        """Replace a ring that was removed or cut, or make the one that could not be made."""
        old = self._rings.get(name)
        if old is None or not old.is_named(directory):
            try:
                directory.refuse_second_writer(ring_path(directory.path, name).name)
            except ServerError as error:
                self._put_off(name, error, now_ns)
                return
        if self._make(name, directory, now_ns):
            log.warning("shm: the ring of %s was missing or cut; it is made anew", name)
            if old is not None:
                old.close()

    def _make(self, name: str, directory: RingDirectory, now_ns: int) -> bool:
        """Make the device's ring, which goes on from the number where the one before ended."""
        context, settings, place, old = self._context, self._settings, self._places[name], self._rings.get(name)
        newest = place.newest if old is None else old.newest
        header = RingHeader(
            context.epoch, os.getpid(), STATE_LIVE, name, place.device_id, settings.slots, newest, newest + 1, now_ns
        )  # fmt: skip
        try:
            ring = self._rings[name] = ShmRing(directory, header, settings.mode, self._group_id)
        except ServerError as error:
            self._put_off(name, error, now_ns)
            return False
        place.problem = ""
        context.rings[name] = str(ring_path(directory.path, name))
        context.without_ring.discard(name)
        if self._group_id is not None and not ring.group_given:
            self._warn_of_group(f"cannot be given files by user {os.geteuid()}, who is not in it")
        return True

    def _put_off(self, name: str, error: ServerError, now_ns: int) -> None:
        place = self._places[name]
        if str(error) != place.problem:
            log.error("shm: no ring for %s: %s; trying again every second", name, error)
        place.problem, place.retry_ns = str(error), now_ns + RETRY_NS
        self._context.without_ring.add(name)

    def _find_group(self) -> int | None:
        try:
            return grp.getgrnam(self._settings.group).gr_gid
        except KeyError:
            self._warn_of_group("does not exist")
            return None

    def _warn_of_group(self, why: str) -> None:
        """Log once why the group cannot read; the daemon starts all the same."""
        self._group_id = None
        log.warning("shm: group %s %s; its members cannot read shared memory", self._settings.group, why)


PUBLISHER = PublisherType("shm", ShmSettings, ShmPublisher)
