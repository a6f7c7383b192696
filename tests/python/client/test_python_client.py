"""The Python client against a real server with the shipped CartPole policy."""

import asyncio

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


def test_a_session_counts_its_steps_and_episodes(session):
    for step in range(3):
        assert session.act(OBSERVATION, reward=2.0).step == step
    assert session.state().episode_return == 4.0
    assert session.state().step == session.step == 3
    summary = session.end_episode(reward=2.0, terminated=True)
    assert (summary.episode_return, summary.steps) == (6.0, 3)
    assert session.state().episode == 1
    assert session.act(OBSERVATION).step == 0


def test_options_reach_the_server(client):
    options = spikeserve.SessionOptions(
        version=1, target_return=123.0, sample=True, temperature=2.0, labels={"robot": "a"}
    )
    with client.open_session("cartpole", options) as session:
        assert session.opening.target_return == session.act(OBSERVATION).return_to_go == 123.0
        assert session.state().labels == {"robot": "a"}


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


def test_a_batch_has_a_result_for_each_session(client):
    with client.open_session("cartpole") as good, client.open_session("cartpole") as bad:
        decision, error = client.act_batch([good, bad], [OBSERVATION, [np.nan] * 4], [0.0, 0.0])
        assert decision.step == 0
        assert isinstance(error, spikeserve.InvalidArgumentError)
        assert (good.step, bad.step) == (1, 0)


def test_the_async_client_plays_many_agents_at_once(address, session):
    expected = [session.act(OBSERVATION, reward=1.0).action_probabilities for _ in range(20)]

    async def play(client):
        async with await client.open_session("cartpole") as agent:
            decisions = [await agent.act(OBSERVATION, reward=1.0) for _ in range(20)]
            assert (await agent.state()).step == 20
            summary = await agent.end_episode(1.0, truncated=True)
            assert (summary.episode_return, summary.steps) == (20.0, 20)
            return [decision.action_probabilities for decision in decisions]

    async def play_all():
        async with spikeserve.AsyncClient(address) as client:
            assert "cartpole" in [policy.name for policy in await client.list_policies()]
            return await asyncio.gather(*(play(client) for _ in range(8)))

    for played in asyncio.run(play_all()):
        np.testing.assert_array_equal(played, expected)


def test_async_errors_and_batches(address):
    async def scenario():
        async with spikeserve.AsyncClient(address) as client:
            with pytest.raises(spikeserve.NotFoundError, match='"nobody"'):
                await client.open_session("nobody")
            async with await client.open_session("cartpole") as agent:
                (decision,) = await client.act_batch([agent], [OBSERVATION], [0.0])
                assert (decision.step, agent.step) == (0, 1)

    asyncio.run(scenario())


def test_evaluate_plays_unseen_seeds(address):
    evaluation = spikeserve.evaluate(
        "CartPole-v1", server=address, episodes=3, seed=FIRST_UNSEEN_SEED
    )
    assert evaluation.policy == "cartpole"
    assert evaluation.mean_return >= 495, evaluation.returns
    assert evaluation.decisions == evaluation.returns.sum()
    assert 0 < evaluation.spikes_per_decision < 1000
    assert str(evaluation).startswith("cartpole/2 plays CartPole-v1: return ")


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
