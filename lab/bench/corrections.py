#!/usr/bin/env python3
"""Plays changed tasks with an operator whose corrections teach the head, and prints what the head returns without him.

usage: lab/bench/corrections.py [--operator=intervenes] [--seeds=10] [--starts=20] [TASK...]

Needs spikeserve_engine, whose sessions learn as the server's do, bit for bit. In each seed, the policy first plays ALONE episodes
while the operator watches. Then he corrects, in whole episodes, until STEPS steps are his, or he has seen WATCHED; and
then he leaves the head alone for LATER episodes, which the guard judges. Each time, the head plays from starts that no operator has
seen, in a frozen session; from the same starts, the operator and the policy play alone. An operator

  intervenes  watches, and takes single steps: those on which what the head would do is not good enough for him (`matters`)
  flies       takes the first steps of an episode, all of them, until the steps are his

With --by_rewards nobody corrects, and rewards teach for as many steps, with the settings of lab/evidence/online-learning.md.
"""

import argparse
import glob
import itertools
import pathlib
import statistics
import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
from spikeserve_engine import Engine, Learning

ROOT = pathlib.Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "lab/recipes"))

from experts import land_urgency

POLICIES = ROOT / "deploy/policies"
ALONE = 5  # episodes before
STEPS = (25, 100, 1000)
WATCHED = 6000  # steps, with those that are corrected
LATER = 10  # episodes: as many as the guard needs to judge a head, and to try the one before
UNSEEN = 2_000_000


def shipped(name):
    return Engine(max(glob.glob(str(POLICIES / name / "*" / "policy.safetensors"))))


class Task:
    def execute(self, action):
        return action

    def matters(self, observation, answered, own):
        """Returns whether an operator who intervenes does so: `answered` is not good enough for him."""
        if np.ndim(own) == 0:
            return answered != own
        return np.max(np.abs(answered - own)) > 0.4  # a tenth of the pendulum's range


class ReversedCartPole(Task):
    """The motor pushes the other way. The operator balances by a linear rule."""

    policy = "cartpole"

    def make(self):
        self.env = gymnasium.make("CartPole-v1")
        return self.env

    def execute(self, action):
        return 1 - action

    def operator(self, observation, _):
        return 1 - int(np.dot([0.1, 0.3, 3.0, 1.0], observation) > 0)


class ReversedPendulum(Task):
    """The motor turns the other way. The operator does what the policy would with a motor that does not."""

    policy = "pendulum"

    def make(self):
        return gymnasium.make("Pendulum-v1")

    def execute(self, action):
        return -action

    def operator(self, observation, twin):
        return -twin.act(observation)


class HeavyPendulum(Task):
    """1.5 times the mass. The operator follows the value function of the heavy pendulum, on a grid."""

    policy = "pendulum"
    mass, torques = 1.5, np.linspace(-2, 2, 21)
    angles, speeds = np.linspace(-np.pi, np.pi, 141), np.linspace(-8, 8, 81)

    def __init__(self):
        angle, speed = np.meshgrid(self.angles, self.speeds, indexing="ij")
        self.value = np.zeros(angle.shape)
        for _ in range(300):
            self.value = np.min([self.cost(angle, speed, torque) for torque in self.torques], axis=0)

    def cost(self, angle, speed, torque):
        """Returns the cost of a step and what follows it, interpolated."""
        after = np.clip(speed + (15 * np.sin(angle) + 3 / self.mass * torque) * 0.05, -8, 8)
        turned = (angle + after * 0.05 + np.pi) % (2 * np.pi)
        a, b = turned / (2 * np.pi) * 140, (after + 8) / 16 * 80
        i, j = np.minimum(a.astype(int), 139), np.minimum(b.astype(int), 79)
        a, b = a - i, b - j
        corners = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
        places = [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)]
        following = sum(weight * self.value[place] for weight, place in zip(corners, places))
        return angle**2 + 0.1 * speed**2 + 0.001 * torque**2 + 0.99 * following

    def make(self):
        env = gymnasium.make("Pendulum-v1")
        env.unwrapped.m = self.mass
        return env

    def operator(self, observation, _):
        angle = np.arctan2(observation[1], observation[0])
        costs = self.cost(angle, np.full(21, observation[2]), self.torques)
        return np.array([self.torques[np.argmin(costs)]], np.float32)

    def matters(self, observation, answered, own):
        """If it costs more than 1 in the end, of the 160 or so that an episode costs."""
        angle, speed = np.arctan2(observation[1], observation[0]), observation[2]
        there, here = (self.cost(angle, speed, float(torque[0])) for torque in (answered, own))
        return there - here > 1.0


class WeakAcrobot(Task):
    """The motor has 0.6 of its torque. The operator looks 20 steps ahead for energy, which is no better than the policy."""

    policy = "acrobot"
    torque = 0.6
    plans = np.array(list(itertools.product((0, 1, 2), repeat=5)))

    def make(self):
        self.env = gymnasium.make("Acrobot-v1")
        self.env.unwrapped.AVAIL_TORQUE = [-self.torque, 0.0, self.torque]
        return self.env

    def operator(self, observation, _):
        first, second = (
            np.arctan2(observation[1], observation[0]),
            np.arctan2(observation[3], observation[2]),
        )
        state = np.tile(np.array([first, second, *observation[4:6]])[:, None], len(self.plans))
        energy, reached = (
            np.full(len(self.plans), -np.inf),
            np.full(len(self.plans), np.inf),
        )
        for step in range(20):
            state = self.following(state, self.torque * (self.plans[:, step // 4] - 1))
            first, second, speed1, speed2 = state
            is_up = -np.cos(first) - np.cos(first + second) > 1
            reached = np.where(is_up & np.isinf(reached), step, reached)
            kinetic = 0.625 * speed1**2 + 0.625 * (speed1 + speed2) ** 2 + 0.5 * speed1**2
            kinetic += 0.5 * speed1 * (speed1 + speed2) * np.cos(second)
            height = -1.5 * np.cos(first) - 0.5 * np.cos(first + second)
            energy = np.maximum(energy, kinetic + 9.8 * height)
        return int(self.plans[np.argmax(np.where(np.isinf(reached), energy, 1e6 - reached)), 0])

    def following(self, state, torque):
        """Returns the state after 0.2 s, by Runge and Kutta's method as Gymnasium has it."""
        changes, before = [], np.zeros_like(state)
        for part in (0.0, 0.1, 0.1, 0.2):
            before = self.change(state + part * before, torque)
            changes.append(before)
        return state + 0.2 / 6 * (changes[0] + 2 * changes[1] + 2 * changes[2] + changes[3])

    def change(self, state, torque):
        """Returns the derivative; the equations of Sutton and Barto's book, as Gymnasium has them."""
        first, second, speed1, speed2 = state
        d1 = 0.25 + 1.25 + np.cos(second) + 2
        d2 = 0.25 + 0.5 * np.cos(second) + 1
        phi2 = 4.9 * np.sin(first + second)
        phi1 = -0.5 * speed2**2 * np.sin(second) - speed2 * speed1 * np.sin(second) + 14.7 * np.sin(first) + phi2
        turn2 = (torque + d2 / d1 * phi1 - 0.5 * speed1**2 * np.sin(second) - phi2) / (1.25 - d2**2 / d1)
        return np.array([speed1, speed2, -(d2 * turn2 + phi1) / d1, turn2])


class WeakLander(Task):
    """The main engine has 0.7 of its power. The operator follows the expert's rule with constants for that, found by random search."""

    policy = "lunar-lander"
    power = 0.7

    def make(self):
        from gymnasium.envs.box2d import lunar_lander  # only this task needs Box2D

        lunar_lander.MAIN_ENGINE_POWER = 13.0 * self.power
        return gymnasium.make("LunarLander-v3")

    def urgency(self, observation):
        return land_urgency(
            observation, lean=(0.48, 0.75, 0.155), turning=(0.68, 1.06), lifting=(0.19, 0.22, 0.59), touching=0.3
        )

    def operator(self, observation, _):
        urgency = self.urgency(observation)
        return max(urgency, key=urgency.get)

    def matters(self, observation, answered, own):
        """If his own action is clearly more urgent: he lets pass what is a matter of taste."""
        urgency = self.urgency(observation)
        return urgency[own] - urgency[answered] > 0.1


class Spoiled(Task):
    """A task as the policy knows it, with an operator who spoils it."""

    random = np.random.default_rng(1)

    def make(self):
        return gymnasium.make(self.task)


class OppositeCartPole(Spoiled):
    policy, task = "cartpole", "CartPole-v0"

    def operator(self, observation, twin):
        return 1 - twin.act(observation)


class OppositePendulum(Spoiled):
    policy, task = "pendulum", "Pendulum-v1"

    def operator(self, observation, twin):
        return -twin.act(observation)


class RandomCartPole(Spoiled):
    policy, task = "cartpole", "CartPole-v0"

    def operator(self, _, twin):
        return int(self.random.integers(2))


class RandomPendulum(Spoiled):
    policy, task = "pendulum", "Pendulum-v1"

    def operator(self, _, twin):
        return self.random.uniform(-2, 2, 1).astype(np.float32)


CHANGED = (ReversedCartPole, ReversedPendulum, HeavyPendulum, WeakLander, WeakAcrobot)
SPOILED = (OppositeCartPole, OppositePendulum, RandomCartPole, RandomPendulum)
TASKS = {kind.__name__: kind for kind in CHANGED + SPOILED}


class Twin:
    """The policy as it is, beside the operator."""

    def __init__(self, engine):
        self.session, self.reward = engine.session(), 0.0

    def act(self, observation):
        return self.session.act(observation, self.reward).action


def play(task, engine, session, start, corrects=0, intervenes=False):
    """Plays an episode; an operator takes `corrects` of its steps. Returns the return, the corrected steps, and the summary."""
    env, twin = task.make(), Twin(engine)
    observation, _ = env.reset(seed=start)
    rewards, executed, corrected, over = [], None, 0, False
    while not over:
        action = session.act(observation, rewards[-1] if rewards else 0.0, executed_action=executed).action
        executed = None
        if corrected < corrects:
            own = task.operator(observation, twin)
            if not intervenes or task.matters(observation, action, own):
                action, corrected = own, corrected + 1
                executed = SimpleNamespace(action=own, kind=2, operator_id="anna")
        observation, reward, terminated, truncated, _ = env.step(task.execute(action))
        rewards.append(float(reward))
        twin.reward = rewards[-1]
        over = terminated or truncated
    summary = session.end_episode(rewards[-1], terminated, executed_action=executed)
    return sum(rewards), corrected, summary


def mean_return(task, engine, starts, delta=None, corrects=0):
    returns = [play(task, engine, engine.session(head_delta=delta), UNSEEN + i, corrects)[0] for i in range(starts)]
    return statistics.fmean(returns)


def learn(task, engine, seed, starts, operator):
    """Returns what the head returns after each number of STEPS and LATER, how many steps were corrected, and the rollbacks."""
    session = engine.session(learning=Learning(rule="corrections"))
    done, watched, after = 0, 0, []
    episodes = itertools.count(1000 * seed)

    def alone(count):
        for _ in range(count):
            play(task, engine, session, next(episodes))

    alone(ALONE)
    for steps in STEPS:
        while done < steps and watched < WATCHED:
            _, corrected, summary = play(task, engine, session, next(episodes), steps - done, operator == "intervenes")
            done, watched = done + corrected, watched + summary.steps
        after.append(mean_return(task, engine, starts, session.state().head_delta))
    alone(LATER)
    state = session.state()
    return *after, mean_return(task, engine, starts, state.head_delta), done, state.rollbacks


def learn_by_rewards(task, engine, seed, starts):
    """Returns what the head returns after each number of STEPS, played in whole episodes."""
    is_box = task.policy == "pendulum"
    learning = Learning(learning_rate=0.03 if is_box else None)
    session = engine.session(learning=learning, seed=seed, sample=True, temperature=1.0 if is_box else 4.0)
    done, after = 0, []
    episodes = itertools.count(1000 * seed)
    for steps in STEPS:
        while done < steps:
            done += play(task, engine, session, next(episodes))[2].steps
        after.append(mean_return(task, engine, starts, session.state().head_delta))
    return after


def main():
    parser = argparse.ArgumentParser(prog="lab/bench/corrections.py")
    parser.add_argument(
        "tasks", nargs="*", default=[kind.__name__ for kind in CHANGED], metavar="TASK", help=", ".join(TASKS)
    )
    parser.add_argument("--operator", choices=("intervenes", "flies"), default="intervenes")
    parser.add_argument("--by_rewards", action="store_true")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--starts", type=int, default=20, help="unseen ones of each evaluation")
    arguments = parser.parse_args()
    columns = [f"after {steps} steps" for steps in STEPS]
    if not arguments.by_rewards:
        columns += [f"{LATER} episodes later", "corrected steps", "rollbacks"]
    print(f"| task | the operator | the policy | {' | '.join(columns)} |")
    print("| --- | ---: | ---: | " + " | ".join(["---"] * len(columns)) + " |")
    for name in arguments.tasks:
        task = TASKS[name]()
        engine = shipped(task.policy)
        operated = mean_return(task, engine, arguments.starts, corrects=sys.maxsize)
        frozen = mean_return(task, engine, arguments.starts)
        runs = []
        for seed in range(1, arguments.seeds + 1):
            taught = (task, engine, seed, arguments.starts)
            runs.append(learn_by_rewards(*taught) if arguments.by_rewards else learn(*taught, arguments.operator))
        cells = []
        for values in map(sorted, zip(*runs)):
            cells.append(f"{statistics.median(values):.1f} ({values[0]:.1f} to {values[-1]:.1f})")
        print(f"| {name} | {operated:.1f} | {frozen:.1f} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
