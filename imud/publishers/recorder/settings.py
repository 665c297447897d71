"""Contract of the configuration: settings of the recorder."""

from typing import Annotated, Final

import msgspec

from imud.contracts.settings import Settings

MEGABYTE: Final = 1_000_000


class RecorderSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the recorder."""

    enabled: bool = False
    """Whether imud records."""
    directory: Annotated[str, msgspec.Meta(min_length=1)] = "/var/lib/imud/recordings"
    """Where the files are; imud makes it where it is missing."""
    devices: list[str] | None = None
    """Names of the devices that are recorded; null for all."""
    keep_gb: Annotated[float, msgspec.Meta(gt=0, le=1_000_000)] = 10.0
    """Room for all files together, GB (10⁹ bytes): the oldest are removed before it is exceeded."""
    file_mb: Annotated[float, msgspec.Meta(ge=1, le=100_000)] = 100.0
    """A new file begins at this size, MB (10⁶ bytes), …"""
    file_minutes: Annotated[float, msgspec.Meta(ge=1, le=10_080)] = 60.0
    """… or after this time, whichever comes first."""

    def __post_init__(self) -> None:
        """Raise ValueError for a budget with room for less than two files."""
        if self.keep_gb * 1000 < 2 * self.file_mb:
            raise ValueError(
                f"keep_gb: expected room for two files of file_mb ({self.file_mb:g}), {self.file_mb / 500:g} or more, "
                f"got {self.keep_gb:g}"
            )

    @property
    def keep_bytes(self) -> int:
        """`keep_gb` in bytes."""
        return round(self.keep_gb * 1000 * MEGABYTE)
