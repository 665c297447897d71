"""Readers of a fleet: what gateways send over MQTT, with a ledger across the network. Reference: docs/fleet.md."""

from imud.fleet.reader import Fleet, FleetBatch, FleetSession, ReaderAccess

__all__ = ["Fleet", "FleetBatch", "FleetSession", "ReaderAccess"]
