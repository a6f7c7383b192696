"""Plays evaluations: returns and spikes of an actor on given starts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spikeserve.engine import Engine
from spikeserve.imitation.actors import DelayedStudentActor, RandomActor, StudentActor
from spikeserve.imitation.delays import AT_ONCE, Delays
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import Actor, Episode, play
from spikeserve.imitation.progress import progress_bar


def standard_error(values: NDArray[np.float64]) -> float:
    """Returns the standard error of the mean; infinite for fewer than two values."""
    if len(values) < 2:
        return math.inf
    return float(values.std(ddof=1)) / math.sqrt(len(values))


@dataclass(frozen=True)
class Figures:
    """The result of an evaluation. `returns` are in the order of the seeds."""

    returns: list[float]
    decisions: int
    spikes: int
    first_seed: int = 0

    @classmethod
    def of(cls, episodes: Iterable[Episode]) -> Figures:
        """Summarises episodes."""
        ordered = sorted(episodes, key=lambda episode: episode.seed)
        return cls(
            [episode.episode_return for episode in ordered],
            sum(episode.steps for episode in ordered),
            sum(episode.spikes for episode in ordered),
            ordered[0].seed,
        )

    @property
    def mean(self) -> float:
        """Returns the mean return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Returns the standard deviation of the returns."""
        return float(np.std(self.returns))

    @property
    def spikes_per_decision(self) -> float:
        """Returns the mean spikes of a decision."""
        return self.spikes / self.decisions

    def __str__(self) -> str:
        """Returns mean ± deviation, with more digits if the returns are small."""
        digits = 1 if abs(self.mean) >= 10 else 3
        return f"{self.mean:.{digits}f} ± {self.std:.{digits}f}"

    def of_the_first(self, episodes: int) -> Figures:
        """Returns the returns of the first starts. Decisions and spikes stay those of all."""
        return replace(self, returns=self.returns[:episodes])

    def falls_by(self, reference: Figures) -> tuple[float, float]:
        """Returns the mean fall from the reference on equal starts, and its standard error."""
        falls = np.array(reference.returns) - np.array(self.returns)
        return float(falls.mean()), standard_error(falls)

    def to_json(self) -> dict[str, Any]:
        """Returns the fields and the means."""
        means = {
            "mean_return": self.mean,
            "std_return": self.std,
            "spikes_per_decision": self.spikes_per_decision,
            "episodes": len(self.returns),
        }
        return means | asdict(self)

    @classmethod
    def from_json(cls, stored: dict[str, Any]) -> Figures:
        """Restores what to_json returned."""
        return cls(**{name: stored[name] for name in cls.__dataclass_fields__})


@dataclass(frozen=True)
class Evaluator:
    """Evaluates actors on the environments of one factory, and policies with delays in turn."""

    factory: EnvironmentFactory
    environments: int
    delays: Delays = AT_ONCE

    def evaluate(self, actor: Actor, first_seed: int, episodes: int, title: str) -> Figures:
        """Plays `episodes` starts from `first_seed` on."""
        seeds = iter(range(first_seed, first_seed + episodes))
        played = []
        with progress_bar(episodes, "episodes", title) as progress:
            for episode in play(self.factory.make, actor, seeds, self.environments):
                played.append(episode)
                progress.update(1)
        return Figures.of(played)

    def evaluate_policy(self, path: Any, first_seed: int, episodes: int, title: str) -> Figures:
        """Plays a policy file with the engine, with its most probable actions."""
        engine = Engine(path)
        actor = DelayedStudentActor(engine, self.delays.in_turn) if self.delays else None
        return self.evaluate(actor or StudentActor(engine), first_seed, episodes, title)

    def evaluate_chance(self, first_seed: int, episodes: int) -> Figures:
        """Plays uniformly random actions."""
        return self.evaluate(RandomActor(first_seed), first_seed, episodes, "random actions play")
