"""Plays episodes in several environments at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from spikeserve.flat_spaces import FlatEnvironment

FlatAction = int | NDArray[np.float32]


@dataclass
class Episode:
    """One episode in the spaces of a policy. `labels` are the actions to imitate."""

    seed: int
    observations: list[NDArray[Any]]  # [steps + 1], of float32, or of uint8 for images
    actions: list[FlatAction] = field(default_factory=list)  # [steps], as executed
    labels: list[FlatAction] = field(default_factory=list)  # [steps], or empty: the actions
    weights: list[float] = field(default_factory=list)  # [steps], or empty: all 1
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False
    spikes: int = 0  # of all decisions, if a policy made them

    @property
    def steps(self) -> int:
        """Returns the number of actions."""
        return len(self.actions)

    @property
    def episode_return(self) -> float:
        """Returns the sum of the rewards."""
        return float(np.sum(self.rewards))


@dataclass
class Row:
    """One environment and its running episode."""

    index: int
    environment: FlatEnvironment
    episode: Episode

    @property
    def reward(self) -> float:
        """Returns the reward of the last action; 0 at the first step."""
        return self.episode.rewards[-1] if self.episode.rewards else 0.0


@dataclass(frozen=True)
class Choice:
    """The choice of an actor in one row. `label` is the action to imitate, if it differs."""

    action: FlatAction
    label: FlatAction | None = None
    spikes: int = 0


class Actor(Protocol):
    """Chooses the actions of all running episodes."""

    def choose(self, rows: list[Row]) -> list[Choice]:
        """Returns one choice for each row."""

    def end(self, row: Row) -> None:
        """Is called when the episode of `row` has ended."""


def play(
    make: Callable[[], FlatEnvironment],
    actor: Actor,
    seeds: Iterator[int],
    environments: int,
) -> Iterator[Episode]:
    """Plays an episode for each seed, several at once, and yields them in the order of their ends.

    The result is a function of the arguments: environments step one after the other. The generator
    reads `seeds` while it runs, so a caller can end the iterator when it has enough.
    """
    rows: list[Row] = []
    for index in range(environments):
        seed = next(seeds, None)
        if seed is None:
            break
        rows.append(_start(index, make(), seed))
    made = [row.environment for row in rows]
    try:
        while rows:
            choices = actor.choose(rows)
            running = []
            for row, choice in zip(rows, choices, strict=True):
                if not _step(row, choice):
                    running.append(row)
                    continue
                actor.end(row)
                yield row.episode
                seed = next(seeds, None)
                if seed is not None:
                    running.append(_start(row.index, row.environment, seed))
            rows = running
    finally:
        for environment in made:
            environment.close()


def _start(index: int, environment: FlatEnvironment, seed: int) -> Row:
    observation, _ = environment.reset(seed=seed)
    return Row(index, environment, Episode(seed, [_stored(environment, observation)]))


def _stored(environment: FlatEnvironment, observation: NDArray[np.float32]) -> NDArray[Any]:
    return observation.astype(environment.observations.stored_dtype, copy=False)


def _step(row: Row, choice: Choice) -> bool:
    """Executes a choice. Returns whether the episode has ended."""
    episode = row.episode
    observation, reward, terminated, truncated, _ = row.environment.step(choice.action)
    episode.actions.append(choice.action)
    if choice.label is not None:
        episode.labels.append(choice.label)
    episode.observations.append(_stored(row.environment, observation))
    episode.rewards.append(reward)
    episode.spikes += choice.spikes
    episode.terminated, episode.truncated = terminated, truncated
    return terminated or truncated


class Budget:
    """Yields seeds until a number of steps is played, and counts them for a progress bar."""

    def __init__(self, steps: int, first_seed: int, progress: Any) -> None:
        self._steps = steps
        self._seed = first_seed
        self._played = 0
        self._progress = progress

    def __iter__(self) -> Iterator[int]:
        return self

    def __next__(self) -> int:
        if self._played >= self._steps:
            raise StopIteration
        self._seed += 1
        return self._seed - 1

    def count(self, episode: Episode) -> None:
        """Counts the steps of a finished episode."""
        self._progress.update(min(episode.steps, max(0, self._steps - self._played)))
        self._played += episode.steps
