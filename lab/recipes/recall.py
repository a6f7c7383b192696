"""Associative recall: pairs of a key and a value, drawn anew in each episode, then the keys alone, each asked for once.

Registers Recall-v0 and Recall32-v0, with 8 and 32 pairs. Keys are drawn without repetition, and asked for in another order. An
observation is one-hot: the key, and the value or that the key is asked for. The action of such a step is the key's value: a right
one rewards with 1 / pairs, a wrong one with -1 / pairs. Before it actions have no effect.

    python -m spikeserve imitate recall:Recall-v0 --expert recall:recall
"""

import gymnasium
import numpy as np
from gymnasium import spaces

VALUES = 4
ASKED = VALUES  # in the place of a value


class Recall(gymnasium.Env):
    """`pairs` pairs of twice as many keys."""

    def __init__(self, pairs=8):
        self.pairs = pairs
        self.observation_space = spaces.MultiDiscrete([2 * pairs, VALUES + 1])
        self.action_space = spaces.Discrete(VALUES)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.keys = self.np_random.permutation(2 * self.pairs)[: self.pairs]
        self.values = self.np_random.integers(VALUES, size=self.pairs)
        self.asked = self.np_random.permutation(self.pairs)
        self.timestep = 0
        return self._observe(), {}

    def step(self, action):
        right = self.answer
        reward = 0.0 if right is None else (1 if action == right else -1) / self.pairs
        self.timestep += 1
        done = self.timestep == 2 * self.pairs
        return self._observe() if not done else np.array([0, ASKED]), reward, done, False, {}

    @property
    def answer(self):
        """The value that is asked for, or None."""
        return None if self.timestep < self.pairs else int(self.values[self.asked[self.timestep - self.pairs]])

    def _observe(self):
        if self.timestep < self.pairs:
            return np.array([self.keys[self.timestep], self.values[self.timestep]])
        return np.array([self.keys[self.asked[self.timestep - self.pairs]], ASKED])


def recall(environment, observation):
    """The expert of Recall. While pairs are shown it names the value that it sees."""
    return int(environment.values[environment.timestep]) if environment.answer is None else environment.answer


gymnasium.register("Recall-v0", Recall)
gymnasium.register("Recall32-v0", Recall, kwargs={"pairs": 32})
