"""Store of `imud fleet collect --to postgresql://…`."""

from collections.abc import Sequence

from imud.fleet.database.settings import CollectorSettings
from imud.fleet.reader import FleetDelivery
from imud.model.errors import ServerError


class LeaseLost(ServerError):
    """The store lost its connection and therefore its lease. Another collector can have the lease now."""


class PostgresStore:
    """Store in a PostgreSQL database. Synchronization: one thread at a time."""

    def __init__(self, url: str, settings: CollectorSettings = CollectorSettings(), lease: str = "") -> None:  # noqa: B008
        """Connect and create missing tables. `lease` is the name of the lease that `take_lease` takes; empty: none.
        Raises ServerError."""
        raise NotImplementedError

    def take_lease(self) -> bool:
        """Take the lease. Return False if another connection has it. Raises ServerError."""
        raise NotImplementedError

    def write(self, deliveries: Sequence[FleetDelivery]) -> None:
        """Store the messages in one transaction. Raises LeaseLost after a lost connection if the store has a lease,
        otherwise ServerError."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the connection. A second call does nothing."""
