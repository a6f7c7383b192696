"""The Python client against a real server with the shipped CartPole policy."""

import gymnasium
import numpy as np
import pytest
import spikeserve

FIRST_UNSEEN_SEED = 1_000_000  # training uses smaller seeds
OBSERVATION = [0.01, -0.02, 0.03, 0.1]


@pytest.fixture
def session(client):
    with client.open_session("cartpole") as opened:
        yield opened


def test_the_shipped_policy_is_listed(client):
    versions = [p for p in client.list_policies() if p.name == "cartpole"]
    assert [(p.version, p.is_default) for p in versions] == [(1, False), (2, True)]
    policy = versions[-1]
    assert policy.environment == "CartPole-v1"
    assert policy.observation_size == 4
    assert policy.action_space == spikeserve.Discrete(2)
    assert policy.training_return >= 495


def test_a_decision_is_whole(session):
    decision = session.act(np.array(OBSERVATION))
    assert decision.action == np.argmax(decision.action_probabilities)
    assert decision.action_probabilities.dtype == np.float32
    assert decision.action_probabilities.sum() == pytest.approx(1)
    assert decision.return_to_go == session.opening.target_return
    assert decision.stats.spikes == sum(decision.stats.spikes_by_stage.values()) > 0


def test_seeds_decide_what_is_sampled(client):
    def play(seed):
        options = spikeserve.SessionOptions(seed=seed, sample=True, temperature=100.0)
        with client.open_session("cartpole", options) as session:
            return [session.act(OBSERVATION, 0.0).action for _ in range(40)]

    assert play(1) == play(1) != play(2)


def test_a_restarted_agent_gets_its_last_answer_again(client, session):
    for _ in range(3):
        last = session.act(OBSERVATION, reward=1.0)
    attached = spikeserve.Session(client, session.session_id, step=2)
    again = attached.act(OBSERVATION, reward=1.0)
    assert again.stats == last.stats
    np.testing.assert_array_equal(again.action_probabilities, last.action_probabilities)
    assert attached.act(OBSERVATION, reward=1.0).step == 3
    assert session.state().decisions == 4


def test_errors_keep_the_servers_message(client, session):
    with pytest.raises(spikeserve.NotFoundError, match='"nobody"') as error:
        client.open_session("nobody")
    assert error.value.call == "OpenSession"
    assert str(error.value) == f"OpenSession: NOT_FOUND: {error.value.message}"
    with pytest.raises(spikeserve.InvalidArgumentError, match="expected 4 numbers, received 3"):
        session.act([1, 2, 3])
    with pytest.raises(spikeserve.FailedPreconditionError, match="expected 0, received 7"):
        spikeserve.Session(client, session.session_id, step=7).act(OBSERVATION, 0.0)
    with pytest.raises(spikeserve.FailedPreconditionError, match="at least one decision"):
        session.end_episode(0.0)
    assert session.act(OBSERVATION).step == 0


def test_observations_of_another_shape_are_refused_here(session):
    with pytest.raises(ValueError, match=r"expected one dimension, received shape \(1, 4\)"):
        session.act([OBSERVATION])


def test_no_server():
    options = spikeserve.ClientOptions(retry=spikeserve.RetryOptions(max_attempts=1))
    with (
        spikeserve.Client("127.0.0.1:1", options) as client,
        pytest.raises(spikeserve.UnavailableError, match="ListPolicies: UNAVAILABLE"),
    ):
        client.list_policies()


def test_a_refused_request_does_not_end_the_stream(client):
    with client.open_session("cartpole") as session, client.act_stream() as stream:
        with pytest.raises(spikeserve.InvalidArgumentError, match="expected 4 numbers, received 1"):
            stream.act(session, [0.5], timeout=30)
        assert session.step == 0
        assert stream.act(session, OBSERVATION, timeout=30).step == 0
        assert session.step == 1


def test_one_request_a_session_is_under_way(client):
    with client.open_session("cartpole") as session, client.act_stream() as stream:
        stream.send(session, OBSERVATION)
        with pytest.raises(ValueError, match="expected no request under way"):
            stream.send(session, OBSERVATION)
        with pytest.raises(ValueError, match="expected no request under way"):
            stream.act(session, OBSERVATION)
        stream.receive(timeout=30)
        with pytest.raises(spikeserve.DeadlineExceededError):
            stream.receive(timeout=0.01)


def test_evaluate_plays_unseen_seeds(address):
    evaluation = spikeserve.evaluate("CartPole-v1", server=address, episodes=3, seed=FIRST_UNSEEN_SEED)
    assert evaluation.policy == "cartpole"
    assert evaluation.mean_return >= 495, evaluation.returns
    assert evaluation.decisions == evaluation.returns.sum()
    assert 0 < evaluation.spikes_per_decision < 1000
    assert str(evaluation).startswith("cartpole/2 plays CartPole-v1: return ")
    assert str(evaluation).endswith(" nJ (estimated by int_sram_45nm) a decision")
    default = sum(episode.energy_joules for episode in evaluation.episodes) / evaluation.decisions
    assert evaluation.energy_joules_per_decision > default > 0  # which has no memory


def test_evaluate_refuses_what_does_not_fit(address):
    served = r"\(acrobot/1 for Acrobot-v1, .*\), received MountainCarContinuous-v0"
    with pytest.raises(LookupError, match=f"env_id: expected .* of a served policy {served}"):
        spikeserve.evaluate("MountainCarContinuous-v0", server=address)
    with pytest.raises(ValueError, match=r"Discrete\(n=2\) for policy 'cartpole', .*\(n=3\)"):
        spikeserve.evaluate("Acrobot-v1", "cartpole", server=address)
    with pytest.raises(ValueError, match="episodes: expected at least 1, received 0"):
        spikeserve.evaluate("CartPole-v1", server=address, episodes=0)


def test_gymnasium_is_played_with_a_plain_loop(session):
    environment = gymnasium.make("CartPole-v1", max_episode_steps=50)
    observation, _ = environment.reset(seed=FIRST_UNSEEN_SEED)
    reward, over = 0.0, False
    while not over:
        decision = session.act(observation, reward)
        observation, reward, terminated, truncated, _ = environment.step(decision.action)
        over = terminated or truncated
    assert session.end_episode(reward, terminated, truncated).episode_return == 50
