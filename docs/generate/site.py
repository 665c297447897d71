"""Build the documents as a static site with a search in build/site: `python -m docs.generate.site`.

Sphinx with MyST reads the Markdown files at their place in the repository. Therefore a link that works on GitHub also
works in the site: a link to another file of the repository becomes a link to a copy. The navigation is docs/index.md:
one group for each of its tables. The site loads nothing from other hosts, and its search works without a server.

The build fails for a warning of Sphinx and for a dead link. It prints links to other hosts and does not follow them.
"""

import re
import shutil
import sys
from pathlib import Path
from typing import Any, Final

from sphinx.application import Sphinx

from docs.generate.dead_links import dead_links
from imud import __version__

ROOT: Final = Path(__file__).parent.parent.parent
INDEX: Final = "docs/index"
GROUP: Final = re.compile(r"^## (.+)$", re.MULTILINE)
ROW_LINK: Final = re.compile(r"^(?:\| )?[^|\n]*?\]\((?!\w+://)([^)#]+)\.md\)", re.MULTILINE)
"""First link of a table row, or of a line before the first table."""
CONFIGURATION: Final[dict[str, Any]] = {
    "project": "imud",
    "version": __version__,
    "extensions": ["myst_parser"],
    "root_doc": INDEX,
    "include_patterns": ["*.md", "docs/**.md", "tests/**/README.md"],
    "exclude_patterns": [".*", "build", "imud", "packaging", "node_modules"],
    "myst_heading_anchors": 6,  # anchors as on GitHub
    "suppress_warnings": [
        "misc.highlighting_failure",  # examples of the socket contain arrows and "…"
        "myst.header",  # generated parts begin with a title of the third level
        "toc.not_included",  # the README files of tests; a test checks that docs/index.md names each document
    ],
    "html_theme": "furo",
    "html_title": f"imud {__version__}",
    "html_copy_source": False,
    "html_show_copyright": False,
    "html_use_index": False,
}
START_PAGE: Final = f'<!doctype html>\n<meta http-equiv="refresh" content="0; url={INDEX}.html">\n'


def navigation(index: str) -> str:
    """Return Sphinx's tables of contents for docs/index.md: one for the lines before the groups, one for each group."""
    begin, *parts = GROUP.split(index)
    groups = [("", begin), *zip(parts[::2], parts[1::2], strict=True)]
    lines = []
    for title, text in groups:
        lines += ["", "```{toctree}", ":hidden:", f":caption: {title}" if title else "", *ROW_LINK.findall(text), "```"]
    return "\n".join(lines)


def add_navigation(_app: Sphinx, name: str, source: list[str]) -> None:
    if name == INDEX:
        source[0] += navigation(source[0])


def build(folder: Path) -> list[str]:
    """Build the site in a folder, and remove the previous content of the folder. Return the problems, one line each."""
    shutil.rmtree(folder, ignore_errors=True)
    app = Sphinx(
        ROOT, None, folder, folder.with_name(folder.name + "-trees"), "html", status=None, freshenv=True,
        warningiserror=True, confoverrides=CONFIGURATION,
    )  # fmt: skip
    app.connect("source-read", add_navigation)
    app.build(force_all=True)
    (folder / "index.html").write_text(START_PAGE)
    problems, external = dead_links(folder)
    print(f"{len(external)} links to other hosts, not followed:", *sorted(external), sep="\n  ")
    return ["Sphinx printed warnings, see above"] * bool(app.statuscode) + problems


def main() -> int:
    folder = ROOT / "build/site"
    problems = build(folder)
    for problem in problems:
        print(f"docs-site: {problem}", file=sys.stderr)
    if not problems:
        print(f"{len(list(folder.rglob('*.html')))} pages without a dead link: {folder / 'index.html'}")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
