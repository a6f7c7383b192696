"""The server counts observations that lie far from the training data of the policy."""

import re

import gymnasium
import numpy as np
import pytest
import spikeserve
from policy_file import read_policy, write_policy
from serving import DEPLOY, RELEASED_POLICIES, metric, page_of, running_server

CARTPOLE = DEPLOY / "policies/cartpole/2/policy.safetensors"
LONG = 200  # elements, more than there are time series


@pytest.fixture(scope="module")
def moments():
    """Returns the mean and the deviation of the training data of the shipped policy."""
    tensors, _ = read_policy(CARTPOLE)
    return tensors["observation.mean"], tensors["observation.std"]


def counted(server, policy):
    """Returns the counters of one policy by element."""
    text = page_of(server, "/metrics")
    pattern = rf'spikeserve_unusual_observations_total\{{element="([^"]*)",(?:name="[^"]*",)?policy="{policy}",version="\d+"\}} (\S+)'
    found = re.findall(pattern, text)
    assert found
    return {element: float(value) for element, value in found}


def test_elements_far_from_the_training_data_are_counted(moments):
    mean, deviation = moments
    with running_server() as server, spikeserve.Client(server.grpc) as client:
        with client.open_session("cartpole") as session:
            assert session.act(mean).stats.unusual_observations == 0
            assert session.act(mean + 7.9 * deviation, 1.0).stats.unusual_observations == 0
            far = mean + np.array([0, 8.1, 0, -8.1]) * deviation
            assert session.act(far, 1.0).stats.unusual_observations == 2
            again = spikeserve.Session(client, session.session_id, session.step - 1)
            assert again.act(far, 1.0).stats.unusual_observations == 2  # the stored answer
            assert session.act(np.full(4, 1e30), 1.0).stats.unusual_observations == 4
        text = page_of(server, "/metrics")
        series = dict(
            re.findall(
                r'spikeserve_unusual_observations_total\{element="(\d+)",name="[a-z_]+",policy="cartpole",version="2"\} (\d+)',
                text,
            )
        )
        assert series == {"0": "1", "1": "2", "2": "1", "3": "2"}


def test_a_return_to_go_far_from_the_training_data_is_counted(moments):
    """CartPole's policy has target_return 500, return_offset 250 and return_scale 250."""
    mean, _ = moments
    with running_server() as server, spikeserve.Client(server.grpc) as client:
        for target, unusual in ((1249.0, 0), (1251.0, 1), (-499.0, 0), (-501.0, 1)):
            options = spikeserve.SessionOptions(target_return=target)
            with client.open_session("cartpole", options) as session:
                assert session.act(mean).stats.unusual_observations == unusual
        assert metric(server, "spikeserve_unusual_observations_total", element="return_to_go") == 2


def test_the_limit_is_a_flag(moments):
    mean, deviation = moments
    for flag, expected in (("2.5", 4), ("0", 0)):
        with (
            running_server(flags=[f"--unusual_deviations={flag}"]) as server,
            spikeserve.Client(server.grpc) as client,
            client.open_session("cartpole") as session,
        ):
            stats = session.act(mean + 3 * deviation).stats
            assert stats.unusual_observations == expected


def test_a_long_observation_has_a_bounded_number_of_series(tmp_path):
    tensors, metadata = read_policy(RELEASED_POLICIES / "cartpole-sparse/1/policy.safetensors")
    size = tensors["embed.state.weight"].shape[0]
    edited = tensors | {
        "embed.state.weight": np.zeros((size, LONG), "f4"),
        "observation.mean": np.zeros(LONG, "f4"),
        "observation.std": np.ones(LONG, "f4"),
    }
    write_policy(tmp_path / "long" / "1" / "policy.safetensors", edited, metadata)
    observation = np.zeros(LONG)
    observation[[0, 3, 4, LONG - 1]] = 100
    with running_server(tmp_path) as server, spikeserve.Client(server.grpc) as client:
        with client.open_session("long") as session:
            assert session.act(observation).stats.unusual_observations == 4
        series = counted(server, "long")
    assert series.pop("return_to_go") == 0
    assert len(series) == 64
    assert {name: count for name, count in series.items() if count} == {"0-3": 2, "4-6": 1, "197-199": 1}
    covered = []
    for name in series:
        first, _, last = name.partition("-")
        covered.extend(range(int(first), int(last or first) + 1))
    assert sorted(covered) == list(range(LONG))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1"])
def test_ordinary_play_raises_no_alarm(address, env_id):
    """The shipped policies in their own tasks stay below the threshold of the alert."""
    with spikeserve.Client(address) as client, gymnasium.make(env_id) as environment:
        policy = next(p for p in client.list_policies() if p.environment == env_id and p.is_default)
        unusual = np.zeros(policy.observation_size)
        decisions = 0
        with client.open_session(policy.name) as session:
            for seed in range(3):
                observation, _ = environment.reset(seed=seed)
                reward, over = 0.0, False
                while not over:
                    decision = session.act(observation, reward)
                    decisions += 1
                    unusual += decision.stats.unusual_observations > 0
                    observation, reward, terminated, truncated, _ = environment.step(decision.action)
                    over = terminated or truncated
                session.end_episode(float(reward), terminated, truncated)
        assert (unusual <= 0.05 * decisions).all()
