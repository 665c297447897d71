"""Rows of the tables of time stamp errors: `clock`, `clock_lines`, and the plots (docs/generate/clock_pictures.py)."""

from msgspec import Struct, field

Spread = tuple[float, float]  # minimum and maximum over all crystals, µs


class ArrivalFigures(Struct, frozen=True):
    arrival: str
    rate_hz: int = field(name="rate, Hz")
    sigma_us: Spread = field(name="σ, µs")
    rms_us: Spread = field(name="rms, µs")
    p999_us: Spread = field(name="p99.9, µs")
    mean_t_err_us: Spread = field(name="mean t_err, µs")
    share: float = field(name="within 2 t_err")  # share of samples after settling, for the worst crystal
    settling: float = field(name="while settling")


class LineFigures(Struct, frozen=True):
    source: str
    over: str
    rate_hz: int = field(name="rate, Hz")
    sigma_us: float = field(name="σ, µs")
    mean_us: float = field(name="mean, µs")
    p999_us: float = field(name="p99.9, µs")
    mean_t_err_us: float = field(name="mean t_err, µs")
    share: float = field(name="within 2 t_err")
    settling: float = field(name="while settling")
    by_it: float = field(name="share from the source")
