"""Event cameras that are asked about what they saw: observations are mostly zero, and what is asked for was seen earlier.

Registers EventWatch-v0. Each of CAMERAS event cameras is a row of PIXELS pixels, on which a spot moves by a pixel now and then. A
camera reports changes only: 1 at the pixel that became bright, -1 at the one that became dark, else 0; at the first step all spots
appear. At each step one camera is asked for (one-hot, after the pixels), and the right action is the part of the row where its
spot is, of ZONES parts. Right actions of an episode add up to 1, random ones to 0.
"""

import gymnasium
import numpy as np
from gymnasium import spaces

CAMERAS, PIXELS, ZONES, STEPS = 2, 16, 4, 24
MOTION = 1 / 3  # probability that a spot moves in a step


class EventWatch(gymnasium.Env):
    observation_space = spaces.Box(-1, 1, (CAMERAS * PIXELS + CAMERAS,), np.float32)
    action_space = spaces.Discrete(ZONES)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.timestep, self.spots = 0, self.np_random.integers(PIXELS, size=CAMERAS)
        return self._observe(np.zeros((CAMERAS, PIXELS), np.float32)), {}

    def step(self, action):
        reward = (1 if action == self.zone else -1 / (ZONES - 1)) / STEPS
        self.timestep += 1
        before = self._image()
        moves = (self.np_random.random(CAMERAS) < MOTION) * self.np_random.choice([-1, 1], CAMERAS)
        self.spots = np.clip(self.spots + moves, 0, PIXELS - 1)
        return self._observe(before), reward, self.timestep == STEPS, False, {}

    @property
    def zone(self):
        """The right action."""
        return int(self.spots[self.asked]) * ZONES // PIXELS

    def _image(self):
        return np.eye(PIXELS, dtype=np.float32)[self.spots]

    def _observe(self, before):
        self.asked = int(self.np_random.integers(CAMERAS))
        return np.concatenate([(self._image() - before).ravel(), np.eye(CAMERAS, dtype=np.float32)[self.asked]])


def expert(environment, observation):
    return environment.zone


gymnasium.register("EventWatch-v0", EventWatch)
