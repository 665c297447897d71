"""Named checks with their durations, and waits for conditions. Runs in the guest with the Python of the system.

with checks("the service is READY after its start"):
    ...                                              each exception is a failure; the run continues
checks.figure("start to READY", 8.1, "s")            a measured value, printed with the results
"""

import contextlib
import json
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

LIMIT_S = 180.0
"""Default time limit, s. An emulated guest on a busy host is tens of times slower than a real system."""
POLL_S = 0.1  # interval of polls
LINES_SHOWN = 12  # last lines of an exception's text


class Failed(Exception):
    """A failed check. Its text contains the received value."""


class Checks:
    def __init__(self, results: Path) -> None:
        self._results = results
        self._rows: list[dict[str, object]] = []
        self._figures: list[dict[str, object]] = []
        self._group = ""

    def begin(self, group: str) -> None:
        self._group = group

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Run one check. An exception fails the check and is printed; the run continues after the block."""
        start_s = time.monotonic()
        why = ""
        try:
            yield
        except Failed as error:
            why = str(error)
        except Exception as error:  # noqa: BLE001 - whatever happens in a check fails it, and no other
            why = "".join(traceback.format_exception(error))
        taken_s = time.monotonic() - start_s
        print(f"{'FAIL' if why else 'PASS'} {taken_s:6.1f} s  {self._group}: {name}", flush=True)
        for line in why.splitlines()[-LINES_SHOWN:]:
            print(f"       {line}", flush=True)
        self._rows.append({"group": self._group, "name": name, "seconds": round(taken_s, 2), "why": why})
        self._save()

    def figure(self, name: str, value: float, unit: str) -> None:
        print(f"     {value:8.2f} {unit}  {self._group}: {name}", flush=True)
        self._figures.append({"group": self._group, "name": name, "value": value, "unit": unit})
        self._save()

    def note(self, text: str) -> None:
        print(f"       {text.strip()[:110]}", flush=True)

    def skip(self, name: str, why: str) -> None:
        print(f"SKIP           {self._group}: {name}: {why}", flush=True)

    @property
    def failed(self) -> list[str]:
        return [f"{row['group']}: {row['name']}" for row in self._rows if row["why"]]

    def summary(self) -> str:
        failed = self.failed
        return f"{len(self._rows)} checks, {len(failed)} failed{': ' if failed else ''}{'; '.join(failed)}"

    def _save(self) -> None:
        self._results.write_text(json.dumps({"checks": self._rows, "figures": self._figures}, indent=1))


def wait_until(found: Callable[[], T | None], what: str, limit_s: float = LIMIT_S) -> T:
    """Return the first true result of `found()`. Raise Failed with `what` after `limit_s`."""
    give_up_s = time.monotonic() + limit_s
    while not (value := found()):
        if time.monotonic() >= give_up_s:
            raise Failed(f"expected within {limit_s:.0f} s: {what}; last value: {value!r}")
        time.sleep(POLL_S)
    return value


def expect(what: str, got: object, wanted: object) -> None:
    if got != wanted:
        raise Failed(f"{what}: expected {wanted!r}, got {got!r}")


def expect_in(part: str, whole: str, what: str) -> None:
    if part not in whole:
        raise Failed(f"{what}: expected {part!r} in: {whole.strip()[-1500:]}")
