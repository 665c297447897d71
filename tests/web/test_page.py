"""The page in a real browser: plots of the sent frames, restarts, phones, the token."""

import math
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from msgspec.json import decode
from selenium.webdriver.common.keys import Keys

from imud.device.turns import cell_of
from imud.web.hub import row_of
from imud.web.messages import encode
from tests.support.daemon_process import RunningDaemon, running_daemon, wait_until
from tests.support.files import ROOT, needs_uplot
from tests.support.metrics import device
from tests.test_daemon import cable
from tests.test_daemon import device as configured
from tests.web.browser import (
    MISSING,
    PERIOD_MS,
    PHONE,
    TOKEN,
    Page,
    Sender,
    choose,
    enter,
    log_in,
    open_page,
    sent_by,
    serving_web,
    upright,
)

pytestmark = [pytest.mark.skipif(bool(MISSING), reason=MISSING), pytest.mark.live]
Site = tuple[RunningDaemon, str]
SECTIONS = ("time", "ledger", "settings", "calibration", "events", "about", "live")
CONDITIONS = ("ok", "degraded", "attention", "missing")
TEXT_ON = [
    *((text, ground) for text in ("ink", "mute", "faint") for ground in ("bg", "card", "well")),
    *((text, ground) for text in CONDITIONS for ground in (f"{text}-soft", "card")),
    ("accent", "card"), ("accent", "accent-soft"), ("accent-ink", "accent"),
]  # fmt: skip
"""Colors of text and of the ground behind it."""
SHAPES = ("x", "y", "z", "mute", "faint", "accent", "queue", "ok-fill", "degraded-fill", *CONDITIONS)
"""Colors of curves, bars and marks on a panel."""
PEAK_EVERY = 40
CONTROLS = {
    "button", "link", "textbox", "searchbox", "spinbutton", "combobox", "checkbox", "switch", "radio", "radiogroup",
    "img", "image", "progressbar", "dialog", "region",
}  # fmt: skip
"""Roles of the accessibility tree that need a name."""
RECEIVED = """return performance.getEntries()
    .filter((one) => one.encodedBodySize && !/api|uplot/.test(one.name))
    .map((one) => [new URL(one.name).pathname, one.encodedBodySize]);"""
"""Path and compressed size of each file of the page, bytes, without uPlot and the replies of the API."""
LOW_CONTRAST = """
    const context = new OffscreenCanvas(1, 1).getContext('2d', { willReadFrequently: true });
    const rgb = (colors) => {
        for (const color of colors) { context.fillStyle = color; context.fillRect(0, 0, 1, 1); }
        return [...context.getImageData(0, 0, 1, 1).data].slice(0, 3);
    };
    const linear = (one) => (one <= 0.04045 ? one / 12.92 : ((one + 0.055) / 1.055) ** 2.4);
    const luminance = (rgb) => rgb.reduce((sum, one, at) => sum + linear(one / 255) * [0.2126, 0.7152, 0.0722][at], 0);
    const hasText = (one) => [...one.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
    const isShown = (one) => one.checkVisibility() && !one.closest(':disabled, [inert], option, noscript');
    return [...document.querySelectorAll('body *')].filter((one) => hasText(one) && isShown(one)).flatMap((one) => {
        const grounds = [];
        for (let node = one; node; node = node.parentElement) grounds.unshift(getComputedStyle(node).backgroundColor);
        const style = getComputedStyle(one);
        const size = parseFloat(style.fontSize);
        const [low, high] = [rgb(grounds), rgb([...grounds, style.color])].map(luminance).sort((a, b) => a - b);
        const least = size >= 24 || (size >= 18.7 && style.fontWeight >= 700) ? 3 : 4.5;
        return (high + 0.05) / (low + 0.05) < least - 0.05 ? [`${one.innerText.slice(0, 30)} ${style.color}`] : [];
    });"""
"""Texts with a contrast below that of WCAG 2, on the color of the ground behind each text."""
CUT = """return [...document.querySelectorAll('html, main *, dialog[open] *')].filter((one) => {
        const isWide = one === document.documentElement && one.scrollWidth > innerWidth;
        return isWide || (one.getBoundingClientRect().right > innerWidth + 1 && !one.closest('.scroll'));
    }).map((one) => one.outerHTML.slice(0, 80))"""
"""Elements over the right border of the window."""
PINCH = """const box = document.querySelector('#accel_m_s2 .plot');
    const { left, width } = box.querySelector('.u-over').getBoundingClientRect();
    const finger = (share, identifier) => new Touch({ identifier, target: box, clientX: left + share * width });
    const touch = (type, shares) =>
        box.dispatchEvent(new TouchEvent(type, { cancelable: true, touches: shares.map(finger) }));
    touch('touchstart', [0.4, 0.6]);
    touch('touchmove', [0.3, 0.7]);
    touch('touchend', []);"""
"""Two fingers move to twice their distance."""
COMPARED = """const { plots, difference } = window.imud?.view ?? {};
    if (!difference?.stored) return false;
    const end = difference.data[0][difference.stored - 1];"""
"""Plots of a comparison, and end of the history in them."""
OF_DEVICE = """const { plots: all, time } = window.imud?.view ?? {};
    const [plots, difference] = [[all?.get?.('accel_m_s2')], time?.stamps];
    if (!difference?.stored) return false;"""
CONTROLS_IN_ORDER = """const selector = 'a[href], button, input, select, textarea, summary, [tabindex]';
    window.controls = [...document.querySelectorAll(selector)].filter((one) =>
        one.tabIndex >= 0 && !one.matches(':disabled') && one.checkVisibility({ visibilityProperty: true }));
    return window.controls.length"""
"""Number of controls that Tab reaches, in the order of the page."""
FOCUSED = """const one = document.activeElement;
    const outlined = [one, one.nextElementSibling].filter(Boolean).map((each) => getComputedStyle(each).outlineStyle);
    return [window.controls.indexOf(one), one.id === 'skip' || outlined.includes('solid')]"""
"""Place of the control with the focus, and whether the focus is visible."""
POINTS = "return window.imud.view.plots?.get('accel_m_s2').data[0].length >= arguments[0]"
PLOTTED = """const plot = window.imud.view.plots.get('accel_m_s2');
    const lines = [plot.plot.data[0].map((x) => x - plot.offset_s), plot.plot.data[6], plot.plot.data[5]];
    return lines.map((one) => one.slice(plot.stored))"""


DIRECTIONS = [(x, y, z) for x in (-0.9, 0.1, 0.5) for y in (-0.2, 0.3) for z in (-0.6, 0.4, 1.0)]
TURNING = {
    "t_s": 5.0, "device": "bow", "event": "calibration", "message": "half of the directions",
    "detail": {"cells": "0000000000ff", "field_t": 48.5e-6, "residual": 0.025},
}  # fmt: skip
"""An event of a calibration (docs/socket.md)."""


def peaks(number: int) -> float:
    return 9.5 if number % PEAK_EVERY else 20.0 + number / PEAK_EVERY / 8


@needs_uplot
def test_the_plot_contains_every_sent_peak(page: Page, tmp_path: Path) -> None:
    with cable(tmp_path) as port, Sender(port, upright(peaks)) as sender, sent_by(tmp_path, port) as daemon:
        daemon.wait_for("bow", "running")
        with serving_web(daemon.socket) as url:
            page.driver.get(f"{url}#/device/bow")
            page.until(POINTS, 100, what="five seconds are plotted")
            page.click("#pause")
            page.until("return !window.imud.view.plots.get('accel_m_s2').isDue")
            drawn = [
                row for row in zip(*page.js(PLOTTED), strict=True) if None not in row
            ]  # a late host breaks the line
            times, least, greatest = map(list, zip(*drawn, strict=True))
            measured = sender.measured
            assert page.problems() == []
    assert len(times) == len(least) == len(greatest) >= 80
    assert all(np.diff(times) > 0)
    lowest = {
        value for value, most in zip(np.round(least, 4), greatest, strict=True) if value < 15 or most > value + 1e-4
    }
    assert lowest == {9.5}, "one of forty samples is a peak, alone in its bucket only if the host was late"
    known = np.array([peaks(number) for number in range(measured)])
    plotted = [value for value in greatest if value > 15]
    assert len(plotted) >= 10, "a peak each 0.2 s"
    numbers = [int(np.argmin(np.abs(known - value))) for value in plotted]
    assert np.allclose(known[numbers], plotted, rtol=1e-6), "each plotted peak was sent with this value"
    assert np.all(np.diff(numbers) == PEAK_EVERY), "no peak between the first and the last is missing"
    moments = [time for time, value in zip(times, greatest, strict=True) if value > 15]
    assert np.median(np.diff(moments)) == pytest.approx(0.2, abs=0.05), "a host that is late moves single ones only"


def test_directions_and_rotations_are_those_of_the_daemon(scripts: Page) -> None:
    cells, cells_of, covered, turned = scripts.module(
        """const { cellDirection, cellOf, coveredCells } = await import('/static/sphere.js');
        const { rotate } = await import('/static/attitude.js');
        const cells = Array.from({ length: 48 }, (_, cell) => cellDirection(cell));
        const turned = rotate([Math.SQRT1_2, 0, 0, Math.SQRT1_2], [1, 0, 0]);
        return [cells, args[0].map(cellOf), coveredCells('800000000005'), turned]""",
        DIRECTIONS,
    )
    assert [cell_of(tuple(one)) for one in cells] == [*range(48)]
    assert cells_of == [cell_of(one) for one in DIRECTIONS]
    assert [cell for cell, is_covered in enumerate(covered) if is_covered] == [0, 2, 47]
    assert turned == pytest.approx([0, 1, 0]), "a quarter turn about z takes x to y"


def test_the_page_continues_after_a_restart_of_the_daemon_and_of_imud_web(page: Page, tmp_path: Path) -> None:
    with cable(tmp_path) as port, Sender(port, upright(peaks)):
        with sent_by(tmp_path, port) as daemon:
            daemon.wait_for("bow", "running")
            socket = daemon.socket
            with serving_web(socket) as url:
                page.driver.get(f"{url}#/device/bow")
                page.until(POINTS, 5)
                page.until_text("#daemon", "imud 0.")
            page.until_text("#problem", "no connection to imud web")
            own_port = int(url.rstrip("/").rpartition(":")[2])
            with serving_web(socket, port=own_port):
                page.until_text("#daemon", "imud 0.")
                page.until("return document.querySelector('#problem').hidden")
        with serving_web(socket, port=own_port):
            page.until_text("#daemon", "not connected")
            page.until_text("#problem", "imud.sock")
            before = page.js("return window.imud.view.plots.get('accel_m_s2').newest")
            with sent_by(tmp_path, port):
                page.until_text("#daemon", "imud 0.")
                page.until("return window.imud.view.plots.get('accel_m_s2').newest > arguments[0] + 1", before)
                greatest = page.js("return window.imud.view.plots.get('accel_m_s2').data[5]")
                assert None in greatest, "the line is broken while nothing came"


def test_ledger_latency_status_and_settings_are_those_of_the_daemon(page: Page, site: Site) -> None:
    _, url = site
    page.driver.get(f"{url}#/device/bow")
    page.until("return document.querySelector('#bar-bytes')?.dataset.total > 0")
    drawn = page.js(
        """const status = window.imud.view.status.status;
        return ['bytes', 'frames', 'samples'].map((id) => {
            const bar = document.querySelector(`#bar-${id}`);
            const width = (one) => one.getBoundingClientRect().width;
            const parts = [...bar.children].map((part) => [Number(part.dataset.count), width(part)]);
            return [Number(bar.dataset.total), parts, width(bar)];
        }).concat([status])"""
    )
    *bars, status = drawn
    assert [bar[0] for bar in bars] == [
        status["ledger"]["bytes_in"], status["ledger"]["frames_good"], status["ledger"]["samples"],
    ]  # fmt: skip
    for total, parts, width in bars:
        assert sum(count for count, _ in parts) == total, "the parts add up"
        shown = [(count, wide) for count, wide in parts if count]
        assert sum(wide for _, wide in shown) == pytest.approx(width, abs=1)
        assert all(wide >= 3 or wide == pytest.approx(width * count / total, abs=1) for count, wide in shown)
    counts = page.js("return [...document.querySelectorAll('.histogram li')].map((one) => Number(one.dataset.count))")
    assert len(counts) == 11
    page.until("return document.querySelectorAll('[data-setting]').length > 3")
    page.until("return document.querySelectorAll('#calibration details').length > 0")
    page.until("return document.querySelectorAll('#about [data-action]').length >= 2")
    assert "Log in to start it." in page.js("return document.querySelector('#calibration').textContent")
    assert page.js("return document.querySelector('#settings .locked').getClientRects().length") == 1
    assert page.js("return document.querySelectorAll('#settings .control :enabled:not([inert] *)').length") == 0
    page.until("return window.imud.view.live.attitude.quaternion")
    assert page.js("return document.querySelector('#attitude3d canvas').toDataURL().length") > 3000
    facts, more = page.js(
        """return [...document.querySelectorAll('#about dl')].map((list) =>
            Object.fromEntries([...list.children].map((one) => one.textContent).flatMap((text, at, all) =>
                at % 2 ? [] : [[text, all[at + 1]]])))"""
    )
    names = set(page.js("return window.imud.view.status.rows.map(([name]) => name)"))
    assert set(more) == names - {"link", "identity", "axes", "settings"} >= {"bytes"}
    assert facts["Product"] == status["identity"]["product"]
    assert facts["Link"] == f"{status['link']}, opened once"
    assert (facts["Driver"], facts["Heading"]) == ("hipnuc-uart", "measured from the direction at power-on")
    assert not re.search(r'[{}"]', "".join(facts.values())), "no JSON"
    page.js("window.imud.view.onMessage({ kind: 'events', events: [arguments[0]] })", TURNING)
    assert page.js("return document.querySelector('#calibration canvas').dataset.covered") == "8"
    assert page.text("#calibration-progress") == "half of the directions"
    assert page.text("#calibration-instruction").startswith("Turn the device")
    assert {"48.5 µT", "2.5 %"} <= set(re.findall(r"[\d.]+ (?:µT|%)", page.text("#calibration .measures")))
    lead, *parts = page.js(
        "return [...document.querySelectorAll('#time :is(.lead, .chain li)')].map((one) => one.textContent)"
    )
    assert re.search(r"\(one sigma\)\. .+ Main cause: [A-Z][^.]+\. ", lead)
    assert [one for one in parts if not re.fullmatch(r"\w+[A-Z][^.]+\.±[\d.,]+ [nµm]?s", one)] == []
    assert len(parts) >= 2
    news = page.js(
        """const { view } = window.imud, show = view.onMessage.bind(view), message = structuredClone(view.status);
        view.onMessage = () => {};
        const news = document.querySelector('#condition [role=status]'), told = [];
        for (const [condition, code, text] of arguments[0]) {
            message.status.condition = { condition, since_ns: 0, reasons: [{ code, message: text, next: '' }] };
            show(message);
            if (told.at(-1) !== news.textContent) told.push(news.textContent);
        }
        message.status.work = { name: 'the command save', begun_ns: (message.now_s - 60) * 1e9, by: 'uid 1000' };
        show(message);
        return told""",
        [("degraded", "lost", "1 %."), ("degraded", "lost", "2 %."), ("degraded", "rate", "3 %."), ("ok", "ok", "4.")],
    )
    assert news == ["bow: Degraded. 1 %.", "bow: Degraded. 3 %.", "bow: OK. 4."], "each change once"
    assert page.text(".activity") == "the command save is running, started 60 s ago by uid 1000"
    assert page.problems() == []


# Choose the second mode in the list, as a user does
CHOOSE_9_AXIS = (
    "const list = document.querySelector('[data-setting=mode] select'); list.selectedIndex = 1;"
    "list.dispatchEvent(new Event('change', { bubbles: true }))"
)
CHOOSE_OTHER_MODE = CHOOSE_9_AXIS.replace("= 1;", "= list.selectedIndex === 1 ? 0 : 1;")
"""Another test of this device may have set the mode of 9 axes."""


def test_settings_are_planned_only_with_the_token(page: Page, site: Site, token: str) -> None:
    daemon, _ = site
    with serving_web(daemon.socket, "--token-file", token, "--reading", "token") as url:
        page.driver.get(f"{url}#/device/bow")
        page.until("return document.querySelector('#login-dialog').open", what="the token is asked for")
        enter(page, "wrong")
        page.until_text("#login-problem", "wrong token")
        enter(page, TOKEN)
        page.until("return !document.querySelector('#login-dialog').open")
        page.until("return document.querySelector('[data-setting=mode] select:enabled')")
        page.js(CHOOSE_9_AXIS)
        page.until_text("#bar", "1 change not applied")
        page.driver.refresh()
        page.until_text("#bar", "1 change not applied")
        page.until("return document.querySelector('#bar .primary').disabled === false")
        page.click("#bar .primary")
        page.until_text("#dialog", "takes effect")
        assert "9-axis" in page.text("#dialog")
        page.click("#dialog [role=switch]")
        page.until_text("#dialog", "The device loses these changes at power-off.")
        page.click("#dialog .primary")
        page.until_text("#outcome", "Applied. The device may lose “Mode” at power-off.")  # the flash is unknown
        page.until("return document.querySelector('#bar').hidden", what="the edit has ended")
        page.js("document.querySelector('#dialog').close()")
        page.until_text("[data-setting=mode] .states", "Changed, not saved to flash.")
        page.click("[data-setting=mode] .states button")
        page.until_text("#toast", "Save: ")
        with daemon.client() as client:
            (mode,) = [one for one in client.call("settings.get", device="bow")["settings"] if one["name"] == "mode"]
        assert (mode["actual"], mode["saved_state"]) == ("9-axis", "same")
        cookies = page.driver.get_cookies()
        assert [(one["httpOnly"], one["sameSite"]) for one in cookies] == [(True, "Strict")]
        assert TOKEN not in page.driver.current_url
        assert [one for one in page.problems() if "401" not in one] == []


def test_both_views_fit_a_telephone(phone: Page, site: Site) -> None:
    wide = "return [document.documentElement.scrollWidth, window.innerWidth]"
    _, url = site
    phone.driver.get(url)
    phone.until("return document.querySelector('[data-device]')")
    assert phone.js(wide) == [PHONE[0], PHONE[0]]
    phone.click("[data-device]")
    phone.until(POINTS, 5)
    phone.until("return document.querySelectorAll('[data-setting]').length > 3")
    for section in SECTIONS:
        phone.js("location.hash = `#/device/bow/${arguments[0]}`", section)
        phone.until("return document.getElementById(arguments[0]).getClientRects().length", section)
        assert (phone.js(wide), phone.js(CUT)) == ([PHONE[0], PHONE[0]], []), section


def test_tab_reaches_each_control_and_each_section_fits_any_width_with_names_and_contrast(
    page: Page, site: Site, token: str
) -> None:
    with serving_web(site[0].socket, "--token-file", token) as url:
        open_page(page, url, "bow")
        log_in(page, TOKEN)
        page.until("return document.querySelectorAll('[data-setting]').length > 3")
        page.until("return document.querySelectorAll('#calibration details').length > 3")
        page.until("return document.querySelectorAll('#about [data-action]').length >= 2")
        page.until_text("#event-list", "Device found")
        page.js("document.querySelectorAll('main details').forEach((one) => (one.open = true))")
        page.js("window.imud.view.onMessage = () => {}")  # a message can replace the control with the focus
        count = page.js(CONTROLS_IN_ORDER)
        page.js("document.activeElement.blur(); getSelection().collapse(document.body, 0)")
        for number in range(count):
            page.driver.switch_to.active_element.send_keys(Keys.TAB)
            assert page.js(FOCUSED) == [number, True], page.js("return document.activeElement.outerHTML")
        found = page.js(
            "delete window.imud.view.onMessage; return window.controls.map((one) => one.closest('.section')?.id)"
        )
        assert set(found) - {None, "ledger"} == {*SECTIONS} - {"ledger"}
        page.js(CHOOSE_OTHER_MODE)
        page.js("window.imud.view.onMessage({ kind: 'events', events: [arguments[0]] })", TURNING)
        faults = [fault for section in SECTIONS for fault in faults_of(page, f"#/device/bow/{section}")]
        page.click("#bar .primary")
        page.until_text("#dialog", "takes effect")
        faults += faults_of(page)
        page.click("#dialog button")
        faults += [fault for address in ("#/", "#/wall", "#/compare") for fault in faults_of(page, address)]
        assert (faults, page.problems()) == ([], [])
        sizes = dict(page.js(RECEIVED))
        assert set(sizes) == {"/", "/static/main.js", "/static/style.css", "/static/icon.svg"}
        assert sum(sizes.values()) <= 60_000, sizes


def faults_of(page: Page, address: str = "") -> list[object]:
    """Return cut elements, low contrasts, and controls without a name, at all widths in both color schemes."""
    found: list[object] = []
    for width in (360, 390, 1024, 1400):
        metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        for theme in ("light", "dark"):
            page.js("document.documentElement.dataset.theme = arguments[0]", theme)
            page.js("location.hash = arguments[0] || location.hash", address)
            page.until("return document.body.dataset.view && document.querySelector('main').children.length")
            found += [(width, theme, address, one) for one in page.js(CUT) + page.js(LOW_CONTRAST)]
    page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    tree = page.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    controls = [one for one in tree if not one["ignored"] and one["role"]["value"] in CONTROLS]
    assert controls
    nameless = [one["backendDOMNodeId"] for one in controls if not one["name"]["value"].strip()]
    describe = partial(page.driver.execute_cdp_cmd, "DOM.describeNode")
    return found + [(address, describe({"backendNodeId": one, "depth": 2})["node"]) for one in nameless]


@needs_uplot
def test_keys_the_filter_and_stored_events(page: Page, site: Site) -> None:
    _, url = site
    page.driver.get(f"{url}#/device/bow")
    page.until_text("#event-list", "Device found")
    page.driver.refresh()
    page.until_text("#event-list", "Device found")

    def press(key: str, selector: str = "body") -> None:
        page.driver.find_element("css selector", selector).send_keys(key)

    for key, script in (
        (" ", "return window.imud.view.live.group.isPaused"),
        ("4", "return location.hash === '#/device/bow/settings'"),
        ("g", "return location.hash === '#/' && document.querySelector('[data-device]')"),
        ("]", "return location.hash === '#/device/bow' && window.imud.view.plots.get('accel_m_s2').plot"),
        ("?", "return document.querySelector('#dialog').open"),
    ):
        press(key)
        page.until(script)
    page.click("#dialog button")
    split = "const { messageOf } = await import('/static/events.js'); return messageOf(args[0])"
    assert page.module(split, {"kind": "bad-frame", "message": "1 bad frame, crc: 5a a5"})[1] == "5a a5"
    press("+", "#accel_m_s2 .plot")
    assert page.js("const [from, to] = window.imud.view.live.group.zoomed; return to - from") == pytest.approx(24)
    press("0", "#accel_m_s2 .plot")
    assert page.js("return window.imud.view.live.group.zoomed") is None
    page.js(PINCH)
    assert page.js("const [from, to] = window.imud.view.live.group.zoomed; return to - from") == pytest.approx(15)
    press("g")
    page.until("return document.querySelector('[data-device]')")
    page.click("main .pair a")
    page.until("return location.hash === '#/device/bow/events/all' && window.imud.view.events?.groups?.length")
    assert page.text("#events [aria-label='events of'] [aria-checked=true]") == "All devices"
    press("g")
    page.until("return document.querySelector('[data-device]')")
    rows = [decode(encode(row_of(device(f"imu{number}"), None, 5))) for number in range(9)]
    rows[0]["work"] = "the command save is running"
    reason = {"code": "lost", "message": "2 samples are lost.", "next": "Run `imud doctor`.", "section": "ledger"}
    for number, row in enumerate(rows):
        row |= {"state": CONDITIONS[1 + number % 3], "reasons": [reason] * (1 + number)}
    # nine devices in place of the devices of the daemon, whose later messages the view ignores
    show = "const { view } = window.imud, show = view.onMessage.bind(view); view.onMessage = () => {};"
    show += "show({ kind: 'overview', now_s: 1, devices: arguments[0] });"
    page.js(show, rows)
    assert "the command save is running" in page.text("[data-device=imu0]")
    assert (page.text("#summary h1"), faults_of(page)) == ("9 of 9 devices have a problem", [])
    assert page.js("return [...document.querySelectorAll('main .group')].map((one) => one.hidden)") == [True, False]
    press("3g", "#filter")
    page.js("const box = document.querySelector('#filter'); box.value = '3'; box.dispatchEvent(new Event('input'))")
    shown = page.js("return [...document.querySelectorAll('main [data-device]')].map((one) => one.dataset.device)")
    assert (shown, page.js("return location.hash")) == (["imu3"], "#/")
    page.js("location.hash = '#/wall'")
    page.until("return document.querySelector('.wall')")
    page.js(show, rows)
    assert page.js("return document.querySelectorAll('.wall:not([hidden], .wall-ok) [data-device] h2').length") == 9
    assert (faults_of(page), page.problems()) == ([], [])


@needs_uplot
def test_two_devices_are_compared_with_their_delay(page: Page, tmp_path: Path) -> None:
    """Both devices move in the same way, the second 100 ms later, with an offset of 0.5 m/s². Some of its frames are
    lost, before the page is open and after it."""

    def moved(offset: float, late_s: float) -> Callable[[int], bytes]:
        def value(number: int) -> float:
            t = begun_s.setdefault(late_s, monotonic()) + number * PERIOD_MS / 1000 - late_s
            return 9.8 + offset + math.sin(8 * t) + math.sin(3.2 * t)

        return upright(value)

    def lossy(frame_of: Callable[[int], bytes]) -> Callable[[int], bytes]:
        return lambda number: b"" if number % 100 == 99 else frame_of(number)

    begun_s: dict[float, float] = {}
    (tmp_path / "other").mkdir()
    with cable(tmp_path) as one, cable(tmp_path / "other") as other:
        devices = {"bow": configured(one.name), "stern": configured(other.name)}
        with (
            running_daemon(tmp_path, devices, python=()) as daemon,
            Sender(one, moved(0.5, 0.0)), Sender(other, lossy(moved(0.0, 0.1))), serving_web(daemon.socket) as url,
        ):  # fmt: skip
            daemon.wait_for("bow", "running")
            daemon.wait_for("stern", "running")
            page.driver.get(f"{url}#/compare/bow/stern")
            page.until("return Boolean(window.imud?.view?.plots)")
            page.click(".timebar [aria-label=quantity] :nth-child(2)")
            begin = page.js("return Date.now() / 1000")
            page.until("return window.imud.view.difference.stored")
            oldest = page.js("return window.imud.view.difference.data.map((one) => one[0])")
            assert (oldest[0] < begin, None in oldest) == (True, False), "the history of both devices"
            page.until("return window.imud.view.difference.data[0].length > 160")
            row = "const row = [...document.querySelectorAll('.figures-table tbody tr')].at(-1).innerText.split('\\t')"
            name, mean, _rms, _most, same, delay = page.until(f"{row}; return !row.includes('–') && row")
            page.until_text(".notes", "Both devices use the same axes: body: x forward, y left, z up")
            assert "imud rotates the values of bow and stern." in page.text(".notes")
            page.until(f"{COMPARED} return [...plots, difference].every((one) => Math.max(...one.losses) > end)")
            page.click("[aria-label=offset] :nth-child(2)")
            centered = """const { data, offsets, plot } = window.imud.view.difference, at = plot.data[0].length - 9;
                const isMoved = (offset, axis) =>
                    Math.abs(plot.data[1 + 2 * axis][at] - data[1 + 2 * axis][at] - offset) < 1e-9;
                return offsets[2] && offsets.every(isMoved) && offsets"""
            assert page.until(centered)[2] == pytest.approx(-0.5, abs=0.2)
            assert (faults_of(page), page.problems()) == ([], [])
            for address, all_plots in (("compare/bow/stern", COMPARED), ("device/stern", OF_DEVICE)):
                page.driver.get("about:blank")
                page.driver.get(f"{url}#/{address}")
                begin = page.js("return Date.now() / 1000")
                page.until(
                    f"{all_plots} return [...plots, difference].every((one) => Math.min(...one.losses) < {begin} - 3)"
                )
    assert name == "z"
    assert float(mean.split()[0]) == pytest.approx(0.5, abs=0.2)
    assert float(same) > 0.6
    assert int(delay.replace("−", "-").split()[0]) == pytest.approx(100, abs=40)


def test_statistics_of_a_comparison_and_angles_over_a_half_turn(scripts: Page) -> None:
    found, delay, none, weighed, [least, most] = scripts.module(
        """const { statistics } = await import('/static/compare.js');
        const { RollingPlot } = await import('/static/plots.js');
        const motion = (t) => Math.sin(t / 9) + Math.sin(t / 5);
        const wave = (late) => Array.from({ length: 300 }, (_, index) => motion(index - late));
        const [a, b] = [wave(0).map((one) => one + 2), wave(3.5)];
        b[7] = a[9] = null;
        const plot = new RollingPlot('t', 't', '°', ['yaw'], { isAngle: true });
        const turn = [[170, 175], [-179, 178], [-175, -170], [-10, 20], [120, 130], [-150, -140]];
        const bucket = (t) => ({ first_s: t, last_s: t, utc_s: t, seq: t, count: 1 });
        turn.forEach((one, t) => plot.add(bucket(t), one.map((angle) => [angle]), 1));
        const other = wave(0).map((_, index) => index);
        const weighed = statistics([1, 4, ...a], [0, 0, ...a], [8, 4, ...a.map(() => 0)], 2);
        return [statistics(a, a), statistics(a, b), statistics(a, other), weighed, [plot.data[2], plot.data[1]]]"""
    )
    assert (weighed["mean"], weighed["rms"], weighed["delay"]) == (2, pytest.approx(2**0.5), pytest.approx(0, abs=1e-6))
    assert found["mean"] == found["rms"] == 0
    assert (found["correlation"], found["delay"]) == (pytest.approx(1), pytest.approx(0, abs=1e-6))
    assert delay["mean"] == pytest.approx(2, abs=0.05)
    assert delay["delay"] == pytest.approx(3.5, abs=0.05)
    assert none["delay"] is None
    assert (least, most) == ([170, 178, 185, -10, 120, 210], [175, 181, 190, 20, 130, 220])


def test_the_start_and_the_end_of_an_alarm_are_one_event(scripts: Page) -> None:
    def row(t: int, count: int = 1, first: int = 0, device: str = "bow", **detail: object) -> dict[str, object]:
        return {"t_ns": t, "first_ns": first or t, "count": count, "device": device, "kind": "alarm", "detail": detail}

    groups = [
        row(1, raised=1, active=True), row(2, active=True, device="mast"), row(3, raised=1, active=False),
        row(4, tilt=True, shock=True), row(5, active=True, verdict="level"), row(6, tilt=False), row(7, shock=False),
        row(8, active=False, device="keel"), row(20, 2, 10, active=False), row(21, 3, 9, active=True),
    ]  # fmt: skip
    join = "const { joinAlarms } = await import('/static/events.js'); return joinAlarms(args[0]).map((one) => "
    join += "[one.first_ns, one.to_ns ?? 0, one.device, one.count, [...one.open ?? ['-']].join()])"
    rules = [{**row(t, rule=name, active=is_active), "kind": "rule"} for t, name, is_active in ((1, "a", True), (2, "b", True), (3, "a", False))]  # fmt: skip  # noqa: E501
    assert scripts.module(join, [*rules, {**row(4, rule="a", result="failed"), "kind": "rule"}]) == [
        [2, 0, "bow", 1, "rule b"], [1, 3, "bow", 1, ""], [4, 0, "bow", 1, "-"],
    ]  # fmt: skip
    assert scripts.module(join, groups) == [
        [2, 0, "mast", 1, "active"], [1, 3, "bow", 1, ""], [5, 0, "bow", 1, "-"], [4, 7, "bow", 1, ""],
        [8, 0, "keel", 1, "-"], [9, 0, "bow", 3, "active"],
    ]  # fmt: skip


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_each_color_of_text_and_of_graphics_has_contrast(scripts: Page, theme: str) -> None:
    tokens = scripts.js(
        """document.documentElement.dataset.theme = arguments[0];
        const style = getComputedStyle(document.documentElement);
        return Object.fromEntries(arguments[1].map((one) => [one, style.getPropertyValue(`--${one}`).trim()]))""",
        theme, sorted({*SHAPES, *(name for pair in TEXT_ON for name in pair)}),
    )  # fmt: skip
    pairs = {(one, "card"): 3.0 for one in SHAPES} | dict.fromkeys(TEXT_ON, 4.5)
    ratios = {(one, ground): contrast(tokens[one], tokens[ground]) for one, ground in pairs}
    assert {pair: ratio for pair, ratio in ratios.items() if ratio < pairs[pair]} == {}


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colors as defined by WCAG 2."""
    low, high = sorted(luminance(color.lstrip("#")) for color in (one, other))
    return (high + 0.05) / (low + 0.05)


def luminance(color: str) -> float:
    digits = color if len(color) == 6 else "".join(2 * one for one in color)
    parts = [int(digits[at : at + 2], 16) / 255 for at in (0, 2, 4)]
    red, green, blue = (one / 12.92 if one <= 0.04045 else ((one + 0.055) / 1.055) ** 2.4 for one in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def test_the_plots_continue_after_a_reload(page: Page, site: Site) -> None:
    _, url = site
    page.driver.get(f"{url}#/device/bow")
    page.until(POINTS, 80)
    begin = page.js("return window.imud.view.plots.get('accel_m_s2').data[0].at(-1)")
    page.driver.refresh()
    page.until("return window.imud.view.plots?.get('accel_m_s2').stored && window.imud.view.time.stamps.stored")
    times, greatest, least = page.js("return window.imud.view.plots.get('accel_m_s2').data.slice(0, 3)")
    assert times[0] < begin
    assert times == sorted(times)
    assert greatest[0] >= least[0]
    assert page.problems() == []


def test_without_uplot_the_page_shows_values_and_the_reason(page: Page, site: Site, tmp_path: Path) -> None:
    shutil.copytree(ROOT / "imud", tmp_path / "imud", ignore=shutil.ignore_patterns("uplot", "__pycache__"))
    with serving_web(site[0].socket, folder=tmp_path) as url:
        open_page(page, url, "bow")
        choose(page, "#spectrum-of", "accel_m_s2")
        page.until(POINTS, 5)
        page.until_text("#accel_m_s2 output", ".")
        for chart in ("#accel_m_s2", "#stamps", "#spectrum"):
            page.until_text(chart, "imud was built without uPlot. Install npm, then build imud again.")
        page.until_text("#spectrum .help:last-child", "Highest peaks")
        assert page.js("return document.querySelectorAll('.plot').length") == 0
        assert (faults_of(page), page.problems()) == ([], [])
        page.driver.get(f"{url}#/compare/bow/bow")
        page.until_text("main", "A comparison needs two devices.")
        assert page.problems() == []


def test_a_plot_merges_old_points_without_loss_of_a_peak(scripts: Page) -> None:
    stored, xs, most, least, losses = scripts.module(
        """const { PlotGroup, RollingPlot } = await import('/static/plots.js');
        const group = Object.assign(new PlotGroup(30), { rate_hz: 4 });
        const plot = new RollingPlot('t', 't', 'm', ['x'], {}, group);
        for (let t = 0; t < 8000; t += 1) {
          const range = t === 7003 ? [[-7], [9]] : [[1], [2]];
          const count = args[0].includes(t) ? 3 : 4;
          const lost = args[0].includes(t - 1) ? 1 : undefined; // imud web gets the counts of the ledger later
          const bucket = { first_s: t, last_s: t, utc_s: t, seq: t, count, lost, t_err_s: t === 7980 ? 0.1 : 0 };
          if (t < 6000 || t > 6100) plot.add(bucket, range, 1);
        }
        const past = new RollingPlot('p', 'p', 'm', ['x'], {}, group);
        const second = (t) => [{ first_s: t, last_s: t, utc_s: t, seq: t, count: 1, gaps: t % 3 }, 1];
        past.restore([0, 1, 2, 3].map(second), () => [[1], [2]]);
        return [plot.stored, ...plot.data, [plot.losses, past.losses]]""",
        [7000, 7980, 7990],
    )
    assert 8000 - 3600 - 60 <= xs[0] < 8000 - 3500
    assert xs == sorted(xs)
    assert len(xs) - stored <= 663
    assert (most.index(9), most.count(9), most.count(None)) == (least.index(-7), 1, 2), "one peak, one gap, one loss"
    assert xs[most.index(None, stored)] == 7989.5, "a time stamp error hides the place of one"
    assert losses == [[6101, 7000, 7981, 7990], [1, 2]], "one mark for a loss"


def test_a_hidden_page_reads_nothing(page: Page, site: Site) -> None:
    daemon, url = site
    page.driver.get(f"{url}#/device/bow")
    page.until(POINTS, 5)

    def clients() -> int:
        with daemon.client() as client:
            return len(client.status()["socket"]["clients"]) - 1

    assert clients() == 1
    page.js(
        """Object.defineProperty(document, 'hidden', { value: true, configurable: true });
        document.dispatchEvent(new Event('visibilitychange'))"""
    )
    wait_until(lambda: clients() == 0, "the page reads nothing")
    page.js("delete document.hidden; document.dispatchEvent(new Event('visibilitychange'))")
    wait_until(lambda: clients() == 1, "it reads again")
