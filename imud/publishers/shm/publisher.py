"""Shared memory: one ring of slots per device, `/dev/shm/imud.<device>`, for readers that want no system call.

Readers are `imud.client.ring` and `imud/include/imud.h`; the layout is `imud.formats.ring`. A reader may be as slow
as it likes: the ring never waits for it.
"""

import grp
import logging
import os
from typing import Annotated

import msgspec

from imud.contracts.publisher import Batch, PublisherContext, PublisherType
from imud.contracts.settings import Settings
from imud.errors import ServerError
from imud.event import Event
from imud.formats.ring import DIRECTORY, STATE_LIVE, RingHeader, ring_path
from imud.publishers.shm.ring import ShmRing, refuse_second_writer

log = logging.getLogger(__name__)

SLOTS_MIN, SLOTS_MAX = 64, 1 << 20
"""64 slots are one 16 kB ring; 2²⁰ are 256 MB, more than a gateway should give to one device."""


class ShmSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shared memory."""

    enabled: bool = True
    """Whether there are rings at all."""
    directory: str = DIRECTORY
    """Where the files are. Readers look into /dev/shm, or where their environment variable IMUD_SHM says."""
    slots: Annotated[int, msgspec.Meta(ge=SLOTS_MIN, le=SLOTS_MAX)] = 4096
    """Samples a ring holds, a power of two, 256 bytes each: 4096 are four seconds at 1 kHz and 1 MB per device."""
    group: str = "imud"
    """Group that may read, if it exists and imud may give files to it."""
    mode: Annotated[int, msgspec.Meta(ge=0, le=0o777)] = 0o640
    """File mode: what the owner, the group and all others may do."""

    def __post_init__(self) -> None:
        """Raise ValueError, which the configuration reports with its line, for what no type can say."""
        if self.slots & (self.slots - 1):
            below = 1 << self.slots.bit_length() - 1
            raise ValueError(f"slots: expected a power of two, found {self.slots}; near it are {below} and {2 * below}")
        if not self.directory.startswith("/"):
            raise ValueError(f"directory: expected an absolute path, found {self.directory!r}")


class ShmPublisher:
    """Writes every device's samples into its ring. Synchronization: the event loop's thread only."""

    def __init__(self, settings: ShmSettings, context: PublisherContext) -> None:
        self._settings = settings
        self._context = context
        self._rings: dict[str, ShmRing] = {}
        self._group_id: int | None = None

    def start(self) -> None:
        """Check the directory and find the group. Raises ServerError when files cannot be made in the directory."""
        directory = self._settings.directory
        if not os.path.isdir(directory):
            raise ServerError(f"{directory}: expected a directory for shared memory; is it mounted?")
        if not os.access(directory, os.W_OK | os.X_OK):
            who = f"user {os.geteuid()}"
            raise ServerError(f"{directory}: {who} may not make files there; `ls -ld {directory}` shows who may")
        self._group_id = self._find_group()

    def add_device(self, name: str, device_id: int) -> None:
        """Make the device's ring. Raises ServerError when it does not fit or another daemon writes it."""
        self.remove_device(name)
        context, settings = self._context, self._settings
        path = ring_path(settings.directory, name)
        now_ns = context.now_ns()
        refuse_second_writer(path, now_ns)
        header = RingHeader(
            context.epoch, os.getpid(), STATE_LIVE, name, device_id, settings.slots, heartbeat_ns=now_ns
        )  # fmt: skip
        ring = self._rings[name] = ShmRing(path, header, settings.mode, self._group_id)
        if self._group_id is not None and not ring.group_given:
            self._warn_of_group(f"cannot be given files by user {os.geteuid()}, who is not in it")

    def remove_device(self, name: str) -> None:
        """Close the device's ring and remove its file; no-op if absent."""
        ring = self._rings.pop(name, None)
        if ring is not None:
            ring.close()

    def publish(self, batch: Batch) -> None:
        """Write the samples; the oldest of the ring give way."""
        ring = self._rings.get(batch.device)
        if ring is not None:
            ring.write(batch.samples, batch.slots())

    def event(self, event: Event) -> None:
        """Nothing: shared memory carries samples only."""

    def tick(self, now_ns: int) -> None:
        """Refresh ledgers and heartbeats."""
        for status in self._context.status():
            ring = self._rings.get(status.name)
            if ring is not None:
                ring.set_ledger(status.driver, status.ledger)
        for ring in self._rings.values():
            ring.beat(now_ns)

    def close(self) -> None:
        """Show the final ledgers, then close every ring; may be called twice."""
        if self._rings:
            self.tick(self._context.now_ns())
        for name in list(self._rings):
            self.remove_device(name)

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
