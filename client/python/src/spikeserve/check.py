"""The form of every error about an argument."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

import numpy as np

_MOST_NAMES = 10  # of an error
_LONGEST_NAME = 64  # of which all is compared


def check(holds: bool, field: str, expected: str, received: object) -> None:
    """Raises ValueError "field: expected X, received Y" unless `holds`."""
    if not holds:
        raise ValueError(f"{field}: expected {expected}, received {received}")


def names_like(received: str, known: Iterable[str]) -> str:
    """Returns the names that exist, or if there are many those that are most like `received`."""
    names = sorted(set(known))
    if len(names) <= _MOST_NAMES:
        return ", ".join(names) or "none"
    near = difflib.get_close_matches(received[:_LONGEST_NAME], names, _MOST_NAMES, cutoff=0)
    return f"{', '.join(near)} and {len(names) - len(near)} more"


def unmasked(values: object, field: str) -> Any:
    """Returns `values`. ValueError for a masked array: the numbers under its mask are unknown."""
    if isinstance(values, np.ma.MaskedArray):
        hidden = int(np.ma.getmaskarray(values).sum())
        check(hidden == 0, field, "numbers", f"a masked array without {hidden} of its numbers")
    return values
