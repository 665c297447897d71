"""Runs `async` tests in an event loop. Uses one browser for all tests. Saves the picture of a failed test."""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest
from selenium.common.exceptions import WebDriverException

from tests.cli.conftest import cli
from tests.support.daemon_process import RunningDaemon, daemon_with_module
from tests.support.files import ROOT
from tests.support.socket_rig import run
from tests.web.browser import TOKEN, Page, browser, serving_web

__all__ = ["cli"]
PICTURES: Final = ROOT / "build/web"
"""Folder for the picture of a failed test."""


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run an `async` test in a new event loop."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = inspect.signature(pyfuncitem.obj).parameters
    run(lambda: pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names}))
    return True


@pytest.fixture(scope="session")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("browser")) as one:
        yield one


@pytest.fixture
def page(window: Page) -> Page:
    window.driver.delete_all_cookies()
    window.driver.get("about:blank")
    window.problems()
    return window


@pytest.fixture(scope="session")
def still(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving_web(tmp_path_factory.mktemp("still") / "none") as url:
        yield url


@pytest.fixture
def scripts(page: Page, still: str) -> Page:
    page.driver.get(still)
    return page


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[RunningDaemon, str]]:
    folder = tmp_path_factory.mktemp("site")
    with daemon_with_module(folder, "--rate", "100") as daemon, serving_web(daemon.socket) as url:
        yield daemon, url


@pytest.fixture
def token(tmp_path: Path) -> str:
    file = tmp_path / "token"
    file.write_text(TOKEN)
    return str(file)


@pytest.fixture
def phone(tmp_path: Path) -> Iterator[Page]:
    with browser(tmp_path, phone=True) as one:
        yield one


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    report: pytest.TestReport = yield  # type: ignore[assignment]  # a wrapper is sent the result
    given = getattr(item, "funcargs", {})
    pages = [one for name, one in given.items() if name in ("page", "phone")]
    if report.failed and call.when == "call":
        report.sections += [("screenshot", keep_picture(one, item.name)) for one in pages]
    return report  # type: ignore[return-value]  # as the wrapper's result


def keep_picture(page: Page, name: str) -> str:
    file = PICTURES / f"{''.join(one if one.isalnum() else '_' for one in name)}.png"
    PICTURES.mkdir(parents=True, exist_ok=True)
    try:
        file.write_bytes(page.driver.get_screenshot_as_png())
    except WebDriverException as error:  # the browser itself has ended
        return f"none: {error.msg}"
    return str(file)
