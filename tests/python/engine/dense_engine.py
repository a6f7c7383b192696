"""Computes and counts the decisions of a dense policy in integer arithmetic with NumPy only, from docs/design/integer.md."""

import json
import math
from collections import Counter

import numpy as np
from integer_engine import norm, power, round_divide, round_shift, sat
from operation_count import INTEGER_PRICES, products, sram


def block(a):
    """Returns 8-bit integers and their exponent."""
    exponent = max(0, int(np.abs(a).max()).bit_length() - 7)
    return np.clip(round_shift(a, exponent), -127, 127), exponent


def gelu(x):
    return 0.5 * x * (1 + math.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))


class DenseEngine:
    """One episode of a policy, with the counts of its last decision."""

    def __init__(self, tensors, metadata):
        self.tensors = tensors
        self.config = json.loads(metadata["config"])
        assert (self.config["mode"], self.config["arithmetic"]) == ("dense", "integer")
        self.offset, self.scale = (np.float32(metadata[f"return_{name}"]) for name in ("offset", "scale"))
        self.heads, self.size = self.config["heads"], self.config["hidden_size"]
        self.fraction = self.config["residual_fraction"]
        self.head_size = self.size // self.heads
        self.timestep = 0
        self.caches = [[] for _ in range(self.config["layers"])]  # (timestep, keys, values), blocks by head
        smaller = [round((i / 32 - gelu(i / 32)) * 2**self.fraction) for i in range(128)]
        self.table = np.array([*smaller, 0])

    def decide(self, return_to_go, observation, last_action):
        """Returns the inputs of the action head. `last_action` is None at the first step."""
        self.done, self.moved = Counter(), Counter()
        if last_action is not None:
            self._token("action", np.asarray(last_action, np.float32))
            self.timestep += 1
        self._token("return", np.array([(np.float32(return_to_go) - self.offset) / self.scale], np.float32))
        mean, std = self.tensors["observation.mean"], self.tensors["observation.std"]
        x = self._token("state", (np.asarray(observation, np.float32) - mean) / std)
        self.done["float mac"] += products(self.tensors["head.weight"], x)
        self.moved["weights"] += 4 * self.tensors["head.weight"].size
        return x.astype(np.float32) / np.float32(2**self.fraction)

    def _part(self, name, *parts):
        return [self.tensors[f"{name}.{part}"].astype(np.int64) for part in parts]

    def _norm(self, name, a):
        self.done["norm"] += len(a)
        return norm(a, *self._part(name, "weight", "shift", "bias"))

    def _map(self, name, x, kind="mac", exponent=0):
        weight, shift, bias = self._part(name, "weight", "shift", "bias")
        self.done[kind] += products(weight, x)
        if self.kind == "state" or name.startswith("embed."):
            self.moved["weights"] += weight.size
        return round_shift(weight @ x, shift - exponent) + bias

    def _map_block(self, name, x):
        b, exponent = block(x)
        return sat(self._map(name, b, exponent=exponent))

    def _token(self, kind, inputs):
        self.kind = kind
        scaled = np.clip(inputs * np.float32(2 ** self.config["input_fraction"]), -32767, 32767)
        x = self._map(f"embed.{kind}", np.rint(scaled).astype(np.int64), "wide mac")
        timesteps = self.tensors["embed.timestep.weight"].astype(np.int64)
        x = self._norm(f"embed.{kind}.norm", x + timesteps[min(self.timestep, len(timesteps) - 1)])
        for layer in range(self.config["layers"]):
            name = f"layers.{layer}"
            keys, values = (self._split(self._map_block(f"{name}.attention.{part}", x)) for part in ("key", "value"))
            self.caches[layer].append((self.timestep, keys, values))
            self.moved["keys and values"] += 2 * self.size
            if layer + 1 == self.config["layers"] and kind != "state":
                return None
            query = self._split(self._map_block(f"{name}.attention.query", x))
            update = self._map_block(f"{name}.attention.output", self._attend(layer, query))
            x = self._norm(f"{name}.attention.norm", x + update)
            hidden = self._map_block(f"{name}.ffn.hidden", x)
            index = np.minimum(round_shift(np.abs(hidden), self.fraction - 5), 128)
            hidden = np.maximum(hidden, 0) - self.table[index]
            x = self._norm(f"{name}.ffn.norm", x + self._map_block(f"{name}.ffn.output", hidden))
        return x

    def _split(self, x):
        return [block(part) for part in x.reshape(self.heads, self.head_size)]

    def _attend(self, layer, query):
        first = self.timestep - self.config["context"]
        band = [(keys, values) for timestep, keys, values in self.caches[layer] if timestep > first]
        scale = round(2**10 * math.log2(math.e) / math.sqrt(self.head_size))
        y = []
        for head, (q, exponent) in enumerate(query):
            octaves = []
            for keys, _ in band:
                k, other = keys[head]
                self.done["attention product"] += int(((q != 0) & (k != 0)).sum())
                octaves.append(int(round_shift(scale * int(q @ k), 2 * self.fraction + 2 - exponent - other)))
            weights = [min(255, power(max(octaves) - octave) >> 8) for octave in octaves]
            total = np.zeros(self.head_size, np.int64)
            for weight, (_, values) in zip(weights, band, strict=True):
                v, other = values[head]
                self.done["attention product"] += int((v != 0).sum()) if weight else 0
                total += weight * v * 2**other
            self.done["scaling"] += int((total != 0).sum())
            self.done["softmax"] += len(band)
            self.moved["keys and values"] += len(band) * 2 * self.head_size
            y.append(sat(round_divide(total, sum(weights))))
        return np.concatenate(y)

    def operations_joules(self):
        prices = INTEGER_PRICES | {"attention product": 0.23}
        return 1e-12 * sum(prices[name] * count for name, count in self.done.items())

    def joules_with_memory(self):
        layers = [t.size for name, t in self.tensors.items() if name.startswith("layers.") and t.ndim == 2]
        memories = {"weights": sum(layers), "keys and values": 3 * self.config["context"] * 2 * self.size}
        return self.operations_joules() + 1e-12 * sum(sram(memories[name]) * n for name, n in self.moved.items())
