"""Latency of each device: the smallest latency that a client or output requests.

    shared memory 5 ms ─┐
    client 3     10 ms ─┼─▶ minimum per device ──changed──▶ the device, which holds samples up to this time
    client 4      0 ms ─┘

A request is for all devices, also future devices, or for named devices. It ends when the client leaves. Without a
request the latency is MOST_NS.
"""

from bisect import bisect_left, insort
from collections.abc import Callable, Collection, Iterator
from typing import Final, NamedTuple

from imud.model.units import NS_PER_MS

MOST_NS: Final = 50 * NS_PER_MS
"""Maximum hold of a sample, ns, for any requested latency. A longer hold saves no measurable CPU time."""


class Need(NamedTuple):
    """Latency of a device."""

    latency_ns: int  # maximum hold of a sample, ns; 0: no hold
    who: str  # name of the client or output; empty without a request


NOBODY: Final = Need(MOST_NS, "")

OnNeed = Callable[[Need], None]  # called with the new latency of a device


class _Request(NamedTuple):
    """Request of one client or output."""

    need: Need
    devices: frozenset[str] | None  # names of the devices; None: all devices


class LatencyBudget:
    """Latency requests and their minimum per device. Synchronization: the loop's thread only.

    The requests are sorted per device, because hundreds of clients can connect and disconnect at the same time.
    """

    def __init__(self) -> None:
        self._requests: dict[str, _Request] = {}
        self._common: list[Need] = []  # requests for all devices, in ascending order of latency
        # requests by the name of the device, in ascending order of latency; also for unknown devices
        self._named: dict[str, list[Need]] = {}
        self._devices: dict[str, tuple[Need, OnNeed]] = {}

    def add_device(self, name: str, on_need: OnNeed) -> None:
        """Add a device. Call `on_need` now and after each change of its latency."""
        need = self._strictest(name)
        self._devices[name] = (need, on_need)
        on_need(need)

    def remove_device(self, name: str) -> None:
        """Remove a device. Its requests stay, because the device can return. Do nothing for an unknown device."""
        self._devices.pop(name, None)

    def ask(self, who: str, latency_ns: int, devices: Collection[str] | None = None) -> None:
        """Request a latency for `devices` (None: all). Replace the previous request of `who`."""
        need = Need(min(max(latency_ns, 0), MOST_NS), who)
        self._replace(who, _Request(need, None if devices is None else frozenset(devices)))

    def release(self, who: str) -> None:
        """Withdraw the request of `who`. Do nothing if `who` did not make a request."""
        self._replace(who, None)

    def need(self, device: str) -> Need:
        """Return the latency of a device."""
        return self._devices[device][0]

    def _replace(self, who: str, request: _Request | None) -> None:
        """Replace the request of `who`. Notify each device whose latency changes."""
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
        self._notify(named if self._common[:1] == common else list(self._devices))

    def _lists(self, request: _Request) -> Iterator[list[Need]]:
        """Return the lists that contain a request."""
        if request.devices is None:
            yield self._common
        else:
            yield from (self._named.setdefault(device, []) for device in request.devices)

    def _strictest(self, device: str) -> Need:
        """Return the smallest request for a device."""
        needs: list[Need] = [NOBODY, *self._common[:1], *self._named.get(device, [])[:1]]
        return min(needs)

    def _notify(self, devices: Collection[str]) -> None:
        """Notify the devices whose latency or requester has changed."""
        for device in devices:
            if device in self._devices:
                before, on_need = self._devices[device]
                now = self._strictest(device)
                if now != before:
                    self._devices[device] = (now, on_need)
                    on_need(now)
