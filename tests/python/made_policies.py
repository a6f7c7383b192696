"""Policies with an unusual shape: one of many actions, and one whose logits overflow."""

import json

import numpy as np
from policy_file import read_policy, write_policy
from serving import SHIPPED_POLICIES, running_server


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


FAR = [2.0, 3.0, 0.2, 3.0]  # makes other neurons fire than ZERO does
ZERO = [0.0, 0.0, 0.0, 0.0]
LARGEST = float(np.finfo(np.float32).max)


def add_overflowing(policies, version):
    """Adds a version of cartpole that decides after ZERO, and fails to decide after FAR."""
    with running_server() as addresses:

        def readout(observation):
            session = addresses.agent.OpenSession(policy="cartpole", version=1).session_id
            addresses.agent.Act(session_id=session, observation=observation)
            return np.array(addresses.agent.Explain(session_id=session).readout)

        far, zero = readout(FAR), readout(ZERO)
    stirred = far > zero
    weight = 2 * LARGEST / (far[stirred].sum() + zero[stirred].sum())  # overflows between the two sums
    assert weight < LARGEST
    tensors, metadata = read_policy(SHIPPED_POLICIES / "cartpole" / "1" / "policy.safetensors")
    tensors["head.weight"][:, stirred] = weight
    write_policy(policies / "cartpole" / str(version) / "policy.safetensors", tensors, metadata)
