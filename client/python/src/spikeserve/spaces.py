"""What a policy may answer: Gymnasium's Discrete and Box, without a need for Gymnasium."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.wire import Message


@dataclass(frozen=True)
class Discrete:
    """Indices from 0 to n - 1."""

    n: int


@dataclass(frozen=True)
class Box:
    """Vectors within finite bounds, in environment units."""

    low: tuple[float, ...]
    high: tuple[float, ...]


ActionSpace = Discrete | Box


def action_space_from_wire(message: Message) -> ActionSpace:
    """From an ActionSpace of the wire contract."""
    if message.WhichOneof("kind") == "discrete":
        return Discrete(message.discrete.n)
    return Box(tuple(message.box.low), tuple(message.box.high))


def as_action_space(space: Any) -> ActionSpace:
    """A Discrete or Box of this module or of Gymnasium, as one of this module.

    ValueError for anything else, for a Discrete that does not start at 0, and for a Box that has
    not one dimension: the model's actions are none of these.
    """
    if isinstance(space, Discrete | Box):
        return space
    if hasattr(space, "n") and hasattr(space, "start"):
        if space.start != 0:
            raise ValueError(f"action_space: expected Discrete from 0, got one from {space.start}")
        return Discrete(int(space.n))
    if hasattr(space, "low") and hasattr(space, "high"):
        if np.ndim(space.low) != 1:
            raise ValueError(f"action_space: expected Box of one dimension, got {space}")
        return Box(_bounds(space.low), _bounds(space.high))
    raise ValueError(f"action_space: expected Discrete or Box, got {space!r}")


def _bounds(values: Any) -> tuple[float, ...]:
    return tuple(np.asarray(values, np.float32).tolist())


def stack_actions(
    actions: list[int | NDArray[np.float32] | None], space: ActionSpace
) -> NDArray[np.int64] | NDArray[np.float32]:
    """One row an action; a row without one holds an action of the space that nobody will read."""
    if isinstance(space, Discrete):
        return np.array([0 if action is None else action for action in actions], np.int64)
    unread = np.asarray(space.low, np.float32)
    return np.stack([unread if action is None else np.asarray(action) for action in actions])
