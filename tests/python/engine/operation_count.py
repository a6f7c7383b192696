"""Counts what a decision in integers does and prices it, from docs/reference/energy.md and the NumPy engines only.

The counts of a decision are those of its new tokens. Nothing here knows how the server counts.
"""

import json
import math
from collections import Counter

import numpy as np
from integer_engine import IntegerEngine, norm, power, round_divide, round_shift, sat

# Picojoules of one operation: int_45nm.
INTEGER_PRICES = {
    "accumulate": 0.03,
    "mac": 0.23,
    "wide mac": 0.43,
    "float mac": 4.6,
    "update": 0.1,
    "leak": 0.05,  # an addition; a leak has one for each signed binary digit, and one for the bias
    "comparison": 0.05,
    "coder spike": 0.03,
    "attention": 0.1,
    "scaling": 0.9,
    "softmax": 1.15,
    "gate": 0.23,
    "norm": 3.05,
    "limit": 0.1,
}


def sram(size):
    """Picojoules of a byte of the smallest memory that holds `size` bytes."""
    return 1.25 if size <= 8192 else 2.5 if size <= 32768 else 12.5


def products(weight, x):
    return int(((weight != 0) & (np.asarray(x) != 0)[None, :]).sum())


class Counted:
    """Adds the counts of the last decision to an engine: `done` operations and `moved` bytes."""

    prices: dict

    def decide(self, *arguments):
        self.done, self.moved = Counter(), Counter()
        return super().decide(*arguments)

    def _token(self, kind, inputs):
        self.kind = kind
        return super()._token(kind, inputs)

    def _norm(self, name, x):
        if self.config.get("norm") != "none":
            self.done["norm"] += len(x)
            self.done["limit"] += len(x)
        self.done["limit"] += len(x)
        return super()._norm(name, x)

    def _code(self, name, x, *stage):
        fired = super()._code(name, x, *stage)
        self.done["comparison"] += len(x) * self.ticks.bit_length()  # a binary search among T + 1 answers
        self.done["coder spike"] += int(fired.sum())
        if name == "readout.coder":
            head = products(self.tensors["head.weight"], fired.any(axis=0))
            self.done["float mac"] += head
            self._count_head(head)
        return fired

    def _synapses(self, name, inputs):
        weight = self.tensors[f"{name}.weight"]
        self.done["accumulate"] += sum(products(weight, spikes) for spikes in inputs)
        return len(weight)

    def _layer_sizes(self):
        d, ffn = self.config["hidden_size"], self.config["ffn_size"]
        return d, ffn, 4 * (3 * d + ffn)  # the last: a 16-bit threshold and bias of each neuron

    def _weights_of_layers(self, analog_bytes):
        spiking = ("query.weight", "key.weight", "value.weight", "ffn.hidden.weight", "ffn.output.weight")
        sizes = {name: tensor.size for name, tensor in self.tensors.items() if name.startswith("layers.")}
        total = 0
        for name, size in sizes.items():
            if name.endswith(spiking):
                total += size
            elif name.endswith(("attention.output.weight", "routing.hidden.weight", "routing.gate.weight")):
                total += analog_bytes * size
        return total

    def operations_joules(self):
        return 1e-12 * sum(self.prices[name] * count for name, count in self.done.items())

    def joules_with_memory(self):
        moved = sum(sram(self.memories()[name]) * count for name, count in self.moved.items())
        return self.operations_joules() + 1e-12 * moved


class CountedIntegerEngine(Counted, IntegerEngine):
    """A policy in integer arithmetic."""

    prices = INTEGER_PRICES

    def _token(self, kind, inputs):
        self.whole = set()  # maps that were read
        return super()._token(kind, inputs)

    def _count_head(self, _):
        self.moved["weights"] += 4 * self.tensors["head.weight"].size

    def _code(self, name, x, stage):
        self.moved["coders"] += 2 * len(x) * self.ticks.bit_length()
        return super()._code(name, x, stage)

    def _map(self, name, x):
        weight = self.tensors[f"{name}.weight"]
        count = products(weight, x)
        self.done["wide mac" if name.startswith("embed.") or name.endswith("routing.gate") else "mac"] += count
        if name.endswith("ffn.output"):
            self.moved["weights"] += count
        elif name not in self.whole and (name.startswith("embed.") or self.kind == "state"):
            self.whole.add(name)  # one reading serves all new tokens, and groups of ticks
            self.moved["weights"] += weight.size
        return super()._map(name, x)

    def _fire(self, name, inputs, stage):
        neurons = self._synapses(name, inputs)
        events = np.flatnonzero(inputs.any(axis=1)) + 1
        self.done["update"] += neurons * len(events)
        digits = (self.leak ^ (3 * self.leak)).bit_count()
        leaks = neurons * (int(events.max(initial=1)) - 1)  # the first tick begins at the bias
        self.done["leak"] += leaks * (digits + 1)
        self.done["limit"] += neurons * len(events) + leaks
        self.moved["weights"] += products(self.tensors[f"{name}.weight"], inputs.any(axis=0))
        self.moved["neurons"] += 4 * neurons * bool(len(events))
        fired = super()._fire(name, inputs, stage)
        if name.endswith("key"):
            self.moved["keys and values"] += (self.ticks * neurons + 7) // 8
        if name.endswith("value"):
            values = int(fired.sum() if self.by_tick else fired.any(axis=0).sum())
            self.done["attention"] += 2 * values  # into the running sum and out of it
            self.moved["keys and values"] += self._value_bytes(self.ticks, neurons) + 2 * values * 4
        return fired

    def _value_bytes(self, ticks, neurons):
        return (ticks * neurons + 7) // 8 if self.by_tick else neurons

    def _attend_group(self, layer, query, keys, values):
        size, ticks = self.head_size, len(query)
        for head in range(self.heads):
            part = slice(head * size, (head + 1) * size)
            planes = values[:, :, part] if self.by_tick else values[:, :, part].any(axis=1, keepdims=True)
            if not query[:, part].any():
                sums = planes.any(axis=0)
                self.done["attention"] += int(sums[1:].sum())
                self.done["scaling"] += int(sums.any(axis=0).sum())
                self.moved["keys and values"] += 2 * size * len(sums)
                continue
            overlaps = (keys[:, :, part] & query[:, part]).sum(axis=(1, 2))
            weights = self._weights(layer, head, overlaps)
            met = (weights != 0)[:, None, None] & planes
            self.done["attention"] += int(overlaps.sum()) + int(met.sum())
            self.done["scaling"] += int(met.any(axis=(0, 1)).sum())
            self.done["softmax"] += len(keys)
            key_bytes = (ticks * size + 7) // 8
            self.moved["keys and values"] += len(keys) * (key_bytes + self._value_bytes(ticks, size))
        return super()._attend_group(layer, query, keys, values)

    def _gates(self, layer, y):
        self.done["gate"] += len(y)
        self.done["softmax"] += self.heads
        return super()._gates(layer, y)

    def memories(self):
        d, _, neurons = self._layer_sizes()
        token = (self.ticks * d + 7) // 8 + self._value_bytes(self.ticks, d)
        return {
            "weights": self._weights_of_layers(1),
            "neurons": neurons,
            "coders": 4 * d * self.ticks,
            "keys and values": 3 * self.config["context"] * token,
        }


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
        self.done["limit"] += 2 * len(a)
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
