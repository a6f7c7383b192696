"""Searches a linear policy from nothing, for environments with continuous actions: augmented random search, V2-t of
Mania, Guy and Recht (2018), "Simple random search provides a competitive approach to reinforcement learning".

    python lab/recipes/ars.py Hopper-v5 --out=hopper.json --steps=3000000

The search is saved after each iteration and goes on from there. The same command gives the same policy on one machine.
The file holds the best policy so far: the action is `weights` (observation - mean) / deviation, clipped to the action
space. experts.py plays it.
"""

import argparse
import dataclasses
import json
import pathlib

import gymnasium
import numpy as np

# Directions of an iteration, how many of them count, step size, size of a disturbance, and what a step earns by being
# alive, which the search does not count: it would reward standing still. From the paper's table 9.
SETTINGS = {
    "Hopper-v5": (8, 4, 0.01, 0.025, 1.0),
    "HalfCheetah-v5": (32, 4, 0.02, 0.03, 0.0),
    "Walker2d-v5": (40, 30, 0.03, 0.025, 1.0),
}
CHECK_EVERY, CHECKS = 20, 10  # iterations; episodes whose mean decides which policy is the best


@dataclasses.dataclass
class Moments:
    """Mean and variance of the observations so far, by Welford's method."""

    count: float
    mean: np.ndarray
    squares: np.ndarray

    def add(self, observations):
        rows = np.asarray(observations)
        count, mean = self.count + len(rows), rows.mean(0)
        delta = mean - self.mean
        self.squares += ((rows - mean) ** 2).sum(0) + delta**2 * self.count * len(rows) / count
        self.mean = self.mean + delta * len(rows) / count
        self.count = count

    def deviation(self):
        deviation = np.sqrt(self.squares / max(self.count - 1, 1))
        return np.where(deviation < 1e-7, 1.0, deviation)


@dataclasses.dataclass
class Rollout:
    """An episode. There is one observation more than actions and rewards."""

    seed: int
    observations: list
    actions: list = dataclasses.field(default_factory=list)
    rewards: list = dataclasses.field(default_factory=list)
    terminated: bool = False


def play(environment, weights, moments, seed):
    """Plays an episode."""
    mean, deviation = moments.mean, moments.deviation()
    low, high = environment.action_space.low, environment.action_space.high
    observation, _ = environment.reset(seed=int(seed))
    rollout, ended = Rollout(int(seed), [observation]), False
    while not ended:
        action = np.clip(weights @ ((observation - mean) / deviation), low, high)
        observation, reward, rollout.terminated, truncated, _ = environment.step(action)
        rollout.observations.append(observation)
        rollout.actions.append(action)
        rollout.rewards.append(reward)
        ended = rollout.terminated or truncated
    return rollout


class Search:
    """The search. A subclass can keep its rollouts."""

    def __init__(self, name, seed, checkpoint=None):
        self._environment = gymnasium.make(name)
        self._settings, self._seed, self._checkpoint = SETTINGS[name], seed, checkpoint
        actions, inputs = self._environment.action_space.shape[0], self._environment.observation_space.shape[0]
        self.weights, self.moments = np.zeros((actions, inputs)), Moments(0, np.zeros(inputs), np.ones(inputs))
        self.iteration, self.steps, self.best = 0, 0, None
        if checkpoint and checkpoint.exists():
            self._resume(np.load(checkpoint))

    def _resume(self, saved):
        self.weights, self.moments = saved["weights"], Moments(saved["count"].item(), saved["mean"], saved["squares"])
        self.iteration, self.steps = saved["iteration"].item(), saved["steps"].item()
        self.best = json.loads(saved["best"].item())

    def save(self):
        part = self._checkpoint.with_suffix(".part.npz")
        state = {"weights": self.weights, "iteration": self.iteration, "steps": self.steps, "best": json.dumps(self.best)}
        np.savez(part, **state, count=self.moments.count, mean=self.moments.mean, squares=self.moments.squares)
        part.replace(self._checkpoint)

    def played(self, rollout):
        """Is called with each rollout of an iteration."""

    def iterate(self):
        """Moves the weights along the directions that earn most."""
        directions, top, step, noise, alive = self._settings
        # The numbers of an iteration depend on nothing before, so a search that was interrupted draws the same.
        generator = np.random.default_rng([self._seed, self.iteration])
        deltas = generator.standard_normal((directions, *self.weights.shape))
        returns, seen = np.zeros((directions, 2)), []
        for row, delta in enumerate(deltas):
            for side, sign in enumerate((1, -1)):
                seed = generator.integers(1_000_000)
                rollout = play(self._environment, self.weights + sign * noise * delta, self.moments, seed)
                self.played(rollout)
                returns[row, side] = sum(rollout.rewards) - alive * len(rollout.rewards)
                seen += rollout.observations[:-1]
        chosen = np.argsort(-returns.max(1))[:top]
        gains = returns[chosen, 0] - returns[chosen, 1]
        self.weights = self.weights + step / (top * returns[chosen].std() + 1e-9) * np.tensordot(gains, deltas[chosen], 1)
        self.moments.add(seen)
        self.iteration, self.steps = self.iteration + 1, self.steps + len(seen)

    def check(self):
        """Keeps the policy if it is the best so far, on starts that no iteration used. Returns its mean return."""
        seeds = range(1_000_000, 1_000_000 + CHECKS)
        mean = float(np.mean([sum(play(self._environment, self.weights, self.moments, seed).rewards) for seed in seeds]))
        if self.best is None or mean > self.best["return"]:
            policy = {"mean": self.moments.mean, "deviation": self.moments.deviation(), "weights": self.weights}
            record = {"return": mean, "steps": self.steps, "seed": self._seed}
            self.best = record | {name: np.round(value, 6).tolist() for name, value in policy.items()}
        return mean


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", choices=SETTINGS)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--steps", type=int, required=True, help="of the environment, in all")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    search = Search(arguments.environment, arguments.seed, arguments.out.with_suffix(".npz"))
    while search.steps < arguments.steps:
        search.iterate()
        if search.iteration % CHECK_EVERY == 0:
            print(f"{search.steps} of {arguments.steps} steps: {search.check():.0f}, best {search.best['return']:.0f}", flush=True)
            lines = (f"{json.dumps(name)}: {json.dumps(value)}" for name, value in search.best.items())
            arguments.out.write_text("{\n" + ",\n".join(lines) + "\n}\n")
        search.save()


if __name__ == "__main__":
    main()
