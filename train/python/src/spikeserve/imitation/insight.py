"""Why a policy is as good as it is: what the report says beside the returns."""

from __future__ import annotations

import csv
import pathlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from spikeserve.imitation.actors import StudentActor
from spikeserve.imitation.baselines import Comparison
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import Choice, Episode, FlatAction, Row, play
from spikeserve.imitation.experts import Expert
from spikeserve.imitation.figures import Figures
from spikeserve.imitation.options import GRADES

_BINS = 10  # of the steps of an episode

_GOOD_SHARE, _WEAK_SHARE = 0.95, 0.5  # of the way from random actions to the expert


@dataclass(frozen=True)
class Verdict:
    """How good a policy is, in words and numbers."""

    grade: str  # one of GRADES
    reason: str

    def meets(self, least: str) -> bool:
        """Returns whether the grade is `least` or better."""
        return GRADES.index(self.grade) >= GRADES.index(least)


def action_error(
    space: spaces.Discrete | spaces.Box, action: FlatAction, label: FlatAction
) -> float:
    """Returns 0 or 1 for an index; for a Box the mean squared difference, mapped to [-1, 1]."""
    if isinstance(space, spaces.Discrete):
        return float(action != label)
    half = (space.high - space.low) / 2
    return float(np.mean(np.square((np.asarray(action) - np.asarray(label)) / half)))


class _TwiceAsked:
    """Plays an expert, and asks it twice in every state."""

    def __init__(self, expert: Expert) -> None:
        self._expert = expert
        self.differences: list[float] = []

    def choose(self, rows: list[Row]) -> list[Choice]:
        return [self._choose(row) for row in rows]

    def end(self, row: Row) -> None:
        pass

    def _choose(self, row: Row) -> Choice:
        actions = row.environment.actions
        first, second = (actions.to_flat(self._expert(row.environment)) for _ in range(2))
        self.differences.append(action_error(actions.space, first, second))
        return Choice(first)


def noise_floor(factory: EnvironmentFactory, expert: Expert, seeds: Sequence[int]) -> float:
    """Returns the error that the noise of the expert's own actions sets, however good a policy is.

    Half of the mean squared difference of two answers in the same state is the variance of the
    expert. For an index it is the share of states with two answers, halved: what the better of two
    equally probable answers gets wrong.
    """
    actor = _TwiceAsked(expert)
    for _ in play(factory.make, actor, iter(seeds), len(seeds)):
        pass
    return float(np.mean(actor.differences)) / 2


def drift(
    factory: EnvironmentFactory, actor: StudentActor, seeds: Sequence[int]
) -> list[tuple[int, int, float]]:
    """Returns the error against the expert in closed loop: (first step, last step, mean error).

    `actor` plays the policy with the expert's labels. Errors that grow with the step come from
    states that the policy reaches and the data lack.
    """
    environment = factory.make()
    environment.close()
    space = environment.actions.space
    episodes = list(play(factory.make, actor, iter(seeds), len(seeds)))
    errors = [_errors(space, episode) for episode in episodes]
    longest = max(map(len, errors))
    edges = np.unique(np.linspace(0, longest, min(_BINS, longest) + 1).astype(int))
    bins = []
    for first, end in pairwise(edges):
        within = np.concatenate([values[first:end] for values in errors])
        bins.append((int(first), int(end) - 1, float(within.mean())))
    return bins


def _errors(space: spaces.Discrete | spaces.Box, episode: Episode) -> NDArray[np.float64]:
    pairs: Iterator[tuple[FlatAction, FlatAction]] = zip(
        episode.actions, episode.labels, strict=True
    )
    return np.array([action_error(space, action, label) for action, label in pairs])


def learning_curves(stages: Sequence[pathlib.Path]) -> list[tuple[int, float, float]]:
    """Returns (iteration, mean, deviation) of the validation losses of several trainings."""
    losses: dict[int, list[float]] = {}
    curves = [stage / "learning_curve.csv" for stage in stages]
    for path in filter(pathlib.Path.is_file, curves):  # none where no episode is held out
        with path.open() as file:
            for row in csv.DictReader(file):
                losses.setdefault(int(row["iteration"]), []).append(float(row["validation_loss"]))
    rows = [
        (iteration, float(np.mean(values)), float(np.std(values, ddof=1)))
        for iteration, values in losses.items()
        if len(values) > 1
    ]
    step = max(1, len(rows) // _BINS)
    return rows[step - 1 :: step]


@dataclass(frozen=True)
class Insight:
    """The figures of one run; None: unknown, for example without an expert to ask."""

    comparison: Comparison | None
    floor: float | None
    drift: list[tuple[int, int, float]] | None
    # Of the way from random actions to the expert; None: the expert returns no more than they do.
    share: float | None
    chance: Figures  # of random actions, on the starts for selection
    curves: list[tuple[int, float, float]]

    def verdict(self) -> Verdict:
        """Judges by the share of the way to the expert."""
        if self.share is None:
            return Verdict("bad", "the expert returns no more than random actions")
        grade = "good" if self.share >= _GOOD_SHARE else "bad"
        if _WEAK_SHARE <= self.share < _GOOD_SHARE:
            grade = "weak"
        reason = f"{self.share:.0%} of the way from random actions to the expert"
        if (comparison := self.comparison) is not None:
            parts = comparison.explained_elements
            elements = ", ".join(f"{name} {share:.0%}" for name, share in parts.items())
            reason += f"; it explains {comparison.explained:.0%} of the actions of held-out steps"
            reason += f" ({elements})" if len(parts) > 1 else ""
        if self.curves and self._still_falls():
            reason += "; undertrained: the validation loss of the first trainings still fell"
        return Verdict(grade, reason)

    def advice(self, observation_changes: bool, context: int) -> list[str]:
        """Returns what to try next, the most promising first."""
        lines = []
        if self.comparison is not None:
            lines += self._about_baselines(observation_changes, context)
        if self.drift is not None and self._grows():
            lines.append(
                "The error grows along the episode: the policy reaches states that the data lack. "
                "Try more rounds (--rounds, --round-steps) or more disturbance (--disturbed)."
            )
        if self.curves and self._still_falls():
            lines.append(
                "The validation loss still fell at the end of the first trainings: try more "
                "iterations (--iterations)."
            )
        if self.share is None:
            lines.append("Imitate an expert that returns more than random actions.")
        elif self.share < _GOOD_SHARE and not lines:
            lines.append(
                "Nothing here explains the distance to the expert: try more data (--steps), a "
                "larger policy (--hidden-size), or an expert that keeps a margin."
            )
        return lines or ["The policy is as good as its expert and the baselines."]

    def _about_baselines(self, observation_changes: bool, context: int) -> list[str]:
        comparison = self.comparison
        assert comparison is not None
        errors = {baseline.name: baseline.error for baseline in comparison.baselines}
        best = min(errors, key=lambda name: errors[name])
        lines = []
        if self.floor is not None and comparison.policy_error < 1.2 * self.floor:
            lines.append(
                f"The error ({comparison.policy_error:.4f}) is near the noise of the expert "
                f"({self.floor:.4f}): only an expert with less noise teaches more."
            )
        elif errors[best] < 0.9 * comparison.policy_error:
            lines.append(
                f"{best} has a smaller error ({errors[best]:.4f} against "
                f"{comparison.policy_error:.4f}): the data teach more than the policy has "
                "learned. Try more iterations (--iterations) or a larger policy (--hidden-size)."
            )
        two = min(errors["line on 2 frames"], errors["mlp on 2 frames"])
        one = min(errors["line on 1 frame"], errors["mlp on 1 frame"])
        four = min(errors["line on 4 frames"], errors["mlp on 4 frames"])
        if two < 0.95 * one and not observation_changes:
            lines.append(
                "Two observations say more than one: try --train-flags=--observation_changes=true."
            )
        if four < 0.95 * two and context < 20:
            lines.append(
                f"Four observations say more than two: try a longer context than {context} "
                "(--context, --clip-steps=0)."
            )
        return lines

    def _grows(self) -> bool:
        assert self.drift is not None
        errors = [error for _, _, error in self.drift]
        half = len(errors) // 2
        return half > 0 and np.mean(errors[half:]) > 1.5 * np.mean(errors[:half])

    def _still_falls(self) -> bool:
        means = [mean for _, mean, _ in self.curves]
        return len(means) >= 3 and means[-1] < 0.97 * means[-2]
