"""Settings of `imud fleet collect --config FILE`: shares, retention and partitions of the database."""

from typing import Annotated

import msgspec

from imud.model.options import Options

Days = Annotated[float, msgspec.Meta(ge=0.01, le=36_500)]


class CollectorSettings(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the collector of a PostgreSQL database."""

    shares: Annotated[int, msgspec.Meta(ge=1, le=64)] = 1
    """Number of shares of the fleet. Each share has one collector at a time."""
    keep_boots: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 10
    """Number of boots per gateway that stay in the ledger."""
    samples_days: Days | None = None
    """Time after which imud removes samples, days; null: never."""
    intervals_days: Days | None = None
    """Time after which imud removes intervals, days; null: never."""
    events_days: Days | None = None
    """Time after which imud removes events and dropped ranges, days; null: never."""
    partition_hours: Annotated[int, msgspec.Meta(ge=1, le=720)] = 24
    """Time that one partition of a table covers, hours."""
    compress_after_days: Days | None = 7.0
    """Age at which TimescaleDB compresses rows, days; null: never. No effect without TimescaleDB."""
    silent_s: Annotated[float, msgspec.Meta(ge=1, le=31_536_000)] = 300.0
    """Time without a message after which a gateway is silent, s."""
    metrics: str = ""
    """Address HOST:PORT of the Prometheus metrics of the collector; empty: none."""
