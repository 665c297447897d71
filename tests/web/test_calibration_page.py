"""Calibrations on the page in a real browser: a rotating device, the sphere, the result."""

import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from imud.client.connection import Client
from imud.device.turns import COVERAGE_WANTED
from imud.formats.jsonrpc import RpcError
from tests.support.daemon_process import LIMIT_S, RunningDaemon
from tests.web.browser import MISSING, TOKEN, Page, log_in, open_page, serving_web
from tests.web.turned import BIAS, turned_module

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.live]
COVERED = "return Number(document.querySelector('#calibration canvas').dataset.covered)"
CALIBRATION_EVENTS = "return document.querySelectorAll('#event-list li[data-kind=calibration]').length"
BEGIN = "#calibration [data-kind={}] button"
PIXEL = """const { onSphere, coveredCells, cellDirection } = await import('/static/sphere.js');
    const canvas = document.querySelector('#calibration canvas');
    const scale = canvas.width / 240;
    const colour = (cell) => {
        const [x, y] = onSphere(cellDirection(cell));
        return [...canvas.getContext('2d').getImageData(x * scale, y * scale, 1, 1).data].join();
    };
    const { sphere } = window.imud.view.calibration;
    sphere.draw(args[0]);
    return coveredCells(args[0]).map((is, cell) => [is, onSphere(cellDirection(cell))[2] > 0.3, colour(cell)]);"""
"""For each cell of a mask: whether it is covered, whether it is in front, and the color of its center."""


def test_a_magnetometer_is_calibrated_with_the_token(page: Page, tmp_path: Path, token: str) -> None:
    with turned_module(tmp_path) as daemon, serving_web(daemon.socket, "--token-file", token) as url:
        open_page(page, url, "bow")
        page.until("return document.querySelectorAll('#calibration details').length >= 5")
        log_in(page, TOKEN)
        page.until("return document.querySelector(arguments[0])", BEGIN.format("magnetometer"))
        page.click(BEGIN.format("magnetometer"))
        page.until("return document.querySelector('#calibration-stop')?.getClientRects().length")
        assert page.js("return document.querySelector(arguments[0]).disabled", BEGIN.format("level"))
        first = page.until(COVERED)
        page.until(f"{COVERED} > arguments[0]", first)
        page.until_text("#calibration .turns", "around x")
        page.until_text("#calibration-result", "magnetometer is verified and saved")
        result = page.text("#calibration-result")
        assert "field strength 45.1 µT, at most 67 µT: passed" in result
        assert "residual of the field" in result
        assert f"The device reports: {BIAS}" in result
        page.until(f"{COVERED} >= arguments[0]", COVERAGE_WANTED * 48)  # the events may arrive after the reply
        assert "45.1 µT" in page.text("#calibration .measures")
        assert not page.js("return document.querySelector('#calibration-stop').getClientRects().length")
        assert not page.js("return document.querySelector(arguments[0]).disabled", BEGIN.format("level"))
        page.until(f"{CALIBRATION_EVENTS} >= 2")
        assert page.js(CALIBRATION_EVENTS) == 2, "its begin and its end; what is between is the sphere"
        assert page.problems() == []


def test_a_calibration_is_seen_without_the_token_and_stopped_with_it(page: Page, tmp_path: Path, token: str) -> None:
    with (
        turned_module(tmp_path, speed=1) as daemon,  # slow: the calibration is still running at the stop
        serving_web(daemon.socket, "--token-file", token) as url,
        ThreadPoolExecutor(1) as pool,
        Client(daemon.socket, timeout_s=LIMIT_S) as client,
    ):
        open_page(page, url, "bow")
        page.until("return document.querySelector('#calibration').textContent.includes('Log in to start it.')")
        assert not page.js("return document.querySelector('#calibration details button')")
        ask = """const { call } = await import('/static/util.js');
            return call(args[0], { device: 'bow', kind: 'level' }).catch((error) => error.message)"""
        for method in ("calibrate", "stop_calibration"):
            assert page.module(ask, method) == "no permission; log in with the token"
        running: Future[Any] = pool.submit(client.call, "calibrate", device="bow", kind="magnetometer")
        page.until(COVERED)
        page.until_text("#calibration-progress", "of the directions and turns")
        page.driver.refresh()
        page.until_text("#calibration .running", "Magnetometer calibration is running")
        page.until(COVERED)
        assert not page.js("return document.querySelector('#calibration-stop').getClientRects().length")
        page.until_text("#calibration .running", f"started by uid {os.getuid()}")
        log_in(page, TOKEN)
        page.click("#calibration-stop")  # of another client
        with pytest.raises(RpcError, match="was cancelled"):
            running.result(LIMIT_S)
        page.until_text("#calibration-result", "calibration magnetometer: it was cancelled")
        page.until("return document.querySelector('#calibration .running').hidden")
        page.until("return document.querySelector(arguments[0])", BEGIN.format("level"))
        page.click(BEGIN.format("level"))
        page.until_text("#calibration-progress", "waiting for rest: ")
        page.click("#calibration-stop")
        page.until_text("#calibration-result", "the calibration was cancelled")
        page.until("return !document.querySelector(arguments[0]).disabled", BEGIN.format("level"))
        assert [one for one in page.problems() if "401" not in one] == []


def test_the_sphere_shows_covered_cells_and_errors(page: Page, site: tuple[RunningDaemon, str], token: str) -> None:
    daemon, _ = site
    with serving_web(daemon.socket, "--token-file", token) as url:
        open_page(page, url, "bow")
        log_in(page, TOKEN)
        page.until("return document.querySelector(arguments[0])", BEGIN.format("magnetometer"))
        page.click(BEGIN.format("magnetometer"))
        page.until_text("#calibration-result", "magnetometer: expected 9-axis mode")
        page.until("return document.querySelector('#calibration .running').hidden")
        page.js("window.imud.view.calibration.turning.hidden = false")
        cells = [tuple(one) for one in page.module(PIXEL, "0f0f0f0f0f0f")]
    covered = {colour for is_covered, is_near, colour in cells if is_near and is_covered}
    open_ = {colour for is_covered, is_near, colour in cells if is_near and not is_covered}
    assert covered
    assert open_
    assert not covered & open_
