"""Makes the datasets `medium`, `medium-replay` and `medium-expert` of a MuJoCo task, in the manner of D4RL, from nothing.

    python lab/recipes/offline_sets.py Hopper-v5 --out=build/sets --steps=100000

J. Fu et al., "D4RL: datasets for deep data-driven reinforcement learning" (2020): `medium` has the steps of a policy that was
trained to a third of the expert's return, `medium-replay` what its training played until then, and `medium-expert` as many steps
of the expert as of it. Theirs are of soft actor-critic, these are of the linear policies of ars.py, whose actions are disturbed
by noise. The folders are datasets of Minari, OUT/hopper-medium-v0 and so on; a set that exists is kept.
"""

import argparse
import contextlib
import json
import pathlib

import ars
import numpy as np
from experts import LINEAR, linear_policy
from spikeserve.imitation.datasets import write_dataset
from spikeserve.imitation.environments import EnvironmentFactory
from spikeserve.imitation.episodes import Choice, Episode, play

EXPERTS = {"Hopper-v5": "hopper", "HalfCheetah-v5": "half-cheetah", "Walker2d-v5": "walker2d"}
SETS = ("medium", "medium-replay", "medium-expert")
SHARE = 1 / 3  # of the expert's return, which `medium` has reached
NOISE = 0.1  # standard deviation of what is added to each action
CHECK_EVERY = 5  # iterations
FIRST_SEED = {"medium": 3_000_000, "expert": 3_500_000}  # starts that neither the search nor an evaluation uses


def names(environment):
    """Returns the names of the sets of an environment, in the order of SETS."""
    return [f"{EXPERTS[environment]}-{kind}-v0" for kind in SETS]


class RecordingSearch(ars.Search):
    """Keeps its rollouts as episodes, but not more than `limit` steps: then every second one, every fourth, and so on."""

    def __init__(self, name, seed, limit):
        super().__init__(name, seed)
        self.episodes, self._limit, self._stride, self._count = [], limit, 1, 0

    def played(self, rollout):
        if self._count % self._stride == 0:
            self.episodes.append(episode_of(rollout))
        self._count += 1
        while sum(episode.steps for episode in self.episodes) > self._limit:
            self.episodes, self._stride = self.episodes[::2], 2 * self._stride


def episode_of(rollout):
    numbers = [np.asarray(values, np.float32) for values in (rollout.observations, rollout.actions)]
    rewards = [float(reward) for reward in rollout.rewards]
    return Episode(
        rollout.seed, *map(list, numbers), rewards=rewards, terminated=rollout.terminated, truncated=not rollout.terminated
    )


class NoisyLine:
    """Plays a linear policy whose actions are disturbed: mean [obs], deviation [obs], weights [act, obs]."""

    def __init__(self, mean, deviation, weights):
        self._mean, self._deviation, self._weights = mean, deviation, weights

    def choose(self, rows):
        return [Choice(self._action(row)) for row in rows]

    def end(self, row):
        pass

    def _action(self, row):
        episode = row.episode
        noise = np.random.default_rng([episode.seed, episode.steps]).normal(0, NOISE, len(self._weights))
        action = self._weights @ ((episode.observations[-1] - self._mean) / self._deviation)
        return np.clip(action + noise, -1, 1).astype(np.float32)


def played_steps(factory, actor, first_seed, steps):
    """Returns episodes that have at least `steps` steps."""
    episodes = []
    seeds = iter(range(first_seed, first_seed + steps))
    for episode in play(factory.make, actor, seeds, environments=1):
        episodes.append(episode)
        if sum(episode.steps for episode in episodes) >= steps:
            return episodes
    return episodes


def expert_return(environment):
    """Returns the mean return of the expert on the starts of ars.py's checks."""
    return json.loads((LINEAR / f"{EXPERTS[environment]}.json").read_text())["return"]


def search_medium(environment, seed, limit):
    """Searches until the policy has a third of the expert's return."""
    search, wanted = RecordingSearch(environment, seed, limit), SHARE * expert_return(environment)
    while True:
        for _ in range(CHECK_EVERY):
            search.iterate()
        mean = search.check()
        print(f"{search.steps} steps: {mean:.0f} of {wanted:.0f}", flush=True)
        if mean >= wanted:
            return search


def make_sets(environment, out, steps, seed=1):
    """Makes the sets of an environment that the folder `out` lacks, of about `steps` steps each; `seed` is that of the search."""
    folders = [out / name for name in names(environment)]
    if all(folder.exists() for folder in folders):
        return
    factory = EnvironmentFactory(environment)
    search = search_medium(environment, seed, steps)
    line = NoisyLine(search.moments.mean, search.moments.deviation(), search.weights)
    expert = NoisyLine(*linear_policy(EXPERTS[environment]))
    medium = played_steps(factory, line, FIRST_SEED["medium"], steps)
    mixed = [
        *played_steps(factory, line, FIRST_SEED["medium"], steps // 2),
        *played_steps(factory, expert, FIRST_SEED["expert"], steps // 2),
    ]
    out.mkdir(parents=True, exist_ok=True)
    for folder, episodes in zip(folders, (medium, search.episodes, mixed), strict=True):
        print(f"{folder.name}: {figures_of(episodes)}", flush=True)
        if not folder.exists():
            with contextlib.closing(factory.make()) as made:
                write_dataset(folder, episodes, made, factory.name)


def figures_of(episodes):
    returns, steps = [episode.episode_return for episode in episodes], sum(episode.steps for episode in episodes)
    range_of = f"return {np.mean(returns):.1f} ± {np.std(returns):.1f}, at most {max(returns):.1f}"
    return f"{len(episodes)} episodes, {steps} steps, {range_of}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", choices=EXPERTS)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    parser.add_argument("--steps", type=int, required=True, help="of each set")
    parser.add_argument("--seed", type=int, default=1, help="of the search")
    arguments = parser.parse_args()
    make_sets(arguments.environment, arguments.out, arguments.steps, arguments.seed)


if __name__ == "__main__":
    main()
