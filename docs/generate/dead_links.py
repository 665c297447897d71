"""Check the links of a folder of HTML files: `dead_links` returns the links that lead nowhere.

A link to another host is not followed. A page must not load a file from another host: a reader without network gets the
whole site, and no other host learns who reads it.
"""

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

CSS_URL: Final = re.compile(r"""url\(\s*["']?([^"')]+)|@import\s+["']([^"']+)""")


class HtmlPage(HTMLParser):
    """Anchors, links, and loaded files of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors = {""}
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(text)
        self.loaded += css_files(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        if "href" in values:
            (self.links if tag == "a" else self.loaded).append(values["href"])
        self.loaded += [values[name] for name in ("src", "data", "poster") if name in values]
        self.loaded += [one.split()[0] for one in values.get("srcset", "").split(",") if one.split()]
        if tag == "meta" and values.get("http-equiv", "").lower() == "refresh":
            self.links.append(values["content"].partition("url=")[2])


def css_files(text: str) -> list[str]:
    """Return the files that a style sheet loads."""
    return [first or second for first, second in CSS_URL.findall(text)]


def dead_links(site: Path) -> tuple[list[str], set[str]]:
    """Return the problems of the links in a folder, one line each, and the links to other hosts."""
    pages = {file: HtmlPage(file.read_text()) for file in sorted(site.rglob("*.html"))}
    problems, external = [], set[str]()
    for file, page in pages.items():
        where = file.relative_to(site)
        problems += [f"{where}: {problem}" for problem in problems_of(file, page, pages)]
        external |= {link for link in page.links if urlsplit(link).scheme}
    for file in site.rglob("*.css"):
        loaded = [one for one in css_files(file.read_text()) if urlsplit(one).netloc]
        problems += [f"{file.relative_to(site)}: expected a file of the site, got {one}" for one in loaded]
    return problems, external


def problems_of(file: Path, page: HtmlPage, pages: dict[Path, HtmlPage]) -> Iterator[str]:
    for link in [*page.links, *page.loaded]:
        parts = urlsplit(link)
        if parts.scheme or parts.netloc:
            if link in page.loaded and parts.scheme != "data":
                yield f"expected a file of the site, got {link}"
            continue
        target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
        if not target.is_file():
            yield f"expected the file {unquote(parts.path)}, got no such file"
        elif target in pages and unquote(parts.fragment) not in pages[target].anchors:
            yield f"expected the anchor #{unquote(parts.fragment)} in {parts.path or file.name}, got no such anchor"
