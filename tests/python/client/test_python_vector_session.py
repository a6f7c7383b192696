"""VectorSession plays real Gymnasium vector environments exactly as Session plays single ones.

Each row of a vector environment uses the same random generator as a single environment with the
same seed. So the episodes of each row must equal those of a single environment, including their
spikes. They differ if one action is added, one reward is lost, or one observation belongs to the
wrong episode.
"""

import asyncio
import shutil

import grpc
import gymnasium
import numpy as np
import pytest
import spikeserve
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorWrapper
from policy_file import read_policy, write_policy
from random_policy import export_random
from serving import SHIPPED_POLICIES, running_server

# Episodes of the random CartPole policy end at different steps. The others end at the time limit.
POLICIES = {
    "random_cartpole": "CartPole-v1",
    "random_mountaincar": "MountainCar-v0",
    "random_acrobot": "Acrobot-v1",
    "random_pendulum": "Pendulum-v1",
}
ROWS = 3
STEPS = 150
MAX_EPISODE_STEPS = 40
SEED = 1_000_000


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policies")
    shutil.copytree(SHIPPED_POLICIES / "cartpole", folder / "cartpole")
    for name, env_id in POLICIES.items():
        with gymnasium.make(env_id) as environment:
            export_random(folder, name, environment)
    with running_server(folder) as server:
        yield server.grpc


def make(env_id):
    return gymnasium.make(env_id, max_episode_steps=MAX_EPISODE_STEPS)


def make_rows(env_id, mode):
    return SyncVectorEnv([lambda: make(env_id)] * ROWS, autoreset_mode=mode)


def play_alone(client, policy, env_id, seed, episodes):
    """Returns the summaries of consecutive episodes of one environment, and every action."""
    environment = make(env_id)
    summaries, actions = [], []
    with client.open_session(policy) as session:
        for episode in range(episodes):
            observation, _ = environment.reset(seed=seed if episode == 0 else None)
            reward, over = 0.0, False
            while not over:
                actions.append(session.act(observation, reward).action)
                observation, reward, terminated, truncated, _ = environment.step(actions[-1])
                over = terminated or truncated
            summaries.append(session.end_episode(reward, terminated, truncated))
    environment.close()
    return summaries, actions


def play_rows(agents, envs):
    """Returns the summaries and the actions of each row."""
    summaries = [[] for _ in range(ROWS)]
    actions = [[] for _ in range(ROWS)]
    observations, _ = envs.reset(seed=SEED)
    outcome = ()
    for _ in range(STEPS):
        chosen = agents.act(observations, *outcome)
        assert chosen.dtype == envs.action_space.dtype
        assert envs.action_space.contains(chosen)
        for row, decision in enumerate(agents.decisions):
            if decision is not None:
                actions[row].append(chosen[row])
        for row, summary in agents.ended.items():
            summaries[row].append(summary)
        observations, *outcome, _ = envs.step(chosen)
    return summaries, actions


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(("policy", "env_id"), [*POLICIES.items(), ("cartpole", "CartPole-v1")])
def test_every_row_plays_as_if_alone(client, policy, env_id, mode):
    envs = make_rows(env_id, mode)
    with spikeserve.VectorSession(client, policy, envs) as agents:
        summaries, actions = play_rows(agents, envs)
        decisions = [session.state().decisions for session in agents.sessions]
    envs.close()
    assert decisions == [len(row) for row in actions]
    for row in range(ROWS):
        assert len(summaries[row]) >= 3
        alone, actions_alone = play_alone(client, policy, env_id, SEED + row, len(summaries[row]))
        assert summaries[row] == alone
        np.testing.assert_array_equal(actions[row][: len(actions_alone)], actions_alone)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_async_rows_play_the_same(client, address, mode):
    def play(step):
        """Returns all results of `step`, which takes the arguments of act."""
        envs = make_rows("CartPole-v1", mode)
        observations, _ = envs.reset(seed=SEED)
        outcome, received = (), []
        for _ in range(STEPS):
            chosen, ended = step(observations, *outcome)
            received.append((chosen.tolist(), ended))
            observations, *outcome, _ = envs.step(chosen)
        return received

    envs = make_rows("CartPole-v1", mode)
    with spikeserve.VectorSession(client, "random_cartpole", envs) as agents:
        expected = play(lambda *outcome: (agents.act(*outcome), agents.ended))
    with asyncio.Runner() as runner:
        other = spikeserve.AsyncClient(address)
        rows = runner.run(open_rows(other, envs))
        received = play(lambda *outcome: (runner.run(rows.act(*outcome)), rows.ended))
        runner.run(rows.reset())
        assert [session.step for session in rows.sessions] == [0] * ROWS
        runner.run(rows.close())
        runner.run(other.close())
    assert received == expected
    assert any(ended for _, ended in received)


async def open_rows(client, envs):
    return await spikeserve.AsyncVectorSession.open(client, "random_cartpole", envs)


class WithoutFinals(VectorWrapper):
    """Resets rows in the same step and does not keep, or does not say, which observations were the last ones."""

    left_out = ()

    def step(self, actions):
        *outcome, infos = self.env.step(actions)
        for key in self.left_out:
            infos.pop(key, None)
        return *outcome, infos


@pytest.mark.parametrize("left_out", [("final_obs", "_final_obs"), ("final_obs",), ("_final_obs",)])
def test_final_observations_may_be_missing(client, left_out):
    envs = WithoutFinals(make_rows("CartPole-v1", AutoresetMode.SAME_STEP))
    envs.left_out = left_out
    with spikeserve.VectorSession(client, "random_cartpole", envs) as agents:
        observations, _ = envs.reset(seed=SEED)
        outcome, ended = (), 0
        while ended < ROWS:
            observations, *outcome = envs.step(agents.act(observations, *outcome))
            ended += len(agents.ended)


def test_a_masked_final_observation_is_none(client):
    envs = make_rows("CartPole-v1", AutoresetMode.SAME_STEP)
    with spikeserve.VectorSession(client, "cartpole", envs) as agents:
        observations, _ = envs.reset(seed=SEED)
        agents.act(observations)
        ended = np.array([True, True, False])
        infos = {"final_obs": np.full((ROWS, 4), np.nan), "_final_obs": np.zeros(ROWS, bool)}
        agents.act(observations, np.ones(ROWS), ended, np.zeros(ROWS, bool), infos)
        assert sorted(agents.ended) == [0, 1]


@pytest.mark.parametrize("bound", [0.1, 1 / 3, np.pi])
def test_actions_are_within_a_space_of_doubles(tmp_path, bound):
    """A policy has bounds in float32, which are not those of the environment."""
    space = gymnasium.spaces.Box(-bound, bound, (1,), np.float64)

    def make_bounded():
        return gymnasium.wrappers.RescaleAction(make("Pendulum-v1"), -bound, bound)

    envs = SyncVectorEnv([make_bounded] * ROWS)
    envs.single_action_space = space
    envs.action_space = gymnasium.vector.utils.batch_space(space, ROWS)
    with make("Pendulum-v1") as pendulum:
        pendulum.action_space = space
        export_random(tmp_path / "made", "bounded", pendulum)
    tensors, metadata = read_policy(tmp_path / "made/bounded/1/policy.safetensors")
    tensors["head.bias"] = np.full_like(tensors["head.bias"], 100.0)  # its greatest action
    write_policy(tmp_path / "served/bounded/1/policy.safetensors", tensors, metadata)
    with running_server(tmp_path / "served") as server, spikeserve.Client(server.grpc) as client:
        with spikeserve.VectorSession(client, "bounded", envs) as agents:
            observations, _ = envs.reset(seed=SEED)
            outcome, chosen = (), []
            for _ in range(20):
                actions = agents.act(observations, *outcome)
                assert envs.action_space.contains(actions), actions
                chosen += actions.ravel().tolist()
                observations, *outcome, _ = envs.step(actions)
        assert set(chosen) == {bound}


def test_masked_numbers_are_refused(client):
    envs = make_rows("CartPole-v1", AutoresetMode.NEXT_STEP)
    hidden = np.ma.masked_array(np.zeros(4), [False, True, False, False])
    expected = "expected numbers, received a masked array without 1 of its numbers"
    with spikeserve.VectorSession(client, "cartpole", envs) as agents:
        with pytest.raises(ValueError, match=f"observations: {expected}"):
            agents.act(np.ma.stack([hidden] + [np.zeros(4)] * (ROWS - 1)))
        agents.act(np.ma.masked_array(np.zeros((ROWS, 4))))
    with client.open_session("cartpole") as session:
        with pytest.raises(ValueError, match=f"observation: {expected}"):
            session.act(hidden)
        session.act(hidden.filled(0.0))
        with pytest.raises(ValueError, match=f"executed_action: {expected}"):
            session.act(np.zeros(4), 1.0, executed_action=np.ma.masked_array([1.0], [True]))


def test_an_ended_row_waits_for_its_reset(client):
    envs = make_rows("CartPole-v1", AutoresetMode.NEXT_STEP)
    with spikeserve.VectorSession(client, "cartpole", envs) as agents:
        observations, _ = envs.reset(seed=SEED)
        agents.act(observations)
        ended = np.array([False, True, False])
        agents.act(observations, np.ones(ROWS), ended, np.zeros(ROWS, bool))
        assert [decision is None for decision in agents.decisions] == ended.tolist()
        assert [session.step for session in agents.sessions] == [2, 0, 2]
        assert {row: summary.steps for row, summary in agents.ended.items()} == {1: 1}
        agents.act(observations, np.zeros(ROWS))
        assert [session.step for session in agents.sessions] == [3, 1, 3]
        assert agents.ended == {}


def test_a_fast_vector_environment_of_gymnasium_is_played(client):
    envs = gymnasium.make_vec("CartPole-v1", num_envs=4)
    with spikeserve.VectorSession(client, "cartpole", envs) as agents:
        observations, _ = envs.reset(seed=SEED)
        outcome, returns = (), []
        while len(returns) < 4:
            observations, *outcome, _ = envs.step(agents.act(observations, *outcome))
            returns += [summary.episode_return for summary in agents.ended.values()]
    assert np.mean(returns) >= 495, returns


def test_a_reset_in_the_middle_starts_new_episodes(client):
    envs = make_rows("CartPole-v1", AutoresetMode.SAME_STEP)
    with spikeserve.VectorSession(client, "cartpole", envs) as agents:
        for _ in range(2):
            observations, _ = envs.reset(seed=SEED)
            agents.reset()
            first = agents.act(observations)
            observations, *outcome, _ = envs.step(first)
            agents.act(observations, *outcome)
            assert [session.step for session in agents.sessions] == [2] * ROWS


def test_all_rows_move_on_or_none(client):
    envs = make_rows("CartPole-v1", AutoresetMode.SAME_STEP)
    with spikeserve.VectorSession(client, "cartpole", envs) as agents:
        observations, _ = envs.reset(seed=SEED)
        agents.act(observations)
        ended = [True, False, False]
        broken = observations.copy()
        broken[1] = np.nan
        with pytest.raises(spikeserve.InvalidArgumentError, match=r"observation\[0\]"):
            agents.act(broken, np.ones(ROWS), ended)
        agents.act(observations, np.ones(ROWS), ended)
        assert [session.step for session in agents.sessions] == [1, 2, 2]
        assert list(agents.ended) == [0]
        assert [session.state().decisions for session in agents.sessions] == [2, 2, 2]


class FailsToEnd(spikeserve.AsyncClient):
    """Raises without a delay when it should end the episode of the session `session_id`."""

    session_id = None

    async def perform(self, call):
        if call.method == "EndEpisode" and call.request.session_id == self.session_id:
            raise spikeserve.UnavailableError(call.method, grpc.StatusCode.UNAVAILABLE, "broken")
        return await super().perform(call)


def test_async_rows_end_although_another_row_fails(address):
    async def scenario():
        envs = make_rows("CartPole-v1", AutoresetMode.SAME_STEP)
        observations, _ = envs.reset(seed=SEED)
        async with FailsToEnd(address) as client:
            rows = await open_rows(client, envs)
            await rows.act(observations)
            client.session_id = rows.sessions[0].session_id
            with pytest.raises(spikeserve.UnavailableError):
                await rows.act(observations, np.ones(ROWS), [True] * ROWS)
            assert [session.step for session in rows.sessions] == [1, 0, 0]
            client.session_id = None
            await rows.act(observations, np.ones(ROWS), [True] * ROWS)
            assert sorted(rows.ended) == [0, 1, 2]
            await rows.close()

    asyncio.run(scenario())


def test_what_does_not_fit_is_refused(client):
    cartpole = make_rows("CartPole-v1", AutoresetMode.NEXT_STEP)
    mismatch = r"expected shape \(6,\) for policy 'random_acrobot', received \(4,\)"
    with pytest.raises(ValueError, match=mismatch):
        spikeserve.VectorSession(client, "random_acrobot", cartpole)
    mountain_car = make_rows("MountainCar-v0", AutoresetMode.DISABLED)
    disabled = "autoreset_mode: expected NextStep or SameStep, received Disabled"
    with pytest.raises(ValueError, match=disabled):
        spikeserve.VectorSession(client, "random_mountaincar", mountain_car)
    with spikeserve.VectorSession(client, "cartpole", cartpole) as agents:
        one_dimension = r"observations: expected shape \(3, n\), received \(3,\)"
        with pytest.raises(ValueError, match=one_dimension):
            agents.act([0, 0, 0])
        agents.act(np.zeros((ROWS, 4)))
        with pytest.raises(ValueError, match="rewards: expected one for each row"):
            agents.act(np.zeros((ROWS, 4)))


@pytest.mark.parametrize("policy", ["random_mountaincar", "random_acrobot", "random_pendulum"])
def test_evaluate_finds_the_policy_of_each_task(address, policy):
    evaluation = spikeserve.evaluate(POLICIES[policy], server=address, episodes=2)
    assert evaluation.policy == policy
    assert len(evaluation.returns) == 2


def test_evaluate_plays_each_seed(client):
    first = spikeserve.evaluate("CartPole-v1", "random_cartpole", server=client, seed=7, episodes=4)
    later = spikeserve.evaluate("CartPole-v1", "random_cartpole", server=client, seed=9, episodes=2)
    assert len(set(first.returns)) > 1
    assert first.episodes[2:] == later.episodes
