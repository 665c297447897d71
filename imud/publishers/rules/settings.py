"""Options of the output `rules`, and the values that a rule can limit."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Final, Literal

import msgspec

from imud.contracts.lines import LineOptions, OutputOptions
from imud.contracts.publisher import PublisherType, make_later
from imud.model.host_object import Command
from imud.model.options import Options, shown

RULES_MAX: Final = 64  # maximum number of rules: each costs time for each sample of its devices
NAME_PATTERN: Final = "[a-z0-9_-]{1,64}"
_NAME: Final = re.compile(NAME_PATTERN)
WINDOW_S: Final = 1.0  # default window, s
LOSS_WINDOW_S: Final = 60.0  # default window of lost samples, s

Measure = Literal[
    "tilt_deg", "peak_accel_m_s2", "rms_accel_m_s2", "angular_rate_deg_s", "temperature_c", "sample_rate_hz",
    "lost_samples", "t_err_ms", "silence_s",
]  # fmt: skip
Axis = Literal["x", "y", "z", "roll", "pitch"]
XYZ: Final = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class MeasureKind:
    """Value that a rule can limit."""

    words: str  # name in messages
    unit: str  # unit in messages; empty for a number
    axes: tuple[str, ...] = ()  # supported values of `axis`
    has_window: bool = False
    default_window_s: float = WINDOW_S
    has_band: bool = False
    is_sampled: bool = True  # False: imud evaluates the value twice per second, not for each sample


MEASURES: Final[Mapping[str, MeasureKind]] = {
    "tilt_deg": MeasureKind("tilt", "°", ("roll", "pitch", "x", "y")),
    "peak_accel_m_s2": MeasureKind("peak acceleration", "m/s²", XYZ, has_window=True, has_band=True),
    "rms_accel_m_s2": MeasureKind("RMS acceleration", "m/s²", XYZ, has_window=True, has_band=True),
    "angular_rate_deg_s": MeasureKind("angular rate", "°/s", XYZ),
    "temperature_c": MeasureKind("temperature", "°C"),
    "sample_rate_hz": MeasureKind("sample rate", "Hz", has_window=True, is_sampled=False),
    "lost_samples": MeasureKind(
        "number of lost samples", "", has_window=True, default_window_s=LOSS_WINDOW_S, is_sampled=False
    ),
    "t_err_ms": MeasureKind("time stamp error", "ms"),
    "silence_s": MeasureKind("silence", "s", is_sampled=False),
}


class RuleOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One rule."""

    measure: Measure
    """Limited value, with its unit: docs/rules.md lists the values."""
    above: Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)] | None = None
    """Upper limit in the unit of `measure`; null: no upper limit."""
    below: Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)] | None = None
    """Lower limit in the unit of `measure`; null: no lower limit."""
    hysteresis: Annotated[float, msgspec.Meta(ge=0, le=1e9)] = 0.0
    """The rule ends when the value is this far inside the limits, in the unit of `measure`."""
    hold_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    """Time beyond a limit before the rule begins, and time inside before it ends (then at least 1 s), s."""
    devices: Annotated[list[str], msgspec.Meta(min_length=1, max_length=256)] | None = None
    """Names of devices; null: all devices."""
    axis: Axis | None = None
    """`x`, `y`, `z` of a vector, or `roll`, `pitch`; `tilt_deg` also has `x`, `y` of an inclinometer. null: norm of the
    vector, or angle of the z axis to the vertical."""
    window_s: Annotated[float, msgspec.Meta(ge=0.01, le=3600)] | None = None
    """Window of peak, RMS, sample rate and lost samples, s; null: 1, and 60 for lost samples."""
    band_hz: Annotated[list[float], msgspec.Meta(min_length=2, max_length=2)] | None = None
    """Lower and upper edge of a band-pass filter for an acceleration, Hz; null: no filter."""
    snapshot: bool = False
    """Save a snapshot of the flight recorder when the rule begins."""
    line: OutputOptions | None = None
    """GPIO line that is active while the rule is active for a device; null: no line."""
    command: Command = msgspec.field(default_factory=list[str])
    """Program with an absolute path, and its arguments, that imud runs when the rule begins; empty: none."""
    end_command: Command = msgspec.field(default_factory=list[str])
    """Program and arguments that imud runs when the rule ends; empty: none."""

    def __post_init__(self) -> None:
        """Raise ValueError if a combination of keys is invalid."""
        kind = MEASURES[self.measure]
        if self.above is None and self.below is None:
            raise ValueError("expected the key above or below, got none")
        if self.above is not None and self.below is not None and self.above - self.below <= 2 * self.hysteresis:
            raise ValueError(
                f"above: expected more than below plus twice the hysteresis "
                f"({self.below + 2 * self.hysteresis:g}), got {self.above:g}"
            )
        if self.axis is not None and self.axis not in kind.axes:
            known = ", ".join(kind.axes) or "no axis"
            raise ValueError(f"axis: expected for {self.measure}: {known}; got {self.axis}")
        if self.window_s is not None and not kind.has_window:
            raise ValueError(f"window_s: expected no window for {self.measure}, got {self.window_s:g}")
        if self.band_hz is not None and not (kind.has_band and 0.01 <= self.band_hz[0] < self.band_hz[1] <= 10_000):
            raise ValueError(
                "band_hz: expected an acceleration and two rising edges from 0.01 to 10000 Hz, "
                f"got {shown(self.band_hz)} for {self.measure}"
            )
        for name in ("command", "end_command"):
            words = getattr(self, name)
            if words and (not words[0].startswith("/") or words[0].endswith("/")):
                raise ValueError(f"{name}: expected a program with an absolute path first, got {shown(words[0])}")

    @property
    def kind(self) -> MeasureKind:
        return MEASURES[self.measure]

    @property
    def window(self) -> float:
        """Present window, s."""
        return self.kind.default_window_s if self.window_s is None else self.window_s

    @property
    def field(self) -> str:
        """Necessary field of a sample; empty if each sample contains the value."""
        if self.measure == "tilt_deg":
            return "incli_rad" if self.axis in XYZ else "euler_rad"
        return {
            "peak_accel_m_s2": "accel_m_s2", "rms_accel_m_s2": "accel_m_s2", "angular_rate_deg_s": "gyro_rad_s",
            "temperature_c": "temperature_c",
        }.get(self.measure, "")  # fmt: skip


class CommandLimits(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of all commands together."""

    running: Annotated[int, msgspec.Meta(ge=1, le=16)] = 4
    """Maximum number of commands at a time. imud does not run a command above this number."""
    per_hour: Annotated[int, msgspec.Meta(ge=1, le=3600)] = 60
    """Maximum number of commands per hour."""
    time_s: Annotated[float, msgspec.Meta(ge=0.1, le=3600)] = 30.0
    """Maximum duration of a command, s. Then imud ends its process group with SIGTERM, and after 2 s with SIGKILL."""


class RulesOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the output `rules`."""

    enabled: bool = False
    """Evaluate the rules."""
    rules: dict[str, RuleOptions] = msgspec.field(default_factory=dict[str, RuleOptions])
    """Rules by name: small letters, digits, `_` and `-`."""
    commands: CommandLimits = CommandLimits()
    """Limits of the commands."""

    def __post_init__(self) -> None:
        """Raise ValueError if a name is invalid, or if there are too many rules."""
        if len(self.rules) > RULES_MAX:
            raise ValueError(f"rules: expected at most {RULES_MAX} rules, got {len(self.rules)}")
        for name in self.rules:
            if _NAME.fullmatch(name) is None:
                raise ValueError(f"rules: expected names of small letters, digits, _ and -, got {shown(name)}")

    @property
    def devices(self) -> Sequence[str]:
        """Names of the devices in all rules. `imud check` reports unknown names."""
        return list(dict.fromkeys(name for rule in self.rules.values() for name in rule.devices or ()))


def lines_of(options: RulesOptions) -> Iterator[tuple[tuple[str, ...], LineOptions]]:
    """Yield the GPIO lines of the rules with the paths of their keys."""
    for name, rule in options.rules.items():
        if rule.line is not None and options.enabled:
            yield ("rules", name, "line"), rule.line


PUBLISHER = PublisherType(
    "rules", RulesOptions, make_later("imud.publishers.rules.publisher:Rules"), required=False, used_lines=lines_of
)
