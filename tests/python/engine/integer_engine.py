"""Computes the decisions of a policy in integer arithmetic with NumPy only, from docs/design/integer.md."""

import json
import math

import numpy as np


def round_shift(a, s):
    a, s = np.broadcast_arrays(np.asarray(a, np.int64), np.asarray(s, np.int64))
    right = np.maximum(s, 0)
    half = np.where(right > 0, np.int64(1) << np.maximum(right - 1, 0), 0)
    return np.where(s > 0, (a + half) >> right, a << np.maximum(-s, 0))


def round_divide(a, b):
    return (2 * a + b) // (2 * b)


def sat(a):
    return np.clip(a, -32767, 32767)


def norm(a, weight, shift, bias):
    a = sat(a)
    c = a - round_divide(int(a.sum()), len(a))
    squares = sum(int(x) ** 2 for x in c)
    if squares == 0:
        return sat(bias.astype(np.int64))
    e = (squares.bit_length() - 31) // 2
    q = squares >> 2 * e if e >= 0 else squares << -2 * e
    assert 2**30 <= q < 2**32
    r = 2**30 // math.isqrt(q)
    u = round_shift(round_shift(c, e) * r, 15)
    assert np.abs(u).max() <= 2**16
    return sat(round_shift(u * weight, shift[0]) + bias)


def turns(radians):
    whole = radians / (2 * math.pi)
    return math.floor((whole - math.floor(whole)) * 2**32 + 0.5) % 2**32


def power(g):
    """P(g): 2^(16 - g / 256), and 0 from 16 octaves on."""
    return 0 if g >= 4096 else (65536 - 128 * (g % 256)) // 2 ** (g // 256)


class IntegerEngine:
    """One episode of a policy."""

    def __init__(self, tensors, metadata):
        self.tensors = tensors
        self.config = json.loads(metadata["config"])
        assert self.config["arithmetic"] == "integer"
        self.offset, self.scale = (np.float32(metadata[f"return_{name}"]) for name in ("offset", "scale"))
        self.ticks, self.heads, self.size = (self.config[name] for name in ("ticks", "heads", "hidden_size"))
        self.head_size = self.size // self.heads
        self.leak = round(256 * (1 - self.config["membrane_decay"]))
        self.by_tick = self.config["attention"] == "shiftmax_by_tick"
        self.timestep = 0
        self.observation = None  # of the step before
        self.caches = [[] for _ in range(self.config["layers"])]  # (timestep, key spikes, value spikes)
        self.spikes = {}

    def decide(self, return_to_go, observation, last_action):
        """Returns the spikes of one decision by stage, and the readout. `last_action` is None at the first step."""
        stages = ("coder", "phase", "query", "key", "value", "ffn_in", "ffn_hidden", "readout")
        self.spikes = dict.fromkeys(stages, 0)
        if last_action is not None:
            self._token("action", np.asarray(last_action, np.float32))
            self.timestep += 1
        self.spikes["phase"] += int(self._phase().sum())
        self._token("return", np.array([(np.float32(return_to_go) - self.offset) / self.scale], np.float32))
        x = self._token("state", self._state(np.asarray(observation, np.float32)))
        counts = self._code("readout.coder", x, "readout").sum(axis=0)
        return self.spikes, counts.astype(np.float32) / np.float32(self.ticks)

    def _state(self, observation):
        inputs = [(observation - self.tensors["observation.mean"]) / self.tensors["observation.std"]]
        if self.config.get("observation_changes"):
            before = observation if self.observation is None else self.observation
            inputs.append((observation - before) / self.tensors["observation.change_std"])
            self.observation = observation
        return np.concatenate(inputs)

    def _part(self, name, *parts):
        return [self.tensors[f"{name}.{part}"].astype(np.int64) for part in parts]

    def _map(self, name, x):
        weight, shift, bias = self._part(name, "weight", "shift", "bias")
        total = weight @ x
        assert np.abs(total).max() < 2**31
        return round_shift(total, shift) + bias

    def _norm(self, name, a):
        if self.config.get("norm") == "none":
            return np.clip(a, -32767, 32767)
        return norm(a, *self._part(name, "weight", "shift", "bias"))

    def _phase(self):
        fired = np.zeros((self.ticks, 0), bool)
        if self.config["mode"] not in ("pos", "full"):
            return fired
        fired = np.zeros((self.ticks, self.heads), bool)
        for k in range(self.heads):
            omega, phi = (float(self.tensors[f"phase.{name}"][k]) for name in ("omega", "phi"))
            for tick in range(1, self.ticks + 1):
                if self.config["phase_clock"] == "window":
                    phase = turns(phi) + tick * turns(omega)
                else:
                    phase = turns(phi) + self.timestep * turns(omega) + (tick - 1) * turns(omega / self.ticks)
                fired[tick - 1, k] = phase % 2**32 < 2**31
        return fired

    def _code(self, name, x, stage):
        sign, threshold = self._part(name, "sign", "threshold")
        fired = np.zeros((self.ticks, len(x)), bool)
        for j, value in enumerate(sign * x):
            periods = np.flatnonzero(value > threshold[j]) + 1
            if len(periods) > 0:
                fired[periods[0] - 1 :: periods[0], j] = True
        self.spikes[stage] += int(fired.sum())
        return fired

    def _fire(self, name, inputs, stage):
        weight, bias, threshold = self._part(name, "weight", "bias", "threshold")
        membrane = np.zeros_like(bias)
        fired = np.zeros((self.ticks, len(bias)), bool)
        for tick in range(self.ticks):
            membrane = np.clip(membrane - round_shift(membrane * self.leak, 8) + bias, -32768, 32767)
            if not inputs[tick].any():
                continue
            membrane = np.clip(membrane + weight @ inputs[tick], -32768, 32767)
            fired[tick] = membrane >= threshold
            membrane[fired[tick]] = 0
        self.spikes[stage] += int(fired.sum())
        return fired

    def _token(self, kind, inputs):
        scaled = np.clip(inputs * np.float32(2 ** self.config["input_fraction"]), -32767, 32767)
        x = self._norm(f"embed.{kind}.norm", self._map(f"embed.{kind}", np.rint(scaled).astype(np.int64)))
        for layer in range(self.config["layers"]):
            name = f"layers.{layer}"
            inputs = np.hstack([self._code(f"{name}.coder", x, "coder"), self._phase()])
            keys = self._fire(f"{name}.attention.key", inputs, "key")
            values = self._fire(f"{name}.attention.value", inputs, "value")
            self.caches[layer].append((self.timestep, keys, values))
            if layer + 1 == self.config["layers"] and kind != "state":
                return None
            query = self._fire(f"{name}.attention.query", inputs, "query")
            x = self._norm(
                f"{name}.attention.norm", x + self._map(f"{name}.attention.output", self._attend(layer, query))
            )
            hidden = self._fire(f"{name}.ffn.hidden", self._code(f"{name}.ffn.coder", x, "ffn_in"), "ffn_hidden")
            x = self._norm(f"{name}.ffn.norm", x + self._map(f"{name}.ffn.output", hidden.sum(axis=0)))
        return x

    def _weights(self, layer, head, overlaps):
        scores = int(self.tensors[f"layers.{layer}.attention.scale"][head]) * overlaps
        octaves = round_shift(scores.max() - scores, 8)
        return np.where(octaves > 8, 0, 256 >> np.minimum(octaves, 8))

    def _groups(self, query):
        """Returns the ticks that attention takes together."""
        if not self.by_tick:
            return [np.arange(self.ticks)]
        active = query.any(axis=1)
        groups = [np.array([tick]) for tick in np.flatnonzero(active)]
        return groups if active.all() else [*groups, np.flatnonzero(~active)]

    def _attend(self, layer, query):
        first = self.timestep - self.config["context"]
        band = [(keys, values) for timestep, keys, values in self.caches[layer] if timestep > first]
        keys = np.stack([key for key, _ in band])
        values = np.stack([value for _, value in band])
        is_sum = self.config["merge"] == "sum"
        routes = self.config["mode"] in ("route", "full")
        total = 0
        for group in self._groups(query):
            y = self._attend_group(layer, query[group], keys[:, group], values[:, group])
            gates = self._gates(layer, y) if routes else np.ones(self.heads, np.int64)
            gated = gates[:, None] * y.reshape(self.heads, self.head_size)
            total = total + len(group) * (gated.sum(axis=0) if is_sum else gated.ravel())
        if routes and not is_sum and self.config["gate"] == "softmax":
            total = total * self.heads
        unit = 256 if routes else self.heads if is_sum else 1
        return np.minimum(255, round_divide(total, unit * self.ticks))

    def _attend_group(self, layer, query, keys, values):
        counts = values.sum(axis=1, dtype=np.int64)
        y = np.zeros(self.size, np.int64)
        for head in range(self.heads):
            part = slice(head * self.head_size, (head + 1) * self.head_size)
            weights = np.ones(len(keys), np.int64)
            if query[:, part].any():
                overlaps = (keys[:, :, part] & query[:, part]).sum(axis=(1, 2)).astype(np.int64)
                weights = self._weights(layer, head, overlaps)
            total = 256 * (weights[:, None] * counts[:, part]).sum(axis=0)
            y[part] = np.minimum(255, round_divide(total, len(query) * int(weights.sum())))
        return y

    def _gates(self, layer, y):
        hidden = np.clip(self._map(f"layers.{layer}.routing.hidden", y), 0, 32767)
        scores = [int(score) for score in self._map(f"layers.{layer}.routing.gate", hidden)]
        if self.config["gate"] == "sigmoid":
            other = [power(abs(score)) for score in scores]
            own = [65536 if score >= 0 else p for score, p in zip(scores, other, strict=True)]
            return np.array([round_divide(256 * a, 65536 + p) for a, p in zip(own, other, strict=True)])
        powers = [power(max(scores) - score) for score in scores]
        return np.array([round_divide(256 * p, sum(powers)) for p in powers])
