"""Environments whose actions are executed 0 to 5 beats late, and experts that bear every delay without knowing it.

    python -m spikeserve imitate late:LatePendulum-v0 --expert late:swing_up

Registers LateCartPole-v0, LatePendulum-v0 and LateLunarLander-v0, which are CartPole-v1, Pendulum-v1 and
LunarLanderContinuous-v3 otherwise. Every episode draws its delay. An expert uses what a policy sees: the observation and,
through the change of the observation, what was executed last. The constants of the first two are those of a cross-entropy
search for the highest return over all delays, on starts of its own.
"""

import gymnasium
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from gymnasium.envs.classic_control.pendulum import PendulumEnv

MOST_BEATS = 5


class _Late(gymnasium.Env):
    """Executes `neutral` until the first action arrives."""

    neutral = 0

    def reset(self, seed=None, options=None):
        self.under_way = []  # LunarLander's reset makes a step
        observation, info = super().reset(seed=seed, options=options)
        self.executed = None  # the last action that was
        self.under_way = [self.neutral] * int(self.np_random.integers(0, MOST_BEATS, endpoint=True))
        return observation, info

    def step(self, action):
        self.under_way.append(action)
        self.executed = self.under_way.pop(0)
        return super().step(self.executed)


class LateCartPole(_Late, CartPoleEnv):
    """The neutral action pushes to the left. Five of them are the end of one of eight episodes, whatever comes after."""


class LatePendulum(_Late, PendulumEnv):
    """The neutral action is no torque."""

    neutral = np.zeros(1, np.float32)


def late_lunar_lander(**settings):
    """Returns LunarLander with two continuous actions. The neutral action fires no engine."""
    from gymnasium.envs.box2d.lunar_lander import LunarLander  # only this environment needs Box2D

    class LateLunarLander(_Late, LunarLander):
        neutral = np.zeros(2, np.float32)

    return LateLunarLander(continuous=True, **settings)


def balance(environment, observation):
    """The expert of LateCartPole-v0. The first action is to the right, against the neutral one."""
    if environment.executed is None:
        return 1
    last = 1 if environment.executed == 1 else -1
    position, speed, angle, turn = observation
    return int(0.023 * position + 0.152 * speed + 1.18 * angle + 0.352 * turn - 0.1 * last > 0)


def swing_up(environment, observation):
    """The expert of LatePendulum-v0: balances where the angle will soon be small, and elsewhere gives or takes energy."""
    cosine, sine, speed = np.asarray(observation, np.float64)
    angle = np.arctan2(sine, cosine)
    last = 0.0 if environment.executed is None else np.clip(environment.executed[0], -2, 2)
    if abs(angle + 0.146 * speed) < 0.945:
        torque = -9.1 * angle - 2.34 * speed - 0.676 * last
    else:
        missing = 15 * (1 - cosine) - speed**2 / 2 - 1.31  # energy
        torque = 2 * np.tanh(0.423 * missing * (speed + 2.4 * sine))
    return np.clip([torque], -2, 2).astype(np.float32)


def land(observation):
    """The expert of LateLunarLander-v0: Gymnasium's heuristic with half as much damping again of the lander's turns."""
    x, y, x_speed, y_speed, angle, turn, left_leg, right_leg = observation
    wanted_angle = np.clip(0.5 * x + x_speed, -0.4, 0.4)
    torque = 0.5 * (wanted_angle - angle) - 1.5 * turn
    lift = 0.5 * (0.55 * abs(x) - y) - 0.5 * y_speed
    if left_leg or right_leg:
        torque, lift = 0.0, -0.5 * y_speed
    return np.clip([20 * lift - 1, -20 * torque], -1, 1).astype(np.float32)


gymnasium.register("LateCartPole-v0", entry_point=LateCartPole, max_episode_steps=500)
gymnasium.register("LatePendulum-v0", entry_point=LatePendulum, max_episode_steps=200)
gymnasium.register("LateLunarLander-v0", entry_point=late_lunar_lander, max_episode_steps=1000)
