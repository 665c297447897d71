"""The browser that all tests of a page share: its start takes seconds."""

from collections.abc import Iterator

import pytest

from tests.web.browser import Page, browser


@pytest.fixture(scope="session")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """One browser for all tests that do not need another size."""
    with browser(tmp_path_factory.mktemp("browser")) as one:
        yield one


@pytest.fixture
def page(window: Page) -> Page:
    """Its tab, with no page open, without a cookie, and with nothing in its log."""
    window.driver.delete_all_cookies()
    window.driver.get("about:blank")
    window.problems()
    return window
