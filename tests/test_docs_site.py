"""Test the site of `make docs-site`: links, navigation, search. The tests of the built site need Sphinx."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from docs.generate.dead_links import HtmlPage, dead_links
from tests.conftest import LIVE_TIMEOUT_S
from tests.support.files import ROOT
from tests.test_docs import PAGES, anchors
from tests.web.browser import MISSING, browser

needs_sphinx = pytest.mark.skipif(
    importlib.util.find_spec("furo") is None or importlib.util.find_spec("myst_parser") is None,
    reason="no Sphinx with MyST and Furo in this Python (make docs-site)",
)

LOADED = "return performance.getEntriesByType('resource').map((one) => one.name)"
GOOD = """<h1 id="top">A</h1><a href="b.html#part">b</a> <a href="#top">a</a> <a href="https://example.org/x">x</a>
<img src="data:image/png;base64,AA"><link rel="stylesheet" href="style.css?v=1">"""


@pytest.mark.parametrize(
    ("html", "problem"),
    [
        ('<a href="c.html">', "expected the file c.html, got no such file"),
        ('<a href="b.html#other">', "expected the anchor #other in b.html, got no such anchor"),
        ('<a href="#other">', "expected the anchor #other in a.html, got no such anchor"),
        ('<img src="a.png">', "expected the file a.png, got no such file"),
        ('<meta http-equiv="refresh" content="0; url=c.html">', "expected the file c.html, got no such file"),
        ('<script src="https://example.org/a.js">', "expected a file of the site, got https://example.org/a.js"),
        ('<link href="//example.org/a.css">', "expected a file of the site, got //example.org/a.css"),
        ('<img srcset="//example.org/a.png 2x">', "expected a file of the site, got //example.org/a.png"),
        (
            "<style>@import 'https://example.org/a.css'</style>",
            "expected a file of the site, got https://example.org/a.css",
        ),
    ],
)
def test_dead_links_and_files_of_other_hosts_are_problems(tmp_path: Path, html: str, problem: str) -> None:
    (tmp_path / "a.html").write_text(GOOD)
    (tmp_path / "b.html").write_text('<h2 id="part">B</h2>')
    (tmp_path / "style.css").write_text("a { background: url(data:image/png;base64,AA) }")
    assert dead_links(tmp_path) == ([], {"https://example.org/x"})
    (tmp_path / "a.html").write_text(GOOD + html)
    assert dead_links(tmp_path) == ([f"a.html: {problem}"], {"https://example.org/x"})


def test_a_style_sheet_that_loads_from_another_host_is_a_problem(tmp_path: Path) -> None:
    (tmp_path / "style.css").write_text('@font-face { src: url("https://example.org/a.woff2") }')
    problem = "style.css: expected a file of the site, got https://example.org/a.woff2"
    assert dead_links(tmp_path) == ([problem], set())


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the built site. A process builds it: in a test, a deprecation in a library is an error."""
    folder = tmp_path_factory.mktemp("site") / "site"
    program = f"from docs.generate.site import *; assert build(Path({str(folder)!r})) == []"
    subprocess.run([sys.executable, "-c", program], cwd=ROOT, check=True, timeout=LIVE_TIMEOUT_S)
    return folder


@needs_sphinx
@pytest.mark.live
def test_navigation_is_the_index_of_the_documents(site: Path) -> None:
    index, built = (ROOT / "docs/index.md").read_text(), (site / "docs/index.html").read_text()
    titles = re.findall(r'class="caption-text">([^<]*)', built)
    assert titles == re.findall(r"^## (.*)$", index, re.MULTILINE) == ["Tasks", "Reference", "Background"]
    pages = re.findall(r'class="toctree-l1[^"]*"><a class="reference internal" href="([^"#]+)\.html"', built)
    assert pages == ["../README", *re.findall(r"^\| \[[\w/-]+\]\(([^)]*)\.md\)", index, re.MULTILINE)]


@needs_sphinx
@pytest.mark.live
def test_built_pages_have_the_anchors_of_github(site: Path) -> None:
    for page in PAGES:
        built = HtmlPage((site / page.relative_to(ROOT).with_suffix(".html")).read_text())
        assert anchors(page) - built.anchors == set(), page.name


@needs_sphinx
@pytest.mark.live
@pytest.mark.skipif(bool(MISSING), reason=MISSING)
def test_search_finds_a_page_without_a_server(site: Path, tmp_path: Path) -> None:
    with browser(tmp_path) as page:
        page.driver.get((site / "index.html").as_uri())
        page.until("return location.pathname.endsWith('/docs/index.html')")
        page.js("document.querySelector('.sidebar-search').value = 'SOUT'")
        page.js("document.querySelector('.sidebar-search').form.submit()")
        link = "document.querySelector('#search-results a[href*=\"docs/lines.html\"]')"
        page.until(f"return {link}")
        loaded = page.js(LOADED)
        page.js(f"{link}.click()")
        page.until("return location.pathname.endsWith('/docs/lines.html')")
        assert [url for url in loaded + page.js(LOADED) if not url.startswith("file://")] == []
