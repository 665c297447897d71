"""Takes the screenshots of `imud web` for README.md and docs/views.md: `make web-pictures`.

Three simulated modules, one of them with faults on its line, in a real browser; and one that is turned: web-*.png in
docs/pictures.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tests.support.daemon_process import running_daemon
from tests.support.files import ROOT
from tests.web.browser import MISSING, Page, browser, log_in, open_page, serving_web
from tests.web.turned import turned_module

FOLDER = ROOT / "docs/pictures"
MODULES = {
    "bow": ("hipnuc-uart", "--rate", "200"),
    "mast": ("imu61x-uart", "--rate", "100"),
    "keel": ("hipnuc-uart", "--rate", "100", "--faults", "cut=0.01,flip=0.01"),
}
FULL = "return window.imud.view.plots.get('accel_m_s2').data[0].length >= 580"
"""Nearly half a minute at 20 Hz."""
TOKEN = "a-token-for-pictures-only"
CHOOSE = """const node = document.querySelector('#spectrum-of');
    node.value = 'accel_m_s2';
    node.dispatchEvent(new Event('change'))"""


@contextmanager
def module(folder: Path, name: str) -> Iterator[dict[str, object]]:
    """A simulated module; its configuration."""
    driver, *options = MODULES[name]
    port = folder / f"port-{name}"
    argv = [sys.executable, "-m", "imud.sim", "--device", driver, "--path", str(port), *options]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline()
            yield {"driver": driver, "uart": {"port": str(port), "baud": "auto"}}
        finally:
            process.terminate()
            process.communicate()


def shot(page: Page, name: str) -> None:
    """Save what the window shows."""
    page.until("return [...document.querySelectorAll('.plot')].length >= 0")
    assert page.driver.save_screenshot(str(FOLDER / f"web-{name}.png"))


def fit(page: Page, width: int) -> None:
    """Make the window as high as the page is."""
    height = int(page.js("return document.querySelector('main').getBoundingClientRect().bottom + window.scrollY"))
    metrics = {"width": width, "height": height + 10, "deviceScaleFactor": 1, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    page.until("return window.innerHeight >= arguments[0]", height)
    page.until("return [...document.querySelectorAll('.plot canvas')].every((one) => one.width > 0)")


def desktop(folder: Path, url: str) -> None:
    """The overview, and the page of a device, as who has logged in sees it."""
    with browser(folder / "desktop", (1320, 560)) as page:
        page.driver.get(url)
        page.until("return document.querySelectorAll('.card').length === arguments[0]", len(MODULES))
        page.until("return [...document.querySelectorAll('.card .pill')].every((one) => one.innerText === 'running')")
        page.until_text(".card", "regression")
        shot(page, "overview")
        log_in(page, TOKEN)
        page.driver.get(f"{url}#/device/bow")
        page.driver.set_window_size(1320, 2400)
        page.until("return Boolean(window.imud?.view?.plots)")
        page.js(CHOOSE)
        page.until(FULL)
        page.until("return window.imud.view.spectrum.spectrum.segments.length >= 4")
        fit(page, 1320)
        shot(page, "device")


def phone(folder: Path, url: str) -> None:
    """The page of a device on a telephone."""
    with browser(folder / "phone", phone=True) as page:
        page.driver.get(f"{url}#/device/mast")
        page.until("return Boolean(window.imud?.view?.plots)")
        page.until(FULL)
        shot(page, "phone")


def calibration(folder: Path) -> None:
    """The panel of a calibration while the module is turned."""
    token = folder / "token"
    token.write_text(TOKEN)
    with (
        turned_module(folder) as daemon,
        serving_web(daemon.socket, "--token-file", str(token)) as url,
        browser(folder / "calibration", (1320, 1100)) as page,
    ):
        open_page(page, url, "bow")
        log_in(page, TOKEN)
        page.until("return document.querySelector('#calibration [data-kind=magnetometer] button')")
        page.js("document.querySelector('header').hidden = true")  # it would stand over the panel
        page.click("#calibration [data-kind=magnetometer] button")
        page.until("return Number(document.querySelector('#calibration canvas').dataset.covered) > 12")
        (panel,) = page.driver.find_elements("css selector", "#calibration")
        assert panel.screenshot(str(FOLDER / "web-calibration.png"))


def main() -> None:
    """Take all of them."""
    if MISSING:
        raise SystemExit(MISSING)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-web-")))
        devices = {name: stack.enter_context(module(folder, name)) for name in MODULES}
        daemon = stack.enter_context(running_daemon(folder, devices, python=()))
        for name in MODULES:
            daemon.wait_for(name, "running")
        token = folder / "token"
        token.write_text(TOKEN)
        url = stack.enter_context(serving_web(daemon.socket, "--token-file", str(token)))
        desktop(folder, url)
        phone(folder, url)
    with tempfile.TemporaryDirectory(prefix="imud-web-") as name:
        calibration(Path(name))


if __name__ == "__main__":
    main()
