"""Exports policies in NIR, and compares what importers make of them with the equations of the policy files."""

import json

import numpy as np
from policy_file import read_policy
from serving import RELEASED_POLICIES, SHIPPED_POLICIES
from spikeserve.export import to_nir

# Policies in float32 and in integers.
POLICIES = (
    RELEASED_POLICIES / "cartpole-sparse/1",
    *(SHIPPED_POLICIES / name for name in ("cartpole/1", "cartpole/2", "cartpole-small/1", "pendulum/1")),
)
TOKENS = 20
RATE = 0.3  # of random input spikes; a population without any at a tick fires at none


def exported_policies(folder):
    """Exports POLICIES with random input spikes. Returns their folders."""
    random = np.random.default_rng(0)
    folders = {}
    for policy in POLICIES:
        exported = to_nir(policy / "policy.safetensors")
        path = folder / f"{policy.parent.name}-{policy.name}"
        exported.write(path)
        _, metadata = read_policy(policy / "policy.safetensors")
        assert exported.manifest["features"] == json.loads(metadata.get("features", "{}"))
        ticks = exported.manifest["ticks"]
        inputs = {
            population: (random.random((TOKENS, ticks, entry["inputs"])) < RATE).astype(int)
            for population, entry in exported.manifest["populations"].items()
        }
        np.savez(path / "spikes.npz", **inputs)
        folders[str(path)] = policy
    return folders


def fire(tensors, config, population, inputs):
    """Returns the spikes by the equations, with membranes that are not rounded."""
    weight, bias = (tensors[f"{population}.{part}"].astype(float) for part in ("weight", "bias"))
    integers = f"{population}.threshold" in tensors
    # A membrane that is rounded reaches its threshold from half a unit below.
    threshold = tensors[f"{population}.threshold"] - 0.5 if integers else np.nextafter(np.float32(config["threshold"]), 0)
    decay = np.float32(config["membrane_decay"])
    membrane = np.zeros((len(inputs), len(bias)))
    spikes = np.zeros((*inputs.shape[:2], len(bias)), bool)
    for tick in range(inputs.shape[1]):
        membrane = membrane * float(decay) + inputs[:, tick] @ weight.T + bias
        spikes[:, tick] = membrane > threshold
        membrane[spikes[:, tick]] = 0
    return spikes


def check_imported(folders, importer):
    """Asserts that the spikes of an importer are those of the equations, but for sums next to the threshold."""
    for path, policy in folders.items():
        tensors, metadata = read_policy(policy / "policy.safetensors")
        imported, inputs = np.load(f"{path}/{importer}.npz"), np.load(f"{path}/spikes.npz")
        total = 0
        for population in imported.files:
            expected = fire(tensors, json.loads(metadata["config"]), population, inputs[population])
            total += int(expected.sum())
            assert (imported[population] != expected).mean() <= 1e-4, (policy, population)
        assert total > 0, policy
