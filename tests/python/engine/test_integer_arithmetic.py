"""Integer policies on a real server give the spikes that a reading of the definition in NumPy gives."""

import hashlib
import json

import numpy as np
import pytest
import spikeserve
from integer_policy import IntegerPolicy
from policy_file import read_policy
from serving import SHIPPED_POLICIES
from spikeserve.export import ModelConfig
from spikeserve.integer_weights import quantize

STEPS = 60  # three times the context
NAMES = sorted(path.name for path in SHIPPED_POLICIES.iterdir())


def shipped(name, version):
    return SHIPPED_POLICIES / name / str(version) / "policy.safetensors"


def encode(space, action):
    if isinstance(space, spikeserve.Discrete):
        return np.eye(space.n)[action]
    low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
    return 2 * (np.asarray(action, np.float64) - low) / (high - low) - 1


@pytest.mark.parametrize("name", NAMES)
def test_every_spike_is_that_of_the_definition(client, name):
    tensors, metadata = read_policy(shipped(name, 2))
    (policy,) = [p for p in client.list_policies() if p.name == name and p.version == 2]
    model = IntegerPolicy(tensors, metadata)
    random = np.random.default_rng(1)
    mean, std = tensors["observation.mean"], tensors["observation.std"]
    last_action, total = None, 0
    with client.open_session(name, spikeserve.SessionOptions(version=2)) as session:
        for step in range(STEPS):
            observation = (mean + 1.5 * std * random.normal(size=len(mean))).astype(np.float32)
            decision = session.act(observation, reward=float(random.integers(-2, 3)))
            expected = model.decide(decision.return_to_go, observation, last_action)
            assert decision.stats.spikes_by_stage == expected, f"step {step}"
            last_action = encode(policy.action_space, decision.action)
            total += decision.stats.spikes
    assert total > 0


def assert_returns_agree(original, rounded):
    """Asserts that two evaluations on the same starts differ by less than 1%, or than chance explains."""
    assert original["first_seed"] == rounded["first_seed"] == 2_000_000
    errors = [evaluation["std_return"] / evaluation["episodes"] ** 0.5 for evaluation in (original, rounded)]
    tolerance = max(0.01 * abs(original["mean_return"]), 3 * np.hypot(*errors))
    assert rounded["mean_return"] == pytest.approx(original["mean_return"], abs=tolerance)


@pytest.mark.parametrize("name", NAMES)
def test_the_python_package_rounds_as_spiketrain_did(name):
    original, metadata = read_policy(shipped(name, 1))
    rounded, rounded_metadata = read_policy(shipped(name, 2))
    ours = quantize(original, ModelConfig(**json.loads(metadata["config"])))
    assert ours.keys() == rounded.keys()
    for tensor, values in rounded.items():
        assert values.dtype == ours[tensor].dtype
        np.testing.assert_array_equal(values, ours[tensor], err_msg=tensor)
    training = json.loads(rounded_metadata["training"])
    assert training["parent_sha256"] == hashlib.sha256(shipped(name, 1).read_bytes()).hexdigest()
    if "imitation" in training:  # spiketrain cannot play this environment
        assert_returns_agree(json.loads(metadata["training"])["evaluation"], training["evaluation"])
        return
    assert training["paired_returns"]["episodes"] == 1000
