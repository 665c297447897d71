"""`imud spectrum DEVICE` without an end: the spectrum of the last seconds, redrawn in the terminal."""

import argparse
import sys
from collections import deque
from contextlib import suppress
from time import monotonic
from typing import Final

import numpy as np

from imud.analysis.quantities import SI, TITLES
from imud.analysis.series import FloatArray
from imud.analysis.spectrum import Spectrum
from imud.analysis.spectrum_plots import SensorVibration
from imud.cli.analysis.spectrum_report import SpectrumSettings, peak_lines, sensor_vibration
from imud.cli.analysis.taking import LATENCY_MS, SILENCE_S, Collector, heard, status_of
from imud.cli.arguments import connect, statuses
from imud.cli.output import COLUMNS, shortened
from imud.contracts.sensors.data_sheet import SensorName
from imud.errors import BadArgument
from imud.units import NS_PER_S

REDRAW_S: Final = 1.0
KEPT_S: Final = 10.0
"""The spectrum is of so much: a longer past would hide what changes."""
PAST_ROWS: Final = 8
"""Rows of the spectrogram."""
HEIGHT: Final = 8
"""Rows of the curve."""
PEAKS_SHOWN: Final = 5
RANGE_DB: Final = 60.0
SHADES: Final = " ░▒▓█"
BARS: Final = " ▁▂▃▄▅▆▇█"
CLEAR: Final = "\x1b[H\x1b[2J"


def live(args: argparse.Namespace, settings: SpectrumSettings) -> int:
    """Redraw until interrupted. Raises ImudError."""
    name = settings.sensors[0]
    with connect(args) as asking, connect(args) as listening:
        status_of(statuses(asking), args.input)
        collector = Collector(args.input)
        view = LiveView(args.input, name)
        drawn_s = monotonic()
        with suppress(KeyboardInterrupt):
            samples = listening.watch([args.input], timeout_s=SILENCE_S, latency_ms=LATENCY_MS)
            for sample in heard(samples, args.input):
                if sample is None:
                    sys.stdout.write(f"{CLEAR}{args.input} sends no samples now; `imud status` says why\n")
                    sys.stdout.flush()
                    continue
                collector.add(sample)
                if monotonic() - drawn_s >= REDRAW_S:
                    drawn_s = monotonic()
                    collector.drop_before(sample.t_ns - round(KEPT_S * NS_PER_S))
                    sys.stdout.write(CLEAR + view.page(collector, settings) + "\n")
                    sys.stdout.flush()
    return 0


class LiveView:
    """Text of the view, and the rows of its spectrogram."""

    def __init__(self, device: str, name: SensorName) -> None:
        self._device = device
        self._name: SensorName = name
        self._past: deque[str] = deque(maxlen=PAST_ROWS)

    def page(self, collector: Collector, settings: SpectrumSettings) -> str:
        """Format the view of what the collector has now, in 80 columns."""
        readings = collector.readings()
        values = readings.accel_m_s2 if self._name == "accel" else readings.gyro_rad_s
        if values is None:
            return f"{self._device} sends no values of the {TITLES[self._name]}"
        try:
            sensor = sensor_vibration(readings, values, settings)
        except BadArgument as error:  # too few samples yet
            return f"{self._device}: {error}"
        return "\n".join(self._lines(sensor))

    def _lines(self, sensor: SensorVibration) -> list[str]:
        columns = in_columns(sensor.spectrum)
        decibels = 10 * np.log10(np.maximum(columns, 1e-300))
        top = 10 * int(np.ceil(decibels.max() / 10))
        level = np.clip((decibels - top + RANGE_DB) / RANGE_DB, 0, 1)
        self._past.appendleft("".join(SHADES[min(int(one * len(SHADES)), len(SHADES) - 1)] for one in level))
        grid, spectrum = sensor.grid, sensor.spectrum
        head = (
            f"{shortened(self._device, 16)} {TITLES[self._name]}: {grid.rate_hz:.3f} Hz, {grid.missing} missing, "
            f"bins of {spectrum.bin_hz:.3g} Hz"
        )
        unit = f"dB of ({SI[self._name]})²/Hz"
        return [
            head, f"{top} {unit}", *curve_rows(level), axis_line(spectrum.rate_hz / 2),
            f"{top - RANGE_DB:.0f} {unit}; the last {len(self._past)} s, newest above:", *self._past,
            f"lines, peak amplitude in {SI[self._name]}",
            *peak_lines(sensor)[: PEAKS_SHOWN + 1],
        ]  # fmt: skip


def in_columns(spectrum: Spectrum) -> FloatArray:
    """(COLUMNS,) the highest density of all axes together in each column: a line stays a line."""
    power = spectrum.density[1:].sum(axis=1)
    column = (np.arange(len(power)) * COLUMNS) // len(power)
    found = np.full(COLUMNS, 0.0)
    np.maximum.at(found, column, power)
    if len(power) < COLUMNS:
        found = power[np.arange(COLUMNS) * len(power) // COLUMNS]
    return np.asarray(found, dtype=np.float64)


def curve_rows(level: FloatArray) -> list[str]:
    """The curve as HEIGHT rows of bars; level (COLUMNS,) 0 to 1."""
    eighths = np.rint(level * HEIGHT * (len(BARS) - 1)).astype(int)
    rows = []
    for row in range(HEIGHT - 1, -1, -1):
        inside = np.clip(eighths - row * (len(BARS) - 1), 0, len(BARS) - 1)
        rows.append("".join(BARS[one] for one in inside).rstrip())
    return rows


def axis_line(half_hz: float) -> str:
    """Frequencies below the columns: 0, a quarter, the middle, three quarters, the end."""
    line = [" "] * COLUMNS
    for quarter in range(5):
        words = f"{half_hz * quarter / 4:.4g}" + (" Hz" if quarter == 4 else "")
        place = round((COLUMNS - 1) * quarter / 4)
        begin = min(max(place - len(words) // 2, 0), COLUMNS - len(words))
        line[begin : begin + len(words)] = words
    return "".join(line)
