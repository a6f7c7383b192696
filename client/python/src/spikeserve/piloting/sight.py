"""Tells an observation from what a robot passes in its place."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spikeserve.check import unmasked
from spikeserve.feature_order import FeatureOrder


def observation_of(
    given: ArrayLike, size: int, order: FeatureOrder
) -> tuple[NDArray[np.float32] | None, str]:
    """Returns the observation in the policy's order, or None and what was expected and received."""
    try:
        values = order.observation(unmasked(given, "observation"))
    except ValueError as error:
        return None, str(error)
    try:
        array = np.array(values, np.float32)
    except (TypeError, ValueError):
        return None, f"observation: expected {size} numbers, received {_named(given)}"
    if array.shape != (size,):
        received = array.size if array.ndim == 1 else _named(given)
        return None, f"observation: expected {size} numbers, received {received}"
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        first = int(bad[0])
        received = array[first]
        return None, f"observation[{first}]: expected a finite number, received {received}"
    return array, ""


def _named(given: Any) -> str:
    shape = getattr(given, "shape", None)
    return f"{type(given).__name__}" if shape is None else f"shape {shape}"
