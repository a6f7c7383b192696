"""Writes policy files with random weights through spikeserve.export."""

import os
import subprocess

import numpy as np
from spikeserve.export import ModelConfig, export_policy, tensor_shapes

SMALL = {"hidden_size": 16, "heads": 2, "ticks": 4, "context": 5, "ffn_size": 32}
DENSE_TIMESTEPS = 8


def random_tensors(config, observation_size, action_size, seed=0):
    """Returns weights for which neurons fire and the actions depend on the observations."""
    random = np.random.default_rng(seed)
    tensors = {}
    for name, shape in tensor_shapes(config, observation_size, action_size).items():
        shape = [length or DENSE_TIMESTEPS for length in shape]
        if name in ("observation.mean", "observation.std", "observation.change_std"):
            tensors[name] = np.full(shape, float(name.endswith("std")))
        elif name.endswith("gain") or "norm.weight" in name:
            tensors[name] = np.ones(shape)
        else:
            tensors[name] = random.normal(0, 1 / np.sqrt(shape[-1]), shape) + 0.1
    tensors["head.weight"] *= 5
    return tensors


def export_random(folder, name, environment, seed=0, arithmetic="float32", **config):
    """Writes version 1 of the policy `name` below `folder`, for a Gymnasium environment."""
    config = ModelConfig(**(SMALL | config))
    space = environment.action_space
    size = int(space.n) if hasattr(space, "n") else space.shape[0]
    tensors = random_tensors(config, environment.observation_space.shape[0], size, seed)
    path = folder / name / "1" / "policy.safetensors"
    export_policy(
        path,
        tensors,
        config,
        action_space=space,
        environment=environment.spec.id,
        target_return=100,
        return_scale=100,
    )
    if arithmetic == "integer":
        command = [os.environ["INTEGER_DECISIONS_PROGRAM"], path, path, config.mode]
        subprocess.run(command, stdin=subprocess.DEVNULL, check=True, timeout=120)
