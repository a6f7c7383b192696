"""Models without attention that imitate a dataset: perceptrons on one observation, and a gated recurrent unit."""

import numpy as np
from gru import Gru, GruActor
from queue_baselines import Perceptron, QueueActor, absorb, choice_of, cut, scaling, seen_and_done
from spikeserve.imitation.datasets import read_dataset

CLIP = 50  # steps of an episode from which a recurrent unit learns at once


def fit(clone, data, seed, budget, space):
    """Fits a model to the dataset of a folder. Returns an actor for a Box of actions, and the multiplications of a decision."""
    episodes = [seen_and_done(episode) for episode in best(list(read_dataset(data)), clone.best)]
    mean, deviation = scaling(np.concatenate([seen for seen, _ in episodes]))
    episodes = [((seen - mean) / deviation, done) for seen, done in episodes]
    model = fit_unit(clone, episodes, seed, budget) if clone.recurrent else fit_perceptron(clone, episodes, seed, budget)
    absorb(model, mean, deviation)
    actor = GruActor(model, choice_of(space)) if clone.recurrent else QueueActor(model, 1, choice_of(space))
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
    clips = cut(episodes, CLIP)
    unit = Gru(clips[0][0].shape[1], clone.hidden, clips[0][1].shape[1], seed)
    unit.train(clips, budget.epochs)
    return unit
