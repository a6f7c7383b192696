"""Experts for environments of Gymnasium that have none of their own.

python -m spikeserve imitate InvertedDoublePendulum-v5 --expert experts:balance_double_pendulum
"""

import functools
import json
import os
import pathlib

import gymnasium
import numpy as np
import safetensors.numpy

# The weights of the regulator's cost: of position and angles, of their velocities, and of the force.
STATE_COST = np.diag([1.0, 10.0, 10.0, 0.1, 0.1, 0.1])
FORCE_COST = 1.0
DIFFERENCE = 1e-5

LINEAR = pathlib.Path(__file__).parent / "linear"  # what ars.py found

NO_ENGINE, LEFT_ENGINE, MAIN_ENGINE, RIGHT_ENGINE = range(4)  # actions of LunarLander-v3


def balance_double_pendulum(observation):
    """Returns the force of a linear-quadratic regulator, the expert of InvertedDoublePendulum-v5."""
    angles = np.arctan2(observation[1:3], observation[3:5])
    state = np.concatenate([observation[:1], angles, observation[5:8]])
    return np.clip(-double_pendulum_gain() @ state, -1.0, 1.0)


@functools.cache
def double_pendulum_gain():
    """Returns K of u = -K x at the upright rest, [1, 6]: the fixed point of the discrete Riccati equation."""
    change, effect = linear_double_pendulum()
    cost = STATE_COST
    for _ in range(3000):
        gain = np.linalg.solve(FORCE_COST + effect.T @ cost @ effect, effect.T @ cost @ change)
        cost = STATE_COST + change.T @ cost @ (change - effect @ gain)
    return gain


def linear_double_pendulum():
    """Returns A [6, 6] and B [6, 1] of one step x' = A x + B u near the upright rest, by central differences."""
    import mujoco  # only this expert needs it

    environment = gymnasium.make("InvertedDoublePendulum-v5").unwrapped
    model, data = environment.model, environment.data

    def step(state_and_force):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = np.split(state_and_force, [3, 6])
        mujoco.mj_step(model, data, nstep=environment.frame_skip)
        return np.concatenate([data.qpos, data.qvel])

    columns = [(step(row) - step(-row)) / (2 * DIFFERENCE) for row in DIFFERENCE * np.eye(7)]
    return np.array(columns[:6]).T, np.array(columns[6:]).T


def walk_to_goal(environment, observation):
    """The expert of MiniGrid's empty rooms: turns until the agent sees the goal, then walks to it.

    It uses nothing that the agent's partial view does not show.
    """
    goal = environment.width - 2, environment.height - 2
    if not environment.in_view(*goal):
        return int(environment.actions.right)
    column, row = environment.get_view_coords(*goal)
    if row < environment.agent_view_size - 1:
        return int(environment.actions.forward)
    sideways = column - environment.agent_view_size // 2
    return int(environment.actions.right if sideways > 0 else environment.actions.left)


def land(observation, **constants):
    """The expert of LunarLander-v3: Gymnasium's heuristic with other constants.

    The heuristic reaches the pad too fast and slides off it in one of ten episodes, because the legs
    have contact and it then stops steering. This one leans against the sideways speed earlier and
    descends later. The constants are those of a random search on the environment seeds 0 to 59.
    """
    urgency = land_urgency(observation, **constants)
    return max(urgency, key=urgency.get)


def land_urgency(observation, lean=(0.44, 0.75, 0.39), turning=(0.5, 0.96), lifting=(0.5, 0.7, 0.58), touching=0.5):
    """Returns how much each engine is needed by land(), and none of them: it takes the action that is needed most."""
    x, y, x_speed, y_speed, angle, angular_speed, left_leg, right_leg = observation
    wanted_angle = np.clip(lean[0] * x + lean[1] * x_speed, -lean[2], lean[2])
    turn = turning[0] * (wanted_angle - angle) - turning[1] * angular_speed
    lift = lifting[0] * (lifting[1] * abs(x) - y) - lifting[2] * y_speed
    if left_leg or right_leg:
        turn, lift = 0.0, -touching * y_speed
    return {NO_ENGINE: 0.05, LEFT_ENGINE: turn, RIGHT_ENGINE: -turn, MAIN_ENGINE: lift}


def gallop(observation):
    """The expert of HalfCheetah-v5 that ars.py found."""
    return linear_action("half-cheetah", observation)


def hop(observation):
    """The expert of Hopper-v5 that ars.py found."""
    return linear_action("hopper", observation)


def walk(observation):
    """The expert of Walker2d-v5 that ars.py found."""
    return linear_action("walker2d", observation)


def linear_action(name, observation):
    """Returns what a linear policy in the folder linear/ does, between -1 and 1."""
    mean, deviation, weights = linear_policy(name)
    return np.clip(weights @ ((observation - mean) / deviation), -1.0, 1.0).astype(np.float32)


@functools.cache
def linear_policy(name):
    """Reads mean [obs], deviation [obs] and weights [act, obs]."""
    policy = json.loads((LINEAR / f"{name}.json").read_text())
    return tuple(np.array(policy[key]) for key in ("mean", "deviation", "weights"))


def rock(observation):
    """The expert of MountainCarContinuous-v0: pushes in the direction of the speed."""
    return np.array([1.0 if observation[1] >= 0 else -1.0], np.float32)


TORQUES = np.linspace(-2.0, 2.0, 21)
DISTURBANCES = np.array([-1.0, 0.0, 0.0, 1.0])  # of a torque, with equal probability
EXECUTED = np.clip(TORQUES[:, None] + DISTURBANCES, -2.0, 2.0)


def swing_up(observation):
    """The expert `cautious` of `spiketrain` for Pendulum-v1: one step of lookahead on its value table.

    `spiketrain expert --env=Pendulum-v1 --expert=cautious --tables=DIR` writes the table; the environment variable
    SPIKETRAIN_TABLES names the folder.
    """
    cosine, sine, speed = np.asarray(observation, np.float64)
    angle = np.arctan2(sine, cosine)
    costs = angle**2 + 0.1 * speed**2 + 0.001 * EXECUTED**2
    speeds = np.clip(speed + (15.0 * sine + 3.0 * EXECUTED) * 0.05, -8.0, 8.0)
    values = (0.99 * pendulum_values(angle + 0.05 * speeds, speeds) - costs).mean(axis=1)
    return np.array([TORQUES[np.argmax(values)]], np.float32)


def pendulum_values(angles, speeds):
    """Interpolates the value table at angles and angular speeds of one shape."""
    table = pendulum_table()
    rows = (angles + np.pi) / (2 * np.pi) * len(table)
    columns = (speeds + 8.0) / 16.0 * (table.shape[1] - 1)
    row, column = np.floor(rows).astype(int), np.minimum(np.floor(columns).astype(int), table.shape[1] - 2)
    low, left = rows - row, columns - column
    row, above = row % len(table), (row + 1) % len(table)  # the angles go round
    below = table[row, column] * (1 - left) + table[row, column + 1] * left
    return below * (1 - low) + (table[above, column] * (1 - left) + table[above, column + 1] * left) * low


@functools.cache
def pendulum_table():
    """Reads the values, [angles, speeds]."""
    path = os.path.join(os.environ["SPIKETRAIN_TABLES"], "pendulum_cautious.safetensors")
    return safetensors.numpy.load_file(path)["values"]
