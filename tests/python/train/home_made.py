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


class Picture(gymnasium.Env):
    """A red dot in a picture of 16 x 16 pixels moves to a green one. The reward is minus the distance."""

    SIDE, STRIDE = 16, 2
    MOVES = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))

    def __init__(self):
        self.observation_space = spaces.Box(0, 255, (self.SIDE, self.SIDE, 3), np.uint8)
        self.action_space = spaces.Discrete(len(self.MOVES))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.dot, self.goal = self.STRIDE * self.np_random.integers(self.SIDE // self.STRIDE, size=(2, 2))
        return self._picture(), {}

    def step(self, action):
        self.dot = np.clip(self.dot + self.STRIDE * np.array(self.MOVES[action]), 0, self.SIDE - self.STRIDE)
        return self._picture(), -float(np.abs(self.goal - self.dot).sum()) / self.SIDE, False, False, {}

    def _picture(self):
        picture = np.full(self.observation_space.shape, 40, np.uint8)
        for channel, (row, column) in enumerate((self.dot, self.goal)):
            picture[row : row + self.STRIDE, column : column + self.STRIDE, channel] = 255
        return picture


gymnasium.register("Picture-v0", entry_point="home_made:Picture", max_episode_steps=16)


def go_to_dot(environment, observation):
    """The expert of Picture-v0: moves along the axis on which the goal is farther away."""
    away = environment.goal - environment.dot
    if not away.any():
        return 0
    axis = int(np.argmax(np.abs(away)))
    return 1 + 2 * axis + int(away[axis] > 0)


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
