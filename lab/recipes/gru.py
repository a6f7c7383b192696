"""A gated recurrent unit in NumPy, trained by backpropagation through whole episodes: the smallest memory without attention.

K. Cho et al., "Learning phrase representations using RNN encoder-decoder", EMNLP 2014; the reset gate acts on U h, as in cuDNN.
"""

import numpy as np
from losses import output_error

BATCH, RATE, DECAYS = 32, 3e-3, (0.9, 0.999)  # episodes; of Adam, whose rate falls to 0 as a cosine
LARGEST_GRADIENT = 1.0  # norm of all gradients together


def sigmoid(x):
    return 1 / (1 + np.exp(-np.clip(x, -30, 30)))


class Gru:
    """h <- z h + (1 - z) tanh(W x + r (U h)); z, r = sigmoid(W x + U h + b); outputs = V h + c.

    `inputs`, `hidden` and `outputs` are sizes. Columns are those of z, r and the candidate, side by side.
    """

    def __init__(self, inputs, hidden, outputs, seed):
        self._random = np.random.default_rng(seed)
        self._hidden = hidden
        shapes = {
            "w": (inputs, 3 * hidden),
            "u": (hidden, 3 * hidden),
            "b": (3 * hidden,),
            "v": (hidden, outputs),
            "c": (outputs,),
        }
        self.parameters = {name: self._random.normal(0, hidden**-0.5, shape).astype(np.float32) for name, shape in shapes.items()}
        self.parameters["b"][:], self.parameters["c"][:] = 0, 0
        self.parameters["b"][:hidden] = 1  # remembers at first
        self._moments = {name: (np.zeros_like(p), np.zeros_like(p)) for name, p in self.parameters.items()}

    @property
    def multiplications(self):
        """Returns the number of a step."""
        return sum(self.parameters[name].size for name in "wuv") + 3 * self._hidden

    @property
    def first_layer(self):
        """Returns the weights that act on an observation, [inputs, outputs], and their offsets."""
        return self.parameters["w"], self.parameters["b"]

    def first_state(self, rows):
        return np.zeros((rows, self._hidden), np.float32)

    def step(self, drive, h):
        """Returns the gates, the candidate, U h of the candidate, and the next state. `drive` is W x + b."""
        size = self._hidden
        inner = h @ self.parameters["u"]
        gates = sigmoid(drive[:, : 2 * size] + inner[:, : 2 * size])
        z, r = gates[:, :size], gates[:, size:]
        candidate = np.tanh(drive[:, 2 * size :] + r * inner[:, 2 * size :])
        return z, r, candidate, inner[:, 2 * size :], z * h + (1 - z) * candidate

    def outputs(self, observations, h):
        """Returns the outputs of one step, [rows, outputs], and the next state."""
        h = self.step(observations @ self.parameters["w"] + self.parameters["b"], h)[-1]
        return h @ self.parameters["v"] + self.parameters["c"], h

    def gradients(self, inputs, labels, weights):
        """Returns the mean loss and its gradients. `inputs` are [steps, rows, inputs], labels and weights as in losses.py."""
        p = self.parameters
        drive = inputs @ p["w"] + p["b"]
        states, tape = [self.first_state(inputs.shape[1])], []
        for x in drive:
            *values, h = self.step(x, states[-1])
            tape.append(values)
            states.append(h)
        after = np.stack(states[1:])
        loss, error = output_error(after @ p["v"] + p["c"], labels, weights)
        of_states = error @ p["v"].T
        of_drive, of_inner = np.empty_like(drive), np.empty_like(drive)
        back = np.zeros_like(states[0])
        for t in reversed(range(len(drive))):
            z, r, candidate, inner = tape[t]
            back = back + of_states[t]
            of_candidate = back * (1 - z) * (1 - candidate**2)
            of_gates = np.concatenate([back * (states[t] - candidate) * z * (1 - z), of_candidate * inner * r * (1 - r)], 1)
            of_drive[t] = np.concatenate([of_gates, of_candidate], 1)
            of_inner[t] = np.concatenate([of_gates, of_candidate * r], 1)
            back = back * z + of_inner[t] @ p["u"].T
        flat = lambda values: values.reshape(-1, values.shape[-1])  # noqa: E731
        return loss, {
            "w": flat(inputs).T @ flat(of_drive),
            "b": flat(of_drive).sum(0),
            "u": flat(np.stack(states[:-1])).T @ flat(of_inner),
            "v": flat(after).T @ flat(error),
            "c": flat(error).sum(0),
        }

    def train(self, episodes, epochs):
        """Makes `epochs` passes over episodes, each the observations [steps, inputs] and the labels, in random draws."""
        steps = max(1, round(epochs * len(episodes) / BATCH))
        for step in range(steps):
            chosen = [episodes[i] for i in self._random.integers(0, len(episodes), BATCH)]
            longest = max(len(labels) for _, labels in chosen)
            inputs = np.zeros((longest, BATCH, chosen[0][0].shape[1]), np.float32)
            of_one = chosen[0][1]
            labels = np.zeros((longest, BATCH, *of_one.shape[1:]), of_one.dtype)
            weights = np.zeros((longest, BATCH), np.float32)
            for row, (seen, answers) in enumerate(chosen):
                inputs[: len(seen), row], labels[: len(seen), row], weights[: len(seen), row] = seen, answers, 1
            _, gradients = self.gradients(inputs, labels, weights)
            self._descend(gradients, step, RATE / 2 * (1 + np.cos(np.pi * step / steps)))

    def _descend(self, gradients, step, rate):
        norm = np.sqrt(sum(float((g**2).sum()) for g in gradients.values()))
        for name, g in gradients.items():
            m, v = self._moments[name]
            g = g * min(1.0, LARGEST_GRADIENT / (norm + 1e-12))
            m += (1 - DECAYS[0]) * (g - m)
            v += (1 - DECAYS[1]) * (g * g - v)
            corrected = np.sqrt(v / (1 - DECAYS[1] ** (step + 1))) + 1e-8
            self.parameters[name] -= (rate / (1 - DECAYS[0] ** (step + 1)) * m / corrected).astype(np.float32)


class GruActor:
    """Plays a unit, with a state for each running episode. `choice` makes a choice from the outputs of one row."""

    def __init__(self, unit, choice):
        self._unit, self._choice, self._states = unit, choice, {}

    def choose(self, rows):
        states = np.concatenate([self._states.get(row.index, self._unit.first_state(1)) for row in rows])
        observations = np.stack([np.asarray(row.episode.observations[-1], np.float32) for row in rows])
        outputs, states = self._unit.outputs(observations, states)
        self._states |= {row.index: state[None] for row, state in zip(rows, states, strict=True)}
        return [self._choice(values) for values in outputs]

    def end(self, row):
        self._states.pop(row.index, None)
