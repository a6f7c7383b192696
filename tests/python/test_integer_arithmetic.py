"""Integer policies on a real server give the spikes that a reading of the definition in NumPy gives."""

import json
import os
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import spikeserve
from integer_policy import IntegerPolicy
from policy_file import read_policy
from serving import SHIPPED_POLICIES, running_server
from spikeserve.export import ModelConfig, export_policy
from spikeserve.integer_weights import quantize

STEPS = 60  # three times the context
NAMES = sorted(path.name for path in SHIPPED_POLICIES.iterdir())


def shipped(name):
    return SHIPPED_POLICIES / name / "1" / "policy.safetensors"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Returns a folder with every shipped float32 policy, rounded by the Python package."""
    folder = tmp_path_factory.mktemp("policies")
    numbers = [
        "return_offset",
        "return_scale",
        "target_return",
        "modulator_mean",
        "modulator_std",
    ]
    for name in NAMES:
        tensors, metadata = read_policy(shipped(name))
        config = ModelConfig(**json.loads(metadata["config"]))
        space = json.loads(metadata["action_space"])
        kind = spikeserve.Discrete if space.pop("type") == "Discrete" else spikeserve.Box
        export_policy(
            folder / name / "1" / "policy.safetensors",
            quantize(tensors, config),
            replace(config, arithmetic="int8"),
            action_space=kind(**{key: tuple(v) if isinstance(v, list) else v for key, v in space.items()}),
            environment=metadata["environment"],
            **{number: float(metadata[number]) for number in numbers},
        )
    return folder


@pytest.fixture(scope="module")
def client(folder):
    with running_server(folder) as server, spikeserve.Client(server.grpc) as opened:
        yield opened


def encode(space, action):
    if isinstance(space, spikeserve.Discrete):
        return np.eye(space.n)[action]
    low, high = (np.asarray(bound, np.float64) for bound in (space.low, space.high))
    return 2 * (np.asarray(action, np.float64) - low) / (high - low) - 1


@pytest.mark.parametrize("name", NAMES)
def test_every_spike_is_that_of_the_definition(client, folder, name):
    tensors, metadata = read_policy(folder / name / "1" / "policy.safetensors")
    (policy,) = [p for p in client.list_policies() if p.name == name]
    model = IntegerPolicy(tensors, metadata)
    random = np.random.default_rng(1)
    mean, std = tensors["observation.mean"], tensors["observation.std"]
    last_action, total = None, 0
    with client.open_session(name) as session:
        for step in range(STEPS):
            observation = (mean + 1.5 * std * random.normal(size=len(mean))).astype(np.float32)
            decision = session.act(observation, reward=float(random.integers(-2, 3)))
            expected = model.decide(decision.return_to_go, observation, last_action)
            assert decision.stats.spikes_by_stage == expected, f"step {step}"
            last_action = encode(policy.action_space, decision.action)
            total += decision.stats.spikes
    assert total > 0


@pytest.mark.skipif("SPIKETRAIN_PROGRAM" not in os.environ, reason="without libtorch")
def test_the_python_package_and_spiketrain_round_alike(folder, tmp_path):
    for name in NAMES[:3]:
        rounded = tmp_path / name / "policy.safetensors"
        subprocess.run(
            [
                os.environ["SPIKETRAIN_PROGRAM"],
                "quantize",
                f"--policy={shipped(name)}",
                f"--out={rounded}",
                "--episodes=1",
            ],
            check=True,
        )
        ours, _ = read_policy(folder / name / "1" / "policy.safetensors")
        theirs, metadata = read_policy(rounded)
        assert json.loads(metadata["config"])["arithmetic"] == "int8"
        assert ours.keys() == theirs.keys()
        for tensor, values in theirs.items():
            assert values.dtype == ours[tensor].dtype
            np.testing.assert_array_equal(values, ours[tensor], err_msg=tensor)
