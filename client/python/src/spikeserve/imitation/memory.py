"""Chooses how far back a policy looks and how it is trained, by what recorded data say.

The data are asked with small regressions: a line and random features of the last observations, with
and without the last action. What matters is the error at the steps after a random action, where
the expert cannot be imitated by repeating what it did before.
"""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from spikeserve.imitation.baselines import LARGEST_COMPARED
from spikeserve.imitation.datasets import read_dataset
from spikeserve.imitation.episodes import Episode, FlatAction
from spikeserve.imitation.options import ImitationOptions

_FRAMES = (1, 2, 4, 8, 16)
_MOST_INPUTS = 256
_MOST_ROWS = 20_000
_FEATURES = 256
_RIDGE = 1e-6  # relative to the number of rows
_HELD_OUT = 5  # every fifth episode
_BETTER = 0.8  # a longer memory has to reach this share of a shorter one's error
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
            context, reason = _context(answer, options.lookback)
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
    """Errors by the number of observations, without and with the last action."""

    errors: dict[int, tuple[float, float]]
    disturbed: bool  # the errors are those of the steps after a random action


def ask(episodes: Sequence[Episode], space: spaces.Discrete | spaces.Box) -> Answer | None:
    """Returns how well the expert's actions follow from the last observations.

    None if the observations are too large or there are too few episodes.
    """
    size = episodes[0].observations[0].size
    if size > LARGEST_COMPARED or len(episodes) < 2 * _HELD_OUT:
        return None
    labels = [_encode_all(space, episode.labels or episode.actions) for episode in episodes]
    executed = [_encode_all(space, episode.actions) for episode in episodes]
    held_out = np.repeat(np.arange(len(episodes)) % _HELD_OUT == 0, [len(x) for x in labels])
    random = [_follows_random(*pair) for pair in zip(labels, executed, strict=True)]
    tested = held_out & np.concatenate(random)
    disturbed = int(tested.sum()) >= 50
    targets = np.concatenate(labels)
    errors = {}
    for frames in _FRAMES:
        if frames > 1 and frames * size > _MOST_INPUTS:
            break
        inputs = np.concatenate([_inputs(episode, frames) for episode in episodes])
        last = np.concatenate([_before(actions) for actions in executed])
        both = np.concatenate([inputs, last], axis=1)
        rows = tested if disturbed else held_out
        errors[frames] = (
            _error(inputs, targets, held_out, rows, space),
            _error(both, targets, held_out, rows, space),
        )
    return Answer(errors, disturbed)


def _context(answer: Answer | None, lookback: int | None) -> tuple[int, str]:
    least = 2 if lookback is None else lookback + 1
    if answer is None:
        return max(_CONTEXT, least), "the data are not asked"
    errors = {frames: min(pair) for frames, pair in answer.errors.items()}
    frames = 1
    for longer, error in errors.items():
        if error < _BETTER * errors[frames]:
            frames = longer
    where = " after a random action" if answer.disturbed else ""
    listed = ", ".join(f"{count}: {error:.3g}" for count, error in errors.items())
    return max(frames + 1, least), (
        f"observations with which the expert's action follows best{where}, and one more. Errors "
        f"by their number: {listed}"
    )


def _action_noise(answer: Answer | None) -> tuple[float, str]:
    if answer is None or not answer.disturbed:
        return _NOISE, "so that the policy does not learn to repeat its last action"
    without = min(pair[0] for pair in answer.errors.values())
    beside = min(pair[1] for pair in answer.errors.values())
    if beside < _ACTIONS_TELL * without:
        return 0.0, (
            f"the last action tells what no observation does: error {beside:.3g} with it, "
            f"{without:.3g} without, after a random action"
        )
    return _NOISE, (
        f"the last action tells nothing that the observations do not: error {beside:.3g} with it, "
        f"{without:.3g} without, after a random action; so the policy must not learn to repeat it"
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


def _error(
    inputs: Table,
    targets: Table,
    held_out: NDArray[np.bool_],
    tested: NDArray[np.bool_],
    space: spaces.Discrete | spaces.Box,
) -> float:
    """Returns the error on the tested rows of a regression on the rows that are not held out."""
    rows = np.flatnonzero(~held_out)
    if len(rows) > _MOST_ROWS:
        rows = rows[:: -(-len(rows) // _MOST_ROWS)]
    mean, deviation = inputs[rows].mean(axis=0), inputs[rows].std(axis=0)
    deviation[deviation < 1e-6 * np.maximum(1, np.abs(mean))] = 1
    random = np.random.default_rng(0)
    size = inputs.shape[1]
    weight = random.normal(size=(size, _FEATURES)) * 1.5 / np.sqrt(size)
    bias = random.uniform(-2, 2, _FEATURES)

    def features(at: NDArray[np.int64]) -> Table:
        scaled = (inputs[at] - mean) / deviation
        return np.concatenate(
            [scaled, np.tanh(scaled @ weight + bias), np.ones((len(at), 1))], axis=1
        )

    fitted = features(rows)
    normal = fitted.T @ fitted + _RIDGE * len(rows) * np.eye(fitted.shape[1])
    solution = np.linalg.solve(normal, fitted.T @ targets[rows])
    at = np.flatnonzero(tested)
    outputs, wanted = features(at) @ solution, targets[at]
    if isinstance(space, spaces.Discrete):
        return float(np.mean(outputs.argmax(axis=1) != wanted.argmax(axis=1)))
    return float(np.mean(np.square(np.clip(outputs, -1, 1) - wanted)))
