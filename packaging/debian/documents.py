"""Copy README.md and all files that its links reach: `documents.py FOLDER`.

The files keep their paths, so that links work, and so that `docs/can.md` in a message of imud is the path of a file.
"""

import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
LINK = re.compile(r"\]\(([^):#]+)(?:#[^)]*)?\)")  # target inside the repository, without its anchor
CODE = re.compile(r"^ *```.*?^ *```|`[^`\n]*`", re.MULTILINE | re.DOTALL)  # can look like a link: `MOTIONS[name](9.8)`


def reached(file: Path, found: set[Path]) -> set[Path]:
    """Return `found` with a file and the files that its links reach. Raises SystemExit if a file is missing."""
    if file in found:
        return found
    if not file.is_file():
        raise SystemExit(f"documents.py: expected the target of a link, got no file {file}")
    found.add(file)
    if file.suffix == ".md":
        for target in LINK.findall(CODE.sub("", file.read_text())):
            reached((file.parent / target).resolve(), found)
    return found


def main(folder: str) -> None:
    """Copy the files."""
    for file in reached(ROOT / "README.md", set()):
        copy = Path(folder) / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
        copy.chmod(0o644)


if __name__ == "__main__":
    main(sys.argv[1])
