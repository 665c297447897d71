"""Print debian/copyright for a folder of installed wheels: `copyright.py SITE-PACKAGES`.

Each library has a paragraph with its license texts. For texts in /usr/share/common-licenses, the paragraph contains
only the path. A library without a license text is an error.
"""

import re
import sys
from importlib.metadata import Distribution, distributions
from pathlib import Path

COMMON = (
    ("Apache License", "Apache-2.0", "Apache-2.0"),
    ("GNU LESSER GENERAL PUBLIC LICENSE Version 2.1", "LGPL-2.1", "LGPL-2.1"),
    ("GNU LESSER GENERAL PUBLIC LICENSE Version 3", "LGPL-3", "LGPL-3"),
)
"""First words of a text, its name, and its file in /usr/share/common-licenses."""
BSD_3_CLAUSE = """
Redistribution and use in source and binary forms, with or without modification, are permitted provided that the
following conditions are met:

1. Redistributions of source code must retain the above copyright notice, this list of conditions and the following
   disclaimer.
2. Redistributions in binary form must reproduce the above copyright notice, this list of conditions and the following
   disclaimer in the documentation and/or other materials provided with the distribution.
3. Neither the name of the copyright holder nor the names of its contributors may be used to endorse or promote products
   derived from this software without specific prior written permission.

THIS SOFTWARE IS PROVIDED BY THE COPYRIGHT HOLDERS AND CONTRIBUTORS "AS IS" AND ANY EXPRESS OR IMPLIED WARRANTIES,
INCLUDING, BUT NOT LIMITED TO, THE IMPLIED WARRANTIES OF MERCHANTABILITY AND FITNESS FOR A PARTICULAR PURPOSE ARE
DISCLAIMED. IN NO EVENT SHALL THE COPYRIGHT HOLDER OR CONTRIBUTORS BE LIABLE FOR ANY DIRECT, INDIRECT, INCIDENTAL,
SPECIAL, EXEMPLARY, OR CONSEQUENTIAL DAMAGES (INCLUDING, BUT NOT LIMITED TO, PROCUREMENT OF SUBSTITUTE GOODS OR
SERVICES; LOSS OF USE, DATA, OR PROFITS; OR BUSINESS INTERRUPTION) HOWEVER CAUSED AND ON ANY THEORY OF LIABILITY,
WHETHER IN CONTRACT, STRICT LIABILITY, OR TORT (INCLUDING NEGLIGENCE OR OTHERWISE) ARISING IN ANY WAY OUT OF THE USE OF
THIS SOFTWARE, EVEN IF ADVISED OF THE POSSIBILITY OF SUCH DAMAGE.
"""
MIT = """
Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated
documentation files (the "Software"), to deal in the Software without restriction, including without limitation the
rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of the Software, and to permit
persons to whom the Software is furnished to do so, subject to the following conditions:

The above copyright notice and this permission notice shall be included in all copies or substantial portions of the
Software.

THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT LIMITED TO THE
WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO EVENT SHALL THE AUTHORS OR
COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN AN ACTION OF CONTRACT, TORT OR
OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE OR OTHER DEALINGS IN THE SOFTWARE.
"""
KNOWN = {"pyserial": BSD_3_CLAUSE, "mcap": MIT}
"""License texts of libraries without a text in the wheel.

Sources: "SPDX-License-Identifier: BSD-3-Clause" in the files of pyserial, the classifier of the MIT license in the
metadata of mcap.
"""


def licence_texts(distribution: Distribution) -> list[str]:
    """Return the license texts in the metadata folder of a library."""
    return [
        Path(str(file.locate())).read_text(errors="replace")
        for file in distribution.files or []
        if ".dist-info/" in str(file) and re.search(r"LICEN[CS]E|COPYING|NOTICE|e[pd]l-v", file.name, re.IGNORECASE)
    ]


def indented(text: str) -> str:
    """Indent `text` as the body of a field."""
    return "\n".join(f" {line.rstrip()}" if line.strip() else " ." for line in text.strip().splitlines())


def paragraph(distribution: Distribution) -> str:
    """Return the paragraph of a library. Raises SystemExit if the library has no license text."""
    name = distribution.metadata["Name"]
    holders, bodies = [], []
    for text in licence_texts(distribution):
        flat = " ".join(text.split())
        common = next((one for one in COMMON if flat[:200].lower().startswith(one[0].lower())), None)
        if common is None:
            holders += [line.strip() for line in text.splitlines() if re.match(r"\s*Copyright\b.*\d{4}", line)]
            bodies.append(text)
        else:
            bodies.append(f"The text of {common[1]} is in /usr/share/common-licenses/{common[2]}.")
    if not bodies and name not in KNOWN:
        raise SystemExit(f"copyright.py: expected a license text in the wheel of {name}, got none; add it to KNOWN")
    bodies = bodies or [KNOWN[name]]
    author = distribution.metadata["Author"] or distribution.metadata["Author-email"] or f"the authors of {name}"
    files = sorted({str(file).split("/")[0] for file in distribution.files or [] if not str(file).startswith("..")})
    return "\n".join(
        [
            f"Files: {' '.join(f'*/site-packages/{one}*' for one in files if one != 'bin')}",
            f"Copyright: {(chr(10) + ' ').join(holders) or author}",
            f"License: {re.sub('[^a-z0-9]+', '-', name.lower())}",
            indented("\n\n".join(bodies)),
        ]
    )


def bundled(folder: Path, name: str) -> str:
    """Return the paragraph of a library inside imud. Raises SystemExit if its license is missing."""
    try:
        text = (folder / "LICENSE").read_text()
    except OSError as error:
        raise SystemExit(
            f"copyright.py: cannot read the license of {name}: {error}; install npm, then build again"
        ) from error
    holders = [line.strip() for line in text.splitlines() if line.startswith("Copyright")]
    files = f"*/site-packages/{folder.relative_to(folder.parents[3])}/*"
    owners = "\n ".join(holders)
    return f"Files: {files}\nCopyright: {owners}\nLicense: {name}\n{indented(text)}"


def main(folder: str) -> None:
    """Print the complete file."""
    print("Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/")
    print("Upstream-Name: imud")
    print("\nFiles: *\nCopyright: the authors of imud\nLicense: Apache-2.0")
    print(" The text of Apache-2.0 is in /usr/share/common-licenses/Apache-2.0.")
    print("\n" + bundled(Path(folder) / "imud/web/static/uplot", "uplot"))
    for distribution in sorted(distributions(path=[folder]), key=lambda one: one.metadata["Name"].lower()):
        if distribution.metadata["Name"] != "imud":
            print("\n" + paragraph(distribution))


if __name__ == "__main__":
    main(sys.argv[1])
