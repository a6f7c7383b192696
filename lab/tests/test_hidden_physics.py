"""CartPole with hidden physics: they change between episodes, and the expert plays all of them."""

import gymnasium
import numpy as np
import pytest
from hidden_physics import GAINS, LONGEST_DELAY, balance


def started(seed):
    """Returns an environment and its first observation."""
    environment = gymnasium.make("HiddenCartPole-v0").unwrapped
    return environment, environment.reset(seed=seed)[0]


def play(seed, policy):
    """Returns the episode's steps, its observations and its actions."""
    environment, observation = started(seed)
    observations, actions, done = [observation], [], False
    while not done and len(actions) < 500:
        actions.append(policy(environment, observation))
        observation, _, done, *_ = environment.step(actions[-1])
        observations.append(observation)
    return len(actions), observations, actions


@pytest.mark.parametrize("seed", range(20))
def test_the_expert_balances_and_sees_the_action_before(seed):
    steps, observations, actions = play(seed, balance)
    assert steps == 500
    assert [observation[-1] for observation in observations] == [0, *(2 * action - 1 for action in actions)]


def test_who_does_not_know_the_sign_falls_in_half_of_the_episodes():
    lengths = [play(seed, lambda environment, observation: int(GAINS @ environment.foreseen_state() > 0))[0] for seed in range(20)]
    assert 5 <= sum(length == 500 for length in lengths) <= 15
    assert min(lengths) < 50


def test_an_action_pushes_after_the_delay_of_the_episode():
    delays = set()
    for seed in range(20):
        environment, _ = started(seed)
        delay = len(environment.underway)
        delays.add(delay)
        other, _ = started(seed)
        for step in range(delay + 1):
            first, second = (each.step(step == 0 and left)[0][:4] for each, left in ((environment, True), (other, False)))
            assert np.array_equal(first, second) == (step < delay)
    assert delays == {0, 1, 2, 3, 4}


def test_who_does_not_look_ahead_falls_in_some_episodes_with_long_delays():
    def policy(environment, observation):
        return int(GAINS @ np.asarray(environment.state) > 0) ^ environment.sign

    lengths = [play(seed, policy)[0] for seed in range(100) if len(started(seed)[0].underway) == LONGEST_DELAY]
    assert len(lengths) > 10
    assert min(lengths) < 500 <= max(lengths)


def test_an_episode_has_the_same_physics_in_each_run():
    (_, first, _), (_, again, _), (_, other, _) = play(1, balance), play(1, balance), play(2, balance)
    assert np.array_equal(first, again)
    assert not np.array_equal(first[1][:4] - first[0][:4], other[1][:4] - other[0][:4])
