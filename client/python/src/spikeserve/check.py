"""The form of every error about an argument."""

from __future__ import annotations

from typing import Any

import numpy as np


def check(holds: bool, field: str, expected: str, received: object) -> None:
    """Raises ValueError "field: expected X, received Y" unless `holds`."""
    if not holds:
        raise ValueError(f"{field}: expected {expected}, received {received}")


def unmasked(values: object, field: str) -> Any:
    """Returns `values`. ValueError for a masked array: the numbers under its mask are unknown."""
    if isinstance(values, np.ma.MaskedArray):
        hidden = int(np.ma.getmaskarray(values).sum())
        check(hidden == 0, field, "numbers", f"a masked array without {hidden} of its numbers")
    return values
