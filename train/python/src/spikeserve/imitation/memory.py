"""Chooses how far back a policy looks and how it is trained, by what recorded data say.

The data are asked with small regressions: a line and random features of the last observations, with
and without the last action. What matters is the error at the steps after a random action, where
the expert cannot be imitated by repeating what it did before.
"""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from spikeserve.imitation.baselines import LARGEST_COMPARED
from spikeserve.imitation.datasets import read_dataset
from spikeserve.imitation.episodes import Episode, FlatAction
from spikeserve.imitation.figures import standard_error
from spikeserve.imitation.options import ImitationOptions

_FRAMES = (1, 2, 4, 8, 16)
_MOST_INPUTS = 256
_MOST_ROWS = 15_000
_FEWEST_EPISODES, _FEWEST_STEPS = 10, 5000
_FEWEST_DISTURBED = 50  # steps
_FEATURES = 256
_SCALE = 1.5  # of their weights
_RIDGE = 1e-6  # relative to the number of rows
_BETTER = 0.75  # a longer memory has to reach this share of a shorter one's error
_ACTIONS_TELL = 0.75  # the same for the last action
_NOISE = 0.5  # of past actions, unless they are the memory
_CONTEXT = 5  # without an answer of the data
_PASSES = 6  # of the first training over the data
_FEWEST_ITERATIONS, _MOST_ITERATIONS = 800, 2000

Table = NDArray[np.float64]


@dataclass(frozen=True)
class TrainingPlan:
    """The settings of the trainings, and why."""

    context: int
    clip_steps: int
    action_noise: float
    learning_rate: float
    iterations: int
    round_iterations: int
    silence_iterations: int
    reasons: list[str]


def plan_training(
    options: ImitationOptions, data: pathlib.Path, space: spaces.Discrete | spaces.Box
) -> TrainingPlan:
    """Returns the settings of `options`; those that are None, by the recorded data."""
    reasons: list[str] = []
    context, noise = options.context, options.action_noise
    if context is None or noise is None:
        answer = ask(list(read_dataset(data)), space)
        if context is None:
            context, reason = _context(answer, options.lookback or 2 * (options.mirror or 0))
            reasons.append(f"context = {context}: {reason}")
        if noise is None:
            noise, reason = _action_noise(answer)
            reasons.append(f"action_noise = {noise:g}: {reason}")
    clip = options.clip_steps
    if clip is None:
        clip = min(context, _CONTEXT)
        reasons.append(f"clip_steps = {clip}: the context, at most {_CONTEXT}")
    rate = options.learning_rate
    if rate is None:
        rate = float(f"{3e-3 * min(1.0, (64 / options.hidden_size) ** 0.5):.2g}")
        reasons.append(f"learning_rate = {rate:g}: by the hidden size of {options.hidden_size}")
    iterations = options.iterations
    if iterations is None:
        steps = sum(episode.steps for episode in read_dataset(data))
        drawn = options.batch * (clip or context)
        iterations = min(max(_PASSES * steps // drawn, _FEWEST_ITERATIONS), _MOST_ITERATIONS)
        reasons.append(
            f"iterations = {iterations}: {_PASSES} passes over {steps} steps, from "
            f"{_FEWEST_ITERATIONS} to {_MOST_ITERATIONS}"
        )
    return TrainingPlan(
        context,
        clip,
        noise,
        rate,
        iterations,
        options.round_iterations or max(1, iterations // 2),
        options.silence_iterations or max(1, iterations // 3),
        reasons,
    )


@dataclass(frozen=True)
class Answer:
    """Errors of each episode by the number of observations, without and with the last action."""

    errors: dict[int, tuple[Table, Table]]
    disturbed: bool  # the errors are those of the steps after a random action


def ask(episodes: Sequence[Episode], space: spaces.Discrete | spaces.Box) -> Answer | None:
    """Returns how well the expert's actions follow from the last observations.

    Each half of the episodes tests what was fitted to the other half. None if the observations are
    too large or there are too few episodes.
    """
    size = episodes[0].observations[0].size
    steps = sum(episode.steps for episode in episodes)
    enough = len(episodes) >= _FEWEST_EPISODES and steps >= _FEWEST_STEPS
    if size > LARGEST_COMPARED or not enough:
        return None
    labels = [_encode_all(space, episode.labels or episode.actions) for episode in episodes]
    executed = [_encode_all(space, episode.actions) for episode in episodes]
    of_row = np.repeat(np.arange(len(episodes)), [len(rows) for rows in labels])
    random = [_follows_random(*pair) for pair in zip(labels, executed, strict=True)]
    tested = np.concatenate(random)
    disturbed = int(tested.sum()) >= _FEWEST_DISTURBED
    if not disturbed:
        tested = np.ones_like(tested)
    last = np.concatenate([_before(actions) for actions in executed])
    question = _Question(np.concatenate(labels), of_row, tested, space)
    errors = {}
    for frames in _FRAMES:
        if frames > 1 and frames * size > _MOST_INPUTS:
            break
        inputs = np.concatenate([_inputs(episode, frames) for episode in episodes])
        both = np.concatenate([inputs, last], axis=1)
        errors[frames] = question.errors(inputs), question.errors(both)
    return Answer(errors, disturbed)


def _beats(challenger: Table, errors: Table, share: float) -> bool:
    """Returns whether errors of episodes fall to a share, by more than chance explains."""
    gains = errors - challenger
    falls = challenger.mean() < share * errors.mean()
    return bool(falls and gains.mean() > 2 * standard_error(gains))


def _best(pair: tuple[Table, Table]) -> Table:
    return min(pair, key=np.mean)


def _context(answer: Answer | None, lookback: int) -> tuple[int, str]:
    least = max(2, lookback + 1)
    if answer is None:
        return max(_CONTEXT, least), "there are too few data, or too large observations, to ask"
    errors = {frames: _best(pair) for frames, pair in answer.errors.items()}
    frames = 1
    for longer, error in errors.items():
        if _beats(error, errors[frames], _BETTER):
            frames = longer
    where = " after a random action" if answer.disturbed else ""
    listed = ", ".join(f"{count}: {error.mean():.3g}" for count, error in errors.items())
    return max(frames + 1, least), (
        f"observations with which the expert's action follows best{where}, and one more. Errors "
        f"by their number: {listed}"
    )


def _action_noise(answer: Answer | None) -> tuple[float, str]:
    if answer is None or not answer.disturbed:
        return _NOISE, "so that the policy does not learn to repeat its last action"
    without = min((pair[0] for pair in answer.errors.values()), key=np.mean)
    beside = min((pair[1] for pair in answer.errors.values()), key=np.mean)
    figures = (
        f"error {beside.mean():.3g} with it, {without.mean():.3g} without, after a random action"
    )
    if _beats(beside, without, _ACTIONS_TELL):
        return 0.0, f"the last action tells what no observation does: {figures}"
    return _NOISE, (
        f"the last action tells nothing that the observations do not: {figures}; so the policy "
        "must not learn to repeat it"
    )


def _encode_all(space: spaces.Discrete | spaces.Box, actions: Sequence[FlatAction]) -> Table:
    """Returns the actions as the trainer encodes them: one-hot, or within [-1, 1]."""
    if isinstance(space, spaces.Discrete):
        one_hot: Table = np.eye(int(space.n))[np.asarray(actions, int)]
        return one_hot
    values = np.asarray(actions, np.float64).reshape(len(actions), -1)
    encoded: Table = 2 * (values - space.low) / (space.high - space.low) - 1
    return encoded


def _follows_random(labels: Table, executed: Table) -> NDArray[np.bool_]:
    """Returns at which steps of an episode the action before was not the expert's."""
    differs = np.abs(executed - labels).max(axis=1) > 1e-6
    return np.concatenate([[False], differs[:-1]])


def _inputs(episode: Episode, frames: int) -> Table:
    """Returns the observation and its last changes, [steps, frames * size]."""
    newer = np.asarray(episode.observations[:-1], np.float64)
    columns = [newer]
    for _ in range(1, frames):
        older = np.concatenate([newer[:1], newer[:-1]])
        columns.append(newer - older)
        newer = older
    return np.concatenate(columns, axis=1)


def _before(actions: Table) -> Table:
    return np.concatenate([np.zeros_like(actions[:1]), actions[:-1]])


@dataclass(frozen=True)
class _Question:
    """The labels of all steps [rows, act], the episode of each, and which of them are tested."""

    targets: Table
    of_row: NDArray[np.int64]
    tested: NDArray[np.bool_]
    space: spaces.Discrete | spaces.Box

    def errors(self, inputs: Table) -> Table:
        """Returns the mean error of each episode that has tested steps."""
        errors = np.zeros(len(inputs))
        for half in (0, 1):
            in_half = self.of_row % 2 == half
            at = np.flatnonzero(in_half & self.tested)
            outputs = _fit(inputs, self.targets, np.flatnonzero(~in_half))(inputs[at])
            errors[at] = self._of(outputs, self.targets[at])
        counts = np.bincount(self.of_row, weights=self.tested)
        sums = np.bincount(self.of_row, weights=errors)
        of_episodes: Table = sums[counts > 0] / counts[counts > 0].mean()
        return of_episodes

    def _of(self, outputs: Table, wanted: Table) -> Table:
        if isinstance(self.space, spaces.Discrete):
            return np.asarray(outputs.argmax(axis=1) != wanted.argmax(axis=1), np.float64)
        return np.asarray(np.square(np.clip(outputs, -1, 1) - wanted).mean(axis=1), np.float64)


def _fit(inputs: Table, targets: Table, rows: NDArray[np.int64]) -> Callable[[Table], Table]:
    """Fits a line and random features of the inputs to the targets of some rows."""
    rows = rows[:: -(-len(rows) // _MOST_ROWS)]
    mean, deviation = inputs[rows].mean(axis=0), inputs[rows].std(axis=0)
    deviation[deviation < 1e-6 * np.maximum(1, np.abs(mean))] = 1
    random = np.random.default_rng(0)
    size = inputs.shape[1]
    weight = random.normal(size=(size, _FEATURES)) * _SCALE / np.sqrt(size)
    bias = random.uniform(-2, 2, _FEATURES)

    def features(values: Table) -> Table:
        scaled = (values - mean) / deviation
        one = np.ones((len(values), 1))
        return np.concatenate([scaled, np.tanh(scaled @ weight + bias), one], axis=1)

    fitted = features(inputs[rows])
    normal = fitted.T @ fitted + _RIDGE * len(rows) * np.eye(fitted.shape[1])
    solution = np.linalg.solve(normal, fitted.T @ targets[rows])
    return lambda values: features(values) @ solution
