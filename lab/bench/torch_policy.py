"""The SNN-DT model in eager PyTorch, which recomputes the full window: the usual way to serve it.

Reads a policy file. Supports the configuration of the shipped policies only: mode `full` (phase spikes and routing),
rate coder, summed heads and softmax gates.
"""

import json

import policy_tensors
import torch
from torch.nn import functional

TOKENS = 3  # of a timestep: return-to-go, state, action
UNSEEN = -1e9


class TorchPolicy:
    def __init__(self, path):
        tensors, metadata = policy_tensors.read_policy_file(path)
        self.p = {name: torch.from_numpy(values) for name, values in tensors.items()}
        self.config = json.loads(metadata["config"])
        expected = {"mode": "full", "coder": "lif", "merge": "sum", "gate": "softmax", "phase_clock": "timestep"}
        for key, value in expected.items():
            if self.config[key] != value:
                raise ValueError(f"{path}: config.{key}: expected {value}, received {self.config[key]}")
        self.actions = json.loads(metadata["action_space"])["n"]
        self.return_offset = float(metadata["return_offset"])
        self.return_scale = float(metadata["return_scale"])
        self.target_return = float(metadata["target_return"])

    def linear(self, x, name):
        return functional.linear(x, self.p[name + ".weight"], self.p[name + ".bias"])

    def norm(self, x, name):
        return functional.layer_norm(x, x.shape[-1:], self.p[name + ".weight"], self.p[name + ".bias"])

    def fire(self, currents):
        """Returns the spikes of LIF neurons for `currents`, both [T, tokens, neurons]."""
        membrane = torch.zeros_like(currents[0])
        spikes = []
        for current in currents:
            membrane = self.config["membrane_decay"] * membrane + current
            spike = membrane >= self.config["threshold"]
            membrane = membrane.masked_fill(spike, 0.0)
            spikes.append(spike.float())
        return torch.stack(spikes)

    def code(self, x, name):
        current = x * self.p[name + ".gain"] + self.p[name + ".bias"]
        return self.fire(current.expand(self.config["ticks"], *current.shape))

    def embed(self, returns, observations, actions):
        modalities = {
            "return": (returns.unsqueeze(-1) - self.return_offset) / self.return_scale,
            "state": (observations - self.p["observation.mean"]) / self.p["observation.std"],
            "action": actions,
        }
        embedded = [self.norm(self.linear(x, f"embed.{k}"), f"embed.{k}.norm") for k, x in modalities.items()]
        return torch.stack(embedded, 1).flatten(0, 1)

    def phase_spikes(self, timesteps):
        """Returns the phase spikes, [T, tokens, H]."""
        ticks = torch.arange(self.config["ticks"], dtype=torch.float64) / self.config["ticks"]
        tau = (timesteps.double() + ticks.unsqueeze(1)).unsqueeze(-1)
        angle = self.p["phase.omega"].double() * tau + self.p["phase.phi"].double()
        return (torch.sin(angle) > 0.0).float().repeat_interleave(TOKENS, 1)

    def heads(self, x):
        return x.unflatten(-1, (self.config["heads"], -1)).transpose(1, 2)  # [T, H, tokens, d_h]

    def attend(self, coded, name, mask):
        q, k, v = (self.heads(self.fire(self.linear(coded, f"{name}.{part}"))) for part in ("query", "key", "value"))
        scores = q @ k.transpose(-1, -2) * self.p[f"{name}.scale"].view(-1, 1, 1)
        return (torch.softmax(scores + mask, -1) @ v).transpose(1, 2)  # [T, tokens, H, d_h]

    def layer(self, x, index, phase, mask):
        name = f"layers.{index}"
        coded = torch.cat([self.code(x, f"{name}.coder"), phase], -1)
        y = self.attend(coded, f"{name}.attention", mask)
        hidden = torch.relu(self.linear(y.flatten(-2), f"{name}.routing.hidden"))
        gates = torch.softmax(self.linear(hidden, f"{name}.routing.gate"), -1)
        merged = (y * gates.unsqueeze(-1)).sum(2).mean(0)
        x = self.norm(x + self.linear(merged, f"{name}.attention.output"), f"{name}.attention.norm")
        spikes = self.fire(self.linear(self.code(x, f"{name}.ffn.coder"), f"{name}.ffn.hidden"))
        return self.norm(x + self.linear(spikes.mean(0), f"{name}.ffn.output"), f"{name}.ffn.norm")

    @torch.no_grad()
    def decide(self, first_timestep, returns, observations, actions):
        """Returns the most probable action at the last of n timesteps, and the probabilities of all actions.

        `actions` holds the n - 1 earlier actions.
        """
        returns = torch.tensor(returns)
        count = len(returns)
        one_hot = functional.one_hot(torch.tensor(actions + [0]), self.actions).float()
        x = self.embed(returns, torch.tensor(observations), one_hot)[:-1]
        phase = self.phase_spikes(torch.arange(first_timestep, first_timestep + count))[:, :-1]
        mask = torch.full((len(x), len(x)), UNSEEN).triu(1)
        for index in range(self.config["layers"]):
            x = self.layer(x, index, phase, mask)
        logits = self.linear(self.code(x[-1:], "readout.coder").mean(0), "head")[0]
        return int(logits.argmax()), torch.softmax(logits, -1).tolist()
