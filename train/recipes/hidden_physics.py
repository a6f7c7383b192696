"""CartPole whose physics are hidden and drawn anew in each episode: the sign of the force, gravity, masses, length and force.

Registers HiddenCartPole-v0. The observation is CartPole's, and the action that was executed last: -1, 1, or 0 at the start.

    python -m spikeserve imitate hidden_physics:HiddenCartPole-v0 --expert hidden_physics:balance
"""

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

GAINS = np.array([0.5, 1.0, 9.0, 2.5])  # of position, velocity, angle and its velocity


class HiddenCartPole(CartPoleEnv):
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
        return self._with(observation, 0), infos

    def step(self, action):
        observation, *rest = super().step(int(action) ^ self.sign)
        return self._with(observation, 2 * int(action) - 1), *rest

    def _with(self, observation, action):
        return np.append(observation, action).astype(np.float32)


def balance(environment, observation):
    """The expert: pushes against a weighted sum of the state, and knows the sign."""
    return int(GAINS @ np.asarray(environment.state) > 0) ^ environment.sign


gymnasium.register("HiddenCartPole-v0", HiddenCartPole, max_episode_steps=500)
