"""Action spaces: the Discrete and Box of Gymnasium, without a dependency on Gymnasium."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.check import check
from spikeserve.wire import Message


@dataclass(frozen=True)
class Discrete:
    """Indices from 0 to n - 1."""

    n: int


@dataclass(frozen=True)
class Box:
    """Vectors within finite bounds, in environment units. One bound for each element."""

    low: tuple[float, ...]
    high: tuple[float, ...]


ActionSpace = Discrete | Box


def action_space_from_wire(message: Message) -> ActionSpace:
    """Converts an ActionSpace of the wire contract."""
    if message.WhichOneof("kind") == "discrete":
        return Discrete(message.discrete.n)
    return Box(tuple(message.box.low), tuple(message.box.high))


def as_action_space(space: Any) -> ActionSpace:
    """Converts a Discrete or Box of Gymnasium to one of this module.

    Returns a Discrete or Box of this module unchanged. ValueError for a Discrete that does not
    start at 0, for a Box without exactly one dimension, and for other types: no policy has them.
    """
    if isinstance(space, Discrete | Box):
        return space
    if hasattr(space, "n") and hasattr(space, "start"):
        check(space.start == 0, "action_space", "Discrete from 0", space)
        return Discrete(int(space.n))
    if hasattr(space, "low") and hasattr(space, "high"):
        check(np.ndim(space.low) == 1, "action_space", "Box of one dimension", space)
        return Box(_bounds(space.low), _bounds(space.high))
    raise ValueError(f"action_space: expected Discrete or Box, received {space!r}")


def check_observation_space(space: Any, size: int, policy: str) -> None:
    """ValueError unless `space`, of Gymnasium, holds vectors of `size` numbers."""
    shape = getattr(space, "shape", None)
    expected = f"shape {(size,)} for policy {policy!r}"
    received: object = shape
    if shape is None:
        expected += "; gymnasium.wrappers.FlattenObservation makes one vector of a Dict or Tuple"
        received = space
    elif len(shape) != 1:
        expected += "; gymnasium.wrappers.FlattenObservation makes a vector of an array"
    check(shape == (size,), "observation space", expected, received)


def _bounds(values: Any) -> tuple[float, ...]:
    return tuple(np.asarray(values, np.float32).tolist())


def stack_actions(
    actions: list[int | NDArray[np.float32] | None], space: ActionSpace
) -> NDArray[np.int64] | NDArray[np.float32]:
    """Returns one row for each action. None becomes an action that the environment ignores."""
    if isinstance(space, Discrete):
        return np.array([0 if action is None else action for action in actions], np.int64)
    ignored = np.asarray(space.low, np.float32)
    return np.stack([ignored if action is None else np.asarray(action) for action in actions])
