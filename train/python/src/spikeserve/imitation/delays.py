"""Delays between an observation and the effect of its decision, in steps, for `imitate`.

With a delay of k steps, what is decided at step t is executed at step t + k. So the action to
imitate at step t is the expert's action in the state of step t + k, and the actions that the
policy remembers are those that were executed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from spikeserve.check import check
from spikeserve.distance import Arrivals, Distance
from spikeserve.imitation.episodes import Choice, Episode, FlatAction, Row
from spikeserve.spaces import as_action_space

_EXPECTED = "steps, as a number like 3 or a range like 0..5"
MOST = 1000  # steps


def parse_delay(value: Any) -> tuple[int, int]:
    """Returns the least and the most steps of `3`, `0..5` or (0, 5). ValueError if it is none."""
    ends: tuple[int, int] | None = None
    if isinstance(value, str):
        match = re.fullmatch(r"(\d+)(?:\.\.(\d+))?", value.strip())
        if match:
            ends = int(match[1]), int(match[2] or match[1])
    elif isinstance(value, int) and not isinstance(value, bool):
        ends = value, value
    elif isinstance(value, tuple | list) and len(value) == 2:
        if all(isinstance(end, int) and not isinstance(end, bool) for end in value):
            ends = value[0], value[1]
    valid = ends is not None and 0 <= ends[0] <= ends[1] <= MOST
    check(valid, "delay", f"0 to {MOST} {_EXPECTED}", value)
    assert ends is not None
    return ends


@dataclass(frozen=True)
class Delays:
    """The delays of episodes, from `least` to `most` steps."""

    least: int = 0
    most: int = 0

    def __bool__(self) -> bool:
        return self.most > 0

    def drawn(self, seed: int, episode_seed: int) -> int:
        """Returns the delay of an episode of the data, which is random."""
        random = np.random.default_rng([seed, episode_seed])
        return int(random.integers(self.least, self.most, endpoint=True))

    def in_turn(self, episode_seed: int) -> int:
        """Returns the delay of an episode of an evaluation, in which all delays take turns."""
        return self.least + episode_seed % (self.most - self.least + 1)


AT_ONCE = Delays()


def label_after(episode: Episode, delay: int) -> Episode | None:
    """Returns the episode with the label of step t + delay at step t; None if it is too short.

    What is decided in the last `delay` steps is never executed, so these steps have weight 0.
    """
    labels = episode.labels or episode.actions
    weights = episode.weights or [1.0] * episode.steps
    kept = episode.steps - delay
    if kept < 1:
        return None
    # A label without weight is not imitated, so any will do.
    return Episode(
        seed=episode.seed,
        observations=episode.observations,
        actions=episode.actions,
        labels=[*labels[delay:], *labels[:delay]],
        weights=[*weights[delay:], *[0.0] * delay],
        rewards=episode.rewards,
        terminated=episode.terminated,
        truncated=episode.truncated,
        spikes=episode.spikes,
    )


def label_all_after(episodes: Iterable[Episode], delays: Delays, seed: int) -> list[Episode]:
    """Applies label_after() with the delays that are drawn for the episodes' seeds."""
    if not delays:
        return list(episodes)
    played = list(episodes)
    moved = (label_after(episode, delays.drawn(seed, episode.seed)) for episode in played)
    kept = [episode for episode in moved if episode is not None]
    expected = "fewer steps than the longest episode has, "
    longest = max((episode.steps for episode in played), default=0)
    check(bool(kept), "delay", f"{expected}{longest}", delays.most)
    return kept


class Delayed:
    """The choices that are under way in each row, and what is executed in their place."""

    def __init__(self) -> None:
        self._running: dict[int, Arrivals] = {}

    def executed(self, row: Row, choice: Choice, delay: int) -> FlatAction:
        """Returns the action that arrives at this step: 0 until the first one does."""
        if row.index not in self._running:
            space = as_action_space(row.environment.action_space)
            self._running[row.index] = Arrivals(Distance(delay), space, 0)
        return self._running[row.index].executed(row.episode.steps, choice.action)

    def end(self, row: Row) -> None:
        """Forgets what is under way."""
        self._running.pop(row.index, None)
