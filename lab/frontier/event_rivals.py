"""Small models in 8 bits that read events: pruned perceptrons and gated recurrent units, with what a decision of theirs costs.

A zero activation is skipped: neither its products nor its weights count. Prices are those of docs/reference/energy.md, with
memory by the smallest SRAM that holds all weights. Where that page has no price, a rival pays more rather than less: an output
of a map is scaled to 8 bits (a 16-bit product, a 32-bit addition), a sigmoid or tanh costs a term of a softmax, a weight of a
pruned matrix has an index of a byte, and a row of one has a pointer of two.
"""

from dataclasses import dataclass

import numpy as np
from gru import Gru, sigmoid
from queue_baselines import Perceptron

MULTIPLY_ACCUMULATE, SCALING, SOFTMAX_TERM, ADDITION, COMPARISON = 0.23, 0.9, 1.15, 0.1, 0.05  # picojoules
LARGEST = 127  # of 8 bits


def sram_price(size):
    """Returns the picojoules of a byte of the smallest memory with `size` bytes."""
    return next((price for largest, price in ((8192, 1.25), (32768, 2.5)) if size <= largest), 12.5)


@dataclass
class Cost:
    """What decisions cost, in picojoules: without memory, of memory, and the part of it that inputs of 0 could save."""

    arithmetic: float = 0.0
    memory: float = 0.0
    idle_inputs: float = 0.0
    spikes: int = 0


class Pruned:
    """Sets the smallest weights of each matrix to 0 and keeps them there while training continues."""

    def prune(self, share):
        self.masks = [np.abs(matrix) >= np.quantile(np.abs(matrix), share) for matrix in self.matrices]

    def _descend(self, *arguments):
        super()._descend(*arguments)
        for matrix, mask in zip(self.matrices, self.masks, strict=True):
            matrix *= mask


class PrunedPerceptron(Pruned, Perceptron):
    matrices = property(lambda self: self._layers[::2])
    arrays = property(lambda self: self._layers)


class PrunedGru(Pruned, Gru):
    matrices = property(lambda self: [self.parameters[name] for name in "wuv"])
    arrays = property(lambda self: [self.parameters[name] for name in "wbuvc"])


class Map:
    """A matrix in 8 bits, one scale for each output, which skips zero activations."""

    def __init__(self, weights, offsets):
        scale = np.maximum(np.abs(weights).max(0), 1e-12) / LARGEST
        self._weights, self._offsets = np.round(weights / scale) * scale, offsets
        self._row_sizes = np.count_nonzero(self._weights, axis=1)
        self._pruned = self._row_sizes.sum() < 0.9 * weights.size
        stored = 2 * self._row_sizes.sum() + 2 * len(weights) if self._pruned else weights.size
        self.bytes = int(stored) + 2 * len(offsets)

    def __call__(self, inputs, cost, price):
        """Returns the outputs of one vector, and adds its cost. `price` is that of a byte of weights."""
        rows = np.flatnonzero(inputs)
        products, outputs = int(self._row_sizes[rows].sum()), len(self._offsets)
        cost.arithmetic += products * MULTIPLY_ACCUMULATE + outputs * (ADDITION + SCALING)
        cost.memory += price * ((2 * products + 2 * len(rows) if self._pruned else products) + 2 * outputs)
        return inputs[rows] @ self._weights[rows] + self._offsets


def rounded(values, largest=1.0):
    """Returns values in 8 bits, of which `largest` is the largest."""
    return np.round(np.clip(values / largest, -1, 1) * LARGEST) * (largest / LARGEST)


class EventPerceptron:
    """Plays a perceptron that reads the sum of the events of each pixel, a memory made by hand, and all other inputs.

    `largest` are those of its hidden activations.
    """

    def __init__(self, layers, largest, pixels):
        self._maps, self._largest = [Map(*layers[i : i + 2]) for i in range(0, len(layers), 2)], largest
        self.bytes, self._pixels = sum(each.bytes for each in self._maps), pixels

    def begin(self):
        self._sums = np.zeros(self._pixels)

    def act(self, observation, _reward, cost):
        events = observation[: self._pixels]
        self._sums = self._sums + events
        cost.arithmetic += np.count_nonzero(events) * ADDITION
        # All sums are read; those that change are read and written before.
        cost.memory += (self._pixels + 2 * np.count_nonzero(events)) * sram_price(self._pixels)
        values = np.concatenate([self._sums, observation[self._pixels :]])
        for i, each in enumerate(self._maps):
            if i:
                values = rounded(np.maximum(values, 0), self._largest[i - 1])
                cost.arithmetic += len(values) * COMPARISON
            values = each(values, cost, sram_price(self.bytes))
        return int(values.argmax())


class EventGru:
    """Plays a unit with a state of 8 bits."""

    def __init__(self, w, b, u, v, c):
        self._input, self._inner, self._output = Map(w, b), Map(u, np.zeros_like(b)), Map(v, c)
        self.bytes, self._size = self._input.bytes + self._inner.bytes + self._output.bytes, len(u)

    def begin(self):
        self._state = np.zeros(self._size)

    def act(self, observation, _reward, cost):
        price, size = sram_price(self.bytes), self._size
        drive, inner = self._input(observation, cost, price), self._inner(self._state, cost, price)
        z, r = np.split(rounded(sigmoid(drive[: 2 * size] + inner[: 2 * size])), 2)
        candidate = rounded(np.tanh(drive[2 * size :] + r * inner[2 * size :]))
        self._state = rounded(z * self._state + (1 - z) * candidate)
        cost.arithmetic += 3 * size * (SOFTMAX_TERM + MULTIPLY_ACCUMULATE)
        cost.memory += 2 * size * sram_price(size)  # reads and writes the state
        return int(self._output(self._state, cost, price).argmax())
