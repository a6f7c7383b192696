"""Integer policies on a real server give the spikes that a reading of the definition in NumPy gives."""

import json

import numpy as np
import pytest
import spikeserve
from integer_policy import IntegerPolicy
from policy_file import read_policy
from serving import RELEASED_POLICIES, running_server
from spikeserve.export import ModelConfig
from spikeserve.integer_weights import quantize

STEPS = 60  # three times the context
NAMES = sorted(path.name for path in RELEASED_POLICIES.iterdir())


@pytest.fixture(scope="module")
def client():
    with running_server(RELEASED_POLICIES) as addresses, spikeserve.Client(addresses.grpc) as opened:
        yield opened


def released(name, version):
    return RELEASED_POLICIES / name / str(version) / "policy.safetensors"


def encode(space, action):
    if isinstance(space, spikeserve.Discrete):
        return np.eye(space.n)[action]
    low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
    return 2 * (np.asarray(action, np.float64) - low) / (high - low) - 1


@pytest.mark.parametrize("name", NAMES)
def test_every_spike_is_that_of_the_definition(client, name):
    tensors, metadata = read_policy(released(name, 2))
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


def test_the_python_package_rounds_as_spiketrain_did():
    original, metadata = read_policy(released("cartpole-sparse", 1))
    rounded, rounded_metadata = read_policy(released("cartpole-sparse", 2))
    ours = quantize(original, ModelConfig(**json.loads(metadata["config"])))
    assert ours.keys() == rounded.keys()
    for tensor, values in rounded.items():
        assert values.dtype == ours[tensor].dtype
        np.testing.assert_array_equal(values, ours[tensor], err_msg=tensor)
