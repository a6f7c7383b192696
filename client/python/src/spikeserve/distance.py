"""`Distance`: plays a task as if the server were far away, in steps and without a clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spikeserve.check import check
from spikeserve.spaces import ActionSpace, Box
from spikeserve.values import Action


@dataclass(frozen=True)
class Distance:
    """How many steps pass between an observation and the effect of its decision.

    Each decision is executed `delay` steps after its observation, and up to `jitter` steps later.
    Of the decisions, the share `loss` never arrives. In the meantime the last action is executed.
    ValueError if a field is out of its range.
    """

    delay: int = 0
    jitter: int = 0
    loss: float = 0.0

    def __post_init__(self) -> None:
        check(self.delay >= 0, "delay", "at least 0 steps", self.delay)
        check(self.jitter >= 0, "jitter", "at least 0 steps", self.jitter)
        check(0 <= self.loss < 1, "loss", "0 to less than 1", self.loss)

    @property
    def is_none(self) -> bool:
        """Returns whether every decision is executed at once."""
        return self.delay == self.jitter == self.loss == 0


class Arrivals:
    """The decisions of one episode that are under way. `seed` decides about jitter and loss."""

    def __init__(self, distance: Distance, space: ActionSpace, seed: int) -> None:
        self._distance = distance
        self._random = np.random.default_rng(seed)
        self._under_way: list[tuple[int, int, Action]] = []  # step of arrival, of observation
        self._newest = -1  # step of the observation whose decision is executed
        self._action = neutral_action(space)

    def executed(self, step: int, decided: Action) -> Action:
        """Returns the action that is executed at a step, for whose observation `decided` is."""
        distance = self._distance
        late = int(self._random.integers(0, distance.jitter + 1))
        if self._random.random() >= distance.loss:
            self._under_way.append((step + distance.delay + late, step, decided))
        for arrival, of, action in self._under_way:
            if arrival <= step and of > self._newest:
                self._newest, self._action = of, action
        self._under_way = [waiting for waiting in self._under_way if waiting[0] > step]
        return self._action


def neutral_action(space: ActionSpace) -> Action:
    """Returns 0, or the middle of a Box in each element whose bounds exclude 0."""
    if not isinstance(space, Box):
        return 0
    low, high = np.asarray(space.low, np.float32), np.asarray(space.high, np.float32)
    return np.where((low <= 0) & (high >= 0), np.float32(0), (low + high) / 2).astype(np.float32)
