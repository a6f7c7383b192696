"""CartPole whose physics are hidden and drawn anew in each episode: the force, its sign and its delay, gravity, masses and length.

Registers HiddenCartPole-v0. An action pushes up to four steps later; before the first one arrives, random ones do. The
observation is CartPole's, and the last action: -1, 1, or 0 at the start.

    python -m spikeserve imitate hidden_physics:HiddenCartPole-v0 --expert hidden_physics:balance
"""

import collections
import copy

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

LONGEST_DELAY = 4  # steps of 20 ms
GAINS = np.array([0.5, 1.0, 9.0, 2.5])  # of position, velocity, angle and its velocity


class HiddenCartPole(CartPoleEnv):
    """Observations are Box(5) of float32, actions Discrete(2), rewards 1 a step, as CartPole's."""

    def __init__(self):
        super().__init__()
        low, high = self.observation_space.low, self.observation_space.high
        self.observation_space = spaces.Box(np.append(low, -1).astype(np.float32), np.append(high, 1).astype(np.float32))

    def reset(self, seed=None, options=None):
        observation, infos = super().reset(seed=seed, options=options)
        draw = self.np_random.uniform
        self.sign = int(draw() < 0.5)
        self.gravity, self.force_mag = draw(5, 15), draw(6, 16)
        self.masscart, self.masspole, self.length = draw(0.5, 2), draw(0.05, 0.3), draw(0.3, 1)
        self.total_mass, self.polemass_length = self.masscart + self.masspole, self.masspole * self.length
        delay = self.np_random.integers(LONGEST_DELAY, endpoint=True)
        self.underway = collections.deque(map(int, self.np_random.integers(2, size=delay)))  # actions, the oldest first
        return self._with(observation, 0), infos

    def step(self, action):
        self.underway.append(int(action))
        observation, *rest = super().step(self.underway.popleft() ^ self.sign)
        return self._with(observation, 2 * int(action) - 1), *rest

    def foreseen_state(self):
        """Returns the state in which an action of now will push."""
        ghost = copy.copy(self)
        for action in self.underway:
            ghost.steps_beyond_terminated = None  # it may fall
            CartPoleEnv.step(ghost, action ^ self.sign)
        return np.asarray(ghost.state)

    def _with(self, observation, action):
        return np.append(observation, action).astype(np.float32)


def balance(environment, observation):
    """The expert: pushes against a weighted sum of the state, knows the sign, and looks ahead by the delay."""
    return int(GAINS @ environment.foreseen_state() > 0) ^ environment.sign


gymnasium.register("HiddenCartPole-v0", HiddenCartPole, max_episode_steps=500)
