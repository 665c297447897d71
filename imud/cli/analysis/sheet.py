"""Figures of a data sheet that the user has, as a YAML or JSON file, in the units of data sheets.

source: HI14 data sheet, revision 3, table 2
gyro: {random_walk_deg_sqrt_h: 0.3, bias_instability_deg_h: 2.5}
accel: {noise_density_ug_sqrt_hz: 60, bias_instability_mg: 0.03}
"""

from pathlib import Path
from typing import Any, Final

import msgspec

from imud.analysis.quantities import DEG_PER_RAD, MG_PER_M_S2, ROOT_S_PER_ROOT_H, S_PER_H, UG_PER_M_S2
from imud.contracts.sensors.data_sheet import DataSheet, Figure, ModelFigures, SensorFigures
from imud.contracts.settings import wrong_values
from imud.errors import BadArgument, reason_of
from imud.files import open_regular

SHEET_BYTES_MOST: Final = 65_536
"""A data sheet has some ten figures."""


class GyroSheet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Figures of a gyroscope."""

    random_walk_deg_sqrt_h: Figure = None
    """Angle random walk."""
    noise_density_deg_s_sqrt_hz: Figure = None
    bias_instability_deg_h: Figure = None
    rate_random_walk_deg_h_sqrt_h: Figure = None
    temperature_slope_deg_h_k: Figure = None

    def figures(self) -> SensorFigures:
        """Convert to SI."""
        return SensorFigures(
            random_walk=_si(self.random_walk_deg_sqrt_h, DEG_PER_RAD * ROOT_S_PER_ROOT_H),
            noise_density=_si(self.noise_density_deg_s_sqrt_hz, DEG_PER_RAD),
            bias_instability=_si(self.bias_instability_deg_h, DEG_PER_RAD * S_PER_H),
            rate_random_walk=_si(self.rate_random_walk_deg_h_sqrt_h, DEG_PER_RAD * S_PER_H * ROOT_S_PER_ROOT_H),
            temperature_slope=_si(self.temperature_slope_deg_h_k, DEG_PER_RAD * S_PER_H),
        )


class AccelSheet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Figures of an accelerometer."""

    random_walk_m_s_sqrt_h: Figure = None
    """Velocity random walk."""
    noise_density_ug_sqrt_hz: Figure = None
    bias_instability_mg: Figure = None
    rate_random_walk_mg_sqrt_h: Figure = None
    temperature_slope_mg_k: Figure = None

    def figures(self) -> SensorFigures:
        """Convert to SI."""
        return SensorFigures(
            random_walk=_si(self.random_walk_m_s_sqrt_h, ROOT_S_PER_ROOT_H),
            noise_density=_si(self.noise_density_ug_sqrt_hz, UG_PER_M_S2),
            bias_instability=_si(self.bias_instability_mg, MG_PER_M_S2),
            rate_random_walk=_si(self.rate_random_walk_mg_sqrt_h, MG_PER_M_S2 * ROOT_S_PER_ROOT_H),
            temperature_slope=_si(self.temperature_slope_mg_k, MG_PER_M_S2),
        )


class SheetFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The file."""

    source: str = ""
    """Document, revision and place, for the report."""
    gyro: GyroSheet = GyroSheet()
    accel: AccelSheet = AccelSheet()


def _si(value: float | None, factor: float) -> float | None:
    return None if value is None else value / factor


def read_sheet(path: Path) -> ModelFigures:
    """Read a file of figures. Raises BadArgument naming what is wrong in it."""
    try:
        with open_regular(path) as file:
            text = file.read(SHEET_BYTES_MOST + 1)
    except OSError as error:
        raise BadArgument(f"--sheet {path}: {reason_of(error)}") from error
    if len(text) > SHEET_BYTES_MOST:
        raise BadArgument(f"--sheet {path}: expected at most {SHEET_BYTES_MOST} bytes; is it the data sheet itself?")
    try:
        tree: Any = msgspec.yaml.decode(text)
    except msgspec.DecodeError as error:
        raise BadArgument(f"--sheet {path}: expected YAML: {reason_of(error)}") from None
    wrong = [str(one) for one in wrong_values(SheetFile, tree, "figure")] if isinstance(tree, dict) else ["no mapping"]
    if wrong:
        raise BadArgument(f"--sheet {path}: {'; '.join(wrong)}")
    try:
        sheet = msgspec.convert(tree, SheetFile)
    except msgspec.ValidationError as error:
        raise BadArgument(f"--sheet {path}: {reason_of(error)}") from None
    return ModelFigures(gyro=sheet.gyro.figures(), accel=sheet.accel.figures(), source=sheet.source or str(path))


def figures_for(sheet: DataSheet, product: str, given: ModelFigures | None) -> ModelFigures | None:
    """Choose what to compare with: what the user gave, else what the driver's manual states of the model, else None."""
    return given if given is not None else sheet.figures_of(product)
