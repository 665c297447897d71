"""Prints, per section of the manuals and of newer firmware, item → code → tests, and the descriptions in the drivers.

`make audit` runs it. It exits with 1 when an item has no code or no test.
"""

import sys
from collections.abc import Iterator

from tests.audit import manuals, newer
from tests.audit.item import Item, described, evidence_of, faults

TITLES = {"A": "Forsense IMU61x", "B": "HiPNUC CH0x0, CH10x, HI14", "C": "Newer firmware and frames"}
ITEMS = {item.key: item for item in (*manuals.ITEMS, *newer.ITEMS)}


def report(marked: dict[str, list[str]]) -> Iterator[str]:
    section, by_section = "", described()
    for item in ITEMS.values():
        if item.section != section:
            section = item.section
            yield ""
            yield f"{section}"
            yield from (f"    described by {words}" for words in by_section.get(section, ()))
        yield f"  {item.key.removeprefix(section).strip()}: {item.words}" if item.words else f"  {item.key}"
        if item.left:
            yield f"    left: {item.left}"
            continue
        yield f"    code  imud.{item.code.replace(':', '.')}"
        yield from (f"    test  {test}" for test in marked.get(item.key, ["none"]))


def count(letter: str, marked: dict[str, list[str]]) -> str:
    own = [item for item in ITEMS.values() if item.key.startswith(letter)]
    done = [item for item in own if not item.left and item.code_exists and item.key in marked]
    left = [item for item in own if item.left]
    return f"{TITLES[letter]}: {len(done)} of {len(own)} items have code and a test, {_left(left)}"


def _left(left: list[Item]) -> str:
    return f"{len(left)} left with a reason" if left else "none is left"


def main() -> int:
    marked = evidence_of(ITEMS.values())
    print("\n".join(report(marked)))
    print()
    for letter in TITLES:
        print(count(letter, marked))
    wrong = list(faults(ITEMS, marked))
    for line in wrong:
        print(line, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
