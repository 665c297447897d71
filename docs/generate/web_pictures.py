"""Takes the screenshots of `imud web` for README.md and docs/views.md: `make web-pictures`.

The browser shows six simulated devices: a vibrating device with lost samples and a wrong setting, a device with a bad
cable, a silent device, a missing device, a device that is OK, and a rotating device. The files are
docs/pictures/web-*.png.
"""

import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, Final

from PIL import Image

from tests.support.daemon_process import RunningDaemon, running_daemon
from tests.support.files import ROOT, UPLOT_MISSING
from tests.web.browser import MISSING, Page, browser, choose, log_in, open_page, serving_web
from tests.web.turned import turned_module

FOLDER = ROOT / "docs/pictures"
PORTS: Final = Path("/tmp/serial/by-id")
MODULES: Final = {
    "bow": ("hipnuc-uart", "--rate", "200", "--motion", "engine", "--faults", "lose=0.0004,flip=0.0002"),
    "mast": ("imu61x-uart", "--rate", "100", "--faults", "cut=0.01,flip=0.01"),
    "crane": ("hipnuc-uart", "--rate", "100", "--motion", "still"),
    "keel": ("imu61x-uart", "--rate", "50"),
}
DECLARED: Final = {"bow": {"mode": "9-axis", "magnetic_calibration": True, "output": {"hi91": 200}, "sout_divisor": 8}}
ABSENT: Final = "stern"
CONDITIONS: Final = {"bow": "attention", "mast": "degraded", "crane": "missing", ABSENT: "missing", "keel": "ok"}
COLOURS_MAX: Final = 256
"""Number of colors of a picture. The file is a third as large and looks the same."""
FULL = "return window.imud.view.plots.get('accel_m_s2').data[0].length >= 580"
"""Number of points in a plot: nearly half a minute at 20 Hz."""
TOKEN = "a-token-for-pictures-only"


class Module:
    def __init__(self, name: str, process: subprocess.Popen[str]) -> None:
        self.name = name
        self._process = process

    @property
    def configuration(self) -> dict[str, Any]:
        return configuration(self.name, MODULES[self.name][0])

    def unplug(self, seconds: float) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"unplug {seconds}\n")
        self._process.stdin.flush()

    def stand_still(self) -> None:
        self._process.send_signal(signal.SIGSTOP)

    def end(self) -> None:
        self._process.terminate()
        self._process.send_signal(signal.SIGCONT)
        self._process.communicate()


def configuration(name: str, driver: str) -> dict[str, Any]:
    port = {"driver": driver, "uart": {"port": str(PORTS / f"usb-{name}"), "baud": "auto"}}
    return {**port, "settings": DECLARED[name]} if name in DECLARED else port


@contextmanager
def module(name: str) -> Iterator[Module]:
    driver, *options = MODULES[name]
    argv = [sys.executable, "-m", "tests.web.vibrating", "--device", driver, "--path", str(PORTS / f"usb-{name}")]
    with subprocess.Popen([*argv, *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        one = Module(name, process)
        try:
            assert process.stdout is not None
            assert process.stdout.readline()
            yield one
        finally:
            one.end()


@contextmanager
def ports() -> Iterator[None]:
    PORTS.mkdir(parents=True)
    try:
        yield
    finally:
        shutil.rmtree(PORTS.parent)


def save(name: str, png: bytes) -> None:
    """Write a picture with a palette."""
    with Image.open(BytesIO(png)) as read:
        few = read.convert("RGB").quantize(COLOURS_MAX, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(FOLDER / f"web-{name}.png", optimize=True)


def shot(page: Page, name: str) -> None:
    save(name, page.driver.get_screenshot_as_png())


def fit(page: Page, width: int) -> None:
    page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})  # `main` is as high as the window
    height = int(page.js("return document.querySelector('main').getBoundingClientRect().bottom + window.scrollY"))
    metrics = {"width": width, "height": height + 10, "deviceScaleFactor": 1, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    page.until("return window.innerHeight >= arguments[0]", height)
    page.until(
        "return [...document.querySelectorAll('main .plot:not([hidden] *) canvas')].every((one) => one.width > 0)"
    )


def desktop(folder: Path, url: str, bow: Module, daemon: RunningDaemon) -> None:
    with browser(folder / "desktop", (1320, 900)) as page:
        page.driver.get(url)
        for name, condition in CONDITIONS.items():
            page.until("return document.querySelector(arguments[0])", f".k-{condition}[data-device={name}]")
        fit(page, 1320)
        shot(page, "overview")
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        page.js("document.documentElement.dataset.theme = 'dark'; location.hash = '#/wall'")
        page.until("return document.querySelectorAll('.tile').length === arguments[0]", len(CONDITIONS))
        shot(page, "wall")
        page.js("document.documentElement.dataset.theme = 'light'")
        log_in(page, TOKEN)
        open_page(page, url, "bow")
        bow.unplug(1.5)
        daemon.wait_for("bow", "missing")
        daemon.wait_for("bow", "running")
        page.until_text("#event-list", "Device found")
        page.until_text("#about", "mode: 6-axis, declared: 9-axis")
        page.until("return document.querySelector('[data-setting=mode].off')")
        choose(page, "#rate", "20")  # clears the plots, which otherwise show the pause
        page.until(FULL)
        fit(page, 1320)
        shot(page, "device")

        page.js("location.hash = '#/compare/bow/keel'")
        page.until("return window.imud.view.difference?.data[0].length >= 580")
        page.until("return !document.querySelector('.figures-table tbody').innerText.includes('NaN')")
        fit(page, 1320)
        shot(page, "compare")


def phone(folder: Path, url: str) -> None:
    with browser(folder / "phone", phone=True) as page:
        page.driver.get(f"{url}#/device/mast")
        page.until("return Boolean(window.imud?.view?.plots)")
        page.until(FULL)
        shot(page, "phone")
        page.js("location.hash = '#/device/bow/settings'")
        page.until("return document.querySelector('[data-setting=mode].off')")
        shot(page, "phone-settings")


def calibration(folder: Path) -> None:
    """Take the panel of a calibration during the rotation of the device."""
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
        page.js("document.querySelector('#top').hidden = true")  # it would cover the section
        page.click("#calibration [data-kind=magnetometer] button")
        page.until("return Number(document.querySelector('#calibration canvas').dataset.covered) > 12")
        (panel,) = page.driver.find_elements("css selector", "#calibration")
        save("calibration", panel.screenshot_as_png)


def main() -> None:
    if MISSING or UPLOT_MISSING:
        raise SystemExit(MISSING or UPLOT_MISSING)
    with ports(), ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="imud-web-")))
        modules = {name: stack.enter_context(module(name)) for name in MODULES}
        devices = {name: one.configuration for name, one in modules.items()}
        devices[ABSENT] = configuration(ABSENT, "hipnuc-uart")
        daemon = stack.enter_context(running_daemon(folder, devices, python=()))
        for name in MODULES:
            daemon.wait_for(name, "running")
        modules["crane"].stand_still()
        token = folder / "token"
        token.write_text(TOKEN)
        url = stack.enter_context(serving_web(daemon.socket, "--token-file", str(token)))
        desktop(folder, url, modules["bow"], daemon)
        phone(folder, url)
    with tempfile.TemporaryDirectory(prefix="imud-web-") as name:
        calibration(Path(name))


if __name__ == "__main__":
    main()
