"""Fits a linear map, perceptrons on a queue of past observations, and gated recurrent units; plays them: memory without attention.

    python lab/recipes/queue_baselines.py popgym:popgym-CountRecallEasy-v0 --data=FOLDER --length=52 --hidden=0,64,256

FOLDER is a dataset that `spikeserve imitate` recorded, such as `OUT/data/expert-v0`; several are joined. The input is the last
LENGTH observations side by side, newest first, 0 where there was none. HIDDEN is the width of two hidden layers; 0 is a linear map.
GRU is the size of a recurrent state, which reads one observation at a time. Actions are Discrete, or a Box.
"""

import argparse
import contextlib
import itertools
import pathlib

import numpy as np
from gru import Gru, GruActor
from gymnasium import spaces
from losses import output_error
from spikeserve.imitation.datasets import read_dataset
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import Choice, play

BATCH, RATE, DECAYS = 256, 2e-3, (0.9, 0.999)  # of Adam; the rate falls to 0 as a cosine
ENVIRONMENTS = 16  # played at once
SMALLEST_DEVIATION = 1e-3  # of a number that hardly changes


def queue_of(observations, length):
    """Returns the input of one decision from the observations of an episode so far: [length * size]."""
    recent = np.asarray(observations[-length:], np.float32)[::-1]
    queue = np.zeros((length, recent.shape[1]), np.float32)
    queue[: len(recent)] = recent
    return queue.ravel()


def read(folders):
    """Returns the observations [steps, size] and the labels, as in losses.py, of all episodes of datasets."""
    return [seen_and_done(episode) for folder in folders for episode in read_dataset(folder)]


def seen_and_done(episode):
    return np.asarray(episode.observations[: episode.steps], np.float32), np.array(episode.labels or episode.actions)


def cut(episodes, steps):
    """Returns clips of at most `steps` steps."""
    return [(seen[i : i + steps], done[i : i + steps]) for seen, done in episodes for i in range(0, len(done), steps)]


def scaling(rows):
    """Returns the mean and the deviation of each column."""
    return rows.mean(0), np.maximum(rows.std(0), SMALLEST_DEVIATION)


def absorb(model, mean, deviation):
    """Makes a model that learned from (x - mean) / deviation read x."""
    weights, offsets = model.first_layer
    weights /= deviation[:, None]
    offsets -= mean @ weights


class Queues:
    """The inputs of all decisions, [decisions, length * size], made as they are asked for: together they may not fit into memory."""

    def __init__(self, episodes, length):
        before = np.zeros((length - 1, episodes[0][0].shape[1]), np.float32)
        rows = np.concatenate([part for seen, _ in episodes for part in (before, seen)])
        self._windows = np.lib.stride_tricks.sliding_window_view(rows, length, axis=0)  # [rows, size, length], oldest first
        firsts = np.cumsum([0, *(len(before) + len(seen) for seen, _ in episodes[:-1])])
        self._starts = np.concatenate([first + np.arange(len(seen)) for first, (seen, _) in zip(firsts, episodes, strict=True)])
        self.size = self._windows.shape[1] * length
        self.mean, self.deviation = np.zeros(self.size, np.float32), np.ones(self.size, np.float32)

    def __getitem__(self, decisions):
        """Returns the inputs of an index or a slice."""
        windows = self._windows[self._starts[decisions]]
        return (windows[:, :, ::-1].transpose(0, 2, 1).reshape(len(windows), -1) - self.mean) / self.deviation

    def standardise(self):
        """Makes every number have mean 0 and deviation 1."""
        ages = range(self._windows.shape[2])
        of_ages = [scaling(self._windows[self._starts, :, -1 - age]) for age in ages]
        self.mean, self.deviation = (np.concatenate(values) for values in zip(*of_ages, strict=True))


class Perceptron:
    """Layers with ReLU between them, trained by Adam on the loss of losses.py."""

    def __init__(self, sizes, seed):
        self._random = np.random.default_rng(seed)
        self._layers = []
        for inputs, outputs in itertools.pairwise(sizes):
            scale = np.sqrt(2 / inputs)
            weight = self._random.normal(0, scale, (inputs, outputs)).astype(np.float32)
            self._layers += [weight, np.zeros(outputs, np.float32)]
        self._moments = [(np.zeros_like(p), np.zeros_like(p)) for p in self._layers]

    @property
    def multiplications(self):
        return sum(p.size for p in self._layers[::2])

    @property
    def first_layer(self):
        """Returns the weights that act on an input, [inputs, outputs], and their offsets."""
        return self._layers[0], self._layers[1]

    def outputs(self, inputs):
        """Returns what every layer reads, the inputs first, and the outputs."""
        values = [inputs]
        for i in range(0, len(self._layers), 2):
            if i:
                values[-1] = np.maximum(values[-1], 0)
            values.append(values[-1] @ self._layers[i] + self._layers[i + 1])
        return values

    def train(self, inputs, labels, epochs):
        """Makes `epochs` passes over the data, in random draws."""
        steps = max(1, round(epochs * len(labels) / BATCH))
        for step in range(steps):
            chosen = self._random.integers(0, len(labels), BATCH)
            values = self.outputs(inputs[chosen])
            _, error = output_error(values[-1], labels[chosen], np.ones(BATCH, np.float32))
            self._descend(values, error, step, RATE / 2 * (1 + np.cos(np.pi * step / steps)))

    def _descend(self, values, error, step, rate):
        gradients = []
        for i in reversed(range(0, len(self._layers), 2)):
            value = values[i // 2]
            gradients = [value.T @ error, error.sum(0), *gradients]
            error = (error @ self._layers[i].T) * (value > 0)
        for p, g, (m, v) in zip(self._layers, gradients, self._moments, strict=True):
            m += (1 - DECAYS[0]) * (g - m)
            v += (1 - DECAYS[1]) * (g * g - v)
            corrected = np.sqrt(v / (1 - DECAYS[1] ** (step + 1))) + 1e-8
            p -= rate * (m / (1 - DECAYS[0] ** (step + 1))) / corrected


class QueueActor:
    """Plays a model. `choice` makes a choice from the outputs of one row."""

    def __init__(self, model, length, choice):
        self._model, self._length, self._choice = model, length, choice

    def choose(self, rows):
        queues = np.stack([queue_of(row.episode.observations, self._length) for row in rows])
        return [self._choice(outputs) for outputs in self._model.outputs(queues)[-1]]

    def end(self, row):
        pass


def choice_of(space):
    """Returns a function that makes a choice from the outputs of one row."""
    if isinstance(space, spaces.Discrete):
        return lambda outputs: Choice(int(outputs.argmax()))
    return lambda outputs: Choice(np.clip(outputs, space.low, space.high).astype(np.float32))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env_id", help="as `spikeserve imitate` takes it")
    parser.add_argument("--data", required=True, type=pathlib.Path, action="append", help="may be repeated")
    parser.add_argument("--length", required=True, type=int)
    parser.add_argument("--hidden", default="0,64,256", help="widths; empty: none")
    parser.add_argument("--gru", default="", help="sizes of recurrent states; empty: none")
    parser.add_argument("--epochs", default=40, type=int)
    parser.add_argument("--gru_epochs", default=100, type=int)
    parser.add_argument("--standardise", action="store_true", help="learn from numbers with mean 0 and deviation 1")
    parser.add_argument("--clip", default=10_000, type=int, help="most steps of an episode from which a unit learns at once")
    parser.add_argument("--episodes", default=300, type=int)
    parser.add_argument("--seed", default=2_000_000, type=int, help="first start to play")
    arguments = parser.parse_args()
    episodes = read(arguments.data)
    factory = EnvironmentFactory(arguments.env_id)
    with contextlib.closing(factory.make()) as environment:
        space = environment.action_space
    choice = choice_of(space)
    actions = int(space.n if isinstance(space, spaces.Discrete) else space.shape[0])

    def report(name, actor, multiplications):
        seeds = iter(range(arguments.seed, arguments.seed + arguments.episodes))
        returns = [e.episode_return for e in play(factory.make, actor, seeds, ENVIRONMENTS)]
        print(f"{name}: return {np.mean(returns):.3f} ± {np.std(returns):.3f}, {multiplications} multiplications", flush=True)

    numbers = episodes[0][0].shape[1]
    mean, deviation = np.zeros(numbers, np.float32), np.ones(numbers, np.float32)
    if arguments.standardise:
        mean, deviation = scaling(np.concatenate([seen for seen, _ in episodes]))
    clips = cut([((seen - mean) / deviation, done) for seen, done in episodes], arguments.clip)
    for size in sizes(arguments.gru):
        unit = Gru(numbers, size, actions, seed=0)
        unit.train(clips, arguments.gru_epochs)
        absorb(unit, mean, deviation)
        report(f"unit of {size}", GruActor(unit, choice), unit.multiplications)
    if not arguments.hidden:
        return
    inputs, labels = Queues(episodes, arguments.length), np.concatenate([labels for _, labels in episodes])
    if arguments.standardise:
        inputs.standardise()
    for hidden in sizes(arguments.hidden):
        model = Perceptron([inputs.size, *([hidden] * 2 if hidden else []), actions], seed=0)
        model.train(inputs, labels, arguments.epochs)
        fit = fit_of(model.outputs(inputs[:20000])[-1], labels[:20000])
        absorb(model, inputs.mean, inputs.deviation)
        report(f"hidden {hidden}, {fit}", QueueActor(model, arguments.length, choice), model.multiplications)


def fit_of(outputs, labels):
    if np.issubdtype(labels.dtype, np.floating):
        return f"squared error {((outputs - labels) ** 2).sum(1).mean():.3g}"
    return f"{(outputs.argmax(1) == labels).mean():.1%} of the labels"


def sizes(text):
    return [int(size) for size in text.split(",") if size]


if __name__ == "__main__":
    main()
