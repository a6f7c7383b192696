"""Compares the C++ environments with those of Gymnasium, step by step.

In the comparison of steps, the C++ environment starts every step from the state of Gymnasium. Two
separate simulations would diverge near an unstable equilibrium because of rounding. A restart also
resets the time limit, so another test compares the time limit in whole episodes, with actions for
which rounding errors do not grow.
"""

import json
import math
import os
import subprocess

import gymnasium
import numpy as np
import pytest

IDS = ["CartPole-v1", "MountainCar-v0", "Acrobot-v1", "Pendulum-v1"]
SEEDS = range(5)
TOLERANCE = 1e-12


class Stepper:
    """The C++ environment in a separate process."""

    def __init__(self, environment_id):
        self._process = subprocess.Popen(
            [os.environ["ENVIRONMENT_STEPPER_PROGRAM"], environment_id],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.stdin.close()
        self._process.stdout.close()
        assert self._process.wait(timeout=10) == 0

    def reset(self, seed):
        return self._ask(seed=seed)

    def reset_to(self, state):
        return self._ask(state=np.asarray(state, np.float64).tolist())

    def step(self, action):
        return self._ask(action=np.asarray(action).tolist())

    def _ask(self, **request):
        print(json.dumps(request), file=self._process.stdin, flush=True)
        answer = json.loads(self._process.stdout.readline())
        answer["observation"] = np.array(answer["observation"], np.float32)
        return answer


@pytest.fixture(params=IDS)
def environment(request):
    with gymnasium.make(request.param) as made:
        yield made


@pytest.fixture
def stepper(environment):
    with Stepper(environment.spec.id) as started:
        yield started


def random_action(environment, observation):
    return environment.action_space.sample()


def scripted_action(environment, observation):
    """Reaches states that random actions do not reach: long upright, at the goal, at full speed."""
    match environment.spec.id:
        case "CartPole-v1":
            return int(np.dot([0.1, 0.3, 3.0, 1.0], observation) > 0)
        case "MountainCar-v0":
            return 2 if observation[1] >= 0 else 0
        case "Acrobot-v1":
            return 2 if observation[4] <= 0 else 0
        case "Pendulum-v1":
            return np.array([math.copysign(2.0, observation[2])], np.float32)


def assert_same_state(ours, theirs, tolerance=TOLERANCE):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance)


@pytest.mark.parametrize("choose_action", [random_action, scripted_action])
@pytest.mark.parametrize("seed", SEEDS)
def test_every_step_of_an_episode_is_the_same(environment, stepper, choose_action, seed):
    environment.action_space.seed(seed)
    observation, _ = environment.reset(seed=seed)
    done = False
    while not done:
        action = choose_action(environment, observation)
        stepper.reset_to(environment.unwrapped.state)
        observation, reward, terminated, truncated, _ = environment.step(action)
        ours = stepper.step(action)
        assert_same_state(ours["state"], environment.unwrapped.state)
        np.testing.assert_array_equal(ours["observation"], observation)
        assert ours["reward"] == pytest.approx(reward, rel=0, abs=TOLERANCE)
        assert ours["terminated"] == terminated
        done = terminated or truncated


# States beside a bound, and an action that meets it: walls, goals, limits of speed and of angles.
EDGES = {
    "CartPole-v1": [
        *(([sign * x for x in state], action) for sign in (1, -1) for state in ([2.39, 1, 0, 0], [0, 0, 0.209, 1]) for action in (0, 1)),
        ([2.39, 0.0, 0.209, 0.0], 1),
    ],
    "MountainCar-v0": [([-1.19, -0.07], 0), ([0.1, -0.07], 0), ([0.1, 0.07], 2), ([0.49, 0.05], 2), ([0.59, -0.02], 0)],
    "Acrobot-v1": [([3.1, -3.1, 12.5, -28.2], 2), ([-3.1, 3.1, -12.5, 28.2], 0), ([3.0, 0.0, 0.0, 0.0], 1)],
    "Pendulum-v1": [([7.0, 7.99], [2.0]), ([-7.0, -7.99], [-2.0]), ([0.5, -2.0], [-2.0]), ([-math.pi, 0.0], [0.0])],
}


def test_steps_beside_a_bound_are_the_same(environment, stepper):
    for state, action in EDGES[environment.spec.id]:
        environment.reset(seed=0)
        environment.unwrapped.state = np.array(state, np.float64)
        stepper.reset_to(state)
        chosen = np.array(action, np.float32) if isinstance(action, list) else action
        observation, reward, terminated, *_ = environment.step(chosen)
        ours = stepper.step(chosen)
        assert_same_state(ours["state"], environment.unwrapped.state)
        np.testing.assert_array_equal(ours["observation"], observation)
        assert ours["reward"] == pytest.approx(reward, rel=0, abs=TOLERANCE)
        assert ours["terminated"] == terminated


def test_a_seed_draws_the_same_initial_state(environment, stepper):
    # Only the first observation of Acrobot is a float32 cosine of a float32 angle.
    ulp = 1 if environment.spec.id == "Acrobot-v1" else 0
    for seed in [*range(1000), 2**32 - 1, 2**32, 2**63]:
        observation, _ = environment.reset(seed=seed)
        ours = stepper.reset(seed)
        assert ours["state"] == np.asarray(environment.unwrapped.state, np.float64).tolist()
        np.testing.assert_array_max_ulp(ours["observation"], observation, maxulp=ulp)


# Actions with which no episode ends before its time limit, and rounding errors do not grow.
UNENDING = {
    "CartPole-v1": scripted_action,
    "MountainCar-v0": lambda environment, observation: 1,
    "Acrobot-v1": lambda environment, observation: 1,
    "Pendulum-v1": lambda environment, observation: np.array([-0.5], np.float32),
}


def test_the_time_limit_truncates_the_same_step(environment, stepper):
    for seed in SEEDS:
        observation, _ = environment.reset(seed=seed)
        stepper.reset(seed)
        for step in range(1, environment.spec.max_episode_steps + 1):
            action = UNENDING[environment.spec.id](environment, observation)
            observation, reward, terminated, truncated, _ = environment.step(action)
            ours = stepper.step(action)
            assert (ours["terminated"], ours["truncated"]) == (terminated, truncated)
            assert ours["reward"] == pytest.approx(reward, rel=0, abs=1e-9)
            assert_same_state(ours["state"], environment.unwrapped.state, tolerance=1e-9)
            assert truncated == (step == environment.spec.max_episode_steps)
