"""The page of a device in a real browser: vectors and angles of the frames, status, settings."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imud.drivers.hipnuc.uart.codec import encode_hi91
from tests.support.daemon_process import daemon_with_module
from tests.test_daemon import cable
from tests.web.browser import MISSING, PERIOD_MS, Page, Sender, open_page, sent_by, serving_web

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.live]
Rows = NDArray[np.float64]
PLOTTED = """return Object.fromEntries([...window.imud.view.plots].map(([member, plot]) =>
    [member, plot.data.map((values) => [...values])]))"""
"""For each plot: times, then maximum and minimum of each axis."""
RISE = {
    "accel_m_s2": (0.004, -0.003, 0.002), "gyro_rad_s": (0.005, -0.006, 0.007), "mag_t": (1e-8, -2e-8, 3e-8),
    "euler_rad": (0.0004, -0.0003, 0.0),
}  # fmt: skip
"""Increase of each axis between two measurements."""
TURN_RAD = 0.02
"""Increase of yaw, which passes ±180° every 314 measurements (1.6 s)."""
HISTORY_LEAST = 50
"""More measurements than in a point of the stream, less than in a second of the history."""
SHOWN = {"gyro_rad_s": math.degrees(1.0), "mag_t": 1e6, "euler_rad": math.degrees(1.0), "accel_m_s2": 1.0}
"""Factors of the plots: °/s per rad/s, µT per T, ° per rad."""


def wrapped(angle_rad: float) -> float:
    return math.remainder(angle_rad, 2 * math.pi)


def vector(member: str, number: int) -> list[float]:
    values = [rise * number for rise in RISE[member]]
    return [*values[:2], wrapped(TURN_RAD * number)] if member == "euler_rad" else values


def ramps(number: int) -> bytes:
    """Return a measurement. Each axis and each measurement has another value."""
    values: dict[str, Any] = {member: vector(member, number) for member in RISE}
    return encode_hi91(
        system_time_ms=number * PERIOD_MS, quat_wxyz=(1.0, 0.0, 0.0, 0.0), temperature_c=20.0, pressure_pa=1e5, **values
    )


def expected(member: str, axis: int, spans: Sequence[tuple[int, int]]) -> Rows:
    found = []
    for first, last in spans:
        values = [vector(member, number)[axis] * SHOWN[member] for number in range(first, last + 1)]
        found.append((max(values), min(values)))
    return np.array(found)


ANGLES_SHOWN = "[...document.querySelectorAll('#attitude3d output')].map((one) => one.textContent)"
TEMPERATURE_SHOWN = """[...document.querySelectorAll('#live .bigs div')].find((one) =>
    one.querySelector('dt').textContent === 'Temperature').querySelector('b').textContent"""


def test_values_disappear_without_new_samples(page: Page, tmp_path: Path) -> None:
    """If a device falls silent, no number and no attitude of its last sample stays on the page."""
    with cable(tmp_path) as port, sent_by(tmp_path, port) as daemon, serving_web(daemon.socket) as url:
        with Sender(port, ramps):
            daemon.wait_for("bow", "running")
            open_page(page, url, "bow")
            page.until("return window.imud.view.live.attitude.quaternion !== null", what="an attitude")
            page.until(f"return {ANGLES_SHOWN}.every((one) => one.endsWith('°'))", what="three angles")
            page.until(f"return {TEMPERATURE_SHOWN} === '20.0'", what="the temperature")
        page.until(f"return {ANGLES_SHOWN}.every((one) => one === '–')", what="no angle")
        page.until(f"return {TEMPERATURE_SHOWN} === '–'", what="no temperature")
        assert page.js("return window.imud.view.live.attitude.quaternion") is None
        with Sender(port, ramps):
            page.until(f"return {ANGLES_SHOWN}.every((one) => one.endsWith('°'))", what="three angles again")
            page.until("return window.imud.view.live.attitude.quaternion !== null", what="the attitude again")
        assert page.problems() == []


def test_every_vector_and_angle_is_plotted_as_it_was_sent_in_the_units_of_people(page: Page, tmp_path: Path) -> None:
    with cable(tmp_path) as port, Sender(port, ramps), sent_by(tmp_path, port) as daemon:
        daemon.wait_for("bow", "running")
        with serving_web(daemon.socket) as url:
            open_page(page, url, "bow")
            page.until("return window.imud.view.plots.get('accel_m_s2').data[0].length >= 100", what="five seconds")
            page.click("#pause")
            page_values = page.text("#euler_rad .key:last-child output")
            plots = {member: np.array(rows, dtype=float) for member, rows in page.js(PLOTTED).items()}
            assert page.problems() == []
    kept = ~np.isnan(plots["accel_m_s2"]).any(axis=0)  # a late host breaks the lines
    plots = {member: rows[:, kept] for member, rows in plots.items()}
    greatest, least = plots["accel_m_s2"][1:3] / RISE["accel_m_s2"][0]
    spans = [(round(low), round(high)) for low, high in zip(least, greatest, strict=True)]
    assert sum(last - first + 1 for first, last in spans) == spans[-1][1] - spans[0][0] + 1, "no measurement is missing"
    for member in RISE:
        assert plots[member].shape == (7, len(spans)), member
        for axis in range(3):
            shown, wanted = plots[member][1 + 2 * axis : 3 + 2 * axis].T, expected(member, axis, spans)
            if (member, axis) != ("euler_rad", 2):
                assert np.allclose(shown, wanted, rtol=1e-5, atol=1e-4), (member, axis)
    # a second of the history is not unwrapped
    live = max((at + 1 for at, (first, last) in enumerate(spans) if last - first >= HISTORY_LEAST), default=0)
    turned = np.degrees(TURN_RAD * np.array(spans[live:])[:, ::-1])
    yaw = plots["euler_rad"][5:].T[live:]
    offset = yaw[0, 0] - turned[0, 0]
    assert offset / 360 == pytest.approx(round(offset / 360), abs=1e-5)
    assert turned[-1, 0] - turned[0, 0] > 720, "yaw went over ±180° more than once"
    inside = (yaw - offset <= turned[:, :1] + 1e-3) & (yaw - offset >= turned[:, 1:] - 1e-3)
    assert inside.all(), "the line of yaw continues over ±180°"
    assert all(-180 <= float(one.replace("−", "-")) <= 180 for one in page_values.split(" … "))


def test_the_corners_of_the_block_are_round_and_it_hides_no_name(scripts: Page) -> None:
    drawn = scripts.module(
        """const { AttitudeView } = await import('/static/attitude.js');
        const calls = [];
        const kept = CanvasRenderingContext2D.prototype;
        const [fill, fillText] = [kept.fill, kept.fillText];
        kept.fill = function (...all) { calls.push(['face', this.lineJoin]); fill.apply(this, all); };
        kept.fillText = function (...all) { calls.push([all[0], this.lineJoin]); fillText.apply(this, all); };
        const view = new AttitudeView();
        view.isCompass = true;
        view.set([1, 0, 0, 0], 'ENU');
        [kept.fill, kept.fillText] = [fill, fillText];
        return calls"""
    )
    names = [name for name, _ in drawn]
    assert ({join for _, join in drawn}, names.count("face")) == ({"round"}, 6)
    last = max(at for at, name in enumerate(names) if name == "face")
    assert {"N", "E", "S", "W", "x", "y", "z"} <= set(names[last:])


def test_a_setting_with_a_difference_is_marked_on_the_page_and_in_the_overview(page: Page, tmp_path: Path) -> None:
    declared = {"mode": "9-axis", "magnetic_calibration": True}
    with daemon_with_module(tmp_path, "--rate", "100", settings=declared) as daemon, serving_web(daemon.socket) as url:
        open_page(page, url, "bow")
        page.until_text("#about", "mode: 6-axis, declared: 9-axis")
        # actual values arrive after the names
        page.until("return document.querySelector('[data-setting=mode].off')")
        three = page.js("return [...document.querySelectorAll('[data-setting=mode] dd')].map((one) => one.innerText)")
        assert three[:2] == ["9-axis", "6-axis"], "declared, on the device, in flash"
        assert page.text("[data-setting=magnetic_calibration] .states") == "as declared, in flash: unknown"
        assert page.js("return document.querySelectorAll('[data-setting].off').length") == 1
        page.click("#home")
        page.until_text(".card", "in the configuration")
        assert page.problems() == []
