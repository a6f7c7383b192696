"""A number of places, which groups of clients divide."""

from __future__ import annotations

import collections
import contextlib
from collections.abc import Iterator


class Places:
    """A group takes more as long as it then holds no more than are free: alone it has half of all.

    Belongs to one event loop.
    """

    def __init__(self, most: int) -> None:
        self._free = most
        self._taken: collections.Counter[str] = collections.Counter()

    def has(self, group: str) -> bool:
        """Returns whether the group may take another place."""
        return self._taken[group] < self._free

    @contextlib.contextmanager
    def taken(self, group: str) -> Iterator[bool]:
        """Holds a place of the group, if it may take one. Yields whether it does."""
        if not self.has(group):
            yield False
            return
        self._free -= 1
        self._taken[group] += 1
        try:
            yield True
        finally:
            self._free += 1
            self._taken[group] -= 1
            self._taken += collections.Counter()  # forgets groups without places
