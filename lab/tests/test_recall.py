"""Associative recall: what is asked for was shown once, and pairs are drawn anew in each episode."""

import gymnasium
import pytest
import recall


@pytest.mark.parametrize(("name", "pairs"), [("Recall-v0", 8), ("Recall32-v0", 32)])
def test_the_value_of_each_key_is_asked_for_once(name, pairs):
    environment = gymnasium.make(name).unwrapped
    shown, answers, total = {}, {}, 0.0
    observation, _ = environment.reset(seed=1)
    for timestep in range(2 * pairs):
        key, value = map(int, observation)
        action = recall.recall(environment, observation)
        if timestep < pairs:
            assert action == value != recall.ASKED
            shown[key] = value
        else:
            assert value == recall.ASKED
            answers[key] = action
        observation, reward, terminated, _, _ = environment.step(action)
        total += reward
        assert terminated == (timestep == 2 * pairs - 1)
        assert observation in environment.observation_space
    assert shown == answers and len(shown) == pairs
    assert total == pytest.approx(1)


def test_pairs_differ_between_episodes_and_not_between_runs():
    environment = gymnasium.make("Recall-v0").unwrapped

    def pairs(seed):
        environment.reset(seed=seed)
        return dict(zip(environment.keys, environment.values, strict=True)), list(environment.asked)

    assert pairs(1) == pairs(1) != pairs(2)


def test_a_wrong_answer_costs_what_a_right_one_gives():
    environment = gymnasium.make("Recall-v0").unwrapped
    observation, _ = environment.reset(seed=3)
    rewards = []
    for _ in range(16):
        observation, reward, *_ = environment.step((recall.recall(environment, observation) + 1) % recall.VALUES)
        rewards.append(reward)
    assert rewards == [0.0] * 8 + [-1 / 8] * 8
