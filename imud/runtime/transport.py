"""Contract of the transport that connects a device to its link.

A transport is a stream of bytes, a CAN bus, or a bus that is polled. It owns the link, finds the device behind it, and
feeds received data to the device's sample path.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from imud.clock import SampleClock
from imud.config import DeviceConfig
from imud.contracts.action import Target
from imud.contracts.codec import Message
from imud.contracts.driver import Driver
from imud.contracts.link import Link, OnEnd
from imud.contracts.publisher import Batch
from imud.contracts.status import DeviceStatus
from imud.frames.settings import published_frame
from imud.host_clock import HostClock
from imud.ledger import Ledger
from imud.runtime.attachments import Attachments
from imud.runtime.health import Health
from imud.runtime.identity import KnownIdentity
from imud.runtime.notices import Notices
from imud.runtime.path import PathContext, SamplePath, make_clock
from imud.runtime.recording.tap import DeviceTap
from imud.units import NS_PER_S

UNHEARD_NS = 2 * NS_PER_S
"""Data without a single good sample for this long: the device has another rate now, or is another one."""
SILENT_SEARCH_NS = 15 * NS_PER_S
"""A silent link is searched anew after this: the device may have been exchanged or set to another rate."""


@dataclass(frozen=True, slots=True)
class DeviceContext:
    """The parts of a device that its transport works with."""

    config: DeviceConfig
    device_id: int
    host: HostClock
    ledger: Ledger
    notices: Notices
    health: Health
    identity: KnownIdentity
    attachments: Attachments
    publish: Callable[[Batch], None]
    tap: DeviceTap
    """Where a recording hears what goes into the path; the transport says when it makes another one."""

    def path_context(self, driver: Driver, link: Link, on_message: Callable[[Message, int], None]) -> PathContext:
        """Return what the sample path of what `driver` decodes needs; messages of the device go to `on_message`."""
        config = self.config

        def overruns() -> int:
            return link.kernel_counters().overrun

        return PathContext(
            config.name, self.device_id, self.ledger, self.publish, on_message, self.notices.bad_frame, overruns,
            self.host, published_frame(config.frame, config.convention, config.declination_deg, driver.axes),
        )  # fmt: skip

    def new_clock(self, driver: Driver, path: SamplePath | None) -> SampleClock:
        """Return a clock for what `driver` decodes, which continues that of the path before."""
        before = path.clock if path is not None else None
        return make_clock(
            self.config, driver, before, host=self.host.steady, on_unknown_gap=self.ledger.add_unknown_gap
        )


class Transport(Protocol):
    """Transport of one device's data from its link to its sample path. Synchronization: the loop's thread only.

    Order of calls: `wait_present`, `link.open`, `start`, then `work` until it or the link ends, `stop`; then again from
    the beginning, and `close` at the end of all.
    """

    @property
    def link(self) -> Link:
        """The link it owns."""
        ...

    @property
    def driver(self) -> Driver | None:
        """Driver of the device; None until it is known."""
        ...

    @property
    def path(self) -> SamplePath | None:
        """Sample path of the device; None until its driver is known."""
        ...

    @property
    def where(self) -> str:
        """The link and its settings, for people."""
        ...

    @property
    def bit_rate(self) -> int:
        """Rate of the link in bit/s; 0 where it has none."""
        ...

    @property
    def receiving(self) -> bool:
        """Whether received data goes to the sample path; False while the device is searched for."""
        ...

    @property
    def hears_replies(self) -> bool:
        """Whether replies reach the device's codec even before its first sample."""
        ...

    @property
    def busy(self) -> bool:
        """Whether a request script is running."""
        ...

    @property
    def hold_ns(self) -> int:
        """How long data of the device waits at present to be processed together, ns."""
        ...

    def set_latency(self, latency_ns: int) -> None:
        """Let samples wait so long from now on, ns; 0: not at all."""
        ...

    async def wait_present(self) -> None:
        """Return when the link can be opened. Raises LinkError where it must not be."""
        ...

    def start(self, on_end: OnEnd) -> None:
        """Deliver from now on; the link is open. `on_end` is called once when it ends by itself. Raises LinkError."""
        ...

    async def work(self) -> None:
        """Find the device and ask for its identity, as often as needed. Ends only with the link, or by an error."""
        ...

    def tick(self, now_ns: int) -> None:
        """Ten times a second, before the flow of samples is looked at."""
        ...

    def on_no_samples(self, path: SamplePath, now_ns: int) -> None:
        """Report received data instead, and try what can help: no sample came for UNHEARD_NS."""
        ...

    def on_reset(self) -> None:
        """Prepare for a reset of the device by its line."""
        ...

    async def run_script(self, make: Callable[[Target], Any]) -> Any:
        """Run the script that `make` makes for the device, and return its result.

        Raises what the script and its making raise: CommandError, TransferError, DeviceRefused, and LinkError.
        """
        ...

    async def read_back(self) -> None:
        """Ask for identity and settings again, after something was changed; a device that does not answer is left."""
        ...

    def add_status(self, status: DeviceStatus) -> DeviceStatus:
        """Return the status with the fields of this kind of transport."""
        ...

    def stop(self) -> None:
        """Stop all work and close the link; may be called twice."""
        ...

    def close(self) -> None:
        """Stop, and release what is shared with other devices; may be called twice."""
        ...
