"""One policy for several tasks: each episode is one of CartPole-v1, Acrobot-v1 and MountainCar-v0, and is not told which.

Registers ManyTasks-v0. The observation is that of the task, filled with zeros. The reward at the end is the score: 0 as random
actions return in the task, 1 as the expert.

    python -m spikeserve imitate many_tasks:ManyTasks-v0 --expert many_tasks:play
"""

import gymnasium
import numpy as np
from gymnasium import spaces
from hidden_physics import GAINS

# Experts of observations, and the mean returns of random actions and of the expert on the starts 1,000,000 to 1,000,299.
TASKS = {
    "CartPole-v1": (lambda seen: 2 * int(GAINS @ seen[:4] > 0), 17.2, 500.0),
    "Acrobot-v1": (lambda seen: 0 if seen[4] > 0 else 2, -498.9, -83.2),
    "MountainCar-v0": (lambda seen: 2 if seen[1] >= 0 else 0, -200.0, -119.5),
}
NUMBERS = 6  # of the longest observation


class ManyTasks(gymnasium.Env):
    def __init__(self):
        self.observation_space = spaces.Box(-np.inf, np.inf, (NUMBERS,), np.float32)
        self.action_space = spaces.Discrete(3)  # left or against, nothing, right; CartPole takes nothing for left
        self.tasks = {name: gymnasium.make(name) for name in TASKS}

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.name = list(TASKS)[self.np_random.integers(len(TASKS))]
        self.total = 0.0
        observation, _ = self.tasks[self.name].reset(seed=int(self.np_random.integers(2**31)))
        return filled(observation), {"task": self.name}

    def step(self, action):
        if self.name == "CartPole-v1":
            action //= 2
        observation, reward, terminated, truncated, _ = self.tasks[self.name].step(int(action))
        self.total += reward
        _, random, expert = TASKS[self.name]
        score = (self.total - random) / (expert - random)
        return filled(observation), score if terminated or truncated else 0.0, terminated, truncated, {"task": self.name}

    def close(self):
        for task in self.tasks.values():
            task.close()


def filled(observation):
    return np.pad(observation, (0, NUMBERS - len(observation))).astype(np.float32)


def play(environment, observation):
    """The expert of the episode's task."""
    return TASKS[environment.name][0](observation)


gymnasium.register("ManyTasks-v0", ManyTasks)
