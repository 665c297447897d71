"""The latency that consumers of samples ask for: for each device, the strictest of them decides.

    shared memory 5 ms ─┐
    client 3     10 ms ─┼─▶ least per device ──changed──▶ the device, which lets samples wait so long
    client 4      0 ms ─┘

A consumer asks once for all devices, those that appear later included, or for some by name, and releases what it has
asked for when it leaves. Where nobody asks, MOST_NS holds: nobody is there to see it.
"""

from collections.abc import Callable, Collection
from typing import Final, NamedTuple

from imud.units import NS_PER_MS

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

    latency_ns: int
    devices: Collection[str] | None
    """None for all."""


class LatencyBudget:
    """The consumers' requests, and what they come to. Synchronization: the event loop's thread only."""

    def __init__(self) -> None:
        self._requests: dict[str, _Request] = {}
        self._devices: dict[str, tuple[Need, OnNeed]] = {}

    def add_device(self, name: str, on_need: OnNeed) -> None:
        """Add a device; `on_need` is called at once, and whenever that changes."""
        self._devices[name] = (NOBODY, on_need)
        need = min((_need(who, one) for who, one in self._requests.items() if _concerns(one, name)), default=NOBODY)
        self._devices[name] = (need, on_need)
        on_need(need)

    def remove_device(self, name: str) -> None:
        """Remove a device; no-op if absent. Requests that name it stay, for it may be added again."""
        self._devices.pop(name, None)

    def ask(self, who: str, latency_ns: int, devices: Collection[str] | None = None) -> None:
        """Ask for a latency of `devices` (None: of all) in place of what `who` asked for before."""
        self._requests[who] = _Request(max(latency_ns, 0), devices)
        self._settle()

    def release(self, who: str) -> None:
        """Ask for nothing any more; no-op for one that does not ask."""
        if self._requests.pop(who, None) is not None:
            self._settle()

    def need(self, device: str) -> Need:
        """Return what holds for a device."""
        return self._devices[device][0]

    def _settle(self) -> None:
        """Find the strictest request of each device, and tell devices whose latency or asker changed."""
        common, named = NOBODY, dict[str, Need]()
        for who, request in self._requests.items():
            need = _need(who, request)
            if request.devices is None:
                common = min(common, need)
                continue
            for device in request.devices:
                before = named.get(device)
                named[device] = need if before is None else min(before, need)
        for device, (before, on_need) in list(self._devices.items()):
            now = min(common, named.get(device, common))
            if now != before:
                self._devices[device] = (now, on_need)
                on_need(now)


def _need(who: str, request: _Request) -> Need:
    return min(Need(request.latency_ns, who), NOBODY)


def _concerns(request: _Request, device: str) -> bool:
    return request.devices is None or device in request.devices
