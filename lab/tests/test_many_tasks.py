"""One environment that is another task in each episode: its expert plays all of them, and its score is that of the task."""

import gymnasium
import many_tasks
import pytest


@pytest.fixture
def environment():
    made = gymnasium.make("ManyTasks-v0").unwrapped
    yield made
    made.close()


def play(environment, seed, policy):
    """Returns the task and the score."""
    observation, _ = environment.reset(seed=seed)
    while True:
        assert observation in environment.observation_space
        observation, reward, terminated, truncated, infos = environment.step(policy(environment, observation))
        if terminated or truncated:
            return infos["task"], reward
        assert reward == 0


def test_the_expert_plays_every_task(environment):
    scores = {}
    for seed in range(15):
        task, score = play(environment, seed, many_tasks.play)
        scores.setdefault(task, []).append(score)
    assert set(scores) == set(many_tasks.TASKS)
    for task, of_task in scores.items():
        assert 0.8 < sum(of_task) / len(of_task) < 1.2, task


def test_a_constant_action_scores_nothing(environment):
    assert max(play(environment, seed, lambda *_: 1)[1] for seed in range(10)) < 0.1


def test_a_start_is_repeated(environment):
    first, again = (environment.reset(seed=4) for _ in range(2))
    assert (first[0] == again[0]).all() and first[1] == again[1]
