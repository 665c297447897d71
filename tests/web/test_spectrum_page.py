"""The spectrum in a real browser: frequency and amplitude of a vibration, and lost samples."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from imud.analysis.series import even_runs, grid_of
from tests.support.daemon_process import wait_until
from tests.test_daemon import cable
from tests.web.browser import MISSING, Page, Sender, choose, open_page, sent_by, serving_web, upright

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.live]
WAVE_HZ = 20.0
RATE_HZ = 200
LOST = (7, 20, 21, 33)
"""Numbers of the lost frames in each 40 measurements: one in ten, at most two adjacent."""
PAUSE = range(900, 930)
GRID_OF = "const { gridOf } = await import('/static/grid.js'); return gridOf(args[0], args[1])"
SEGMENTS = "return window.imud.view.spectrum.spectrum.segments.length >= arguments[0]"


def wave(number: int) -> float:
    return 9.8 + 2.0 * math.sin(2 * math.pi * WAVE_HZ * number / RATE_HZ)


def with_losses(frame_of: Callable[[int], bytes]) -> Callable[[int], bytes]:
    return lambda number: b"" if number % 40 in LOST or number in PAUSE else frame_of(number)


def test_transform_and_filling_are_those_of_numpy_and_imud_spectrum(scripts: Page) -> None:
    values = np.random.default_rng(5).normal(size=256)
    places = np.delete(np.arange(200), [60, 90, 91, 92, 93])
    bent = np.sin(2 * np.pi * 0.09 * places) + 0.2 * places
    found, smooth = scripts.module(
        """const { density } = await import('/static/spectrum.js');
        const { filled } = await import('/static/grid.js');
        return [[...density(args[0], 128)], filled(args[1], args[2], 190)]""",
        values.tolist(), places.tolist(), bent.tolist(),
    )  # fmt: skip
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(256) / 256)
    expected = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2 / (128 * np.sum(window**2))
    expected[1:-1] *= 2
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-15)
    grid = grid_of((places * 5_000_000).astype(np.int64))
    (expected,) = even_runs(grid, bent, smooth=True)
    assert np.allclose(smooth, expected[:190], atol=1e-9), "away from the ends both splines are the same"


def test_lost_samples_are_counted_and_a_vibration_keeps_its_frequency_and_size(page: Page, tmp_path: Path) -> None:
    """The frames are lost before imud, so that only the time has a step, and not `seq`."""
    with cable(tmp_path) as port, sent_by(tmp_path, port) as daemon, serving_web(daemon.socket) as url:
        open_page(page, url, "bow")
        choose(page, "#spectrum-of", "accel_m_s2")
        with Sender(port, with_losses(upright(wave))) as sender:
            wait_until(lambda: sender.measured > PAUSE.stop + 768, "two segments of 512 after the pause")
            page.until("return window.imud.view.spectrum.spectrum.gaps >= 1", what="the long gap is seen")
            page.until(SEGMENTS, 2)
            page.click("#pause")
            frequencies, _, _, density = page.js("return window.imud.view.spectrum.data")
            rate_hz, missing, segments, gaps = page.js(
                """const one = window.imud.view.spectrum.spectrum;
                return [one.rate_hz, one.missing, one.segments.length, one.gaps]"""
            )
            note = page.text("#spectrum .help:last-child")
        assert page.problems() == []
    assert rate_hz == pytest.approx(RATE_HZ, rel=0.005), "the rate of the device, not of the received samples"
    power = np.array(density, dtype=float) ** 2 * (frequencies[1] - frequencies[0])
    at = int(np.argmax(power))
    assert frequencies[at] == pytest.approx(WAVE_HZ, abs=RATE_HZ / 512)
    line = power[max(at - 4, 0) : at + 5].sum()
    assert line == pytest.approx(2.0**2 / 2, rel=0.1), "the mean square of a sine of 2 m/s²"
    assert power.sum() - line < 0.02 * line, "pieces put together without a gap would have lines beside it"
    assert gaps > 1 or missing == pytest.approx(segments * 256 / 10 + 512 / 10, abs=40), "one in ten of the transformed"
    assert f"{missing} lost samples filled, restarted at {gaps} longer gap" in note


def even(rng: np.random.Generator, scatter: float) -> NDArray[np.float64]:
    """Return the times of 400 samples at 200.03 Hz. Their scatter is given in periods."""
    times = 100.0 + (np.arange(400) + rng.normal(scale=scatter, size=400).clip(-0.45, 0.45)) / 200.03
    return np.asarray(np.sort(times))


STAMPS: dict[str, Callable[[np.random.Generator], NDArray[np.float64]]] = {
    "good": lambda rng: even(rng, 0.02),
    "with single ones missing": lambda rng: np.delete(even(rng, 0.05), [50, 120, 121, 200, 201, 202, 203, 350]),
    "with a long gap": lambda rng: np.delete(even(rng, 0.05), range(150, 163)),
    "in whole ms": lambda rng: np.round(100.0 + np.arange(400) / 300, 3),
    "that scatter": lambda rng: even(rng, 0.4),
    "that scatter, with a pause": lambda rng: even(rng, 0.4) + np.where(np.arange(400) < 200, 0.0, 1.7),
    "that scatter, with pauses only": lambda rng: 4001 * even(rng, 0.4),
}


def test_the_page_finds_the_same_lost_samples_as_imud_spectrum(scripts: Page) -> None:
    for kind, stamps in STAMPS.items():
        times = stamps(np.random.default_rng(3))
        expected = grid_of(np.rint((times - 90.0) * 1e9).astype(np.int64))
        found = scripts.module(GRID_OF, times.tolist(), list(range(1, len(times) + 1)))
        assert found["steps"] == np.diff(expected.place).tolist(), kind
        assert found["isLocated"] is expected.located, kind
        assert found["rate_hz"] == pytest.approx(expected.rate_hz, rel=1e-7), kind
        assert found["scatter_s"] == pytest.approx(expected.scatter_s, abs=1e-8), kind
    times = even(np.random.default_rng(3), 0.4)
    numbers = np.delete(np.arange(0, 1600, 4), [100, 101])
    found = scripts.module(GRID_OF, np.delete(times, [100, 101]).tolist(), numbers.tolist())
    assert not found["isLocated"]
    assert found["steps"] == [*[1] * 99, 3, *[1] * 297], "each fourth sample has a value; two of these were lost"
