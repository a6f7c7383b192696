"""Environments whose observation lacks a part of the state, and experts that know it.

Registers Reacher2D-v0, Spring-v0, Vehicle-v0, Thermostat-v0 and AnglePendulum-v0. An expert is a function of the
environment and the observation. What is hidden shows only in how the observation changes, or in
what happened many steps ago.
"""

from __future__ import annotations

import gymnasium
import numpy as np
from gymnasium.envs.classic_control.pendulum import PendulumEnv, angle_normalize


class _Hidden(gymnasium.Env):
    """An environment of `observations` numbers and `actions` actions within -1 and 1."""

    observations = 1
    actions = 1

    def __init__(self):
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.observations,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.actions,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.start(self.np_random)
        return self.observe(), {}

    def step(self, action):
        reward = self.move(np.clip(np.asarray(action, np.float64), -1, 1))
        return self.observe(), float(reward), False, False, {}

    def observe(self):
        return np.concatenate(self.seen()).astype(np.float32)


class Reacher2D(_Hidden):
    """A mass in the plane is pushed to a target. Its velocity is hidden."""

    observations = 4
    actions = 2

    def start(self, random):
        self.position, self.velocity = random.uniform(-1, 1, 2), np.zeros(2)
        self.target = random.uniform(-1, 1, 2)
        self.noise = np.random.default_rng(random.integers(1 << 32))

    def move(self, push):
        self.velocity = self.velocity + 0.04 * 8 * push
        self.position = self.position + 0.04 * self.velocity
        return -np.linalg.norm(self.target - self.position)

    def seen(self):
        return self.position, self.target


class Spring(_Hidden):
    """A mass on a spring is moved to a target. Its velocity is hidden."""

    observations = 2

    def start(self, random):
        self.position, self.velocity = random.uniform(-1, 1, 1), random.uniform(-2, 2, 1)
        self.target = random.uniform(-0.5, 0.5, 1)

    def move(self, push):
        self.velocity = self.velocity + 0.05 * (12 * push - 9 * self.position - 0.1 * self.velocity)
        self.position = self.position + 0.05 * self.velocity
        return -np.square(self.target - self.position).item() - 0.01 * np.square(push).item()

    def seen(self):
        return self.position, self.target


class Vehicle(_Hidden):
    """A vehicle drives to a stop line. Its force follows the pedal with a lag, and is hidden."""

    observations = 2

    def start(self, random):
        self.distance, self.speed = random.uniform(2, 8, 1), random.uniform(-1, 2, 1)
        self.force = random.uniform(-1, 1, 1)

    def move(self, pedal):
        self.force = self.force + 0.1 * (pedal - self.force)
        self.speed = self.speed + 0.05 * (3 * self.force - 0.2 * self.speed)
        self.distance = self.distance - 0.05 * self.speed
        return -abs(self.distance.item()) / 4 - 0.02 * np.square(pedal).item()

    def seen(self):
        return self.distance, self.speed


class Thermostat(_Hidden):
    """A room is heated to a wanted temperature. The temperature of its walls is hidden."""

    observations = 2

    def start(self, random):
        self.air, self.walls = random.uniform(10, 25, 1), random.uniform(5, 20, 1)
        self.wanted = random.uniform(18, 23, 1)

    def move(self, heating):
        self.air = self.air + 0.2 * (self.walls - self.air) + 3 * (heating + 1) / 2
        self.walls = self.walls + 0.03 * (self.air - self.walls) + 0.01 * (5 - self.walls)
        return -abs(self.wanted - self.air).item() - 0.2 * (heating.item() + 1) / 2

    def seen(self):
        return self.air, self.wanted


class AnglePendulum(gymnasium.ObservationWrapper):
    """Gymnasium's Pendulum-v1. Its angular velocity is hidden."""

    def __init__(self):
        super().__init__(PendulumEnv())
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def observation(self, observation):
        return observation[:2]


def reach(environment, _):
    """Pushes towards the target and against the velocity, with noise."""
    wanted = 3 * (environment.target - environment.position) - 1.1 * environment.velocity
    return np.clip(wanted + environment.noise.normal(0, 0.2, 2), -1, 1)


def hold(environment, _):
    """Carries the spring's force at the target, and damps."""
    wanted = 0.75 * environment.target + 2 * (environment.target - environment.position)
    return np.clip(wanted - 0.5 * environment.velocity, -1, 1)


def brake(environment, _):
    """Stops at the line, and takes the lag into account."""
    wanted = 1.5 * (environment.distance - environment.speed - environment.force)
    return np.clip(wanted, -1, 1)


def heat(environment, _):
    """Gives the heat that the walls will take."""
    needed = environment.wanted - environment.air - 0.2 * (environment.walls - environment.air)
    return np.clip(2 * needed / 3 - 1, -1, 1)


def swing_up(environment, _):
    """Pumps energy until the pendulum is nearly upright, then balances."""
    angle, speed = angle_normalize(environment.state[0]), environment.state[1]
    if abs(angle) < 0.6 and abs(speed) < 3:
        return np.clip([-12 * angle - 3.2 * speed], -2, 2)
    energy = speed**2 / 2 + 15 * (np.cos(angle) - 1)  # 0 at rest upright
    push = speed if abs(speed) > 0.3 else np.copysign(0.3, speed)
    return np.clip([-energy * push], -2, 2)


for _name, _class, _steps in (
    ("Reacher2D-v0", Reacher2D, 150),
    ("Spring-v0", Spring, 150),
    ("Vehicle-v0", Vehicle, 200),
    ("Thermostat-v0", Thermostat, 200),
    ("AnglePendulum-v0", AnglePendulum, 200),
):
    gymnasium.register(_name, entry_point=_class, max_episode_steps=_steps)
