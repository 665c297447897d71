"""Settings of the recorder: files that are always written, and the flight recorder."""

from typing import Annotated, Final

import msgspec

from imud.contracts.lines import InputSettings
from imud.contracts.settings import Settings

MEGABYTE: Final = 1_000_000


class FlightSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the flight recorder."""

    enabled: bool = False
    """Whether imud keeps the last minutes, to be saved by an alert or by `imud record --snapshot`."""
    minutes: Annotated[float, msgspec.Meta(ge=0.1, le=1440)] = 5.0
    """Time before an alert that is kept, min."""
    after_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 30.0
    """Time after an alert that is saved with it, s."""
    memory_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 64.0
    """Room for what is kept, MB (10⁶ bytes): where `minutes` need more, less of them is kept."""
    directory: str = ""
    """Where it is kept: empty for the main memory, or a directory that imud makes, for example on a tmpfs; what a
    killed imud left there is saved at the next start."""
    acceleration_m_s2: Annotated[float, msgspec.Meta(gt=0, le=1_000_000)] | None = None
    """An acceleration above which a sample is an alert, m/s², gravity included; null for none."""
    device_lost: bool = True
    """Whether it is an alert that a device that was running is gone or silent."""
    line: InputSettings | None = None
    """A GPIO line whose becoming active is an alert, with the keys `line`, `chip`, `active_low` and `bias` as those of
    a device; null for none."""
    per_hour: Annotated[int, msgspec.Meta(ge=1, le=3600)] = 6
    """At most so many snapshots are saved by alerts within an hour."""


class RecorderSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the recorder."""

    enabled: bool = False
    """Whether imud records always, to files that follow one another."""
    directory: Annotated[str, msgspec.Meta(min_length=1)] = "/var/lib/imud/recordings"
    """Where the files are; imud makes it where it is missing."""
    devices: list[str] | None = None
    """Names of the devices that are recorded; null for all."""
    keep_gb: Annotated[float, msgspec.Meta(gt=0, le=1_000_000)] = 10.0
    """Room for all files together, snapshots included, GB (10⁹ bytes): the oldest are removed before it is exceeded."""
    file_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 100.0
    """A new file begins at this size, MB (10⁶ bytes), …"""
    file_minutes: Annotated[float, msgspec.Meta(ge=1, le=10_080)] = 60.0
    """… or after this time, whichever comes first."""
    flight: FlightSettings = FlightSettings()
    """The flight recorder: the last minutes, saved when something happens."""

    def __post_init__(self) -> None:
        """Raise ValueError for a budget with room for less than two files, or for a snapshot."""
        if self.keep_gb * 1000 < 2 * self.file_mb:
            raise ValueError(
                f"keep_gb: expected room for two files of file_mb ({self.file_mb:g}), {self.file_mb / 500:g} or more, "
                f"got {self.keep_gb:g}"
            )
        room_mb = (2 * self.file_mb if self.enabled else 0) + self.flight.memory_mb
        if self.flight.enabled and self.keep_gb * 1000 < room_mb:
            raise ValueError(
                f"keep_gb: expected room for a snapshot of flight.memory_mb ({self.flight.memory_mb:g}) beside the "
                f"files, {room_mb / 1000:g} or more, got {self.keep_gb:g}"
            )

    @property
    def keep_bytes(self) -> int:
        """`keep_gb` in bytes."""
        return round(self.keep_gb * 1000 * MEGABYTE)
