"""The latency that consumers of samples ask for: for each device, the strictest of them decides.

    shared memory 5 ms ─┐
    client 3     10 ms ─┼─▶ least per device ──changed──▶ the device, which lets samples wait so long
    client 4      0 ms ─┘

A consumer asks once for all devices, those that appear later included, or for some by name, and releases what it has
asked for when it leaves. Where nobody asks, MOST_NS holds: nobody is there to see it.
"""

from bisect import bisect_left, insort
from collections.abc import Callable, Collection, Iterator
from typing import Final, NamedTuple

from imud.model.units import NS_PER_MS

MOST_NS: Final = 50 * NS_PER_MS
"""No device lets samples wait for longer, whatever is asked for: more would save nothing that can be measured."""


class Need(NamedTuple):
    """What holds for a device."""

    latency_ns: int
    """How long a sample may wait before it is published; 0: not at all."""
    who: str
    """Who asks for it; empty for nobody."""


NOBODY: Final = Need(MOST_NS, "")

OnNeed = Callable[[Need], None]
"""Called with what holds for a device from now on."""


class _Request(NamedTuple):
    """What one consumer asks for."""

    need: Need
    devices: frozenset[str] | None
    """None for all."""


class LatencyBudget:
    """The consumers' requests, and what they come to. Synchronization: the event loop's thread only.

    Requests are kept in order, for each device that is named and for all: hundreds of clients may come and go at once.
    """

    def __init__(self) -> None:
        self._requests: dict[str, _Request] = {}
        self._common: list[Need] = []
        """Requests that concern all devices, the strictest first."""
        self._named: dict[str, list[Need]] = {}
        """Those that name a device, by its name, the strictest first; also of devices that are not there."""
        self._devices: dict[str, tuple[Need, OnNeed]] = {}

    def add_device(self, name: str, on_need: OnNeed) -> None:
        """Add a device; `on_need` is called at once, and whenever that changes."""
        need = self._strictest(name)
        self._devices[name] = (need, on_need)
        on_need(need)

    def remove_device(self, name: str) -> None:
        """Remove a device; no-op if absent. Requests that name it stay, for it may be added again."""
        self._devices.pop(name, None)

    def ask(self, who: str, latency_ns: int, devices: Collection[str] | None = None) -> None:
        """Ask for a latency of `devices` (None: of all) in place of what `who` asked for before."""
        need = Need(min(max(latency_ns, 0), MOST_NS), who)
        self._replace(who, _Request(need, None if devices is None else frozenset(devices)))

    def release(self, who: str) -> None:
        """Ask for nothing any more; no-op for one that does not ask."""
        self._replace(who, None)

    def need(self, device: str) -> Need:
        """Return what holds for a device."""
        return self._devices[device][0]

    def _replace(self, who: str, request: _Request | None) -> None:
        """Put a request in the place of the one of `who` before; tell the devices for which that changes something."""
        before, common = self._requests.pop(who, None), self._common[:1]
        named = set[str]()
        if before is not None:
            for needs in self._lists(before):
                del needs[bisect_left(needs, before.need)]
            named.update(before.devices or ())
        if request is not None:
            self._requests[who] = request
            for needs in self._lists(request):
                insort(needs, request.need)
            named.update(request.devices or ())
        for device in named:
            if not self._named[device]:
                del self._named[device]
        self._tell(named if self._common[:1] == common else list(self._devices))

    def _lists(self, request: _Request) -> Iterator[list[Need]]:
        """Where a request is kept."""
        if request.devices is None:
            yield self._common
        else:
            yield from (self._named.setdefault(device, []) for device in request.devices)

    def _strictest(self, device: str) -> Need:
        """Find what holds for a device."""
        needs: list[Need] = [NOBODY, *self._common[:1], *self._named.get(device, [])[:1]]
        return min(needs)

    def _tell(self, devices: Collection[str]) -> None:
        """Tell those of some devices whose latency or asker changed."""
        for device in devices:
            if device in self._devices:
                before, on_need = self._devices[device]
                now = self._strictest(device)
                if now != before:
                    self._devices[device] = (now, on_need)
                    on_need(now)
