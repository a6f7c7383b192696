"""Makes a policy of so many actions that its answers are long: each holds one float an action."""

import json

import numpy as np
from policy_file import read_policy, write_policy
from serving import SHIPPED_POLICIES


def add_wide(policies, actions):
    """Adds the policy `wide` with this number of actions, for CartPole's observations."""
    tensors, metadata = read_policy(SHIPPED_POLICIES / "cartpole-small/1/policy.safetensors")
    for name in ("head.weight", "head.bias"):
        tensors[name] = np.repeat(tensors[name], actions // 2, axis=0)
    size = len(tensors["embed.action.weight"])
    tensors["embed.action.weight"] = np.zeros((size, actions), np.int8)  # other sums could overflow
    del metadata["features"], metadata["wiring"]
    metadata["action_space"] = json.dumps({"type": "Discrete", "n": actions})
    write_policy(policies / "wide/1/policy.safetensors", tensors, metadata)
