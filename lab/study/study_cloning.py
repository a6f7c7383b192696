"""Models without attention that imitate a dataset: lines and perceptrons on a queue of observations, gated recurrent units."""

import numpy as np
from gru import Gru, GruActor
from gymnasium import spaces
from queue_baselines import Perceptron, QueueActor, Queues, absorb, choice_of, cut, scaling, seen_and_done
from spikeserve.imitation.datasets import read_dataset


def fit(clone, how, data, seed, share, space):
    """Fits a model to the dataset of a folder. Returns its actor, and the multiplications of a decision.

    `how` is a study_tasks.Cloning, of whose epochs a share is made; `space` is that of the actions, a Discrete or a Box.
    """
    episodes = [seen_and_done(episode) for episode in best(list(read_dataset(data)), clone.best)]
    outputs = int(space.n if isinstance(space, spaces.Discrete) else space.shape[0])
    if clone.recurrent:
        unit = fit_unit(clone, how, episodes, outputs, seed, share)
        return GruActor(unit, choice_of(space)), unit.multiplications
    model = fit_perceptron(clone, how, episodes, outputs, seed, share)
    return QueueActor(model, how.queue, choice_of(space)), model.multiplications


def best(episodes, share):
    """Returns the share of the episodes that has the highest returns."""
    ordered = sorted(episodes, key=lambda episode: -episode.episode_return)
    return ordered[: max(1, round(share * len(ordered)))]


def fit_perceptron(clone, how, episodes, outputs, seed, share):
    inputs, labels = Queues(episodes, how.queue), np.concatenate([done for _, done in episodes])
    if how.standardised:
        inputs.standardise()
    model = Perceptron([inputs.size, *([clone.hidden] * 2 if clone.hidden else []), outputs], seed)
    model.train(inputs, labels, share * how.epochs / clone.best)  # as many steps whatever the share of the episodes
    absorb(model, inputs.mean, inputs.deviation)
    return model


def fit_unit(clone, how, episodes, outputs, seed, share):
    numbers = episodes[0][0].shape[1]
    mean, deviation = np.zeros(numbers, np.float32), np.ones(numbers, np.float32)
    if how.standardised:
        mean, deviation = scaling(np.concatenate([seen for seen, _ in episodes]))
    clips = cut([((seen - mean) / deviation, done) for seen, done in episodes], how.clip)
    unit = Gru(numbers, clone.hidden, outputs, seed)
    unit.train(clips, share * how.recurrent_epochs)
    absorb(unit, mean, deviation)
    return unit
