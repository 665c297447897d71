"""A real browser (chromium of Debian, headless) and a process `imud web`, for tests and pictures of the page."""

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final

from selenium.common.exceptions import JavascriptException
from selenium.webdriver import Chrome, ChromeOptions, ChromeService
from selenium.webdriver.support.ui import WebDriverWait

from tests.support.daemon_process import LIMIT_S, RunningDaemon, running_daemon
from tests.support.files import ROOT, hi91
from tests.test_daemon import Cable, device

CHROMIUM, CHROMEDRIVER = shutil.which("chromium"), shutil.which("chromedriver")
MISSING = "" if CHROMIUM and CHROMEDRIVER else "no chromium and chromedriver on this host (make web-deps)"
LOOK_S: Final = 0.05
PHONE: Final = (390, 844)
PERIOD_MS: Final = 5
TOKEN: Final = "correct-horse-battery-staple"


class Page:
    def __init__(self, driver: Chrome) -> None:
        self.driver = driver

    def js(self, script: str, *arguments: object) -> Any:
        return self.driver.execute_script(script, *arguments)

    def module(self, script: str, *arguments: object) -> Any:
        """Run the body of an async function in the page. `import()` works there. Return its value."""
        body = f"const done = arguments[arguments.length - 1]; (async (...args) => {{ {script} }})(...arguments)"
        answer = self.driver.execute_async_script(
            f"{body}.then((value) => done([value]), (error) => done(String(error)));", *arguments
        )
        assert isinstance(answer, list), answer
        return answer[0]

    def until(self, script: str, *arguments: object, what: str = "") -> Any:
        wait = WebDriverWait(self.driver, LIMIT_S, LOOK_S, ignored_exceptions=(JavascriptException,))
        return wait.until(lambda _driver: self.js(script, *arguments), what or script)

    def text(self, selector: str) -> str:
        return str(self.js("return document.querySelector(arguments[0])?.innerText ?? ''", selector))

    def until_text(self, selector: str, words: str) -> None:
        script = "return (document.querySelector(arguments[0])?.innerText ?? '').includes(arguments[1])"
        self.until(script, selector, words, what=f"{selector} shows {words!r}")

    def click(self, selector: str) -> None:
        """Click an element. Wait until it exists, because a message can replace it."""
        script = "const found = document.querySelector(arguments[0]); found?.click(); return Boolean(found)"
        self.until(script, selector, what=f"click {selector}")

    def problems(self) -> list[str]:
        return [entry["message"] for entry in self.driver.get_log("browser") if entry["level"] == "SEVERE"]  # type: ignore[no-untyped-call]


@contextmanager
def browser(folder: Path, size: tuple[int, int] = (1400, 2600), *, phone: bool = False) -> Iterator[Page]:
    options = ChromeOptions()
    options.binary_location = str(CHROMIUM)
    arguments = ["--headless=new", "--disable-dev-shm-usage", "--disable-gpu", "--hide-scrollbars", "--no-first-run"]
    arguments += ["--disable-background-networking", f"--user-data-dir={folder / 'chromium'}"]
    arguments += [f"--window-size={size[0]},{size[1]}", "--force-color-profile=srgb"]
    if os.getuid() == 0:
        arguments.append("--no-sandbox")
    for argument in arguments:
        options.add_argument(argument)
    if phone:
        metrics = {"width": PHONE[0], "height": PHONE[1], "pixelRatio": 2.0, "touch": True, "mobile": True}
        options.add_experimental_option("mobileEmulation", {"deviceMetrics": metrics})
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = Chrome(options=options, service=ChromeService(executable_path=str(CHROMEDRIVER)))
    driver.set_script_timeout(LIMIT_S)
    try:
        yield Page(driver)
    finally:
        driver.quit()


def open_page(page: Page, url: str, device: str) -> None:
    page.driver.get(f"{url}#/device/{device}")
    page.until("return Boolean(window.imud?.view?.plots)")


def log_in(page: Page, token: str) -> None:
    page.click("#login")
    enter(page, token)
    page.until("return window.imud.session.control")


def enter(page: Page, token: str) -> None:
    page.js("document.querySelector('#token').value = arguments[0]", token)
    page.click("#login-form button[type=submit]")


@contextmanager
def serving_web(socket: Path, *words: str, port: int = 0, folder: Path = ROOT) -> Iterator[str]:
    """Run `imud web` from the package `imud` in `folder`. Yield the address of the page."""
    argv = [sys.executable, "-m", "imud", "web", "--socket", str(socket), "--port", str(port), *words]
    with subprocess.Popen(argv, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().strip()
            assert url.startswith("http://"), "imud web ended at its start"
            yield url
        finally:
            process.terminate()
            process.wait(LIMIT_S)


class Sender:
    """A device at a virtual serial port that measures at 200 Hz. The test defines its frames."""

    def __init__(self, cable: Cable, frame_of: Callable[[int], bytes]) -> None:
        """`frame_of` returns the frame of a measurement by number; empty for a lost frame."""
        self.measured = 0
        self._cable = cable
        self._frame_of = frame_of
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sender")

    def __enter__(self) -> "Sender":
        os.set_blocking(self._cable.master, False)
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._stopped.set()
        self._thread.join(LIMIT_S)

    def _run(self) -> None:
        begin = monotonic()
        while not self._stopped.is_set():
            frame = self._frame_of(self.measured)
            self.measured += 1
            while frame and not self._stopped.is_set():
                with suppress(BlockingIOError):  # the daemon reads too slowly, or has ended
                    frame = frame[os.write(self._cable.master, frame) :]
                if frame:
                    sleep(LOOK_S)
            sleep(max(0.0, begin + self.measured * PERIOD_MS / 1000 - monotonic()))


def upright(value_of: Callable[[int], float]) -> Callable[[int], bytes]:
    """Frames of a device at rest with this acceleration along z, m/s². The device time has steps of PERIOD_MS."""
    return lambda number: hi91(number * PERIOD_MS, value_of(number))


@contextmanager
def sent_by(folder: Path, port: Cable) -> Iterator[RunningDaemon]:
    with running_daemon(folder, {"bow": device(port.name)}, python=()) as daemon:
        yield daemon


def choose(page: Page, selector: str, value: str) -> None:
    page.js(
        """const node = document.querySelector(arguments[0]);
        node.value = arguments[1];
        node.dispatchEvent(new Event('change'))""",
        selector, value,
    )  # fmt: skip
