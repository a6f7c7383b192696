"""Plays the real Gymnasium with a real server. Needs only the address of the server.

The reflection of the server provides the message classes. This shows that a client needs no file of
this repository.
"""

import grpc
import gymnasium
import pytest

from security import code_of
from serving import Service

# Training uses smaller seeds.
FIRST_UNSEEN_SEED = 1_000_000
EPISODES = 3


@pytest.fixture(scope="module")
def channel(address):
    with grpc.insecure_channel(address) as opened:
        yield opened


@pytest.fixture(scope="module")
def policy_service(channel):
    return Service(channel, "spikeserve.v1.PolicyService")


def test_health(channel):
    health = Service(channel, "grpc.health.v1.Health")
    for name in ("", "spikeserve.v1.PolicyService", "inference.GRPCInferenceService"):
        assert health.Check(service=name).status == 1  # SERVING
    assert code_of(health.Check, service="nothing.of.the.kind") == grpc.StatusCode.NOT_FOUND


def test_the_shipped_policy_is_listed(policy_service):
    policies = [p for p in policy_service.ListPolicies().policies if p.name == "cartpole"]
    assert policies
    assert policies[0].environment == "CartPole-v1"
    assert policies[0].observation_size == 4
    assert policies[0].action_space.discrete.n == 2


def test_a_repeated_step_gets_the_identical_answer(policy_service):
    session = policy_service.OpenSession(policy="cartpole")
    for step in range(30):
        request = {
            "session_id": session.session_id,
            "step": step,
            "observation": [0.01 * step, -0.02 * step, 0.003 * step, 0.1],
            "reward": 1.0,
        }
        answer = policy_service.Act(**request)
        assert answer.SerializeToString() == policy_service.Act(**request).SerializeToString()
    assert policy_service.GetSession(session_id=session.session_id).decisions == 30
    policy_service.CloseSession(session_id=session.session_id)


def play_episode(environment, policy_service, session_id, seed):
    """Plays one episode and returns its return."""
    observation, _ = environment.reset(seed=seed)
    reward, episode_return, step, spikes, over = 0.0, 0.0, 0, 0, False
    while not over:
        answer = policy_service.Act(
            session_id=session_id, step=step, observation=observation.tolist(), reward=reward
        )
        spikes += answer.stats.spikes
        observation, reward, terminated, truncated, _ = environment.step(answer.action.discrete)
        reward = float(reward)
        episode_return += reward
        step += 1
        over = terminated or truncated
    end = policy_service.EndEpisode(
        session_id=session_id, reward=reward, terminated=terminated, truncated=truncated
    )
    assert end.episode_return == episode_return
    assert end.steps == step
    assert end.spikes == spikes
    return episode_return


def test_plays_gymnasiums_cart_pole(policy_service):
    session = policy_service.OpenSession(policy="cartpole")
    environment = gymnasium.make("CartPole-v1")
    returns = [
        play_episode(environment, policy_service, session.session_id, FIRST_UNSEEN_SEED + episode)
        for episode in range(EPISODES)
    ]
    environment.close()
    policy_service.CloseSession(session_id=session.session_id)
    assert sum(returns) / len(returns) >= 495, returns
