"""An environment that is not Gymnasium's, with a Dict observation and a MultiDiscrete action, and experts.

`gymnasium.make("home_made:HomeMade-v0")` imports this module, which registers the environment.
"""

import gymnasium
import numpy as np
from gymnasium import spaces

SIZE = 4.0
CORNERS = np.array([[0.0, 0.0], [0.0, SIZE], [SIZE, 0.0], [SIZE, SIZE]])
FIRST_CORNER = 1


class HomeMade(gymnasium.Env):
    """A point on a square moves to the corner that the observation names. The reward is minus the distance."""

    def __init__(self):
        self.observation_space = spaces.Dict(
            {"corner": spaces.Discrete(4, start=FIRST_CORNER), "place": spaces.Box(0.0, SIZE, (2,), np.float64)}
        )
        self.action_space = spaces.MultiDiscrete([3, 3])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._corner = FIRST_CORNER + int(self.np_random.integers(4))
        self._place = self.np_random.uniform(0, SIZE, 2)
        return self._observation(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self._place = np.clip(self._place + 0.5 * (np.asarray(action) - 1), 0, SIZE)
        reward = -float(np.abs(CORNERS[self._corner - FIRST_CORNER] - self._place).sum())
        return self._observation(), reward, False, False, {}

    def _observation(self):
        return {"corner": self._corner, "place": self._place.copy()}


gymnasium.register("HomeMade-v0", entry_point="home_made:HomeMade", max_episode_steps=20)


def go_to_corner(observation):
    """The expert of HomeMade-v0."""
    away = CORNERS[observation["corner"] - FIRST_CORNER] - observation["place"]
    return 1 + np.sign(np.where(np.abs(away) < 0.25, 0, away)).astype(np.int64)


def balance(environment, observation):
    """An expert of CartPole-v1 that also takes the environment, as Gymnasium's heuristics do."""
    assert environment.unwrapped is environment
    x, x_dot, angle, angle_dot = observation
    return int(0.1 * x + 0.3 * x_dot + 3 * angle + angle_dot > 0)


class Backwards(gymnasium.ObservationWrapper):
    """Reverses the observation."""

    def __init__(self, environment):
        super().__init__(environment)
        space = environment.observation_space
        self.observation_space = spaces.Box(space.low[::-1], space.high[::-1], dtype=space.dtype)

    def observation(self, observation):
        return observation[::-1]
