"""Readers of a fleet: samples that gateways send over MQTT, with a ledger of each stream. Reference: docs/fleet.md."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from imud.fleet.paho_client import ReaderAccess
    from imud.fleet.reader import Fleet, FleetBatch, FleetSession

__all__ = ["Fleet", "FleetBatch", "FleetSession", "ReaderAccess"]


def __getattr__(name: str) -> Any:
    # The daemon imports this package for the output `mqtt` and does not need the reader.
    if name in __all__:
        from imud.fleet import reader

        return getattr(reader, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
