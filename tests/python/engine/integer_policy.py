"""Computes the decisions of an integer policy with NumPy only, from the definition of the model.

Spike-driven parts are in integers: weights and biases in units of a scale, 16-bit membranes. The other parts are in
float32 and add in the order that the engines define: affine maps from the bias on, by ascending input; LayerNorm in 16
interleaved partial sums. The spikes therefore equal those of the server one by one.
"""

import json
import math

import numpy as np

EPSILON = np.float32(1e-5)
KINDS = ("return", "state", "action")


def affine(weight, bias, x):
    total = bias.copy()
    for j in np.flatnonzero(x):
        total += weight[:, j] * x[j]
    return total


def ordered_sum(values):
    partial = np.zeros(16, np.float32)
    for i in range(0, len(values), 16):
        part = values[i : i + 16]
        partial[: len(part)] += part
    for half in (8, 4, 2, 1):
        partial[:half] += partial[half : 2 * half]
    return partial[0]


def layer_norm(x, weight, bias):
    size = np.float32(len(x))
    centred = x - ordered_sum(x) / size
    variance = ordered_sum(centred * centred) / size
    inverse = np.float32(1) / np.sqrt(variance + EPSILON)
    return centred * inverse * weight + bias


def exp(x):
    """Returns e^x in float32, by the polynomial of Cephes' expf."""
    x = np.clip(np.float32(x), np.float32(-87), np.float32(88))
    shift = np.float32(12582912)
    n = (x * np.float32(1.44269504088896341) + shift) - shift
    x = x - n * np.float32(0.693359375)
    x = x - n * np.float32(-2.12194440e-4)
    y = np.float32(1.9875691500e-4)
    for coefficient in (
        1.3981999507e-3,
        8.3334519073e-3,
        4.1665795894e-2,
        1.6666665459e-1,
        5.0000001201e-1,
    ):
        y = y * x + np.float32(coefficient)
    y = y * (x * x) + x + np.float32(1)
    return y * np.ldexp(np.float32(1), np.int32(n))


class IntegerPolicy:
    """One episode of an integer policy with rate coders and, if it has routing, softmax gates."""

    def __init__(self, tensors, metadata):
        self.tensors = tensors
        self.config = json.loads(metadata["config"])
        expected = {
            "coder": "lif",
            "gate": "softmax",
            "arithmetic": "int8",
        }
        assert expected.items() <= self.config.items()
        self.offset, self.scale = (np.float32(metadata[f"return_{name}"]) for name in ("offset", "scale"))
        self.ticks, self.heads = self.config["ticks"], self.config["heads"]
        self.head_size = self.config["hidden_size"] // self.heads
        self.decay = np.float32(self.config["membrane_decay"])
        self.integer_decay = round(float(self.decay) * 32768)
        self.timestep = 0
        self.previous = None  # the last observation
        self.caches = [[] for _ in range(self.config["layers"])]  # (timestep, keys, values) by layer
        self.spikes = {}

    def decide(self, return_to_go, observation, last_action):
        """Returns the spikes of one decision by stage. `last_action` is encoded; None at the first step."""
        self.spikes = {}
        if last_action is not None:
            self._token("action", np.asarray(last_action, np.float32))
            self.timestep += 1
        self._count("phase", self._phase())
        self._token("return", np.array([(np.float32(return_to_go) - self.offset) / self.scale]))
        x = self._token("state", self._state(np.asarray(observation, np.float32)))
        self._count("readout", self._code("readout.coder", x))
        return self.spikes

    def _state(self, observation):
        """Returns the input of the state token: the observation and, if the policy uses it, its change."""
        state = (observation - self.tensors["observation.mean"]) / self.tensors["observation.std"]
        if self.config.get("observation_changes"):
            previous = observation if self.previous is None else self.previous
            state = np.concatenate([state, (observation - previous) / self.tensors["observation.change_std"]])
        self.previous = observation
        return state

    def _count(self, stage, spikes):
        self.spikes[stage] = self.spikes.get(stage, 0) + int(spikes.sum())

    def _affine(self, name, x):
        return affine(self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"], x)

    def _norm(self, name, x):
        if self.config.get("norm") == "none":
            return x
        return layer_norm(x, self.tensors[f"{name}.weight"], self.tensors[f"{name}.bias"])

    def _phase(self):
        """Returns the phase spikes of the timestep, [T][H]."""
        if self.config["mode"] not in ("pos", "full"):
            return np.zeros((self.ticks, 0), bool)
        window = self.config["phase_clock"] == "window"
        tau = np.arange(self.ticks) + 1.0 if window else self.timestep + np.arange(self.ticks) / self.ticks
        omega, phi = (self.tensors[f"phase.{name}"].astype(float) for name in ("omega", "phi"))
        turns = (omega * tau[:, None] + phi) / (2 * math.pi)
        fraction = turns - np.floor(turns)
        return (fraction > 0) & (fraction < 0.5)

    def _code(self, name, x):
        """Returns the spikes of LIF neurons under a constant float32 current, [T][d]."""
        current = x * self.tensors[f"{name}.gain"] + self.tensors[f"{name}.bias"]
        membrane = np.zeros_like(current)
        spikes = np.zeros((self.ticks, len(x)), bool)
        for tick in range(self.ticks):
            membrane = self.decay * membrane + current
            spikes[tick] = membrane >= np.float32(self.config["threshold"])
            membrane[spikes[tick]] = 0
        return spikes

    def _fire(self, name, inputs):
        """Returns the spikes of integer LIF neurons that receive the spikes `inputs`, [T][out]."""
        weight, bias, threshold = (
            self.tensors[f"{name}.{part}"].astype(np.int64) for part in ("weight", "bias", "threshold")
        )
        membrane = np.zeros_like(bias)
        spikes = np.zeros((self.ticks, len(bias)), bool)
        for tick in range(self.ticks):
            current = bias + weight @ inputs[tick].astype(np.int64)
            assert np.abs(current).max() <= 32767
            leaked = (self.integer_decay * membrane + 16384) >> 15
            membrane = np.clip(leaked + current, -32768, 32767)
            spikes[tick] = membrane >= threshold
            membrane[spikes[tick]] = 0
        return spikes

    def _token(self, kind, inputs):
        x = self._norm(
            f"embed.{kind}.norm",
            self._affine(f"embed.{kind}", inputs.astype(np.float32)),
        )
        for layer in range(self.config["layers"]):
            name = f"layers.{layer}"
            coded = self._code(f"{name}.coder", x)
            self._count("coder", coded)
            inputs = np.concatenate([coded, self._phase()], axis=1)
            keys = self._fire(f"{name}.attention.key", inputs)
            values = self._fire(f"{name}.attention.value", inputs)
            self._count("key", keys)
            self._count("value", values)
            self.caches[layer].append((self.timestep, keys, values))
            if layer + 1 == self.config["layers"] and kind != "state":
                return None
            query = self._fire(f"{name}.attention.query", inputs)
            self._count("query", query)
            update = self._affine(f"{name}.attention.output", self._attend(layer, query))
            x = self._norm(f"{name}.attention.norm", x + update)
            x = self._norm(f"{name}.ffn.norm", x + self._feed_forward(f"{name}.ffn", x))
        return x

    def _attend(self, layer, query):
        first = self.timestep - self.config["context"]
        band = [(keys, values) for timestep, keys, values in self.caches[layer] if timestep > first]
        keys, values = (np.stack(part) for part in zip(*band, strict=True))  # [tokens][T][d]
        scale = self.tensors[f"layers.{layer}.attention.scale"]
        concat = self.config["merge"] == "concat"
        merged = np.zeros(self.head_size * (self.heads if concat else 1), np.float32)
        for tick in range(self.ticks):
            y = []
            for head in range(self.heads):
                part = slice(head * self.head_size, (head + 1) * self.head_size)
                overlaps = (keys[:, tick, part] & query[tick, part]).sum(axis=1)
                if self.config.get("relative_bias"):
                    relative = self.tensors[f"layers.{layer}.attention.relative"][head]
                    y.append(self._attend_biased(overlaps, values[:, tick, part], scale[head], relative))
                    continue
                y.append(self._attend_head(overlaps, values[:, tick, part], scale[head]))
            gated = self._gates(layer, np.concatenate(y))[:, None] * np.stack(y)
            merged += gated.ravel() if concat else sum(gated)
        return merged / np.float32(self.ticks)

    def _attend_head(self, overlaps, values, scale):
        best = overlaps.max() if scale >= 0 else overlaps.min()
        distances = np.abs(overlaps - best)
        y, total = np.zeros(self.head_size, np.float32), np.float32(0)
        for distance in np.unique(distances):
            members = distances == distance
            weight = exp(-np.abs(scale) * np.float32(distance))
            total += weight * np.float32(members.sum())
            y += weight * values[members].sum(axis=0).astype(np.float32)
        return y * (np.float32(1) / total)

    def _attend_biased(self, overlaps, values, scale, relative):
        scores = scale * overlaps.astype(np.float32) + relative[: len(overlaps)][::-1]  # the last token asks
        weights = exp(scores - scores.max())
        y = np.zeros(self.head_size, np.float32)
        for weight, value in zip(weights, values, strict=True):
            y += weight * value.astype(np.float32)
        return y * (np.float32(1) / ordered_sum(weights))

    def _gates(self, layer, y):
        if self.config["mode"] not in ("route", "full"):
            concat = self.config["merge"] == "concat"
            return np.full(self.heads, 1 if concat else 1 / self.heads, np.float32)
        hidden = np.maximum(self._affine(f"layers.{layer}.routing.hidden", y), np.float32(0))
        scores = self._affine(f"layers.{layer}.routing.gate", hidden)
        gates = exp(scores - scores.max())
        total = np.float32(0)
        for gate in gates:
            total += gate
        gates = gates / total
        return gates * np.float32(self.heads) if self.config["merge"] == "concat" else gates

    def _feed_forward(self, name, x):
        coded = self._code(f"{name}.coder", x)
        hidden = self._fire(f"{name}.hidden", coded)
        self._count("ffn_in", coded)
        self._count("ffn_hidden", hidden)
        sums = self.tensors[f"{name}.output.weight"].astype(np.int64) @ hidden.sum(axis=0)
        factor = self.tensors[f"{name}.output.scale"] / np.float32(self.ticks)
        return factor * sums.astype(np.float32) + self.tensors[f"{name}.output.bias"]
