"""Progress on standard error: bars on a terminal, lines in a file."""

from __future__ import annotations

import sys
import time
from typing import Any

import tqdm

from spikeserve.printing import say

_LINE_SECONDS = 30.0  # between two lines


class _Lines:
    """Prints a line now and then, and one at the end."""

    def __init__(self, total: int, unit: str, title: str) -> None:
        self._total, self._unit, self._title = total, unit, title
        self._done = 0
        self._printed = time.monotonic()

    def __enter__(self) -> _Lines:
        return self

    def __exit__(self, *_: object) -> None:
        self._print()

    def update(self, n: int) -> None:
        self._done += n
        if time.monotonic() - self._printed >= _LINE_SECONDS:
            self._print()

    def _print(self) -> None:
        self._printed = time.monotonic()
        say(f"{self._title}: {self._done} of {self._total} {self._unit}", error=True)


def progress_bar(total: int, unit: str, title: str) -> Any:
    """Returns a context manager that has `update(n)`."""
    if not sys.stderr.isatty():
        return _Lines(total, unit, title)
    return tqdm.tqdm(total=total, unit=f" {unit}", desc=title, mininterval=1.0, dynamic_ncols=True)
