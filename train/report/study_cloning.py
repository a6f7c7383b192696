"""Models without attention that imitate a dataset: perceptrons on one observation, and a gated recurrent unit."""

import numpy as np
from gru import Gru, GruActor
from queue_baselines import Perceptron, QueueActor
from spikeserve.imitation.datasets import read_dataset
from spikeserve.imitation.episodes import Choice

CLIP = 50  # steps of an episode from which a recurrent unit learns at once
SMALLEST_DEVIATION = 1e-3  # of an observed number that hardly changes


def fit(clone, data, seed, budget):
    """Fits a model to the dataset of a folder. Returns an actor, and the multiplications of a decision."""
    episodes = [
        (np.asarray(e.observations[: e.steps], np.float32), np.asarray(e.actions, np.float32))
        for e in best(list(read_dataset(data)), clone.best)
    ]
    seen = np.concatenate([observations for observations, _ in episodes])
    mean, deviation = seen.mean(0), np.maximum(seen.std(0), SMALLEST_DEVIATION)
    episodes = [((observations - mean) / deviation, actions) for observations, actions in episodes]
    model = fit_unit(clone, episodes, seed, budget) if clone.recurrent else fit_perceptron(clone, episodes, seed, budget)
    # The model learned from observations with mean 0 and deviation 1. Its first weights absorb both.
    weights, offsets = model.first_layer
    weights /= deviation[:, None]
    offsets -= mean @ weights
    actor = GruActor(model, action) if clone.recurrent else QueueActor(model, 1, action)
    return actor, model.multiplications


def best(episodes, share):
    """Returns the share of the episodes that has the highest returns."""
    ordered = sorted(episodes, key=lambda episode: -episode.episode_return)
    return ordered[: max(1, round(share * len(ordered)))]


def fit_perceptron(clone, episodes, seed, budget):
    inputs, labels = (np.concatenate(values) for values in zip(*episodes, strict=True))
    model = Perceptron([inputs.shape[1], clone.hidden, clone.hidden, labels.shape[1]], seed)
    model.train(inputs, labels, budget.epochs / clone.best)  # as many steps whatever the share
    return model


def fit_unit(clone, episodes, seed, budget):
    clips = [
        (observations[start : start + CLIP], actions[start : start + CLIP])
        for observations, actions in episodes
        for start in range(0, len(actions), CLIP)
    ]
    unit = Gru(clips[0][0].shape[1], clone.hidden, clips[0][1].shape[1], seed)
    unit.train(clips, budget.epochs)
    return unit


def action(outputs):
    """Returns the action of a Box from -1 to 1."""
    return Choice(np.clip(outputs, -1, 1).astype(np.float32))
