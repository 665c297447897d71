"""Compare the interfaces of docs/stability.md with their stored facts: `python -m tests.stability [--write]`.

Exit status 1 if a fact differs. `--write` stores the present facts. It refuses incompatible changes with an unchanged
version, except with `--not-released`, for names that no release contains.
"""

import argparse
import os
import sys

os.environ["IMUD_PLUGINS"] = "off"  # the facts must not depend on installed drivers and outputs

from tests.stability.snapshots import advice, all_interfaces, problem, write


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.stability", description=__doc__)
    parser.add_argument("--write", action="store_true", help="store the present facts")
    parser.add_argument(
        "--not-released", action="store_true", help="store names that change before their first release"
    )
    options = parser.parse_args()
    status = 0
    for name, interface, before, after in all_interfaces():
        text = advice(name, interface, before, after)
        if text:
            print(text)
        refused = bool(before and problem(before, after, interface.place)) and not options.not_released
        if text and options.write and not refused:
            write(name, after)
            print(f"  wrote tests/stability/{name}.txt, {len(after)} facts")
        else:
            status |= bool(text)
    return status


if __name__ == "__main__":
    sys.exit(main())
